"""The result: maps over the grid, and one number a region."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Layer, MeanOfMeans
from torchcover.coverage.blocks import BlockSums, KnownCells, Maps
from torchcover.coverage.bodies import BodySums
from torchcover.coverage.coverage_file import read_coverage, write_coverage
from torchcover.coverage.grid import BandFrame, BevGrid
from torchcover.coverage.measures import Measure, errors_of_cells, estimate_area, estimate_known, estimate_redundancy
from torchcover.coverage.quantity import RADIUS, by_area, over_known
from torchcover.coverage.redundancy import Redundancy, layers_of, redundancy_quantities
from torchcover.coverage.region_sums import PlaceNumbers, PlaceSums
from torchcover.coverage.regions import Places, Region, check_regions, regions_within, shown_places
from torchcover.coverage.summary import RegionSummary, summarise
from torchcover.estimation import Estimate, Quantity
from torchcover.files import write_atomically
from torchcover.notebooks import data_frame, data_set, small_html

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure


class Coverage:
    """Coverage maps of a run: what `CoverageMetric.compute` returns.

    It is kept of the K known cells, which a reference point has probed; arrays over all cells have the grid's shape
    (H, Y, X), are made when they are asked for, and are NaN with count 0 where nothing is known.

    Args:
        grid: Cells and height bands.
        thresholds: Detection thresholds in metres.
        max_radius: Saturation of the radius in metres.
        known: The known cells, with their steps and points.
        layers: What was measured of them, (K,) each: the mean radius, the detection at each threshold, then those of
            other aggregations.
        counts: What happened on the way, one number for each name in `COUNTS`.
        blocks: The sums in blocks of contiguous steps, if errors were asked for.
        area: The sums over the visible surface, if the reference points had square metres.
        regions: What `summary` gives numbers for, unless it is told others; the paper's `forward_regions()` that fit
            the grid if not given.
        places: The sums by area over `regions`, point by point; None if the reference points had no square metres.
        aggregated: What other aggregations than the mean of means say of `regions`, if there were any.
        redundancy: What each sensor of the rig adds, if the metric was told of the sensors.
        bodies: What the rig sees of bodies that were put beside the vehicle, if any were.

    Attributes:
        listed: The layers over the known cells, by the key of their quantity.
    """

    COUNTS: ClassVar[tuple[str, ...]] = (
        "steps",
        "empty_sensor_frames",
        "empty_reference_frames",
        "saturated_points",
        "inside_points",
        "outside_points",
        "no_ground_points",
    )

    def __init__(
        self,
        *,
        grid: BevGrid,
        thresholds: Sequence[float],
        max_radius: float,
        known: KnownCells,
        layers: Iterable[Layer],
        counts: Mapping[str, int],
        blocks: BlockSums | None = None,
        area: BlockSums | None = None,
        regions: Sequence[Region] | None = None,
        places: PlaceSums | None = None,
        aggregated: PlaceNumbers | None = None,
        redundancy: Redundancy | None = None,
        bodies: BodySums | None = None,
    ) -> None:
        self.grid = grid
        self.thresholds = tuple(thresholds)
        self.max_radius = max_radius
        self.known = known
        self.listed: Mapping[str, Layer] = {layer.quantity.key: layer for layer in layers}
        self.counts = dict(counts)
        self.blocks = blocks
        self.area = area
        self.regions = regions_within(grid) if regions is None else tuple(regions)
        self.places = places
        self.aggregated = aggregated
        self.redundancy = redundancy
        self.bodies = bodies
        self._estimates: dict[tuple[Region, str, Measure], Estimate] = {}

    def __repr__(self) -> str:
        known = f"{len(self.known.at) / self.grid.cells:.1%} of the cells known"
        return f"Coverage({self.grid.shape} cells, {self.counts['frames']} steps, {known})"

    def _repr_html_(self) -> str:
        return small_html([repr(self)], self.plot())

    def plot(self, layer: str | None = None, height: str | None = None) -> "Figure":
        """One layer in one height band, seen from above.

        Args:
            layer: A key of `layers`; the detection at the first threshold if not given.
            height: Name of the band; the first if not given.

        Returns:
            A figure of its own, outside pyplot.

        Raises:
            ValueError: There is no such layer or band.
        """
        from matplotlib.figure import Figure

        from torchcover.coverage.plotting import draw_coverage

        figure = Figure(figsize=(9.0, 4.5), layout="constrained")
        draw_coverage(self, figure.subplots(), layer, height)
        return figure

    def to_dataframe(self, regions: Sequence[Region] | None = None) -> "pandas.DataFrame":
        """The numbers of `scalars`, a row for each region of `summary` and height band, or body beside the vehicle.

        Raises:
            ModuleNotFoundError: pandas is not there.
        """
        rows, errors = self._rows(regions), self.blocks is not None
        return data_frame({"region": row.region, "height": row.height, **row.flat(errors=errors)} for row in rows)

    def to_xarray(self) -> "xarray.Dataset":
        """The maps: each layer, its standard error as `KEY_error`, `points` and `probed_steps`.

        Returns:
            Over `height`, names of bands, and `y_m` and `x_m`, the middles of the cells; NaN where nothing is known.

        Raises:
            ModuleNotFoundError: xarray is not there.
        """
        maps = {key: layer.values for key, layer in self.layers.items()}
        maps |= {f"{key}_error": values for key, values in self.errors.items()}
        maps |= {"points": self.points, "probed_steps": self.probed_steps}
        of_cells = {"y_m": self.grid.y_centres_m.numpy(), "x_m": self.grid.x_centres_m.numpy()}
        arrays = {key: values.cpu().numpy() for key, values in maps.items()}
        return data_set(arrays, {"height": list(self.grid.heights), **of_cells})

    @property
    def layers(self) -> Mapping[str, Layer]:
        """(H, Y, X) each, by the key of their quantity: `coverage.layers["radius_m"].values`."""
        return layers_of(self.listed, self.known)

    @property
    def probed_steps(self) -> Tensor:
        """(H, Y, X) int64 steps that had a reference point in the cell."""
        return self.known.spread(self.known.probed_steps, 0)

    @property
    def points(self) -> Tensor:
        """(H, Y, X) int64 reference points in the cell."""
        return self.known.spread(self.known.points, 0)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What there is one number of for each region: the mean radius, then the detection at each threshold."""
        return MeanOfMeans(self.thresholds).quantities

    @property
    def band_frame(self) -> BandFrame:
        """What the height bands are over: "ground", the local ground, or "vehicle", z of the vehicle frame."""
        return self.grid.band_frame

    @property
    def radius(self) -> Tensor:
        """(H, Y, X) float64 mean blind spot radius in metres."""
        return self.layers[RADIUS.key].values

    @property
    def detection(self) -> Tensor:
        """(T, H, Y, X) float64 detection probability at each threshold."""
        each = [self.known.spread(self.listed[quantity.key].values) for quantity in self.quantities[1:]]
        return torch.stack(each) if each else self.radius.new_empty((0, *self.grid.shape))

    @property
    def errors(self) -> Mapping[str, Tensor]:
        """Key of a quantity -> (H, Y, X) standard errors; NaN where too few blocks probed, empty without blocks."""
        return Maps(self.listed_errors, self.known.spread)

    @cached_property
    def listed_errors(self) -> Mapping[str, Tensor]:
        """Key of a quantity -> (K,) standard errors in the known cells."""
        if self.blocks is None:
            return {}
        errors = errors_of_cells(self.quantities, self.known, self.blocks)
        if self.area is not None:
            each = errors_of_cells(self.quantities, self.known, self.area)
            errors |= {by_area(one).key: each[one.key] for one in self.quantities}
        return errors

    def summary(self, regions: Sequence[Region] | None = None) -> list[RegionSummary]:
        """One row for each region and height band that tables show of it.

        Args:
            regions: Regions within the grid; `self.regions` if not given.

        Returns:
            Rows in the order of the regions, then of the bands.

        Raises:
            ValueError: A region reaches beyond the grid, or holds no cell centre.
        """
        wanted = self.regions if regions is None else regions
        return [summarise(self, *place) for place in shown_places(wanted, self.grid)]

    @property
    def measure(self) -> Measure:
        """What its numbers are means over: "area" if the reference points had square metres, else "cells"."""
        return "cells" if self.area is None else "area"

    def estimate(self, region: Region, height: str, measure: Measure | None = None) -> Estimate:
        """The numbers of one region in one band with what they become without each block, for errors of differences.

        Args:
            region: A region within the grid.
            height: Name of the band.
            measure: "area", the mean over the visible surface (`torchcover.coverage.measures.area_in_blocks`), or
                "cells", the paper's unweighted mean over the known cells. Not given: that of this result.

        Returns:
            That of `quantities`.

        Raises:
            ValueError: A region that reaches beyond the grid, or holds no cell centre; no such band; "area" of points
                without square metres, or of a region that was not asked for and whose edges are not those of cells.
        """
        key = region, height, measure or self.measure
        if key not in self._estimates:
            check_regions([region], self.grid)
            of_measure = estimate_area if key[2] == "area" else estimate_known
            self._estimates[key] = of_measure(self, region, height)
        return self._estimates[key]

    def estimate_aggregated(self, region: Region, height: str) -> Estimate:
        """The numbers of other aggregations in one region and band; unknown where the metric was not told of it."""
        if self.aggregated is None:
            return self.estimate(region, height)[:0]
        quantities, value, left_out = self.aggregated
        place = self.place_of(region, height)
        if place is None or self.blocks is None:
            return Estimate.of(quantities, torch.full_like(value[0], math.nan) if place is None else value[place])
        used = self.blocks.steps > 0
        return Estimate(quantities, value[place], left_out[used, place], self.blocks.steps[used])

    def estimate_of(self, key: str, region: Region, height: str) -> Estimate:
        """Any one number, by the name of its column in `summary.csv`.

        Args:
            key: "radius_m", "detection_0.4m"; "cells_detection_0.4m" over the known cells of a result by area;
                "radius_maximum_m" of an aggregation; "radius_m_without_roof" and "seen_by_two_0.4m" of redundancy.
            region: A region within the grid.
            height: Name of the band.

        Raises:
            ValueError: There is no such number; as `estimate`.
        """
        for quantities, estimate in self._estimators.items():
            for at, quantity in enumerate(quantities):
                if quantity.key == key:
                    return replace(estimate(region, height)[at : at + 1], quantities=(quantity,))
        there = [quantity.key for quantity in self.every_quantity]
        nearest = get_close_matches(key, there, n=1) or there
        raise ValueError(f"{key}: the result has no such number; it has {', '.join(nearest)}")

    @property
    def every_quantity(self) -> tuple[Quantity, ...]:
        """All that `estimate_of` has a number of."""
        return tuple(quantity for quantities in self._estimators for quantity in quantities)

    @property
    def _estimators(self) -> dict[tuple[Quantity, ...], Callable[[Region, str], Estimate]]:
        estimators: dict[tuple[Quantity, ...], Callable[[Region, str], Estimate]] = {self.quantities: self.estimate}
        if self.aggregated is not None:
            estimators[self.aggregated.quantities] = self.estimate_aggregated
        if self.measure == "area":
            estimators[tuple(map(over_known, self.quantities))] = partial(self.estimate, measure="cells")
        if self.redundancy is not None:
            own = redundancy_quantities(self.redundancy.sensors, self.thresholds)
            estimators[own] = lambda *place: estimate_redundancy(self, *place)[len(self.quantities) :]
        return estimators

    def scalars(self, regions: Sequence[Region] | None = None) -> dict[str, float]:
        """The summary as a flat dict for a logger, of the regions that `summary` takes.

        Returns:
            `"radius_m/20m/ground"`, `"detection_0.4m/20m/ground"`, `"observed_share/20m/ground"` and so on, and
            `"visible_m2/20m/ground"` if the reference points had square metres.
        """
        rows = self._rows(regions)
        return {key: value for row in rows for key, value in row.scalars(errors=self.blocks is not None).items()}

    def _rows(self, regions: Sequence[Region] | None) -> list[RegionSummary]:
        return [*self.summary(regions), *(self.bodies.summary() if self.bodies else ())]

    def save(self, path: str | Path) -> None:
        """Write everything to one `.npz` file, which NumPy reads too: lists over the known cells, and the blocks.

        What `load` gives back has the same numbers, errors and differences to the last bit.
        """
        write_atomically(Path(path), partial(write_coverage, self))

    @classmethod
    def load(cls, path: str | Path) -> "Coverage":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: No such file.
            IsADirectoryError: A folder.
            BadFileError: Not a coverage file, a damaged one, one of another version, or too large a one.
        """
        return cls(**read_coverage(path))

    def place_of(self, region: Region, height: str) -> int | None:
        """Which of `regions` and bands it is, region by region; None if it is none."""
        self.band_of(height)
        return Places(self.regions, self.grid).number_of(region, height)

    def cells_of(self, region: Region) -> Tensor:
        """(Y, X) bool: the cells of a region."""
        return region.mask(self.grid).to(self.known.at.device)

    def known_in(self, region: Region, height: str) -> Tensor:
        """(K,) bool: which of the known cells lie in a region in a band."""
        return self.known.within(self.cells_of(region), self.band_of(height))

    def band_of(self, height: str) -> int:
        """The number of a band; ValueError if there is none of this name."""
        if height not in self.grid.heights:
            raise ValueError(f"height {height!r}: the grid has {', '.join(self.grid.heights)}")
        return list(self.grid.heights).index(height)


# `torch.load` gives them back with weights_only=True, its default.
torch.serialization.add_safe_globals([Coverage, BlockSums, KnownCells, PlaceNumbers, PlaceSums])
torch.serialization.add_safe_globals([Layer, Quantity, Redundancy])
