"""Objects, all together, by category and by range: what numbers about objects are given for."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from torchcover.detection import Boxes

CATEGORIES = ("car", "truck", "bus", "cyclist", "motorcycle", "pedestrian")
RANGE_BORDERS_M = (20.0, 40.0, 80.0)


class ObjectStrata:
    """All objects, those of each category, and those in each bin of range: [lo, hi) of the centre's, over ground.

    Args:
        categories: Names; objects of others are among all of them only.
        range_borders_m: Ascending, positive; the last bin is open.

    Raises:
        ValueError: A category that is named twice, borders out of order.

    Example:
        >>> ObjectStrata(("car",), (20.0, 40.0)).names
        ('', ':car', ':0-20m', ':20-40m', ':40m+')
    """

    def __init__(self, categories: Sequence[str], range_borders_m: Sequence[float]) -> None:
        self.categories = tuple(categories)
        self.range_borders_m = tuple(float(border) for border in range_borders_m)
        if len(set(self.categories)) < len(self.categories):
            raise ValueError(f"categories: each may be given once; got {', '.join(self.categories)}")
        if not all(low < high for low, high in pairwise((0.0, *self.range_borders_m))):
            raise ValueError(f"range_borders_m: ascending numbers > 0 are needed; got {self.range_borders_m}")

    @property
    def meaning(self) -> dict[str, object]:
        """What sums over them depend on."""
        return {"categories": self.categories, "range_borders_m": self.range_borders_m}

    @property
    def names(self) -> tuple[str, ...]:
        """What is appended to the name of a number; nothing for all objects."""
        lows = [f"{low:g}" for low in (0.0, *self.range_borders_m)]
        bins = [f":{low}-{high}m" for low, high in pairwise(lows)]
        return ("", *(f":{category}" for category in self.categories), *bins, f":{lows[-1]}m+")

    def members(self, boxes: Boxes) -> Tensor:
        """(strata, K) float64: 1 where an object is one of them."""
        device = boxes.yaw_rad.device
        of_category = [[category == name for category in boxes.categories] for name in self.categories]
        category = torch.tensor(of_category, dtype=torch.float64, device=device).view(len(self.categories), len(boxes))
        range_m = torch.linalg.vector_norm(boxes.centre_m[:, :2].double(), dim=1)
        borders = torch.tensor(self.range_borders_m, dtype=torch.float64, device=device)
        which = torch.bucketize(range_m, borders, right=True)
        bins = torch.nn.functional.one_hot(which, len(borders) + 1).T.double()
        return torch.cat([torch.ones_like(range_m)[None], category, bins])
