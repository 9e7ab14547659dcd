"""k-cover: how much is seen by k sensors or more."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.contrib.frame_metric import WorldRatios, said
from torchcover.contrib.sights import rig_of
from torchcover.coverage import BevGrid, Region, check_regions
from torchcover.coverage.regions import Places
from torchcover.frames import Frame

AT_LEAST = (1, 2, 3)


class KCover(WorldRatios):
    """Share of the visible square metres within the threshold of k sensors of the rig or more.

    The binary cover with redundancy of the art gallery line (Vijay et al. 2021): of surface that the random reference
    sees instead of a list of cells, so that k = 1 is the detection by area.

    Args:
        grid: Cells and height bands.
        regions: Those that have numbers of their own.
        threshold_m: Distance within which a point counts as seen.
        at_least: Numbers of sensors, k; more than the rig has are covered nowhere.
        square_metres: Whether the share is one of square metres, which frames are then to have; else one of points.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.

    Raises:
        ValueError: k below 1, a threshold that is negative, regions that the grid does not hold. From `update`: points
            of unknown sensors; no square metres where they are wanted.

    Example:
        >>> grid = BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0)
        >>> frame = Frame({"rig": torch.zeros(2, 3)}, torch.tensor([[0.3, 0.0, 0.0]]), 0, "a",
        ...               sensor_points={"rig": {"left": 1, "right": 1, "rear": 0}})
        >>> metric = KCover(grid, (), square_metres=False)
        >>> metric.update(frame)
        >>> [one.value for one in metric.compute()]
        [1.0, 1.0, 0.0]
    """

    def __init__(
        self,
        grid: BevGrid,
        regions: Sequence[Region],
        threshold_m: float = 0.4,
        at_least: Sequence[int] = AT_LEAST,
        *,
        square_metres: bool = True,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in metres is needed; got {threshold_m}")
        if not at_least or any(least < 1 for least in at_least) or len(set(at_least)) < len(at_least):
            raise ValueError(f"at_least: different numbers of sensors from 1 on are needed; got {tuple(at_least)}")
        check_regions(regions, grid)
        places = Places(regions, grid)
        names = ["", *(f":{region.name}_{band}" for region in places.regions for band in grid.heights)]
        counted = "reference points, by square metres" if square_metres else "reference points"
        ratios = [
            said(f"k_cover_{k}_{threshold_m:g}m{name}", "share", counted, k=k, threshold_m=threshold_m)
            for k in at_least
            for name in names
        ]
        meaning = {
            "threshold_m": float(threshold_m),
            "at_least": tuple(at_least),
            "square_metres": square_metres,
            "grid": grid,
            "regions": places.regions,
        }
        super().__init__(ratios, meaning, **kwargs)
        self.places = places
        self.threshold_m = float(threshold_m)
        self.at_least = tuple(at_least)
        self.square_metres = square_metres
        self.sights.by_sensor = True

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        weights = frame.reference_weights if self.square_metres else frame.reference.new_ones(len(frame.reference))
        if weights is None:
            raise ValueError(
                f"frame {frame.name!r}: the square metres of its reference points (reference_weights) are needed; got "
                "none; for a share of the points use square_metres=False"
            )
        within = self.sights.of_sensors(frame, rig_of(frame, self.rig), self.threshold_m) <= self.threshold_m
        inside, of, cell = self.sights.bins(frame, self.places.grid)
        point = inside[of]
        sensors = within.sum(dim=0)[point]
        weight = weights.to(point.device)[point].double()
        seen = [weight * (sensors >= k) for k in self.at_least]
        values = torch.stack([torch.ones_like(weight), weight, *seen])
        place, of_place = self.places.of_points(frame.reference.to(point.device)[point], cell)
        in_places = values.new_zeros(len(values), self.places.count).index_add_(1, place, values[:, of_place])
        sums = torch.cat([values.sum(dim=1, keepdim=True), in_places], dim=1)
        count, base = (row.repeat(len(seen)) for row in sums[:2])
        return base, sums[2:].flatten(), count.long()
