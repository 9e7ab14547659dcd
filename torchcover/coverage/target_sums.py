"""Visibility of test targets around the vehicle: shares of free positions and of surface with detection."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage.grid import BevGrid
from torchcover.coverage.regions import Region
from torchcover.coverage.summary import RegionSummary
from torchcover.estimation import Estimate, Quantity
from torchcover.files import check_dtype_kind, guard_reader, parse_json, read_npz

# Names of the arrays in a coverage file: the header as JSON, then tensors in the order of the fields of `TargetSums`.
TARGET_ARRAYS = ("target_header", "target_frame_counts", "target_sums", "target_position_counts")


class TargetColumn(IntEnum):
    """Columns of the sums of a target in a region.

    Attributes:
        TRIED: Positions that were tried.
        FREE: Positions that were free.
        DETECTED: Free positions at which the target was detected.
        VISIBLE_M2: Area of the target that the reference positions observed, in square meters.
        DETECTED_M2: Area of it that was detected, in square meters.
    """

    TRIED = 0
    FREE = 1
    DETECTED = 2
    VISIBLE_M2 = 3
    DETECTED_M2 = 4


@dataclass(frozen=True, eq=False)
class TargetSums:
    """Sums over positions of test targets, which are placed one at a time, in B fine blocks of frames.

    Args:
        target_names: Names of the test targets.
        regions: Regions that contain the centers of the targets.
        detection_points: Smallest number of points with which a target counts as detected.
        threshold_m: Largest distance in meters from the surface of a target to a point on it.
        grid: Cells of the maps.
        frame_counts: (B,) int64 frames with targets in each block.
        sums: (B, targets, regions, 5) float64 sums by `TargetColumn`.
        position_counts: (targets, Y, X, 2) float64 free positions, and positions with detection.
    """

    target_names: tuple[str, ...]
    regions: tuple[Region, ...]
    detection_points: int
    threshold_m: float
    grid: BevGrid
    frame_counts: Tensor
    sums: Tensor
    position_counts: Tensor

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities of each region and target: the share of positions and the share of surface."""
        positions_title = f"free positions with {self.detection_points} points or more"
        surface_title = f"surface within {self.threshold_m:g} m of a point"
        positions_key = f"target_positions_{self.detection_points}_points"
        surface_key = f"target_surface_{self.threshold_m:g}m"
        return (
            Quantity(positions_key, positions_title, "share", lower_is_better=False),
            Quantity(surface_key, surface_title, "share", lower_is_better=False),
        )

    @property
    def region_targets(self) -> list[tuple[Region, str]]:
        """Pairs of region and target with numbers."""
        return [(region, target) for region in self.regions for target in self.target_names]

    def estimate(self, region: Region, target_name: str) -> Estimate:
        """Estimate the shares of a target in a region.

        Args:
            region: One of the regions.
            target_name: One of the targets.

        Returns:
            NaN if no position was free, or no surface was visible.
        """
        sums = self._get_sums(region, target_name)
        denominators = sums[:, [TargetColumn.FREE, TargetColumn.VISIBLE_M2]]
        numerators = sums[:, [TargetColumn.DETECTED, TargetColumn.DETECTED_M2]]
        return Estimate.from_ratios(self.quantities, denominators, numerators, self.frame_counts)

    def summarize(self) -> list[RegionSummary]:
        """Summarize each of `region_targets`; cells are tried positions, observed cells free ones."""
        rows = []
        for region, target in self.region_targets:
            tried, free, _, visible_m2, _ = self._get_sums(region, target).sum(dim=0).tolist()
            numbers = self.estimate(region, target).to_numbers(count=int(free), counted_items="free positions")
            rows.append(
                RegionSummary(
                    region=region.name,
                    band=target,
                    num_cells=int(tried),
                    observed_cells=int(free),
                    average="target_positions",
                    numbers=numbers,
                    cell_averages={},
                    visible_m2=visible_m2 / free if free else math.nan,
                )
            )
        return rows

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Convert to arrays by name, for `Coverage.save`; `read_target_sums` reads them."""
        header = {
            "target_names": self.target_names,
            "detection_points": self.detection_points,
            "threshold_m": self.threshold_m,
            "regions": [asdict(region) for region in self.regions],
            "grid": {"x_m": self.grid.x_m, "y_m": self.grid.y_m, "cell_m": self.grid.cell_m},
        }
        tensors = (self.frame_counts, self.sums, self.position_counts)
        arrays = {name: tensor.numpy() for name, tensor in zip(TARGET_ARRAYS[1:], tensors, strict=True)}
        return {TARGET_ARRAYS[0]: np.array(json.dumps(header)), **arrays}

    def _get_sums(self, region: Region, target_name: str) -> Tensor:
        return self.sums[:, self.target_names.index(target_name), self.regions.index(region)]


@guard_reader("saved test targets")
def read_target_sums(path: Path) -> TargetSums | None:
    """Read the sums of test targets from a coverage file.

    Args:
        path: File that `Coverage.save` wrote; it may come from an untrusted source.

    Returns:
        The sums; None if the file has none.

    Raises:
        BadFileError: The file is damaged or too large.
    """
    arrays = read_npz(path, partial(check_dtype_kind, "fiuU"), set(TARGET_ARRAYS).intersection)
    if not arrays:
        return None
    header: dict[str, Any] = parse_json(str(arrays[TARGET_ARRAYS[0]]))
    grid = BevGrid(**header.pop("grid"))
    names = tuple(header.pop("target_names"))
    regions = tuple(Region.from_record(record) for record in header.pop("regions"))
    frame_counts, sums, position_counts = (torch.from_numpy(arrays[name]) for name in TARGET_ARRAYS[1:])
    expected_shapes = (len(frame_counts), len(names), len(regions), len(TargetColumn)), (len(names), *grid.shape[1:], 2)
    shapes = tuple(sums.shape), tuple(position_counts.shape)
    if shapes != expected_shapes:
        raise ValueError(f"the sums of {len(names)} test targets have shapes {shapes}, not {expected_shapes}")
    return TargetSums(
        target_names=names,
        regions=regions,
        grid=grid,
        frame_counts=frame_counts,
        sums=sums,
        position_counts=position_counts,
        **header,
    )


class TargetMixture(NamedTuple):
    """Numbers of `TargetSums` as weighted means over scenarios with the same regions and targets.

    Args:
        parts: Weights that sum to 1, and sums of each scenario.
        region_targets: Pairs of region and target.
    """

    parts: Sequence[tuple[float, TargetSums]]
    region_targets: Sequence[tuple[Region, str]]

    @classmethod
    def from_parts(cls, parts: Sequence[tuple[float, TargetSums | None]]) -> "TargetMixture | None":
        """Mix the sums of scenarios.

        Args:
            parts: Weights that sum to 1, and sums of each scenario; None without test targets.

        Returns:
            The mixture; None if no scenario has test targets.

        Raises:
            ValueError: Two scenarios differ in regions or test targets.
        """
        weighted_sums = [(weight, sums) for weight, sums in parts if sums is not None]
        if not weighted_sums:
            return None
        region_targets = weighted_sums[0][1].region_targets
        is_equal = all(sums.region_targets == region_targets for _, sums in weighted_sums)
        if not is_equal or len(weighted_sums) < len(parts):
            raise ValueError("scenarios cannot be mixed: they differ in their test targets; use the same in all")
        return cls(weighted_sums, region_targets)

    def estimate(self, region: Region, target_name: str) -> Estimate:
        """Estimate the weighted mean of `TargetSums.estimate`.

        Args:
            region: As in `TargetSums.estimate`.
            target_name: As in `TargetSums.estimate`.
        """
        return Estimate.from_strata([(weight, sums.estimate(region, target_name)) for weight, sums in self.parts])

    def summarize(self) -> list[RegionSummary]:
        """Summarize as `TargetSums.summarize`; counts of positions are sums over all scenarios."""
        weights = [weight for weight, _ in self.parts]
        scenario_rows = zip(*(sums.summarize() for _, sums in self.parts), strict=True)
        mixed_rows = []
        for (region, target), rows in zip(self.region_targets, scenario_rows, strict=True):
            free = sum(row.observed_cells for row in rows)
            mixed_rows.append(
                replace(
                    rows[0],
                    num_cells=sum(row.num_cells for row in rows),
                    observed_cells=free,
                    numbers=self.estimate(region, target).to_numbers(count=free, counted_items="free positions"),
                    visible_m2=sum(weight * row.visible_m2 for weight, row in zip(weights, rows, strict=True)),
                )
            )
        return mixed_rows
