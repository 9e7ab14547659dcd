"""Select some of many candidate sensors, and test the selection on held-out worlds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from torchcover import __version__
from torchcover.coverage import Average
from torchcover.coverage.quantity import make_detection_quantity
from torchcover.coverage.regions import RegionBands
from torchcover.estimation import Number
from torchcover.evaluation.progress import Progress
from torchcover.evaluation.result import describe_sensor_models
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

SAMPLED = 1000  # random selections within the limits, as a control
HEADINGS = ("sensor", "alone (%)", "lost without it\n(points)", "cost (EUR)")
MAX_SIZES = 12  # numbers of sensors in the picture
SIZE_LIMIT_S = 5.0  # time of the solver for each of them


@dataclass(frozen=True, eq=False, repr=False)
class SelectionResult(ReportMixin):
    """What was chosen, and how good that is. Its picture, `sizes.png`, shows what more sensors are worth.

    Args:
        space: What there was to choose from.
        average: What the choice is by.
        sensor_model: What its sensors make of their hits, `ideal` or `real`.
        sensors: The candidates that can be mounted.
        excluded: Name of each of the others, and why it cannot be.
        candidates: What each of `sensors` sees.
        limits: What the choice keeps to.
        selections: The best of the objective; of several, what lies between, and then the best of each.
        numbers: What the rig of the first of them scores, from the same observers as `evaluate`.
        sampled_selections: Random choices, by the first objective, ascending.
        baseline: What it is compared with.
        test: On held-out worlds; None if the two are the same, or there are no held-out worlds.
        no_test_reason: Why there is no test.
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
        """The choice."""
        return self.selections[0]

    @cached_property
    def rig(self) -> Rig:
        """The rig of the best choice."""
        return self.build_rig(self.best.selected, f"{self.space.name}_best")

    def build_rig(self, selected: tuple[int, ...], name: str) -> Rig:
        """The rig of a choice."""
        return self.space.build_rig(tuple(self.sensors[one] for one in selected), name)

    def get_sensor_names(self, selected: tuple[int, ...]) -> tuple[str, ...]:
        """What the sensors of a choice are called."""
        return tuple(self.sensors[one].name for one in selected)

    @cached_property
    def failure_effects(self) -> dict[int, float]:
        """Number of each chosen sensor -> what is lost of the first objective when it fails."""
        return dict(
            zip(
                self.best.selected,
                self.coverage.compute_failure_effects(self.best.selected)[:, 0].tolist(),
                strict=True,
            )
        )

    @property
    def improvements(self) -> tuple[HeldOutImprovement, ...]:
        """Of the best on held-out worlds."""
        return self.test.improvements["best"] if self.test else ()

    @property
    def summary(self) -> str:
        """What it comes to."""
        values = ", ".join(f"{100 * self.numbers[name].value:.2f} %" for name in self.space.objectives)
        kind = (
            "the best there is"
            if len(self.selections) == 1
            else f"between the best of {', '.join(self.space.objectives)}"
        )
        if self.best.shortfall:
            lacks = zip(
                self.space.scored_objectives,
                (np.array(self.limits.min_values) - self.best.values).tolist(),
                strict=True,
            )
            short = "; ".join(
                f"{100 * lack:.2f} points of {name}" for name, lack in lacks if lack > SolverParams.tolerance
            )
            kind = f"no choice keeps all that must be kept, and this one lacks the least: {short}"
        elif not self.best.is_proven:
            gap = f"at most {100 * self.best.gap:.2f} points below" if len(self.selections) == 1 else "not proven to be"
            kind = f"{gap} the best"
        found = f"{', '.join(self.get_sensor_names(self.best.selected))}: {values}, {kind}"
        (model,) = describe_sensor_models({self.rig.name: self.sensor_model})
        if self.test is None:
            return f"{found}; not tested in held-out worlds: {self.no_test_reason}. {model}"
        asked = self.improvements[: len(self.space.objectives)]
        gains = "; ".join(f"{gain.objective}: {describe_improvement(gain, optimism=True)}" for gain in asked)
        return (
            f"{found}. Against {', '.join(self.get_sensor_names(self.baseline))}: {gains}. {self.test.summary}. {model}"
        )

    @property
    def report(self) -> PlacementReport:
        """For its files, its page, and the terminal."""
        table = PageTable(f"{self.space.name}: {len(self.sensors)} candidates", HEADINGS, self._chosen_rows(), 1)
        record = self._record
        ends = zip(build_file_stems(list(self.space.objectives)), self.selections[1:], strict=False)
        rigs = {f"best_{stem}.yaml": self.build_rig(end.selected, f"{self.space.name}_{stem}") for stem, end in ends}
        return PlacementReport(
            title=f"{self.space.name}: which sensors, and how many?",
            summary=self.summary,
            record=record,
            setting_names=[name for name in record if name != "torchcover"],
            rigs={"best.yaml": self.rig} | rigs,
            page_rigs={"best": self.rig, "now": self.build_rig(self.baseline, f"{self.space.name}_now")},
            tables=[table, *([self.test.table] if self.test else ())],
            csv_tables={"candidates.csv": self._candidate_rows(), "sizes.csv": [SelectionSize._fields, *self._sizes]},
            render_plots=self._pictures,
            ego_outline_m=self.space.scenarios[0].compute_ego_box().outline_m,
        )

    def __repr__(self) -> str:
        return f"SelectionResult in {self.space.name}: {self.summary}"

    @property
    def _record(self) -> dict[str, Any]:
        return {
            "torchcover": __version__,
            "choice": self.space.name,
            "estimate": self.average,
            "sensor_model": self.sensor_model,
            "band_frame": DEFAULT_BAND_FRAME,
            "found": [
                {
                    "sensors": self.get_sensor_names(one.selected),
                    "values": dict(zip(self.space.scored_objectives, one.values, strict=True)),
                    "gap": one.gap,
                    "proven": one.is_proven,
                    "lacks": one.shortfall,
                    "cost_eur": self.limits.compute_price_eur(one.selected) if self.space.prices_eur else None,
                }
                for one in self.selections
            ],
            "errors": {name: number.error for name, number in self.numbers.items()},
            "lost_without": {self.sensors[one].name: lost for one, lost in self.failure_effects.items()},
            "drawn": {
                "count": len(self.sampled_selections),
                "median": self.sampled_selections[len(self.sampled_selections) // 2].values[0],
                "best": self.sampled_selections[-1].values[0],
                "share_below_best": float(
                    np.mean([one.values[0] < self.best.values[0] for one in self.sampled_selections])
                ),
            },
            "now": {
                "sensors": self.get_sensor_names(self.baseline),
                "values": self.coverage.compute_values(self.baseline).tolist(),
            },
            "fresh": {f"{gain.objective}, {gain.average}": gain.record for gain in self.improvements} or None,
            "changes": self.test and self.test.record,
            "refused": self.excluded,
        }

    def _candidate_rows(self) -> Iterator[Sequence[object]]:
        """A row for each candidate, with a heading: values are shares, with what is always there."""
        yield ["name", "value_alone", "cost_eur", "chosen", "lost_without", "why_not"]
        for at, sensor in enumerate(self.sensors):
            alone = float(self.coverage.compute_values([at])[0])
            yield [sensor.name, alone, self._price(at), at in self.failure_effects, self.failure_effects.get(at), ""]
        for name, why in self.excluded.items():
            yield [name, "", "", False, "", why]

    def _chosen_rows(self) -> list[tuple[TextCell, ...]]:
        """Cells below `HEADINGS`, what is lost the most first."""
        rows = []
        for at, lost in sorted(self.failure_effects.items(), key=lambda one: -one[1]):
            price = self._price(at)
            numbers = f"{100 * self.coverage.compute_values([at])[0]:.2f}", f"{100 * lost:.2f}"
            rows.append(tuple(map(TextCell, (self.sensors[at].name, *numbers, "-" if price is None else f"{price:g}"))))
        return rows

    def _price(self, at: int) -> float | None:
        return self.limits.compute_price_eur([at]) if self.space.prices_eur else None

    @cached_property
    def _sizes(self) -> list[SelectionSize]:
        """The best choices of so many sensors, by the first objective."""
        found = []
        for size in range(1, min(self.limits.max_sensors, MAX_SIZES) + 1):
            one = select_sensors(self.coverage, replace(self.limits, max_sensors=size), time_limit_s=SIZE_LIMIT_S)
            if len(one.selected) == size and not one.shortfall:
                found.append(SelectionSize(size, one.values[0], one.values[0] + one.gap))
        return found

    def _pictures(self) -> Iterator[tuple[str, str, Figure]]:
        drawn = [one.values[0] for one in self.sampled_selections]
        figure = plot_selection_sizes(
            self._sizes, drawn, len(self.best.selected), self.best.values[0], title=self.space.name
        )
        yield "sizes", "What more sensors bring, and what random choices are worth", figure


def run_selection(
    space: SelectionSpace, frames: CommonFrames, *, test_seed: int, num_held_out_scenes: int, progress: bool = False
) -> SelectionResult:
    """Find the best choice of candidates, and compare it with today's in worlds that it was not chosen by.

    Each candidate is scanned once in each frame. The distance to the nearest point of several sensors is the least of
    their distances, so that what a choice sees is the OR of what its sensors see. Noise and drop-out are drawn anew for
    each place in a rig's list of sensors: there it is that of other draws.

    Args:
        space: The candidates and the limits.
        frames: Frames of the scenarios of the space, with its numbers.
        test_seed: Seed of the held-out worlds.
        num_held_out_scenes: How many.
        progress: Whether to show a bar.

    Raises:
        ValueError: No candidate can be mounted, or sees anything that counts; one of `now` cannot be mounted; the
            sensor model is to be real, and of none of the chosen sensors that is known.
    """
    sensors, seen, refused = _mount_candidates(space, frames, progress=progress)
    always = observe_points(space.fixed_rig, frames)[0] if space.fixed_rig else np.zeros_like(seen[0])
    coverage = CandidateCoverage.from_points(compute_point_weights(frames), seen, always)
    places = {sensor.name: at for at, sensor in enumerate(sensors)}
    if lost := [name for name in space.baseline or () if name not in places]:
        raise ValueError(f"now: {lost[0]} cannot be there: {refused[lost[0]]}")
    now = tuple(places[name] for name in space.baseline or ())
    numbers = {sensor.name: number for number, sensor in enumerate(space.sensors)}
    limits = space.build_limits([numbers[sensor.name] for sensor in sensors])
    objectives = len(space.objectives)
    kept = zip(space.scored_objectives, coverage.compute_values(now).tolist(), strict=True)
    minimum = [-np.inf if name in space.objectives else space.bounds.get(name, own) for name, own in kept]
    limits = replace(limits, min_values=minimum)
    found = select_for_objectives(coverage, limits, objectives)
    if not found[0].selected:
        raise ValueError(
            f"candidates: none of the {len(sensors)} that can be there adds anything to the objective; move or turn "
            "them, or ask about places that they see"
        )
    drawn = sorted(sample_selections(coverage, limits, SAMPLED, frames.seed), key=lambda one: one.values[0])
    now = now or drawn[len(drawn) // 2].selected
    rig = space.build_rig(tuple(sensors[one] for one in found[0].selected), f"{space.name}_best")
    scored = frames.score(rig).estimate.to_numbers()
    model = rig.apply_sensor_model(frames.sensor_model).sensor_model
    choice = tuple(found), scored, tuple(drawn), now
    chosen = SelectionResult(space, frames.average, model, sensors, refused, coverage, limits, *choice)
    return _validate(chosen, frames, test_seed, num_held_out_scenes)


def observe_points(rig: Rig, frames: CommonFrames) -> tuple[Bools, float]:
    """Return which reference points a rig detects, (T * P,) threshold by threshold, and its share of self-hits."""
    queries, rays, self_hits = frames.queries, 0, 0
    within: list[list[Bools]] = [[] for _ in queries.thresholds_m]
    for frame in frames.iterate_frames(rig):
        for threshold, masks in zip(queries.thresholds_m, within, strict=True):
            points = frame.get_cloud(max_error_m=threshold)
            distance = nearest(frame.reference, points, max_distance=queries.max_radius_m).distance
            masks.append((distance <= threshold).numpy())
        rays, self_hits = rays + frame.counts["rays"], self_hits + frame.counts["self_hits"]
    return np.concatenate([np.concatenate(masks) for masks in within]), self_hits / rays


def compute_point_weights(frames: CommonFrames) -> Float64:
    """Return (Q, T * P) what each reference point adds to each number: the sums are those of `CoverageMetric`.

    By area, a point adds its share of the visible square meters. Over observed cells it adds its share of the square
    meters in its cell and frame, divided by the frames that observe the cell and by the number of observed cells. For a
    threshold that is not that of the number it adds nothing.

    Raises:
        ValueError: No frame shows a surface in one of the regions and bands.
    """
    queries, reference = frames.queries, list(frames.iterate_frames())
    keys = [make_detection_quantity(threshold).key for threshold in queries.thresholds_m]
    points = sum(len(frame.reference) for frame in reference)
    weights = np.zeros((len(queries.objectives), len(keys), points))
    for row, (name, objective) in zip(weights, queries.objectives.items(), strict=True):
        for place in objective.region_bands:
            row[keys.index(objective.key)] += _weights_in(place, name, frames, reference) / len(objective.region_bands)
    return weights.reshape(len(weights), -1)


def _weights_in(place: tuple[str, str], name: str, frames: CommonFrames, reference: Sequence[Frame]) -> Float64:
    """Return (P,) what each point adds to the number of a region and band."""
    (region, band), queries, grid = place, frames.queries, frames.queries.grid
    where = RegionBands([queries.regions[region]], grid)
    cells = torch.zeros(grid.shape, dtype=torch.bool, device="cpu")
    cells[list(grid.heights).index(band)] = where.regions[0].mask_cells(grid)
    of_frames, m2, probed = (
        [],
        torch.zeros(0, device="cpu"),
        torch.zeros(grid.num_cells, dtype=torch.int64, device="cpu"),
    )
    for frame in reference:
        inside, of, cell = grid.assign_cells(frame.reference, frame.get_heights_m(grid.band_frame))
        if frames.average == "area":
            at, point = where.assign_points(frame.reference[inside[of]], cell)
            selected = point[at == where.find_index(where.regions[0], band)]
        else:
            selected = cells.view(-1)[cell].nonzero().squeeze(1)
        points, cell = inside[of[selected]], cell[selected]
        assert frame.reference_weights is not None  # square meters
        weight = frame.reference_weights[points].double()
        of_frames.append((points, weight, cell))
        m2, probed = torch.cat([m2, weight]), probed + torch.bincount(cell, minlength=grid.num_cells).bool()
    if not len(m2):
        raise ValueError(f"{name}: no frame shows any surface of {band} in {region}; use more worlds")
    weights = []
    for frame, (points, weight, cell) in zip(reference, of_frames, strict=True):
        share = weight / m2.sum()
        if frames.average == "cells":
            of_cell = torch.bincount(cell, weights=weight, minlength=grid.num_cells)
            share = weight / of_cell[cell] / probed[cell] / (probed > 0).sum()
        weights.append(
            torch.zeros(len(frame.reference), dtype=torch.float64, device="cpu").index_add_(0, points, share)
        )
    return torch.cat(weights).numpy()


def _mount_candidates(
    space: SelectionSpace, frames: CommonFrames, *, progress: bool
) -> tuple[tuple[Sensor, ...], list[Bools], dict[str, str]]:
    """The candidates that can be mounted, what they see, and why the others cannot."""
    sensors: list[Sensor] = []
    seen: list[Bools] = []
    refused: dict[str, str] = {}
    most = space.constraints.max_self_hit_share
    with Progress(len(space.sensors), space.name, is_shown=progress) as bar:
        for sensor in space.sensors:
            bar.advance(len(space.sensors), sensor.name)
            if space.is_too_close(sensor):
                refused[sensor.name] = "a sensor that is always there is too close"
                continue
            alone = Rig(name=sensor.name, vehicle=space.build_rig((sensor,), "any").vehicle, sensors=(sensor,))
            try:
                points, own = observe_points(alone, frames)
            except ValueError as error:
                refused[sensor.name] = str(error)
                continue
            if most is not None and own > most:
                refused[sensor.name] = f"{own:.1%} of its rays end on the vehicle; max_self_hit_share is {most:.1%}"
                continue
            sensors.append(sensor)
            seen.append(points)
    if not sensors:
        name, why = next(iter(refused.items()))
        raise ValueError(f"candidates: none of {len(refused)} can be there; of {name}: {why}")
    return tuple(sensors), seen, refused


def _validate(found: SelectionResult, frames: CommonFrames, test_seed: int, worlds: int) -> SelectionResult:
    if set(found.best.selected) == set(found.baseline):
        return replace(found, no_test_reason="it is what is there today")
    now = found.build_rig(found.baseline, f"{found.space.name}_now")
    try:
        return replace(found, test=validate({"best": found.rig}, now, frames, test_seed=test_seed, num_scenes=worlds))
    except ValueError as error:
        return replace(found, no_test_reason=str(error))
