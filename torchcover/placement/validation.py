"""Validation of the finalists of a search: paired with the start on held-out scenes, in numbers and sentences."""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.coverage.quantities import make_detection_quantity
from torchcover.estimation import Difference, Estimate, Quantity
from torchcover.estimation.errors import ROUND_OFF
from torchcover.evaluation.target_visibility import build_flat_ground
from torchcover.placement.common_frames import CommonFrames
from torchcover.placement.host_vehicle import NOT_WORSE
from torchcover.placement.objective import DEFAULT_THRESHOLD_M, Objective
from torchcover.report import PageTable, TextCell
from torchcover.report.number_format import format_difference, get_display_unit
from torchcover.simulation import RegionsOfInterest, Rig, set_ego
from torchcover.targets import TARGETS, Raster, Target, measure_target_visibility


@dataclass(frozen=True)
class TargetRasterParams:
    """Positions of test targets around the vehicle at which two rigs are compared.

    Args:
        max_distance_m: Maximum distance of a position from the vehicle in meters.
        spacing_m: Distance between two positions; a few hundred positions distinguish two rigs.
    """

    max_distance_m: float = 3.0
    spacing_m: float = 0.4


class HeldOutImprovement(NamedTuple):
    """Improvement of a finalist over the start in one objective.

    Args:
        objective: Name of the objective.
        average: Average of the number, "area" or "cells"; "-" if the number has only one.
        difference: Paired difference on held-out scenes.
        search_improvement: The improvement on the frames of the search.
    """

    objective: str
    average: str
    difference: Difference
    search_improvement: float

    @property
    def description(self) -> str:
        """The improvement on held-out scenes with its interval, without its unit: shares in percentage points."""
        return format_signed_difference(self.difference)

    @property
    def optimism(self) -> float:
        """Improvement in the search minus improvement on held-out scenes."""
        return self.search_improvement - self.difference.improvement

    @property
    def t_statistic(self) -> float:
        """Improvement over its standard error; NaN if the error is unknown or 0."""
        return self.difference.improvement / self.difference.error if self.difference.error > 0 else math.nan

    @property
    def record(self) -> dict[str, Any]:
        """Numbers for JSON."""
        difference, quantity = self.difference, self.difference.quantity
        return {
            "unit": quantity.unit,
            "improvement": difference.improvement,
            "error": difference.error,
            "confidence_interval": sorted(
                [quantity.compute_improvement(difference.low), quantity.compute_improvement(difference.high)]
            ),
            "t_statistic": self.t_statistic,
            "p_value": difference.p_value,
            "block_count": difference.block_count,
            "better_count": difference.better_count,
            "search_improvement": self.search_improvement,
            "optimism": self.optimism,
        }


class SideEffect(NamedTuple):
    """Change of a number that was not the objective, on held-out scenes.

    Args:
        name: Description of the number.
        difference: Paired difference to the start.
        p_value: Its p value, adjusted for all side effects (Holm 1979).
        objective_shares: Objective -> share of its improvement, if the number is a part of it.
    """

    name: str
    difference: Difference
    p_value: float
    objective_shares: Mapping[str, float]

    @property
    def is_significant(self) -> bool:
        """True if the change is significant at 5 %."""
        return self.p_value <= 0.05

    @property
    def is_worse(self) -> bool:
        """True if the number became significantly worse."""
        return self.is_significant and self.difference.improvement < 0

    @property
    def description(self) -> str:
        """Description of the number, its change with the interval, and the unit."""
        unit = self.difference.quantity.unit
        return f"{self.name} {format_signed_difference(self.difference)} {format_unit(unit)}"


class ValidationResult(NamedTuple):
    """Result of `validate`.

    Args:
        improvements: Name of a finalist -> improvements of all numbers of the search.
        side_effects: Side effects of the first finalist, significant deteriorations first.
    """

    improvements: Mapping[str, tuple[HeldOutImprovement, ...]]
    side_effects: tuple[SideEffect, ...]

    @property
    def summary(self) -> str:
        """Sentence about significant deteriorations; at most four are listed."""
        worse = [change.description for change in self.side_effects if change.is_worse]
        total = f"{len(self.side_effects)} numbers around the vehicle"
        if not worse:
            return f"None of {total} became significantly worse"
        max_listed = 4
        remaining = [f"{len(worse) - max_listed} more"] if len(worse) > max_listed else []
        return f"Significantly worse, of {total}: {'; '.join([*worse[:max_listed], *remaining])}"

    @property
    def table(self) -> PageTable:
        """Table of all side effects."""
        headings = ("number", "improvement on\nheld-out scenes", "unit", "p (Holm)", "share of the\nimprovement")
        rows = []
        for change in self.side_effects:
            shares = [f"{name} {share:.0%}" for name, share in change.objective_shares.items()]
            improvement = format_signed_difference(change.difference)
            cells = (
                TextCell(change.name),
                TextCell(improvement, "significant" if change.is_significant else ""),
                TextCell(format_unit(change.difference.quantity.unit)),
                TextCell("-" if math.isnan(change.p_value) else f"{change.p_value:.2g}"),
                TextCell(", ".join(shares)),
            )
            rows.append(cells)
        return PageTable("Side effects", headings, rows, 1)

    @property
    def record(self) -> list[dict[str, Any]]:
        """The side effects, for JSON."""
        return [
            {
                "name": change.name,
                "improvement": change.difference.improvement,
                "error": change.difference.error,
                "p_value_holm": change.p_value,
                "objective_shares": change.objective_shares,
            }
            for change in self.side_effects
        ]


def validate(
    finalists: Mapping[str, Rig],
    start: Rig,
    search_frames: CommonFrames,
    *,
    test_seed: int,
    num_scenes: int,
    params: TargetRasterParams = TargetRasterParams(),
) -> ValidationResult:
    """Compare finalists with the start on held-out scenes, frame by frame with the same reference points.

    Scenarios without random traffic are excluded, because they are the same scene for any seed.

    Args:
        finalists: Rigs by name; side effects are those of the first.
        start: Rig that they are compared with.
        search_frames: Frames of the search.
        test_seed: Seed of the held-out scenes.
        num_scenes: Number of held-out scenes of each scenario.
        params: Positions of test targets.

    Raises:
        ValueError: The seed is that of the search, no scenario has random traffic, or a rig cannot be mounted in a
            held-out scene.
    """
    first = next(iter(finalists))
    has_failures = max(len(start.sensors), len(finalists[first].sensors)) > 1
    extra_objectives, parts = _list_extra_objectives(search_frames.objectives, has_failures=has_failures)
    with closing(search_frames.resample(test_seed, num_scenes, extra_objectives)) as held_out_frames:
        start_estimate = held_out_frames.score(start).estimate
        differences = {}
        for name, rig in finalists.items():
            estimate = held_out_frames.score(rig).estimate
            differences[name] = _compute_differences(estimate, start_estimate, search_frames.objectives)
    search_start = search_frames.score(start).estimate
    improvements: dict[str, tuple[HeldOutImprovement, ...]] = {}
    for name, rig in finalists.items():
        search_differences = search_frames.score(rig).estimate.compute_differences(search_start)
        improvements[name] = tuple(
            HeldOutImprovement(
                objective,
                definition.fixed_average or search_frames.average,
                differences[name][objective],
                search_differences[objective].improvement,
            )
            for objective, definition in search_frames.objectives.items()
        )
    changes = differences[first]
    changes |= _compare_targets(finalists[first], start, search_frames, params)
    objective_names = [name for name in search_frames.objectives if not name.startswith(NOT_WORSE)]
    side_effects = _build_side_effects(changes, objective_names, parts)
    return ValidationResult(improvements, side_effects)


def _build_side_effects(
    changes: Mapping[str, Difference], objective_names: Sequence[str], parts: Mapping[str, list[str]]
) -> tuple[SideEffect, ...]:
    """Adjust the p values of all changes that are no objective, and sort significant deteriorations first."""
    tested = {name: changes[name] for name in changes if name not in objective_names}
    objective_shares: dict[str, dict[str, float]] = {name: {} for name in tested}
    for objective, part_names in parts.items():
        total = sum(changes[part].improvement for part in part_names)
        if not changes[objective].is_significant or not total > 0:
            continue  # without an improvement there is no share of it
        for part in part_names:
            objective_shares[part][objective] = changes[part].improvement / total
    p_values = adjust_holm([change.p_value for change in tested.values()])
    side_effects = [
        SideEffect(name, change, p_value, objective_shares[name])
        for (name, change), p_value in zip(tested.items(), p_values, strict=True)
    ]

    def get_rank(side_effect: SideEffect) -> tuple[bool, bool, float, float]:
        """Return the sort key: significant deteriorations first, then by p value; unknown p values last."""
        p_value = side_effect.p_value
        return not side_effect.is_worse, math.isnan(p_value), p_value, side_effect.difference.improvement

    return tuple(sorted(side_effects, key=get_rank))


def _compute_differences(
    estimate: Estimate, baseline: Estimate, objectives: Mapping[str, Objective]
) -> dict[str, Difference]:
    """Compute the differences of two rigs; differences of requirements do not depend on scenes and have no error."""
    differences = estimate.compute_differences(baseline)
    for name, objective in objectives.items():
        if objective.requirement:
            value = differences[name].value
            is_different = abs(value) > ROUND_OFF
            p_value = 0.0 if is_different else 1.0
            differences[name] = differences[name]._replace(
                error=0.0, low=value, high=value, is_significant=is_different, p_value=p_value
            )
    return differences


def adjust_holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values for multiple comparisons (Holm 1979).

    Args:
        p_values: p values; NaN is not counted and stays NaN.

    Returns:
        Adjusted p values in the same order.

    Example:
        >>> adjust_holm([0.02, 0.001, math.nan, 0.9])
        [0.04, 0.003, nan, 0.9]
    """
    known_count = int(np.count_nonzero(~np.isnan(p_values)))
    adjusted, largest = [math.nan] * len(p_values), 0.0
    for rank, index in enumerate(np.argsort(p_values, kind="stable")[:known_count].tolist()):  # NaN is sorted last
        largest = max(largest, min((known_count - rank) * p_values[index], 1.0))
        adjusted[index] = largest
    return adjusted


def _list_extra_objectives(
    objectives: Mapping[str, Objective], *, has_failures: bool
) -> tuple[dict[str, Objective], dict[str, list[str]]]:
    """List further numbers to test, by description, and the descriptions of the parts of each objective."""
    extra: dict[str, Objective] = {}
    parts: dict[str, list[str]] = {}
    custom_regions: set[str] = set()
    for name, objective in objectives.items():
        if isinstance(objective.region, dict):
            custom_regions |= set(objective.region)
        if not name.startswith(NOT_WORSE) and len(objective.region_bands) > 1:
            objective_parts = {part.description: part for part in objective.parts}
            extra |= objective_parts
            parts[name] = list(objective_parts)
    # The names of the default regions do not depend on the outline of the vehicle.
    outline_m = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])
    failure_key = f"{make_detection_quantity(DEFAULT_THRESHOLD_M).key}_without_any"
    for region in RegionsOfInterest().build_query_plan(outline_m).regions:
        for band in PAPER_HEIGHTS if region.name not in custom_regions else ():
            objective = Objective(region=region.name, band=band)
            extra[objective.description] = objective
            if has_failures:
                failure = objective.model_copy(update={"number": failure_key})
                extra[f"{objective.description}, any one sensor failed"] = failure
    return {name: extra[name] for name in extra if name not in objectives}, parts


def _compare_targets(
    rig: Rig, start: Rig, search_frames: CommonFrames, params: TargetRasterParams
) -> dict[str, Difference]:
    """Compare the shares of positions near the vehicle at which test targets are detected on flat ground."""
    differences = {}
    for target in TARGETS:
        rig_share, start_share = (
            _estimate_detected_share(tested_rig, target, search_frames, params) for tested_rig in (rig, start)
        )
        differences[f"{target} within {params.max_distance_m:g} m"] = rig_share.compute_differences(start_share)[target]
    return differences


def _estimate_detected_share(
    rig: Rig, target: str, search_frames: CommonFrames, params: TargetRasterParams
) -> Estimate:
    """Estimate the share of free positions near the vehicle at which a test target is detected."""
    ground = build_flat_ground().model_copy(update={"ego": search_frames.scenarios[0].ego})
    scenario = set_ego(ground, {rig.name: rig})
    raster = Raster.from_vehicle(scenario.compute_ego_box(), params.max_distance_m, params.spacing_m)
    result = measure_target_visibility(rig.apply_sensor_model("ideal"), scenario, Target.load(target), raster)
    is_tested = result.free_mask & (result.distance_m <= params.max_distance_m)
    # Every fourth cell along each axis is a block, so that the blocks estimate the error of a finite raster.
    rows, columns = (np.arange(count) % 4 for count in is_tested.shape)
    block_index = torch.from_numpy((4 * rows[:, None] + columns)[is_tested])
    cells = torch.bincount(block_index, minlength=16)
    detected = torch.from_numpy(result.detected_mask[is_tested]).double()
    detected_cells = torch.bincount(block_index, detected, minlength=16)
    quantity = Quantity(target, f"{target} detected", "share", lower_is_better=False)
    return Estimate.from_ratios((quantity,), cells.double(), detected_cells[:, None], cells)


def format_signed_difference(difference: Difference) -> str:
    """Format a difference with its interval, without unit, with a sign so that more is better.

    Args:
        difference: The difference.
    """
    if difference.quantity.lower_is_better:
        difference = difference._replace(value=-difference.value, low=-difference.high, high=-difference.low)
    return format_difference(difference)


def format_improvement(value: float, unit: str) -> str:
    """Format an improvement without its unit: shares in percentage points.

    Args:
        value: The improvement.
        unit: Its unit.

    Example:
        >>> format_improvement(0.01234, "share"), format_improvement(0.01234, "m")
        ('+1.23', '+0.012')
    """
    return f"{get_display_unit(unit).factor * value:+.{2 if unit == 'share' else 3}f}"


def format_unit(unit: str) -> str:
    """Return the unit of an improvement: "points" for a share.

    Args:
        unit: Unit of the number.
    """
    return "points" if unit == "share" else unit


def describe_improvement(improvement: HeldOutImprovement, *, optimism: bool = False) -> str:
    """Describe an improvement; "improved" and "worsened" are significant by Student's t at 95 %.

    Args:
        improvement: Improvement on held-out scenes.
        optimism: Whether to add the difference to the improvement in the search.
    """
    difference, unit = improvement.difference, improvement.difference.quantity.unit
    if math.isnan(difference.value):
        return "unknown on held-out scenes"
    t_statistic = "unknown" if math.isnan(improvement.t_statistic) else f"{improvement.t_statistic:.1f}"
    scenes = f"on {difference.block_count} held-out scenes (t {t_statistic}, better in {difference.better_count})"
    if difference.low == difference.high:
        scenes = "in any scene"
    text = f"{improvement.description} {format_unit(unit)} {scenes}"
    if optimism and not math.isnan(improvement.optimism):
        text += f", optimism {format_improvement(improvement.optimism, unit)}"
    if not difference.is_significant:
        return f"no significant improvement: {text}"
    return f"{'improved by' if difference.improvement > 0 else 'worsened by'} {text}"


def replace_nan(value: Any) -> Any:  # noqa: ANN401  (any content of a record)
    """Replace non-finite numbers of a record by None, for JSON.

    Args:
        value: Mapping, sequence or value.
    """
    if isinstance(value, Mapping):
        return {key: replace_nan(content) for key, content in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
