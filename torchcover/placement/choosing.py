"""Choose some of many candidates, and test the choice in fresh worlds."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from torchcover import __version__
from torchcover.coverage import Measure
from torchcover.placement.bits import Bits
from torchcover.placement.choice_space import ChoiceSpace
from torchcover.placement.common_instants import CommonInstants
from torchcover.placement.fresh import FreshGain, FreshTest, fresh_test
from torchcover.placement.result import known, told, told_optimism
from torchcover.placement.subsets import Candidates, Limits, Subset, exact, greedy, marginal_values, random_subsets
from torchcover.placement.worth import Worth
from torchcover.simulation import Rig, Sensor

OBJECTIVE = "objective"
# Random choices that keep to the limits, as a control.
DRAWN = 1000


@dataclass(frozen=True, eq=False)
class SensorChoice:
    """What was chosen, and how good that is.

    Args:
        space: What there was to choose from.
        measure: What the choice is by.
        sensors: The candidates that can be mounted.
        refused: Name of each of the others, and why it cannot be.
        candidates: What each of `sensors` sees.
        limits: What the choice keeps to.
        greedy: The greedy choice.
        best: The best that was found.
        drawn: Random choices, by value, ascending.
        now: What it is compared with.
        test: That comparison in fresh worlds; None if the two are the same, or there are no fresh worlds.
        untested: Why there is no test.
    """

    space: ChoiceSpace
    measure: Measure
    sensors: tuple[Sensor, ...]
    refused: dict[str, str]
    candidates: Candidates
    limits: Limits
    greedy: Subset
    best: Subset
    drawn: tuple[Subset, ...]
    now: tuple[int, ...]
    test: FreshTest | None
    untested: str

    @cached_property
    def rig(self) -> Rig:
        """The rig of the best choice."""
        return self.rig_of(self.best.chosen, f"{self.space.name}_best")

    def rig_of(self, chosen: tuple[int, ...], name: str) -> Rig:
        """The rig of a choice."""
        return self.space.rig(tuple(self.sensors[one] for one in chosen), name)

    def names(self, chosen: tuple[int, ...]) -> tuple[str, ...]:
        """What the sensors of a choice are called."""
        return tuple(self.sensors[one].name for one in chosen)

    @cached_property
    def marginal_values(self) -> list[float]:
        """What is lost when each of the chosen sensors fails."""
        return marginal_values(self.candidates, self.best.chosen)

    @property
    def better_than_drawn(self) -> float:
        """The share of random choices that are worth less."""
        return float(np.mean([one.value < self.best.value for one in self.drawn]))

    @property
    def gain(self) -> FreshGain | None:
        """On fresh worlds."""
        return None if self.test is None else self.test.gains[OBJECTIVE][self.measure]

    @property
    def sentence(self) -> str:
        """What it comes to."""
        kind = "the best there is" if self.best.proven else f"at most {100 * self._gap:.2f} points below the best"
        found = f"{', '.join(self.names(self.best.chosen))}: {100 * self.best.value:.2f} %, {kind}"
        if self.gain is None:
            return f"{found}; not tested in fresh worlds: {self.untested}."
        now = ", ".join(self.names(self.now))
        return f"{found}. Against {now}: {told(self.gain)}{told_optimism(self.gain)}."

    @property
    def _gap(self) -> float:
        return self.best.upper_bound - self.best.value

    @property
    def record(self) -> dict[str, Any]:
        """All of it, for JSON; what nobody knows is None."""
        record: dict[str, Any] = known(
            {
                "torchcover": __version__,
                "choice": self.space.name,
                "measure": self.measure,
                "sentence": self.sentence,
                "best": {
                    "sensors": self.names(self.best.chosen),
                    "value": self.best.value,
                    "upper_bound": self.best.upper_bound,
                    "proven": self.best.proven,
                    "cost_eur": self.limits.price(self.best.chosen) if self.space.cost else None,
                    "lost_without": dict(zip(self.names(self.best.chosen), self.marginal_values, strict=True)),
                },
                "greedy": {"sensors": self.names(self.greedy.chosen), "value": self.greedy.value},
                "drawn": {
                    "count": len(self.drawn),
                    "median": self.drawn[len(self.drawn) // 2].value,
                    "best": self.drawn[-1].value,
                    "share_below_best": self.better_than_drawn,
                },
                "now": {"sensors": self.names(self.now), "value": self.candidates.value(self.now)},
                "fresh": None if self.gain is None else vars(self.gain),
                "refused": self.refused,
            }
        )
        return record


def choose(
    space: ChoiceSpace,
    instants: CommonInstants,
    *,
    test_seed: int,
    fresh_worlds: int,
    measure: Measure = "area",
) -> SensorChoice:
    """Find the best choice of candidates, and compare it with today's in worlds that it was not chosen by.

    Each candidate is scanned once at each instant; what a choice sees is the OR of what its sensors see.

    Args:
        space: The candidates and the limits.
        instants: Of the scenarios of the space, for the objective "objective".
        test_seed: Seed of the fresh worlds.
        fresh_worlds: How many.
        measure: What a value is.

    Raises:
        ValueError: No candidate can be mounted, or sees anything that counts; one of `now` cannot be mounted.
    """
    sensors, bits, refused = _mounted(space, instants)
    always = instants.bits(space.always).seen if space.always else np.zeros_like(bits[0].seen)
    candidates = Candidates(Worth.of_objective(instants, OBJECTIVE, measure), [one.seen for one in bits], always)
    numbers = {sensor.name: number for number, sensor in enumerate(space.sensors)}
    limits = space.limits([numbers[sensor.name] for sensor in sensors])
    best = exact(candidates, limits)
    if not best.chosen:
        raise ValueError(
            f"candidates: none of the {len(sensors)} that can be there adds anything to the objective; move or turn "
            "them, or ask about places that they see"
        )
    drawn = sorted(random_subsets(candidates, limits, DRAWN, instants.seed), key=lambda one: one.value)
    now = drawn[len(drawn) // 2].chosen
    if space.now is not None:
        places = {sensor.name: at for at, sensor in enumerate(sensors)}
        if lost := [name for name in space.now if name not in places]:
            raise ValueError(f"now: {lost[0]} cannot be there: {refused[lost[0]]}")
        now = tuple(places[name] for name in space.now)
    found = SensorChoice(
        space,
        measure,
        sensors,
        refused,
        candidates,
        limits,
        greedy(candidates, limits),
        best,
        tuple(drawn),
        now,
        None,
        "",
    )
    return _tested(found, instants, test_seed, fresh_worlds)


def _mounted(space: ChoiceSpace, instants: CommonInstants) -> tuple[tuple[Sensor, ...], list[Bits], dict[str, str]]:
    """The candidates that can be mounted, what they see, and why the others cannot."""
    sensors: list[Sensor] = []
    bits: list[Bits] = []
    refused: dict[str, str] = {}
    for sensor in space.sensors:
        if space.too_close(sensor):
            refused[sensor.name] = "a sensor that is always there is too close"
            continue
        alone = Rig(name=sensor.name, vehicle=space.rig((sensor,), "any").vehicle, sensors=(sensor,))
        try:
            bits.append(instants.bits(alone))
        except ValueError as error:
            refused[sensor.name] = str(error)
            continue
        sensors.append(sensor)
    if not sensors:
        name, why = next(iter(refused.items()))
        raise ValueError(f"candidates: none of {len(refused)} can be there; of {name}: {why}")
    return tuple(sensors), bits, refused


def _tested(found: SensorChoice, instants: CommonInstants, test_seed: int, worlds: int) -> SensorChoice:
    if set(found.best.chosen) == set(found.now):
        return replace(found, untested="it is what is there today")
    now = found.rig_of(found.now, f"{found.space.name}_now")
    try:
        tests = fresh_test({"best": found.rig}, now, instants, test_seed=test_seed, worlds=worlds)
    except ValueError as error:
        return replace(found, untested=str(error))
    return replace(found, test=tests["best"])
