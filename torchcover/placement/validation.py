"""Validation of the finalists of a search: paired with the start on held-out worlds, in numbers and words."""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import torch

from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.coverage.quantity import make_detection_quantity
from torchcover.estimation import Difference, Estimate, Quantity
from torchcover.estimation.errors import ROUND_OFF
from torchcover.evaluation.target_survey import build_flat_ground
from torchcover.placement.common_frames import CommonFrames
from torchcover.placement.host_vehicle import NOT_WORSE
from torchcover.placement.objective import THRESHOLD_M, Objective
from torchcover.report import PageTable, TextCell
from torchcover.report.wording import format_difference, get_display_unit
from torchcover.simulation import RegionsOfInterest, Rig, set_ego
from torchcover.targets import TARGETS, Raster, Target, survey

# Changes that a sentence names.
MOST_TOLD = 4
# Of targets around the vehicle, and how far apart they are put: some hundred places tell two rigs apart.
WITHIN_M, STEP_M = 3.0, 0.4
# Usual regions have the same names around any vehicle.
ANY_OUTLINE_M = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])
CHANGE_HEADINGS = ("what", "gain on\nheld-out worlds", "unit", "p (Holm)", "share of\nthe gain")


class HeldOutImprovement(NamedTuple):
    """Improvement of a finalist over the start in one objective.

    Args:
        objective: Its name.
        average: Average of the number, "area" or "cells"; "-" where the number has no such choice.
        difference: Paired difference on held-out worlds.
        search_improvement: The same difference on the frames of the search.
    """

    objective: str
    average: str
    difference: Difference
    search_improvement: float

    @property
    def description(self) -> str:
        """The improvement on held-out worlds with its interval, without its unit: shares in percentage points."""
        return format_signed_difference(self.difference)

    @property
    def optimism(self) -> float:
        """How much larger the improvement was in the search."""
        return self.search_improvement - self.difference.improvement

    @property
    def t_statistic(self) -> float:
        """Gain over error; NaN if the error is unknown, or 0."""
        return self.difference.improvement / self.difference.error if self.difference.error > 0 else math.nan

    @property
    def record(self) -> dict[str, Any]:
        """All of it, for JSON."""
        test = self.difference
        return {
            "unit": test.quantity.unit,
            "gain": test.improvement,
            "error": test.error,
            "interval": sorted(
                [test.quantity.compute_improvement(test.low), test.quantity.compute_improvement(test.high)]
            ),
            "t": self.t_statistic,
            "p": test.p_value,
            "worlds": test.block_count,
            "better": test.better_count,
            "search_improvement": self.search_improvement,
            "optimism": self.optimism,
        }


class SideEffect(NamedTuple):
    """A change of another number on held-out worlds.

    Args:
        name: The number in words.
        difference: Paired difference to the start.
        p_value: Its p value, adjusted for all changes (Holm 1979).
        objective_shares: Objective -> share of its improvement, if the number is a part of it.
    """

    name: str
    difference: Difference
    p_value: float
    objective_shares: Mapping[str, float]

    @property
    def is_worse(self) -> bool:
        """Whether it got worse beyond chance."""
        return self.p_value <= 0.05 and self.difference.improvement < 0

    @property
    def description(self) -> str:
        """It with its interval and unit."""
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
        """The side effects in words."""
        worse = [change.description for change in self.side_effects if change.is_worse]
        told = [*worse[:MOST_TOLD], *([f"{len(worse) - MOST_TOLD} more"] if len(worse) > MOST_TOLD else [])]
        number = f"of {len(self.side_effects)} numbers around the vehicle"
        if not worse:
            return f"None {number} got worse beyond chance"
        return f"Worse beyond chance, {number}: {'; '.join(told)}"

    @property
    def table(self) -> PageTable:
        """All changes."""
        rows = [
            (
                TextCell(change.name),
                TextCell(format_signed_difference(change.difference), "significant" if change.p_value <= 0.05 else ""),
                TextCell(format_unit(change.difference.quantity.unit)),
                TextCell("-" if math.isnan(change.p_value) else f"{change.p_value:.2g}"),
                TextCell(", ".join(f"{name} {share:.0%}" for name, share in change.objective_shares.items())),
            )
            for change in self.side_effects
        ]
        return PageTable("What else changed", CHANGE_HEADINGS, rows, 1)

    @property
    def record(self) -> list[dict[str, Any]]:
        """The changes, for JSON."""
        return [
            {
                "what": one.name,
                "gain": one.difference.improvement,
                "error": one.difference.error,
                "p_holm": one.p_value,
                "shares": one.objective_shares,
            }
            for one in self.side_effects
        ]


def validate(
    finalists: Mapping[str, Rig], start: Rig, search_frames: CommonFrames, *, test_seed: int, num_scenes: int
) -> ValidationResult:
    """Score finalists of a search, by name, on worlds of another seed, frame by frame against the same reference.

    A scenario without traffic is the same world for any seed, and is left out.

    ValueError: the seed of the search; no scenario with traffic; a rig that cannot be mounted in a fresh world.
    """
    first = next(iter(finalists))
    others, parts = _others(
        search_frames.objectives, failures=max(len(start.sensors), len(finalists[first].sensors)) > 1
    )
    with closing(search_frames.resample(test_seed, num_scenes, others)) as fresh:
        start_by_test = fresh.score(start).estimate
        by_test = {
            name: _differences(fresh.score(winner).estimate, start_by_test, search_frames.objectives)
            for name, winner in finalists.items()
        }
    start_by_search = search_frames.score(start).estimate
    gains, found = {}, by_test[first]
    for name, winner in finalists.items():
        in_search = search_frames.score(winner).estimate.compute_differences(start_by_search)
        gains[name] = tuple(
            HeldOutImprovement(
                objective,
                asked.fixed_average or search_frames.average,
                by_test[name][objective],
                in_search[objective].improvement,
            )
            for objective, asked in search_frames.objectives.items()
        )
    tests = {name: test for name, test in found.items() if name in others or name.startswith(NOT_WORSE)}
    tests |= _of_targets(finalists[first], start, search_frames)
    shares: dict[str, dict[str, float]] = {name: {} for name in tests}
    for objective, each in parts.items():
        whole = sum(found[part].improvement for part in each)
        for part in each if found[objective].is_significant and whole > 0 else ():  # of no gain there is no share
            shares[part][objective] = found[part].improvement / whole
    changes = [
        SideEffect(name, test, p, shares[name])
        for (name, test), p in zip(tests.items(), adjust_holm([test.p_value for test in tests.values()]), strict=True)
    ]
    changes.sort(key=lambda one: (not one.is_worse, math.isnan(one.p_value), one.p_value, one.difference.improvement))
    return ValidationResult(gains, tuple(changes))


def _differences(one: Estimate, other: Estimate, asked: Mapping[str, Objective]) -> dict[str, Difference]:
    """Of two rigs. What is required is looked at once and not in worlds, so that chance has no part in it."""
    found = one.compute_differences(other)
    for name in (name for name, each in asked.items() if each.requirement):
        value = found[name].value
        differs = abs(value) > ROUND_OFF
        p = 0.0 if differs else 1.0
        found[name] = found[name]._replace(error=0.0, low=value, high=value, is_significant=differs, p_value=p)
    return found


def adjust_holm(p_values: Sequence[float]) -> list[float]:
    """Of each probability, what it is with all others looked at (Holm 1979); what is unknown stays so, and counts not.

    Example:
        >>> adjust_holm([0.02, 0.001, math.nan, 0.9])
        [0.04, 0.003, nan, 0.9]
    """
    known = sorted((one, at) for at, one in enumerate(p_values) if not math.isnan(one))
    adjusted, least = [math.nan] * len(p_values), 0.0
    for rank, (one, at) in enumerate(known):
        least = adjusted[at] = max(least, min((len(known) - rank) * one, 1.0))
    return adjusted


def _others(asked: Mapping[str, Objective], *, failures: bool) -> tuple[dict[str, Objective], dict[str, list[str]]]:
    """Return further numbers to test, by their words, and the names of those that each objective is the mean of."""
    found, parts = dict[str, Objective](), dict[str, list[str]]()
    for name, objective in asked.items():
        if name.startswith(NOT_WORSE) or len(objective.region_bands) < 2:
            continue
        each = {one.description: one for one in objective.parts}
        found, parts[name] = found | each, list(each)
    own = {region for objective in asked.values() if isinstance(objective.region, dict) for region in objective.region}
    plain = make_detection_quantity(THRESHOLD_M).key
    for region in RegionsOfInterest().build_query_plan(ANY_OUTLINE_M).regions:
        for band in PAPER_HEIGHTS if region.name not in own else ():
            one = Objective(region=region.name, band=band)
            found[one.description] = one
            if failures:
                found[f"{one.description}, any one sensor failed"] = one.model_copy(
                    update={"number": f"{plain}_without_any"}
                )
    return {name: one for name, one in found.items() if name not in asked}, parts


def _of_targets(rig: Rig, start: Rig, searched: CommonFrames) -> dict[str, Difference]:
    """Places within a few metres of the vehicle at which targets are seen, on empty ground."""
    found = {}
    for target in TARGETS:
        ends = []
        for one in (rig, start):
            empty = set_ego(build_flat_ground().model_copy(update={"ego": searched.scenarios[0].ego}), {one.name: one})
            raster = Raster.around(empty.compute_ego_box(), WITHIN_M, STEP_M)
            seen = survey(one.apply_sensor_model("ideal"), empty, Target.load(target), raster)
            there = seen.free & (seen.distance_m <= WITHIN_M)
            # Every fourth cell along each axis is a block of its own: by them it is known what the raster leaves open.
            rows, columns = (np.arange(count) % 4 for count in there.shape)
            of = torch.from_numpy((4 * rows[:, None] + columns)[there])
            cells = torch.bincount(of, minlength=16)
            enough = torch.bincount(of, torch.from_numpy(seen.enough[there]).double(), minlength=16)
            quantity = Quantity(target, f"{target} seen", "share", lower_is_better=False)
            ends.append(Estimate.from_ratios((quantity,), cells.double(), enough[:, None], cells))
        found[f"{target} within {WITHIN_M:g} m"] = ends[0].compute_differences(ends[1])[target]
    return found


def format_signed_difference(difference: Difference) -> str:
    """A difference with its interval and no unit, its sign turned so that more is better."""
    if difference.quantity.lower_is_better:
        difference = difference._replace(value=-difference.value, low=-difference.high, high=-difference.low)
    return format_difference(difference)


def format_improvement(value: float, unit: str) -> str:
    """A gain without its unit: shares in percentage points.

    Example:
        >>> format_improvement(0.01234, "share"), format_improvement(0.01234, "m")
        ('+1.23', '+0.012')
    """
    return f"{get_display_unit(unit).factor * value:+.{2 if unit == 'share' else 3}f}"


def format_unit(unit: str) -> str:
    """What stands behind it."""
    return "points" if unit == "share" else unit


def describe_improvement(improvement: HeldOutImprovement, *, optimism: bool = False) -> str:
    """Describe an improvement; it is called one only if it is significant by Student's t at 95 %."""
    test, unit = improvement.difference, improvement.difference.quantity.unit
    if math.isnan(test.value):
        return "unknown in the held-out worlds"
    t = "t unknown" if math.isnan(improvement.t_statistic) else f"t {improvement.t_statistic:.1f}"
    where = f"on {test.block_count} held-out worlds ({t}, better in {test.better_count})"
    rest = f"{improvement.description} {format_unit(unit)} {'in any world' if test.low == test.high else where}"
    if optimism and not math.isnan(improvement.optimism):
        rest += f", optimism {format_improvement(improvement.optimism, unit)}"
    if test.is_significant:
        return f"{'gained' if test.improvement > 0 else 'lost'} {rest}"
    return f"no gain is shown: {rest}"


def replace_nan(value: Any) -> Any:  # noqa: ANN401  (whatever a record holds)
    """A record as JSON can have it: what is unknown is None."""
    if isinstance(value, Mapping):
        return {key: replace_nan(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
