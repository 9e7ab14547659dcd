"""Selection of sensors from many candidates, with a test of the selection on held-out scenes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchcover import __version__
from torchcover.coverage import Average
from torchcover.coverage.quantities import make_detection_quantity
from torchcover.coverage.regions import RegionBands
from torchcover.estimation import Number
from torchcover.evaluation.progress import Progress
from torchcover.evaluation.result_notes import describe_sensor_models
from torchcover.frames import Frame
from torchcover.geometry.arrays import Bools, Float64
from torchcover.neighbors import nearest
from torchcover.placement.common_frames import CommonFrames
from torchcover.placement.report_files import PlacementReport, ReportMixin
from torchcover.placement.selection_solver import (
    CandidateCoverage,
    SelectionLimits,
    SensorSelection,
    SolverParams,
    sample_selections,
    select_for_objectives,
    select_sensors,
)
from torchcover.placement.selection_space import SelectionSpace
from torchcover.placement.validation import HeldOutImprovement, ValidationResult, describe_improvement, validate
from torchcover.report import PageTable, SelectionSize, TextCell, build_file_stems, plot_selection_sizes
from torchcover.simulation import Rig, Sensor
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME


@dataclass(frozen=True, eq=False, repr=False)
class SelectionResult(ReportMixin):
    """Result of `run_selection`. Its plot `sizes.png` shows the objective against the number of sensors.

    Args:
        space: The selection space.
        average: Average of the numbers, "area" or "cells".
        sensor_model: Sensor model, "ideal" or "real".
        sensors: Candidates that can be mounted.
        excluded: Name of each other candidate -> reason.
        coverage: Coverage of `sensors`.
        limits: Limits of the selection.
        selections: The best of one objective; of several the compromise and then the best of each.
        numbers: Scores of the rig of the first selection, from the same observers as `evaluate`.
        sampled_selections: Random selections, sorted by the first objective in ascending order.
        baseline: Indices of the candidates that the selection is compared with.
        test: Validation on held-out scenes; None without a test.
        no_test_reason: Reason why there is no test; empty if there is one.
    """

    space: SelectionSpace
    average: Average
    sensor_model: str
    sensors: tuple[Sensor, ...]
    excluded: dict[str, str]
    coverage: CandidateCoverage
    limits: SelectionLimits
    selections: tuple[SensorSelection, ...]
    numbers: dict[str, Number]
    sampled_selections: tuple[SensorSelection, ...]
    baseline: tuple[int, ...]
    test: ValidationResult | None = None
    no_test_reason: str = ""

    @property
    def best(self) -> SensorSelection:
        """The first selection: the best, or the compromise."""
        return self.selections[0]

    @cached_property
    def rig(self) -> Rig:
        """Rig of the first selection."""
        return self.build_rig(self.best.selected, f"{self.space.name}_best")

    def build_rig(self, selected: tuple[int, ...], name: str) -> Rig:
        """Build the rig of a selection.

        Args:
            selected: Indices of the candidates.
            name: Name of the rig.
        """
        return self.space.build_rig(tuple(self.sensors[index] for index in selected), name)

    def get_sensor_names(self, selected: tuple[int, ...]) -> tuple[str, ...]:
        """Return the names of the sensors of a selection.

        Args:
            selected: Indices of the candidates.
        """
        return tuple(self.sensors[index].name for index in selected)

    @cached_property
    def failure_effects(self) -> dict[int, float]:
        """Index of each selected sensor -> loss of the first objective when it fails."""
        effects = self.coverage.compute_failure_effects(self.best.selected)[:, 0].tolist()
        return dict(zip(self.best.selected, effects, strict=True))

    @property
    def improvements(self) -> tuple[HeldOutImprovement, ...]:
        """Improvements of the first selection on held-out scenes; empty without a test."""
        return self.test.improvements["best"] if self.test else ()

    @property
    def summary(self) -> str:
        """Summary: selected sensors, their score, and the improvement on held-out scenes."""
        values = ", ".join(f"{100 * self.numbers[name].value:.2f} %" for name in self.space.objectives)
        sensors = f"{', '.join(self.get_sensor_names(self.best.selected))}: {values}, {self._describe_optimality()}"
        (model,) = describe_sensor_models({self.rig.name: self.sensor_model})
        if self.test is None:
            return f"{sensors}; not validated on held-out scenes: {self.no_test_reason}. {model}"
        texts = []
        for improvement in self.improvements[: len(self.space.objectives)]:
            texts.append(f"{improvement.objective}: {describe_improvement(improvement, optimism=True)}")
        baseline = ", ".join(self.get_sensor_names(self.baseline))
        return f"{sensors}. Compared with {baseline}: {'; '.join(texts)}. {self.test.summary}. {model}"

    def _describe_optimality(self) -> str:
        """Describe how far the selection may be from the optimum, and its shortfalls."""
        is_single = len(self.selections) == 1
        if self.best.shortfall:
            shortfalls = (np.array(self.limits.min_values) - self.best.values).tolist()
            texts = []
            for name, shortfall in zip(self.space.scored_objectives, shortfalls, strict=True):
                if shortfall > SolverParams.tolerance:
                    texts.append(f"{100 * shortfall:.2f} points of {name}")
            return f"no selection meets all bounds, and this one has the smallest shortfall: {'; '.join(texts)}"
        if self.best.is_proven:
            return "proven optimal" if is_single else f"compromise between {', '.join(self.space.objectives)}"
        return f"at most {100 * self.best.gap:.2f} points below the optimum" if is_single else "not proven optimal"

    @property
    def report(self) -> PlacementReport:
        """Tables, files and plots of the result."""
        headings = ("sensor", "alone (%)", "effect of failure\n(points)", "cost (EUR)")
        table = PageTable(f"{self.space.name}: {len(self.sensors)} candidates", headings, self._build_rows(), 1)
        record = self._record
        rigs = {"best.yaml": self.rig}
        stems = build_file_stems(list(self.space.objectives))
        for stem, selection in zip(stems, self.selections[1:], strict=False):
            rigs[f"best_{stem}.yaml"] = self.build_rig(selection.selected, f"{self.space.name}_{stem}")
        baseline = self.build_rig(self.baseline, f"{self.space.name}_baseline")
        return PlacementReport(
            title=f"{self.space.name}: sensor selection",
            summary=self.summary,
            record=record,
            setting_names=[name for name in record if name != "torchcover"],
            rigs=rigs,
            page_rigs={"best": self.rig, "baseline": baseline},
            tables=[table, *([self.test.table] if self.test else ())],
            csv_tables={"candidates.csv": self._yield_candidates(), "sizes.csv": [SelectionSize._fields, *self._sizes]},
            render_plots=self._render_plots,
            ego_outline_m=self.space.scenarios[0].compute_ego_box().outline_m,
        )

    def __repr__(self) -> str:
        return f"SelectionResult in {self.space.name}: {self.summary}"

    @property
    def _record(self) -> dict[str, Any]:
        """Build the content of search.json."""
        improvements = {f"{item.objective}, {item.average}": item.record for item in self.improvements}
        sampled_values = [selection.values[0] for selection in self.sampled_selections]
        return {
            "torchcover": __version__,
            "space": self.space.name,
            "average": self.average,
            "sensor_model": self.sensor_model,
            "band_frame": DEFAULT_BAND_FRAME,
            "selections": [self._record_selection(selection) for selection in self.selections],
            "standard_errors": {name: number.error for name, number in self.numbers.items()},
            "failure_effects": {self.sensors[index].name: effect for index, effect in self.failure_effects.items()},
            "sampled_selections": {
                "count": len(sampled_values),
                "median": sampled_values[len(sampled_values) // 2],
                "best": sampled_values[-1],
                "share_below_best": float(np.mean(np.array(sampled_values) < self.best.values[0])),
            },
            "baseline": {
                "sensors": self.get_sensor_names(self.baseline),
                "values": self.coverage.compute_values(self.baseline).tolist(),
            },
            "improvements": improvements or None,
            "side_effects": self.test and self.test.record,
            "excluded": self.excluded,
        }

    def _record_selection(self, selection: SensorSelection) -> dict[str, Any]:
        """Build the record of one selection for search.json."""
        return {
            "sensors": self.get_sensor_names(selection.selected),
            "values": dict(zip(self.space.scored_objectives, selection.values, strict=True)),
            "gap": selection.gap,
            "is_proven": selection.is_proven,
            "shortfall": selection.shortfall,
            "cost_eur": self._compute_price_eur(selection.selected),
        }

    def _yield_candidates(self) -> Iterator[Sequence[object]]:
        """Yield the headings, and a row for each candidate: values are shares, together with the fixed sensors."""
        yield ["name", "value_alone", "cost_eur", "selected", "failure_effect", "reason"]
        for index, sensor in enumerate(self.sensors):
            value = float(self.coverage.compute_values([index])[0])
            effect = self.failure_effects.get(index)
            yield [sensor.name, value, self._compute_price_eur([index]), effect is not None, effect, ""]
        for name, reason in self.excluded.items():
            yield [name, "", "", False, "", reason]

    def _build_rows(self) -> list[tuple[TextCell, ...]]:
        """Build a row for each selected sensor, the largest effect of failure first."""
        rows = []
        for index in sorted(self.failure_effects, key=self.failure_effects.__getitem__, reverse=True):
            price_eur = self._compute_price_eur([index])
            texts = (
                self.sensors[index].name,
                f"{100 * self.coverage.compute_values([index])[0]:.2f}",
                f"{100 * self.failure_effects[index]:.2f}",
                "-" if price_eur is None else f"{price_eur:g}",
            )
            rows.append(tuple(TextCell(text) for text in texts))
        return rows

    def _compute_price_eur(self, selected: Sequence[int]) -> float | None:
        return self.limits.compute_price_eur(selected) if self.space.prices_eur else None

    @cached_property
    def _sizes(self) -> list[SelectionSize]:
        """Best selections of 1 to 12 sensors by the first objective, as far as they exist."""
        sizes = []
        params = SolverParams(time_limit_s=5.0)  # one minute for all sizes
        for size in range(1, min(self.limits.max_sensors, 12) + 1):
            selection = select_sensors(self.coverage, replace(self.limits, max_sensors=size), params=params)
            if len(selection.selected) == size and not selection.shortfall:
                value = selection.values[0]
                sizes.append(SelectionSize(size, value, value + selection.gap))
        return sizes

    def _render_plots(self) -> Iterator[tuple[str, str, Figure]]:
        """Yield the plot of the objective against the number of sensors."""
        sampled_values = [selection.values[0] for selection in self.sampled_selections]
        num_sensors, value = len(self.best.selected), self.best.values[0]
        figure = plot_selection_sizes(self._sizes, sampled_values, num_sensors, value, title=self.space.name)
        yield "sizes", "Objective against the number of sensors, and of random selections", figure


def run_selection(
    space: SelectionSpace, frames: CommonFrames, *, test_seed: int, num_held_out_scenes: int, progress: bool = False
) -> SelectionResult:
    """Find the best selection of candidates, and compare it with the baseline on held-out scenes.

    Each candidate is scanned once in each frame. The radius of several sensors is the smallest of their radii, so that
    a selection detects the union of the points that its sensors detect. Noise and drop-out of a sensor depend on its
    position in the list of a rig, so that the rig of the selection has other random values than its candidates.

    Args:
        space: Candidates and constraints.
        frames: Frames of the scenarios and objectives of the space.
        test_seed: Seed of the held-out scenes.
        num_held_out_scenes: Number of held-out scenes of each scenario.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: No candidate can be mounted or improves an objective, a candidate of the baseline cannot be mounted,
            or the sensor model is "real" and no selected sensor has known range limits.
    """
    sensors, observed, excluded = _observe_candidates(space, frames, progress=progress)
    base_mask = observe_points(space.fixed_rig, frames)[0] if space.fixed_rig else np.zeros_like(observed[0])
    coverage = CandidateCoverage.from_points(compute_point_weights(frames), observed, base_mask)
    indices = {sensor.name: index for index, sensor in enumerate(sensors)}
    if missing := [name for name in space.baseline or () if name not in indices]:
        raise ValueError(f"baseline: {missing[0]} cannot be mounted: {excluded[missing[0]]}")
    baseline = tuple(indices[name] for name in space.baseline or ())
    space_indices = {sensor.name: index for index, sensor in enumerate(space.sensors)}
    limits = space.build_limits([space_indices[sensor.name] for sensor in sensors])
    minimum = []
    for name, value in zip(space.scored_objectives, coverage.compute_values(baseline).tolist(), strict=True):
        minimum.append(-np.inf if name in space.objectives else space.bounds.get(name, value))
    limits = replace(limits, min_values=minimum)
    selections = select_for_objectives(coverage, limits, len(space.objectives))
    if not selections[0].selected:
        raise ValueError(
            f"candidates: none of the {len(sensors)} that can be mounted improves the objective; move or turn them, or "
            "choose regions that they observe"
        )
    # 1,000 random selections show the value of the solver within a percent of their distribution.
    sampled = sample_selections(coverage, limits, 1000, frames.seed)
    sampled.sort(key=lambda selection: selection.values[0])
    rig = space.build_rig(tuple(sensors[index] for index in selections[0].selected), f"{space.name}_best")
    result = SelectionResult(
        space,
        frames.average,
        rig.apply_sensor_model(frames.sensor_model).sensor_model,
        sensors,
        excluded,
        coverage,
        limits,
        tuple(selections),
        frames.score(rig).estimate.to_numbers(),
        tuple(sampled),
        baseline or sampled[len(sampled) // 2].selected,
    )
    return _validate_result(result, frames, test_seed, num_held_out_scenes)


def observe_points(rig: Rig, frames: CommonFrames) -> tuple[Bools, float]:
    """Find the reference points that a rig detects.

    Args:
        rig: The rig.
        frames: Frames with P reference points in total and T thresholds.

    Returns:
        (T * P,) bool, threshold by threshold; and the share of self hits.
    """
    queries, ray_count, self_hit_count = frames.queries, 0, 0
    masks: list[list[Bools]] = [[] for _ in queries.thresholds_m]
    for frame in frames.iterate_frames(rig):
        for threshold_m, threshold_masks in zip(queries.thresholds_m, masks, strict=True):
            points = frame.get_cloud(max_error_m=threshold_m)
            distance_m = nearest(frame.reference, points, max_distance=queries.max_radius_m).distance
            threshold_masks.append((distance_m <= threshold_m).numpy())
        ray_count += frame.counts["rays"]
        self_hit_count += frame.counts["self_hits"]
    return np.concatenate([np.concatenate(frame_masks) for frame_masks in masks]), self_hit_count / ray_count


def compute_point_weights(frames: CommonFrames) -> Float64:
    """Compute the weight of each reference point in each number, so that sums equal the numbers of `CoverageMetric`.

    By area, the weight is the share of the visible area. Over observed cells it is the share of the area in the cell
    and frame, divided by the number of frames that observe the cell and by the number of observed cells. Weights are 0
    for thresholds other than that of the number.

    Args:
        frames: Frames with P reference points in total, Q objectives and T thresholds.

    Returns:
        (Q, T * P) float64.

    Raises:
        ValueError: No frame contains a surface in a region and band.
    """
    queries, reference = frames.queries, list(frames.iterate_frames())
    keys = [make_detection_quantity(threshold_m).key for threshold_m in queries.thresholds_m]
    point_count = sum(len(frame.reference) for frame in reference)
    weights = np.zeros((len(queries.objectives), len(keys), point_count))
    for row, (name, objective) in zip(weights, queries.objectives.items(), strict=True):
        for region, band in objective.region_bands:
            part = _compute_region_weights(region, band, name, frames, reference)
            row[keys.index(objective.key)] += part / len(objective.region_bands)
    return weights.reshape(len(weights), -1)


def _compute_region_weights(
    region_name: str, band: str, objective_name: str, frames: CommonFrames, reference: Sequence[Frame]
) -> Float64:
    """Compute the (P,) weights of all points in the number of a region and band."""
    grid, region = frames.queries.grid, frames.queries.regions[region_name]
    regions = RegionBands([region], grid)
    region_cells = torch.zeros(grid.shape, dtype=torch.bool, device="cpu")
    region_cells[list(grid.heights).index(band)] = regions.regions[0].mask_cells(grid)
    selections: list[tuple[Tensor, Tensor, Tensor]] = []
    areas_m2 = torch.zeros(0, device="cpu")
    frames_per_cell = torch.zeros(grid.num_cells, dtype=torch.int64, device="cpu")
    for frame in reference:
        is_inside, band_points, cell = grid.assign_cells(frame.reference, frame.get_heights_m(grid.band_frame))
        if frames.average == "area":
            number, point = regions.assign_points(frame.reference[is_inside[band_points]], cell)
            selected = point[number == regions.find_index(regions.regions[0], band)]
        else:
            selected = region_cells.view(-1)[cell].nonzero().squeeze(1)
        points, cell = is_inside[band_points[selected]], cell[selected]
        assert frame.reference_weights is not None  # a SurfaceReference always has weights
        area_m2 = frame.reference_weights[points].double()
        selections.append((points, area_m2, cell))
        areas_m2 = torch.cat([areas_m2, area_m2])
        frames_per_cell += torch.bincount(cell, minlength=grid.num_cells).bool()
    if not len(areas_m2):
        raise ValueError(
            f"{objective_name}: no frame contains a visible surface of {band} in {region_name}; use more scenes"
        )
    weights = []
    for frame, (points, area_m2, cell) in zip(reference, selections, strict=True):
        share = area_m2 / areas_m2.sum()
        if frames.average == "cells":
            cell_area_m2 = torch.bincount(cell, weights=area_m2, minlength=grid.num_cells)
            share = area_m2 / cell_area_m2[cell] / frames_per_cell[cell] / (frames_per_cell > 0).sum()
        frame_weights = torch.zeros(len(frame.reference), dtype=torch.float64, device="cpu")
        weights.append(frame_weights.index_add_(0, points, share))
    return torch.cat(weights).numpy()


def _observe_candidates(
    space: SelectionSpace, frames: CommonFrames, *, progress: bool
) -> tuple[tuple[Sensor, ...], list[Bools], dict[str, str]]:
    """Return the candidates that can be mounted, the points that they detect, and why the others are excluded."""
    sensors: list[Sensor] = []
    observed: list[Bools] = []
    excluded: dict[str, str] = {}
    max_share = space.constraints.max_self_hit_share
    with Progress(len(space.sensors), space.name, is_shown=progress) as bar:
        for sensor in space.sensors:
            bar.advance(len(space.sensors), sensor.name)
            if space.is_too_close(sensor):
                excluded[sensor.name] = "it is too close to a fixed sensor"
                continue
            rig = Rig(name=sensor.name, vehicle=space.build_rig((sensor,), "any").vehicle, sensors=(sensor,))
            try:
                mask, self_hit_share = observe_points(rig, frames)
            except ValueError as error:
                excluded[sensor.name] = str(error)
                continue
            if max_share is not None and self_hit_share > max_share:
                excluded[sensor.name] = (
                    f"{self_hit_share:.1%} of its rays hit the vehicle; max_self_hit_share is {max_share:.1%}"
                )
                continue
            sensors.append(sensor)
            observed.append(mask)
    if not sensors:
        name, reason = next(iter(excluded.items()))
        raise ValueError(f"candidates: none of {len(excluded)} can be mounted; {name}: {reason}")
    return tuple(sensors), observed, excluded


def _validate_result(result: SelectionResult, frames: CommonFrames, test_seed: int, num_scenes: int) -> SelectionResult:
    """Compare the selection with the baseline on held-out scenes."""
    if set(result.best.selected) == set(result.baseline):
        return replace(result, no_test_reason="it equals the baseline")
    baseline = result.build_rig(result.baseline, f"{result.space.name}_baseline")
    try:
        test = validate({"best": result.rig}, baseline, frames, test_seed=test_seed, num_scenes=num_scenes)
    except ValueError as error:
        return replace(result, no_test_reason=str(error))
    return replace(result, test=test)
