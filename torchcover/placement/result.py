"""What a search has found, in numbers and words."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from torchcover.coverage import Measure
from torchcover.placement.arm import Arm
from torchcover.placement.evaluation import OPTIMISER, RANDOM, START, Evaluation
from torchcover.placement.fresh import FreshGain, FreshTest
from torchcover.placement.pareto import hypervolume
from torchcover.placement.search import PlacementSearch
from torchcover.simulation import Rig

# Otherwise, a gain is not told from chance; of few worlds, a large t is none yet.
ENOUGH_T, ENOUGH_P = 2.0, 0.05


@dataclass(frozen=True, eq=False)
class Pick:
    """A rig that was found.

    Args:
        arm: Who found it: "optimiser" or "random".
        role: Of several objectives, "middle" of the front, or the name of the objective that it is best in; else empty.
        evaluation: It.
        rig: It, as it can be evaluated.
        test: On fresh worlds; None if it was not tested, as the start itself is not.
    """

    arm: str
    role: str
    evaluation: Evaluation
    rig: Rig
    test: FreshTest | None = None

    @property
    def is_start(self) -> bool:
        """Whether nothing better was found."""
        return self.evaluation.arm == START

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"{self.arm}: {self.role}" if self.role else self.arm

    def tested(self, test: FreshTest | None) -> Self:
        """It, with its test."""
        return replace(self, test=test)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What `PlacementSearch.run` returns.

    Args:
        search: With all its evaluations.
        picks: What was found, the optimiser's first, of several objectives the middle of its front.
        untested: Why there is no test on fresh worlds; empty if there is one.
        seconds: What it took, with what was spent before it was resumed.
    """

    search: PlacementSearch
    picks: Sequence[Pick]
    untested: str
    seconds: float

    @property
    def best(self) -> Pick | None:
        """The optimiser's; None if no candidate can be, nor the start."""
        return next((pick for pick in self.picks if pick.arm == OPTIMISER), None)

    @property
    def rig(self) -> Rig:
        """The best, or the start if nothing better was found."""
        return self.search.space.start if self.best is None else self.best.rig

    def gains_of(self, pick: Pick) -> Iterator[tuple[str, Measure, FreshGain]]:
        """What it gained on fresh worlds: objective by objective, in the measure of the search first."""
        first = self.search.plan.measure
        for objective, gains in pick.test.gains.items() if pick.test is not None else ():
            for measure in sorted(gains, key=lambda each: each != first):
                yield objective, measure, gains[measure]

    @property
    def hypervolumes(self) -> dict[str, float]:
        """Of the front of each arm, above the least that any candidate of both gained in each objective."""
        gains = {name: arm.gains[arm.complete] for name, arm in self.search.arms.items()}
        every = np.vstack([*gains.values(), np.zeros((1, len(self.search.space.objectives)))])
        return {name: hypervolume(values, every.min(axis=0)) for name, values in gains.items()}

    @property
    def sentence(self) -> str:
        """The last line: what was gained on fresh worlds, and what random search got with the same budget."""
        return " ".join(self._sentences())

    def _sentences(self) -> Iterator[str]:
        search, best = self.search, self.best
        others = search.evaluations[1:]
        refused = [one.infeasible for one in others if one.infeasible]
        if others and len(refused) == len(others):
            yield f"None of {len(others)} candidates can be, the last for this reason: {refused[-1]}."
            return
        if best is None:
            yield f"No candidate of the optimiser can be in {self._spent(OPTIMISER)}."
        elif best.is_start:
            yield f"Nothing better than {search.space.start.name} was found in {self._spent(OPTIMISER)}."
        elif best.test is None:
            yield f"Found in {self._spent(OPTIMISER)}, but not tested, so that no gain is shown: {self.untested}."
        else:
            yield f"{'; '.join(self._told(best))}."
        yield self._control()
        yield f"Racing saved {search.share_saved:.0%} of the instants."

    def _control(self) -> str:
        """What random search got."""
        if len(self.search.space.objectives) > 1:
            volumes = self.hypervolumes
            shares = ", ".join(
                f"{100 * volume / (max(volumes.values()) or 1):.0f} by {name}" for name, volume in volumes.items()
            )
            return f"Hypervolume of the fronts, with the same budget, in per cent of the larger: {shares}."
        other = next((pick for pick in self.picks if pick.arm == RANDOM), None)
        if other is not None and other.test is not None:
            return f"Random search with the same budget: {'; '.join(self._told(other, short=True))}."
        what = "no rig" if other is None else "nothing better" if other.is_start else "a rig that was not tested"
        return f"Random search with the same budget found {what} in {self._spent(RANDOM)}."

    def _told(self, pick: Pick, *, short: bool = False) -> Iterator[str]:
        for objective, measure, gain in self.gains_of(pick):
            if measure != self.search.plan.measure:
                continue
            yield f"{objective}: {told(gain)}" + ("" if short else told_optimism(gain))

    def _spent(self, arm: str) -> str:
        one = self.search.arms[arm]
        return f"{len(one.evaluations) - 1} candidates"

    @property
    def record(self) -> dict[str, Any]:
        """All but the single evaluations: what stands in `search.json`; what nobody knows is None."""
        search, plan = self.search, self.search.plan
        several = len(search.space.objectives) > 1
        record: dict[str, Any] = known(
            {
                **plan.settings(search.space),
                "evaluations": plan.evaluations,
                "budget_s": plan.budget_s,
                "test_seed": plan.seed_of_test,
                "fresh_worlds": plan.fresh_worlds,
                "seconds": round(self.seconds, 3),
                "arms": {name: _arm_record(arm) for name, arm in search.arms.items()},
                "share_of_instants_saved": search.share_saved,
                "hypervolume": self.hypervolumes if several else None,
                "found": [self._pick_record(pick) for pick in self.picks],
                "untested": self.untested or None,
                "sentence": self.sentence,
            }
        )
        return record

    def _pick_record(self, pick: Pick) -> dict[str, Any]:
        return {
            "arm": pick.arm,
            "role": pick.role or None,
            "evaluation": pick.evaluation.number,
            "values": pick.evaluation.values,
            "cost_eur": None if pick.is_start else self.search.space.cost_eur(pick.rig),
            "fresh_instants": None if pick.test is None else pick.test.instants,
            "gains": None
            if pick.test is None
            else {
                name: {measure: asdict(gain) for measure, gain in gains.items()}
                for name, gains in pick.test.gains.items()
            },
        }

    def save(self, folder: str | Path) -> list[Path]:
        """Write the files of the command line; see `save_search`."""
        from torchcover.placement.result_files import save_search

        return save_search(self, Path(folder))


def is_shown(gain: FreshGain) -> bool:
    """Whether a gain or a loss is told from chance: at least two standard errors, of enough worlds."""
    return abs(gain.t) >= ENOUGH_T and gain.p < ENOUGH_P


def told(gain: FreshGain) -> str:
    """A gain in words, which call it one only where it is told from chance.

    Example:
        >>> told(FreshGain(0.0132, 0.0024, 5.5, 0.0001, 16, 16, 0.0148, 0.0016))
        'gained 1.32 ± 0.24 points on 16 fresh worlds (t 5.5, better in 16)'
        >>> told(FreshGain(0.003, 0.004, 0.75, 0.46, 16, 9, 0.0148, 0.0118))
        'no gain is shown: +0.30 ± 0.40 points on 16 fresh worlds (t 0.8, better in 9)'
    """
    if math.isnan(gain.gain):
        return "unknown in every fresh world"
    error = "± ?" if math.isnan(gain.error) else f"± {100 * gain.error:.2f}"
    t = "t unknown" if math.isnan(gain.t) else f"t {gain.t:.1f}"
    rest = f"{error} points on {gain.worlds} fresh worlds ({t}, better in {gain.better})"
    if is_shown(gain) and gain.t > 0:
        return f"gained {100 * gain.gain:.2f} {rest}"
    if is_shown(gain):
        return f"lost {-100 * gain.gain:.2f} {rest}"
    return f"no gain is shown: {100 * gain.gain:+.2f} {rest}"


def told_optimism(gain: FreshGain) -> str:
    """How much more the search had promised, to follow `told`; nothing where nobody knows."""
    return "" if math.isnan(gain.optimism) else f", optimism {100 * gain.optimism:+.2f}"


def _arm_record(arm: Arm) -> dict[str, Any]:
    others = arm.evaluations[1:]
    return {
        "candidates": len(others),
        "infeasible": sum(bool(one.infeasible) for one in others),
        "scored at all instants": len(arm.complete) - (0 in arm.complete),
        "instants": sum(one.instants for one in others),
        "seconds": round(sum(one.seconds for one in others), 3),
    }


def known(value: Any) -> Any:  # noqa: ANN401  (whatever a record holds)
    """A record as JSON can have it: what nobody knows is None."""
    if isinstance(value, Mapping):
        return {key: known(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [known(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
