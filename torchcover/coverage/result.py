"""The result: maps over the grid, and one number a region."""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage.blocks import Blocks
from torchcover.coverage.errors import cell_errors
from torchcover.coverage.estimate import Estimator, RegionEstimate, estimate_region, unseen_cells
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.regions import Region, forward_regions
from torchcover.coverage.summary import RegionNumbers, RegionSummary

FORMAT_VERSION = 1


class Coverage:
    """Coverage maps of a run: what `CoverageMetric.compute` returns.

    Arrays have the grid's shape (H, Y, X). An unknown cell, which no reference point ever probed, is NaN with count 0.

    Args:
        grid: Cells and height bands.
        thresholds: Detection thresholds in metres.
        max_radius: Saturation of the radius in metres.
        probed_steps: (H, Y, X) int64 steps that had a reference point in the cell.
        points: (H, Y, X) int64 reference points in the cell.
        radius: (H, Y, X) float64 mean blind spot radius in metres.
        detection: (T, H, Y, X) float64 detection probability at each threshold.
        maximum: (H, Y, X) largest radius in metres, if asked for.
        pooled: (H, Y, X) pooled mean radius in metres, if asked for.
        quantile_levels: Levels of `quantiles`.
        quantiles: (Q, H, Y, X) quantiles of the radius in metres, if asked for.
        blocks: The sums in blocks of contiguous steps, if errors were asked for.
        radius_error: (H, Y, X) standard error of `radius`, if errors were asked for; made from `blocks` if not given.
            NaN in cells that too few blocks probed.
        detection_error: (T, H, Y, X) standard error of `detection`, likewise.
        counts: What happened on the way, one number for each name in `COUNTS`.
    """

    COUNTS: ClassVar[tuple[str, ...]] = (
        "steps",
        "empty_sensor_steps",
        "empty_reference_steps",
        "saturated_points",
        "outside_points",
    )
    _ARRAYS: ClassVar[tuple[str, ...]] = (
        "probed_steps",
        "points",
        "radius",
        "detection",
        "radius_error",
        "detection_error",
        "maximum",
        "pooled",
        "quantiles",
    )

    def __init__(
        self,
        *,
        grid: BevGrid,
        thresholds: Sequence[float],
        max_radius: float,
        probed_steps: Tensor,
        points: Tensor,
        radius: Tensor,
        detection: Tensor,
        counts: Mapping[str, int],
        blocks: Blocks | None = None,
        radius_error: Tensor | None = None,
        detection_error: Tensor | None = None,
        maximum: Tensor | None = None,
        pooled: Tensor | None = None,
        quantile_levels: Sequence[float] = (),
        quantiles: Tensor | None = None,
    ) -> None:
        self.grid = grid
        self.thresholds = tuple(thresholds)
        self.max_radius = max_radius
        self.probed_steps = probed_steps
        self.points = points
        self.radius = radius
        self.detection = detection
        self.counts = dict(counts)
        self.blocks = blocks
        self.maximum = maximum
        self.pooled = pooled
        self.quantile_levels = tuple(quantile_levels)
        self.quantiles = quantiles
        self._given_errors = (radius_error, detection_error)
        self._estimates: dict[tuple[Region, str, Estimator], RegionEstimate] = {}

    def __repr__(self) -> str:
        known = float((self.probed_steps > 0).double().mean())
        return f"Coverage({self.grid.shape} cells, {self.counts['steps']} steps, {known:.1%} of the cells known)"

    @cached_property
    def radius_error(self) -> Tensor | None:
        """(H, Y, X) standard error of `radius` in metres; NaN where too few blocks probed, None without blocks."""
        return self._given_errors[0] if self.blocks is None else cell_errors(self.blocks.radius_sum, self.blocks)

    @cached_property
    def detection_error(self) -> Tensor | None:
        """(T, H, Y, X) standard error of `detection`, likewise."""
        if self.blocks is None:
            return self._given_errors[1]
        each = [cell_errors(sums, self.blocks) for sums in self.blocks.detection_sum.unbind(dim=1)]
        return torch.stack(each) if each else torch.zeros_like(self.detection)

    def summary(self, regions: Sequence[Region] | None = None) -> list[RegionSummary]:
        """One row for each region and height band.

        Args:
            regions: Regions within the grid; the paper's `forward_regions()` that fit the grid if not given.

        Returns:
            Rows in the order of the regions, then of the bands.

        Raises:
            ValueError: A region reaches beyond the grid, or holds no cell centre.
        """
        return [self._summarise(region, height) for region in self._regions(regions) for height in self.grid.heights]

    def estimate(self, region: Region, height: str, estimator: Estimator = "known") -> RegionEstimate:
        """The numbers of one region in one band with what they become without each block, for errors of differences.

        Args:
            region: A region within the grid.
            height: Name of the band.
            estimator: "known", the paper's unweighted mean over the known cells, or "completed", which adds those that
                more steps would make known (`torchcover.coverage.estimate.completed_mean`).

        Raises:
            ValueError: A region that reaches beyond the grid, or holds no cell centre; no such band.
        """
        if (region, height, estimator) not in self._estimates:
            self._estimates[region, height, estimator] = self._estimate(region, height, estimator)
        return self._estimates[region, height, estimator]

    def _estimate(self, region: Region, height: str, estimator: Estimator) -> RegionEstimate:
        cells = region.mask(self.grid).to(self.radius.device)
        if not cells.any():
            raise ValueError(f"region {region.name!r} holds no cell centre; the cell is {self.grid.cell:g} m")
        if height not in self.grid.heights:
            raise ValueError(f"height {height!r}: the grid has {', '.join(self.grid.heights)}")
        band = list(self.grid.heights).index(height)
        probed_steps = self.probed_steps[band][cells]
        means = torch.cat([self.radius[None, band], self.detection[:, band]])[:, cells]
        sums = (means * probed_steps).where(probed_steps > 0, 0.0)
        return estimate_region(probed_steps, sums, self.blocks, band, cells, estimator)

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
            if self.blocks is not None:
                flat[f"radius_error_m/{row.region}/{row.height}"] = row.radius_error_m
                for threshold, error in row.detection_error.items():
                    flat[f"detection_{threshold:g}m_error/{row.region}/{row.height}"] = error
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

    def _summarise(self, region: Region, height: str) -> RegionSummary:
        known, completed = self.estimate(region, height), self.estimate(region, height, "completed")
        probed_steps = self.probed_steps[list(self.grid.heights).index(height)].cpu()[region.mask(self.grid)]
        return RegionSummary(
            region=region.name,
            height=height,
            cells=len(probed_steps),
            known_cells=int((probed_steps > 0).sum()),
            unseen_cells=unseen_cells(probed_steps),
            **self._numbers(known),
            completed=RegionNumbers(**self._numbers(completed)),
        )

    def _numbers(self, estimate: RegionEstimate) -> dict[str, Any]:
        (radius_m, *detection), (radius_error_m, *detection_error) = estimate.value.tolist(), estimate.error.tolist()
        return {
            "radius_m": radius_m,
            "detection": dict(zip(self.thresholds, detection, strict=True)),
            "radius_error_m": radius_error_m,
            "detection_error": dict(zip(self.thresholds, detection_error, strict=True)),
        }


def _read_npz(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as parts:
        arrays = dict(parts)
    header: dict[str, Any] = json.loads(str(arrays.pop("header")))
    return header, arrays
