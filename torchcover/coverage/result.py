"""The result: maps over the grid, and one number a region."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage.grid import BevGrid
from torchcover.coverage.regions import Region, forward_regions

FORMAT_VERSION = 1


@dataclass(frozen=True)
class RegionSummary:
    """The numbers of one region in one height band.

    Args:
        region: Name of the region.
        height: Name of the height band.
        cells: Number of cells in the region.
        known_cells: How many of them a reference point has probed.
        radius_m: Unweighted mean blind spot radius over the known cells in metres; NaN if none is known.
        detection: Threshold in metres -> unweighted mean detection probability over the known cells.
    """

    region: str
    height: str
    cells: int
    known_cells: int
    radius_m: float
    detection: Mapping[float, float]

    @property
    def known_share(self) -> float:
        """Share of the region's cells that are known. The numbers are about this share, and biased when it is low."""
        return self.known_cells / self.cells


class Coverage:
    """Coverage maps of a run: what `CoverageMetric.compute` returns.

    Arrays have the grid's shape (H, Y, X). An unknown cell, which no reference point ever probed, is NaN with count 0.

    Args:
        grid: Cells and height bands.
        thresholds: Detection thresholds in metres.
        max_radius: Saturation of the radius in metres.
        frames: (H, Y, X) int64 steps that had a reference point in the cell.
        points: (H, Y, X) int64 reference points in the cell.
        radius: (H, Y, X) float64 mean blind spot radius in metres.
        detection: (T, H, Y, X) float64 detection probability at each threshold.
        maximum: (H, Y, X) largest radius in metres, if asked for.
        pooled: (H, Y, X) pooled mean radius in metres, if asked for.
        quantile_levels: Levels of `quantiles`.
        quantiles: (Q, H, Y, X) quantiles of the radius in metres, if asked for.
        counts: What happened on the way, one number for each name in `COUNTS`.
    """

    COUNTS: ClassVar[tuple[str, ...]] = (
        "steps",
        "empty_sensor_steps",
        "empty_reference_steps",
        "saturated_points",
        "outside_points",
    )
    _ARRAYS: ClassVar[tuple[str, ...]] = ("frames", "points", "radius", "detection", "maximum", "pooled", "quantiles")

    def __init__(
        self,
        *,
        grid: BevGrid,
        thresholds: Sequence[float],
        max_radius: float,
        frames: Tensor,
        points: Tensor,
        radius: Tensor,
        detection: Tensor,
        counts: Mapping[str, int],
        maximum: Tensor | None = None,
        pooled: Tensor | None = None,
        quantile_levels: Sequence[float] = (),
        quantiles: Tensor | None = None,
    ) -> None:
        self.grid = grid
        self.thresholds = tuple(thresholds)
        self.max_radius = max_radius
        self.frames = frames
        self.points = points
        self.radius = radius
        self.detection = detection
        self.counts = dict(counts)
        self.maximum = maximum
        self.pooled = pooled
        self.quantile_levels = tuple(quantile_levels)
        self.quantiles = quantiles

    def __repr__(self) -> str:
        known = float((self.frames > 0).double().mean())
        return f"Coverage({self.grid.shape} cells, {self.counts['steps']} steps, {known:.1%} of the cells known)"

    def summary(self, regions: Sequence[Region] | None = None) -> list[RegionSummary]:
        """One row for each region and height band.

        Args:
            regions: Regions within the grid; the paper's `forward_regions()` that fit the grid if not given.

        Returns:
            Rows in the order of the regions, then of the bands.

        Raises:
            ValueError: A region reaches beyond the grid, or holds no cell centre.
        """
        rows = []
        for region in self._regions(regions):
            mask = region.mask(self.grid).to(self.radius.device)
            if not mask.any():
                raise ValueError(f"region {region.name!r} holds no cell centre; the cell is {self.grid.cell:g} m")
            rows += [self._summarise(region, height, band, mask) for band, height in enumerate(self.grid.heights)]
        return rows

    def scalars(self, regions: Sequence[Region] | None = None) -> dict[str, float]:
        """The summary as a flat dict for a logger.

        Args:
            regions: As in `summary`.

        Returns:
            `"radius_m/20m/ground"`, `"detection_0.4m/20m/ground"`, `"known_share/20m/ground"` and so on.
        """
        flat = {}
        for row in self.summary(regions):
            flat[f"radius_m/{row.region}/{row.height}"] = row.radius_m
            for threshold, probability in row.detection.items():
                flat[f"detection_{threshold:g}m/{row.region}/{row.height}"] = probability
            flat[f"known_share/{row.region}/{row.height}"] = row.known_share
        return flat

    def save(self, path: str | Path) -> None:
        """Write everything to one compressed `.npz` file, which NumPy reads too."""
        arrays = {name: value.cpu().numpy() for name in self._ARRAYS if (value := getattr(self, name)) is not None}
        header = {
            "format": FORMAT_VERSION,
            "grid": {"x": self.grid.x, "y": self.grid.y, "cell": self.grid.cell, "heights": dict(self.grid.heights)},
            "thresholds": self.thresholds,
            "max_radius": self.max_radius,
            "quantile_levels": self.quantile_levels,
            "counts": self.counts,
        }
        with Path(path).open("wb") as file:
            np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "Coverage":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: No such file.
            ValueError: Not a coverage file, a damaged one, or one of a newer version.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path}: no such coverage file")
        try:
            header, arrays = _read_npz(path)
            version = header.pop("format")
            loaded = cls._from_parts(header, arrays) if version == FORMAT_VERSION else None
        except Exception as error:  # damage shows anywhere: in the zip, zlib, NumPy, JSON, or as a missing part
            raise ValueError(f"{path}: not a coverage file as Coverage.save writes it ({error})") from error
        if loaded is None:
            raise ValueError(f"{path}: coverage format {version}; this torchcover reads format {FORMAT_VERSION}")
        return loaded

    @classmethod
    def _from_parts(cls, header: dict[str, Any], arrays: dict[str, Any]) -> "Coverage":
        stored = header.pop("grid")
        heights = {name: (band[0], band[1]) for name, band in stored["heights"].items()}
        grid = BevGrid(x=tuple(stored["x"]), y=tuple(stored["y"]), cell=stored["cell"], heights=heights)
        for name, array in arrays.items():
            if array.shape[-3:] != grid.shape:
                raise ValueError(f"{name} has shape {array.shape}, the grid {grid.shape}")
        tensors: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
        return cls(grid=grid, **header, **tensors)

    def _regions(self, regions: Sequence[Region] | None) -> Sequence[Region]:
        if regions is not None:
            return regions
        (_, front), (right, left) = self.grid.x, self.grid.y
        fitting = [r for r in forward_regions() if self.grid.x[0] <= 0 and r.x[1] <= front and right <= r.y[0]]
        return [region for region in fitting if region.y[1] <= left]

    def _summarise(self, region: Region, height: str, band: int, mask: Tensor) -> RegionSummary:
        known = mask & (self.frames[band] > 0)
        return RegionSummary(
            region=region.name,
            height=height,
            cells=int(mask.sum()),
            known_cells=int(known.sum()),
            # The mean of no cell is NaN: unknown.
            radius_m=float(self.radius[band][known].mean()),
            detection={
                threshold: float(self.detection[at, band][known].mean()) for at, threshold in enumerate(self.thresholds)
            },
        )


def histogram_quantiles(histogram: Tensor, edges: Tensor, levels: Sequence[float]) -> Tensor:
    """Quantiles from weights in bins, linear within a bin.

    Args:
        histogram: (B, C) weight in each bin, one column a cell.
        edges: (B + 1,) bin edges, ascending; the last may be infinite.
        levels: Q levels in [0, 1].

    Returns:
        (Q, C) quantiles; infinite in the last bin if its upper edge is; NaN in a column without weight.
    """
    cumulative = histogram.cumsum(dim=0)
    total = cumulative[-1]
    rows = []
    for level in levels:
        target = total * level
        # The second condition matters at level 0: the least value lies in the first bin that has any weight.
        at = ((cumulative < target) | (cumulative == 0)).sum(dim=0).clamp(max=len(histogram) - 1)
        weight = histogram.gather(0, at[None])[0]
        below = cumulative.gather(0, at[None])[0] - weight
        share = ((target - below) / weight).nan_to_num(0.0).clamp(0, 1)
        low, high = edges[at], edges[at + 1]
        value = torch.where(high.isinf(), high, low + share * (high - low))
        rows.append(value.where(total > 0, math.nan))
    return torch.stack(rows)


def _read_npz(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as parts:
        arrays = dict(parts)
    header: dict[str, Any] = json.loads(str(arrays.pop("header")))
    return header, arrays
