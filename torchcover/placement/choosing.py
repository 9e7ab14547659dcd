"""Choose some of many candidates, and test the choice in fresh worlds."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from torchcover import __version__
from torchcover.coverage import Measure
from torchcover.coverage.regions import Places
from torchcover.estimation import Number
from torchcover.evaluation.result import sensor_model_words
from torchcover.evaluation.settings import FILES
from torchcover.neighbors import nearest
from torchcover.placement.choice_space import ChoiceSpace
from torchcover.placement.common_instants import CommonInstants
from torchcover.placement.fresh import FreshGain, fresh_test, told
from torchcover.placement.report_files import PlacementReport
from torchcover.placement.subsets import (
    Bytes,
    Candidates,
    Limits,
    Subset,
    Worth,
    exact,
    greedy,
    marginal_values,
    random_subsets,
)
from torchcover.report import ChoiceSize, PageTable, Words, draw_choice
from torchcover.simulation import Rig, Sensor
from torchcover.simulation.reference_sensor import DEFAULT_BAND_FRAME

OBJECTIVE = "objective"
# Random choices that keep to the limits, as a control.
DRAWN = 1000
HEADINGS = ("sensor", "alone (%)", "lost without it\n(points)", "cost (EUR)")
# Sizes of choices that are looked at, for the picture.
MOST_SIZES = 12


@dataclass(frozen=True, eq=False)
class SensorChoice:
    """What was chosen, and how good that is.

    Args:
        space: What there was to choose from.
        estimate: What the choice is by.
        sensor_model: What its sensors make of their hits, `ideal` or `real`.
        sensors: The candidates that can be mounted.
        refused: Name of each of the others, and why it cannot be.
        candidates: What each of `sensors` sees.
        limits: What the choice keeps to.
        greedy: The greedy choice.
        best: The best that was found.
        number: What its rig scores, from the same observers as `evaluate`.
        drawn: Random choices, by value, ascending.
        now: What it is compared with.
        gain: On fresh worlds; None if the two are the same, or there are no fresh worlds.
        untested: Why there is no test.
    """

    space: ChoiceSpace
    estimate: Measure
    sensor_model: str
    sensors: tuple[Sensor, ...]
    refused: dict[str, str]
    candidates: Candidates
    limits: Limits
    greedy: Subset
    best: Subset
    number: Number
    drawn: tuple[Subset, ...]
    now: tuple[int, ...]
    gain: FreshGain | None
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
    def sentence(self) -> str:
        """What it comes to."""
        gap = self.best.upper_bound - self.best.value
        kind = "the best there is" if self.best.proven else f"at most {100 * gap:.2f} points below the best"
        found = f"{', '.join(self.names(self.best.chosen))}: {100 * self.number.value:.2f} %, {kind}"
        (model,) = sensor_model_words({self.rig.name: self.sensor_model})
        if self.gain is None:
            return f"{found}; not tested in fresh worlds: {self.untested}. {model}"
        return f"{found}. Against {', '.join(self.names(self.now))}: {told(self.gain, optimism=True)}. {model}"

    @property
    def report(self) -> PlacementReport:
        """For its files, its page, and the terminal."""
        table = PageTable(f"{self.space.name}: {len(self.sensors)} candidates", HEADINGS, self._chosen_rows(), 1)
        record = self._record
        return PlacementReport(
            title=f"{self.space.name}: which sensors, and how many?",
            sentence=self.sentence,
            record=record,
            settings=[name for name in record if name != "torchcover"],
            rigs={"best.yaml": self.rig},
            shown={"best": self.rig, "now": self.rig_of(self.now, f"{self.space.name}_now")},
            tables=[table],
            rows={"candidates.csv": self._candidate_rows(), "sizes.csv": [ChoiceSize._fields, *self._sizes]},
            pictures=self._pictures,
            ego_outline_m=self.space.scenarios[0].ego_box().outline_m,
        )

    def save(self, folder: str | Path, *, files: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of the command line; see `PlacementReport.save`.

        They are `best.yaml`, `candidates.csv`, `sizes.csv`, `search.json`, `sizes.png`, `report.html`, `summary.json`.
        """
        return self.report.save(folder, files=files)

    @property
    def _record(self) -> dict[str, Any]:
        return {
            "torchcover": __version__,
            "choice": self.space.name,
            "estimate": self.estimate,
            "sensor_model": self.sensor_model,
            "band_frame": DEFAULT_BAND_FRAME,
            "best": {
                "sensors": self.names(self.best.chosen),
                "value": self.number.value,
                "error": self.number.error,
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
            "fresh": self.gain and self.gain.record,
            "refused": self.refused,
        }

    def _candidate_rows(self) -> Iterator[Sequence[object]]:
        """A row for each candidate, with a heading: values are shares, with what is always there."""
        lost = dict(zip(self.best.chosen, self.marginal_values, strict=True))
        yield ["name", "value_alone", "cost_eur", "chosen", "lost_without", "why_not"]
        for at, sensor in enumerate(self.sensors):
            yield [sensor.name, self.candidates.value([at]), self._price(at), at in lost, lost.get(at), ""]
        for name, why in self.refused.items():
            yield [name, "", "", False, "", why]

    def _chosen_rows(self) -> list[tuple[Words, ...]]:
        """Cells below `HEADINGS`, in the order in which the sensors were chosen."""
        rows = []
        for at, lost in zip(self.best.chosen, self.marginal_values, strict=True):
            price = self._price(at)
            numbers = f"{100 * self.candidates.value([at]):.2f}", f"{100 * lost:.2f}"
            rows.append(tuple(map(Words, (self.sensors[at].name, *numbers, "-" if price is None else f"{price:g}"))))
        return rows

    def _price(self, at: int) -> float | None:
        return self.limits.price([at]) if self.space.cost else None

    @cached_property
    def _sizes(self) -> list[ChoiceSize]:
        """The best choices of so many sensors."""
        found = []
        for size in range(1, min(self.limits.most, MOST_SIZES) + 1):
            same = size == len(self.best.chosen)
            best = self.best if same else greedy(self.candidates, replace(self.limits, most=size))
            if len(best.chosen) == size:
                found.append(ChoiceSize(size, best.value, best.upper_bound))
        return found

    def _pictures(self) -> Iterator[tuple[str, str, Figure]]:
        drawn = [one.value for one in self.drawn]
        figure = draw_choice(self._sizes, drawn, len(self.best.chosen), self.best.value, title=self.space.name)
        yield "sizes", "What more sensors bring, and what random choices are worth", figure


def choose(
    space: ChoiceSpace,
    instants: CommonInstants,
    *,
    test_seed: int,
    fresh_worlds: int,
) -> SensorChoice:
    """Find the best choice of candidates, and compare it with today's in worlds that it was not chosen by.

    Each candidate is scanned once at each instant. The distance to the nearest point of several sensors is the least of
    their distances, so that what a choice sees is the OR of what its sensors see. Noise and drop-out are drawn anew for
    each place in a rig's list of sensors: there it is that of other draws.

    Args:
        space: The candidates and the limits.
        instants: Of the scenarios of the space, for the objective "objective".
        test_seed: Seed of the fresh worlds.
        fresh_worlds: How many.

    Raises:
        ValueError: No candidate can be mounted, or sees anything that counts; one of `now` cannot be mounted; the
            sensor model is to be real, and of none of the chosen sensors that is known.
    """
    sensors, bits, refused = _mounted(space, instants)
    always = seen_by(space.always, instants) if space.always else np.zeros_like(bits[0])
    candidates = Candidates(worth_of(instants), bits, always)
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
    rig = space.rig(tuple(sensors[one] for one in best.chosen), f"{space.name}_best")
    number = instants.estimates(rig)[instants.estimate].numbers()[OBJECTIVE]
    control = greedy(candidates, limits), best, number, tuple(drawn), now
    model = rig.sensing(instants.sensor_model).sensor_model
    found = SensorChoice(space, instants.estimate, model, sensors, refused, candidates, limits, *control, None, "")
    return _tested(found, instants, test_seed, fresh_worlds)


def seen_by(rig: Rig, instants: CommonInstants) -> Bytes:
    """(B,) uint8: which reference points have a point of a rig within the threshold, eight a byte, instant by instant.

    Each instant begins a byte of its own.

    Raises:
        ValueError: The rig cannot be mounted.
    """
    (threshold,) = instants.questions.thresholds_m
    found = []
    for frame in instants.frames(rig):
        points = frame.cloud_of(within_m=threshold)
        distance = nearest(frame.reference, points, max_distance=instants.questions.max_radius_m).distance
        found.append(np.packbits((distance <= threshold).numpy()))
    return np.concatenate(found)


def worth_of(instants: CommonInstants) -> Worth:
    """What each reference point adds to the objective: the same numbers as those of `CoverageMetric`.

    By area, a point is worth its share of the square metres that are seen. Over known cells it is worth its share of
    the square metres in its cell at its instant, which share the cell with its other instants, and that the mean with
    all known cells.

    Raises:
        ValueError: A region and band that no instant shows.
    """
    questions, grid = instants.questions, instants.questions.grid
    frames = list(instants.frames())
    of_bits = [torch.zeros(-(-len(frame.reference) // 8) * 8, dtype=torch.float64) for frame in frames]
    places = questions.objectives[OBJECTIVE].places
    for region, band in places:
        where = Places([questions.regions[region]], grid)
        cells = torch.zeros(grid.shape, dtype=torch.bool)
        cells[list(grid.heights).index(band)] = where.regions[0].mask(grid)
        of_places, m2, probed = [], torch.zeros(0), torch.zeros(grid.cells, dtype=torch.int64)
        for frame in frames:
            inside, of, cell = grid.bins(frame.reference, frame.heights_in(grid.band_frame))
            if instants.estimate == "area":
                place, point = where.of_points(frame.reference[inside[of]], cell)
                own = point[place == where.number_of(where.regions[0], band)]
            else:
                own = cells.view(-1)[cell].nonzero().squeeze(1)
            points, cell = inside[of[own]], cell[own]
            assert frame.reference_weights is not None  # square metres
            weight = frame.reference_weights[points].double()
            of_places.append((points, weight, cell))
            m2, probed = torch.cat([m2, weight]), probed + torch.bincount(cell, minlength=grid.cells).bool()
        if not len(m2):
            raise ValueError(f"objective: no instant shows any surface of {band} in {region}; use more worlds")
        for worth, (points, weight, cell) in zip(of_bits, of_places, strict=True):
            share = weight / m2.sum()
            if instants.estimate == "known":
                of_cell = torch.bincount(cell, weights=weight, minlength=grid.cells)
                share = weight / of_cell[cell] / probed[cell] / (probed > 0).sum()
            worth.index_add_(0, points, share / len(places))
    return Worth(torch.cat(of_bits).numpy())


def _mounted(space: ChoiceSpace, instants: CommonInstants) -> tuple[tuple[Sensor, ...], list[Bytes], dict[str, str]]:
    """The candidates that can be mounted, what they see, and why the others cannot."""
    sensors: list[Sensor] = []
    bits: list[Bytes] = []
    refused: dict[str, str] = {}
    for sensor in space.sensors:
        if space.too_close(sensor):
            refused[sensor.name] = "a sensor that is always there is too close"
            continue
        alone = Rig(name=sensor.name, vehicle=space.rig((sensor,), "any").vehicle, sensors=(sensor,))
        try:
            bits.append(seen_by(alone, instants))
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
    return replace(found, gain=tests["best"][0])
