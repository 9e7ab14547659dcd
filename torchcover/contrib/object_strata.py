"""Objects, all together, by category and by range: what numbers about objects are given for."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from torchcover.detection import Boxes

CATEGORIES = ("car", "truck", "bus", "cyclist", "motorcycle", "pedestrian")
RANGE_BORDERS_M = (20.0, 40.0, 80.0)


class ObjectStrata:
    """All objects up to the last border, those of each category, and those in each bin of range, [lo, hi).

    An object's range is the distance of its centre from the vehicle's origin, over ground.

    `categories`: names; objects of others are among all of them only; `range_borders_m`: ascending, positive; what is
    farther than the last does not count. ValueError: a category that is named twice, borders out of order or none.

    Example:
        >>> ObjectStrata(("car",), (20.0, 40.0)).names
        ('', ':car', ':0-20m', ':20-40m')
    """

    def __init__(self, categories: Sequence[str], range_borders_m: Sequence[float]) -> None:
        self.categories = tuple(categories)
        self.range_borders_m = tuple(float(border) for border in range_borders_m)
        if len(set(self.categories)) < len(self.categories):
            raise ValueError(f"categories: each may be given once; got {', '.join(self.categories)}")
        if not self.range_borders_m or not all(low < high for low, high in pairwise((0.0, *self.range_borders_m))):
            raise ValueError(f"range_borders_m: ascending numbers > 0 are needed; got {self.range_borders_m}")

    @property
    def meaning(self) -> dict[str, object]:
        """What sums over them depend on."""
        return {"categories": self.categories, "range_borders_m": self.range_borders_m}

    @property
    def names(self) -> tuple[str, ...]:
        """What is appended to the name of a number; nothing for all objects."""
        bins = [f":{low:g}-{high:g}m" for low, high in pairwise((0.0, *self.range_borders_m))]
        return ("", *(f":{category}" for category in self.categories), *bins)

    def members(self, boxes: Boxes) -> Tensor:
        """(strata, K) float64: 1 where an object is one of them."""
        device = boxes.yaw_rad.device
        of_category = [[category == name for category in boxes.categories] for name in self.categories]
        category = torch.tensor(of_category, dtype=torch.float64, device=device).view(len(self.categories), len(boxes))
        range_m = torch.linalg.vector_norm(boxes.centre_m[:, :2].double(), dim=1)
        borders = torch.tensor(self.range_borders_m, dtype=torch.float64, device=device)
        bins = torch.nn.functional.one_hot(torch.bucketize(range_m, borders, right=True), len(borders) + 1).T.double()
        near = 1.0 - bins[-1]
        return torch.cat([near[None], category * near, bins[:-1]])
