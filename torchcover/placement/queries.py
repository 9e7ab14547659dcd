"""Queries of objectives around one vehicle, and the observers of `evaluate` that answer them for a rig."""

import math
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from torchcover.coverage import AGGREGATIONS, Aggregation, Average, BevGrid, CoverageSums, MeanOfMeans, Region
from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.coverage.quantity import RADIUS, make_detection_quantity, make_failure_quantity
from torchcover.estimation import Estimate
from torchcover.evaluation import CoverageObserver
from torchcover.evaluation.measuring import BLOCKS
from torchcover.geometry.arrays import Float64
from torchcover.placement.objective import THRESHOLD_M, Objective
from torchcover.simulation import Areas, RegionsOfInterest, Rig, SurfaceReference
from torchcover.simulation.regions_of_interest import RegionOfInterest

# Of the cells of a search.
CELL_M = 0.5
# What stands in a key for the sensor without which the number is worst.
ANY = "any"
SEEN_WITHIN = re.compile(r"(?:detection|sensors|make_redundancy_quantity)_(\d+(?:\.\d+)?)m")
# What is asked where nothing else is, for the steps.
FOR_STEPS = {"": Objective(region="20m", band="ground")}
FAILURE = re.compile(r"(.+)_without_(.+)")


class Queries(NamedTuple):
    """Objectives by name, and the regions, bands and thresholds that they query around one vehicle.

    Requirements of targets and encounters are not among them; `objective_names` are those of all, in order.
    The `grid` has cells of 0.5 m around these. Radii
    saturate at `max_radius_m`: as in `evaluate`, or at the largest threshold if no radius is asked for.
    """

    objectives: Mapping[str, Objective]
    regions: Mapping[str, Region]
    grid: BevGrid
    max_radius_m: float
    thresholds_m: tuple[float, ...]
    objective_names: tuple[str, ...]

    @classmethod
    def from_objectives(cls, ego_outline_m: Float64, objectives: Mapping[str, Objective]) -> Self:
        """Return the queries for a vehicle with (K, 2) corners x, y.

        ValueError: a region or a band that is none; two regions of one name; one that holds no cell centre.
        """
        usual = {region.name: region for region in RegionsOfInterest().build_query_plan(ego_outline_m).regions}
        regions, names = dict[str, Region](), tuple(objectives)
        objectives = {name: one for name, one in objectives.items() if not one.requirement} or FOR_STEPS
        for name, objective in objectives.items():
            try:
                for region in objective.resolve_regions(usual):
                    if regions.setdefault(region.name, region) != region:
                        raise ValueError(f"region {region.name!r}: another objective calls another region so")
            except ValueError as error:
                raise ValueError(f"objective {name!r}: {error}") from error
        bands = [band for objective in objectives.values() for _, band in objective.region_bands]
        written = {name: _written(region) for name, region in regions.items()}
        heights = {band: PAPER_HEIGHTS[band] for band in bands}
        grid = RegionsOfInterest(regions=written, heights=heights).build_query_plan(ego_outline_m, CELL_M).grid
        keys = [objective.key for objective in objectives.values()]
        thresholds = sorted({float(each) for key in keys for each in SEEN_WITHIN.findall(key)})
        within = all(SEEN_WITHIN.match(key) for key in keys) and max(thresholds) > 0
        max_radius_m = max(thresholds) if within else grid.diagonal_m
        grid = _around(grid, regions.values())
        return cls(objectives, regions, grid, max_radius_m, tuple(thresholds), names)

    @property
    def search_radius_m(self) -> float | None:
        """How near to a point of the reference all lies that can change a number; None if anything can."""
        return self.max_radius_m if self.max_radius_m in self.thresholds_m else None

    @property
    def areas(self) -> Areas:
        """Rectangles of whole cells around the regions: over known cells a cell counts as a whole."""
        each = (_around(self.grid, [region]) for region in self.regions.values())
        return tuple((own.x_m, own.y_m) for own in each)

    def build_reference_sensor(self, rays: int) -> SurfaceReference:
        """One that is aimed at what is asked about."""
        return SurfaceReference(
            self.areas, rays, bands_m=tuple(self.grid.heights.values()), band_frame=self.grid.band_frame
        )

    def mask_points(self, points: Tensor, heights_m: Tensor | None = None) -> Tensor:
        """Return (M,) bool: which of (M, 3) points lie in a queried region and band."""
        inside, of, cell = self.grid.assign_cells(points, heights_m)
        kept = torch.zeros(len(points), dtype=torch.bool, device="cpu")
        x, y, bands = *points[inside[of], :2].T, list(self.grid.heights)
        band, column = cell // (self.grid.num_cells // len(bands)), cell % (self.grid.num_cells // len(bands))
        for place in dict.fromkeys(place for objective in self.objectives.values() for place in objective.region_bands):
            region = self.regions[place[0]]
            own = (
                region.mask_points(x, y) | region.mask_cells(self.grid).view(-1)[column]
            )  # by area, or of a cell of it
            kept[inside[of[own & (band == bands.index(place[1]))]]] = True
        return kept

    def check(self, rig: Rig) -> None:
        """Refuse objectives that are numbers of no result of such a rig on its ego.

        ValueError: such a one; the message has the nearest name.
        """
        queries = self._replace(thresholds_m=self.thresholds_m or (THRESHOLD_M,))
        with warnings.catch_warnings(action="ignore"):  # that they were fed with nothing
            of_coverage = [one.key for one in queries.build_observer(rig, "area").compute().all_quantities]
        single = (RADIUS, *map(make_detection_quantity, queries.thresholds_m))
        others = [one.key for kind in AGGREGATIONS for one in kind.parse(kind.example).quantities]
        of_coverage += [one.key for one in (*single, *(make_failure_quantity(ANY, each) for each in single))] + others
        for name, objective in self.objectives.items():
            if objective.key not in of_coverage:
                near = get_close_matches(objective.key, of_coverage, n=1, cutoff=0.0)
                raise ValueError(f"objective {name!r}: no result has a number {objective.key!r}; near is {near[0]!r}")

    @property
    def aggregations(self) -> tuple[Aggregation, ...]:
        """Those whose numbers are asked for."""
        return tuple(one for kind in AGGREGATIONS if (one := kind.from_keys(set(self._keys))))

    @property
    def _keys(self) -> list[str]:
        return [objective.key for objective in self.objectives.values()]

    def build_observer(self, rig: Rig, average: Average) -> CoverageObserver:
        """Return an observer of the coverage of a rig, fed with nothing yet, for means by area or over known cells."""
        coverage = CoverageSums(
            self.grid,
            self.thresholds_m,
            max_radius_m=self.max_radius_m,
            num_blocks=BLOCKS,
            regions=tuple(self.regions.values()),
            aggregations=self.aggregations,
            sensor_names=tuple(sensor.name for sensor in rig.sensors) if any(map(_of_failures, self._keys)) else (),
            has_area_weights=average == "area",
        )
        return CoverageObserver(coverage, rig.name)

    def estimate(self, metric: CoverageSums, met_shares: Mapping[str, Estimate]) -> Estimate:
        """Return the objectives, each a quantity under its own name.

        Args:
            metric: That of `build_observer`, with the sums of all frames.
            met_shares: Name of an objective that is required of bodies -> share of the requirements that are met, the same in
                every block.
        """
        answers = self._answers(metric)
        steps = max((one.frame_counts for each in answers.values() for one in each), key=len)
        quantities, values, left_out = [], [], []
        for name in self.objective_names:
            each = answers.get(name) or [met_shares[name]]
            quantities.append(each[0].quantities[0]._replace(key=name))
            values.append(torch.cat([one.value for one in each]).mean())
            whole = all(len(one.jackknife_values) == len(steps) for one in each)
            unknown = torch.full((len(steps),), math.nan, dtype=torch.float64, device="cpu")
            known = torch.cat([one.jackknife_values for one in each], dim=1).mean(dim=1) if whole else unknown
            left_out.append(values[-1].expand(len(steps)) if name in met_shares else known)
        return Estimate(tuple(quantities), torch.stack(values), torch.stack(left_out, dim=1), steps)

    def _answers(self, metric: CoverageSums) -> dict[str, list[Estimate]]:
        """Return for each objective its number in each of its regions and bands."""
        plain = [quantity.key for quantity in MeanOfMeans(metric.thresholds_m).quantities]
        places = list(dict.fromkeys(place for one in self.objectives.values() for place in one.region_bands))
        if metric.has_area_weights and all(key in plain for key in self._keys):
            by_area = metric.estimate_regions([(self.regions[region], band) for region, band in places], "area")
            found = dict(zip(places, by_area, strict=True))

            def number(key: str, place: tuple[str, str]) -> Estimate:
                at = [quantity.key for quantity in found[place].quantities].index(key)
                return found[place][at : at + 1]
        else:
            coverage = metric.compute()

            def number(key: str, place: tuple[str, str]) -> Estimate:
                key = key if metric.has_area_weights else key.removeprefix("known_")
                return coverage.estimate_number(key, self.regions[place[0]], place[1])

        def answer(key: str, place: tuple[str, str]) -> Estimate:
            alone, sensor = failed.groups() if (failed := FAILURE.match(key)) else (key, "")
            if sensor == ANY:
                worst = _worst([number(f"{alone}_without_{one}", place) for one in metric.sensor_names])
                title = worst.quantities[0].title.removesuffix(metric.sensor_names[0]) + "any one sensor"
                return replace(worst, quantities=(worst.quantities[0]._replace(title=title),))
            return number(
                key if sensor in ("", *metric.sensor_names) else alone, place
            )  # what is not there cannot fail

        return {name: [answer(one.key, place) for place in one.region_bands] for name, one in self.objectives.items()}


def _of_failures(key: str) -> bool:
    """Whether only a metric that is told of the sensors gives the number."""
    return FAILURE.match(key) is not None or not key.startswith(("radius", "detection", "known_"))


def _worst(each: Sequence[Estimate]) -> Estimate:
    """The worst of one number of several rigs, and so without each block."""
    quantity = each[0].quantities[0]
    value, left_out = (
        torch.stack(parts) for parts in zip(*((one.value, one.jackknife_values) for one in each), strict=True)
    )
    worst: Any = torch.amax if quantity.lower_is_better else torch.amin
    return Estimate(each[0].quantities, worst(value, dim=0), worst(left_out, dim=0), each[0].frame_counts)


def _written(region: Region) -> RegionOfInterest:
    if region.corners_m:
        return RegionOfInterest(polygon_m=region.corners_m)
    return RegionOfInterest(x_m=region.x_m, y_m=region.y_m)


def _around(grid: BevGrid, regions: Collection[Region]) -> BevGrid:
    """The part of a grid that holds some regions: the same cells, but fewer."""

    def outside(edges: Tensor, bounds: Sequence[tuple[float, float]]) -> tuple[float, float]:
        low, high = min(low for low, _ in bounds), max(high for _, high in bounds)
        return float(edges[edges <= low].max()), float(edges[edges >= high].min())

    x, y = outside(grid.x_edges_m, [one.x_m for one in regions]), outside(grid.y_edges_m, [one.y_m for one in regions])
    return BevGrid(x, y, grid.cell_m, grid.heights, grid.band_frame)
