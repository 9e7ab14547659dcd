"""Encounters as documents: a few numbers each, of which some are swept or drawn."""

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from torchcover.simulation.bodies import Shape, Vehicle, VehicleShape
from torchcover.simulation.document_errors import format_validation_error
from torchcover.simulation.documents import BuiltInDocument, Document, build_name_validator
from torchcover.simulation.returns import CLEAR, Weather

# Of a family: ten times what anybody would wait for.
MOST = 10_000
FASTEST_KMH = 500.0
# The key that tables have a column for; values of others become part of the name.
SPEED = ("ego", "speed_kmh")

KeyPath = tuple[str | int, ...]
SpeedKmh = Annotated[float, Field(ge=-FASTEST_KMH, le=FASTEST_KMH)]


def _body(content: Any) -> Any:  # noqa: ANN401  (whatever stood in the file)
    """The name or file of a vehicle is its shape."""
    return {"type": "vehicle", "vehicle": content} if isinstance(content, str) else content


# At the door, and once: a set has few bodies.
_vehicle = lru_cache(maxsize=64)(Vehicle.load)


def _known(shape: Shape) -> Shape:
    try:
        if isinstance(shape, VehicleShape):
            _vehicle(shape.vehicle)
    except FileNotFoundError as error:
        raise ValueError(str(error)) from error
    return shape


BodyShape = Annotated[Shape, BeforeValidator(_body), AfterValidator(_known)]


class EncounterPath(Document):
    """How somebody comes to the place of the meeting: straight, or around a bend and then straight.

    Args:
        speed_kmh: Constant; negative is in reverse.
        radius_m: Of the bend, positive to the left; straight if not given.
        turn_deg: How much of the bend lies before the meeting, and as much behind it; beyond it the way is straight.
    """

    speed_kmh: SpeedKmh
    radius_m: float | None = None
    turn_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 90.0

    @model_validator(mode="after")
    def _check_radius(self) -> Self:
        if self.radius_m is not None and abs(self.radius_m) < 1.0:
            raise ValueError(f"radius_m: at least 1 m to either side is needed; got {self.radius_m:g}")
        return self

    @property
    def speed_mps(self) -> float:
        """Signed, in metres a second."""
        return self.speed_kmh / 3.6


class EncounteredRoadUser(EncounterPath):
    """Who is met.

    Args:
        body: A built-in vehicle, the YAML file of one, or a shape; people are built-in vehicles, too.
        yaw_deg: Where it heads at the meeting, from the ego's heading to the left: 90 crosses from the right.
        approach_distance_m: How long its way to the meeting is; before, it is not there. From the beginning if not given.
        impact_location: Where its middle is at the meeting, as a share of the ego's width, from its right side.
    """

    body: BodyShape
    yaw_deg: float = 90.0
    approach_distance_m: PositiveFloat | None = None
    impact_location: float = 0.5


class Obstacle(Document):
    """What stands in the way of the sight, beside the ego's way; rows are nearest first.

    Args:
        body: As of `Other`.
        side: Of the ego's way, straight on from the meeting.
        position: Before the meeting, or beyond it.
        lateral_gap_m: Between its side and that of the ego.
        longitudinal_gap_m: Between its end and the outline of the other at the meeting, or the end of the one before on that side.
        yaw_deg: Where it heads, from the ego's heading to the left.
    """

    body: BodyShape
    side: Literal["left", "right"] = "right"
    position: Literal["before", "beyond"] = "before"
    lateral_gap_m: float = 1.0
    longitudinal_gap_m: float = 1.0
    yaw_deg: float = 0.0


class Encounter(Document):
    """Two ways that meet: the middle of the ego's front, of its rear in reverse, reaches the way of the other.

    Args:
        name: What tables call it.
        ego: The vehicle that carries the rig.
        road_user: Who is met.
        obstacles: What hides it.
        weather: Built in, or a YAML file; clear if not given.
        max_lead_time_s: How long before the meeting it begins, unless the other comes later.
        is_speed_swept: Whether tables have a row for this speed of the ego; else it was drawn, among others.
    """

    name: str
    ego: EncounterPath
    road_user: EncounteredRoadUser
    obstacles: tuple[Obstacle, ...] = ()
    weather: Annotated[Weather, build_name_validator(Weather)] = CLEAR
    max_lead_time_s: Annotated[float, Field(gt=0.0, le=60.0)] = 6.0
    is_speed_swept: bool = True

    @model_validator(mode="after")
    def _check_speeds(self) -> Self:
        if self.ego.speed_kmh == 0 and self.road_user.speed_kmh == 0:
            raise ValueError("nobody moves: ego.speed_kmh and other.speed_kmh are 0")
        return self

    @property
    def speed_kmh(self) -> float:
        """Of the ego."""
        return self.ego.speed_kmh

    @property
    def description(self) -> str:
        """Which one of its set."""
        return f"encounter {self.name!r} at {self.speed_kmh:g} km/h"

    @property
    def approach_speed_mps(self) -> float:
        """How fast the other comes towards the ego, along the ego's way; negative if it drives ahead.

        Example:
            >>> car = {"body": "hatchback", "speed_kmh": 54, "yaw_deg": 180}
        >>> oncoming = {"name": "oncoming", "ego": {"speed_kmh": 90}, "road_user": car}
            >>> round(Encounter.model_validate(oncoming).approach_speed_mps, 9)
            15.0
        """
        along_mps = self.road_user.speed_mps * math.cos(math.radians(self.road_user.yaw_deg))
        return -math.copysign(1.0, self.ego.speed_mps) * along_mps

    @property
    def lead_time_s(self) -> float:
        """How long before the meeting it begins."""
        speed_mps, from_m = abs(self.road_user.speed_mps), self.road_user.approach_distance_m
        return (
            self.max_lead_time_s if from_m is None or speed_mps == 0 else min(self.max_lead_time_s, from_m / speed_mps)
        )


class EncounterSet(BuiltInDocument):
    """Encounters of some families. In a family any value may be swept, as a list, or drawn, as `{from: 1.0, to: 1.4}`.

    All lists are combined with each other, and each combination with the same `num_samples` of what is drawn: evenly from
    each range (a Latin hypercube).

    Args:
        name: What tables call it.
        description: What it is, and where its numbers come from.
        num_samples: How many are drawn.
        seed: Of what is drawn.
        encounters: The families; in Python all of their encounters.

    Example:
        >>> crossings = EncounterSet.load("crossing_like").encounters
        >>> len(crossings), crossings[0].name
        (22, 'child from behind a parked car: hatchback')
    """

    kind: ClassVar[str] = "a set of encounters"
    folder: ClassVar[str] = "encounters"

    name: str
    description: str = ""
    num_samples: PositiveInt = 16
    seed: Annotated[int, Field(ge=0)] = 0
    encounters: tuple[Encounter, ...] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _expand(cls, content: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (whatever stood in the file)
        families = content.get("encounters") if isinstance(content, dict) else None
        draws, seed = (
            (content.get(key, usual) for key, usual in (("num_samples", 16), ("seed", 0))) if families else (16, 0)
        )
        sound = isinstance(draws, int) and isinstance(seed, int) and 1 <= draws <= MOST and seed >= 0
        if not isinstance(families, list | tuple) or not sound:
            return content  # which is told field by field
        found, first = list[Any](), dict[str, int]()
        for number, family in enumerate(families):
            if not isinstance(family, dict):
                found.append(family)
                continue
            try:
                for one in expand_family(family, draws, np.random.default_rng([seed, number])):
                    found.append(Encounter.model_validate(one, context=info.context))
                    name = found[-1].name
                    if first.setdefault(name, number) < number:
                        raise ValueError(f"encounters.{first[name]} is called {name!r}, too")
            except ValueError as error:
                words = format_validation_error(error) if isinstance(error, ValidationError) else error
                raise ValueError(f"encounters.{number}: {words}") from error
        return {**content, "encounters": tuple(found)}

    @model_validator(mode="after")
    def _check_directions(self) -> Self:
        forward = {one.name for one in self.encounters if one.speed_kmh > 0}
        if both := next((one.name for one in self.encounters if one.speed_kmh < 0 and one.name in forward), None):
            raise ValueError(f"encounters: {both!r} has speeds forward and in reverse; make an encounter of each")
        return self


def expand_family(family: dict[str, Any], num_samples: int, generator: np.random.Generator) -> Iterator[dict[str, Any]]:
    """The encounters of a family, each with one value where the family has a list or a range.

    ValueError: a list of none, a range that is none, or too many.
    """
    swept, drawn = dict[KeyPath, Any](), dict[KeyPath, Any]()
    for place, value in _leaves(family, ()):
        if isinstance(value, dict):
            drawn[place] = _between(place, value, num_samples, generator)
        else:
            if len(value) == 0:
                raise ValueError(f"{'.'.join(map(str, place))}: a list of values is empty")
            swept[place] = value
    count = math.prod(map(len, swept.values())) * (num_samples if drawn else 1)
    if count > MOST:
        raise ValueError(f"{count:,} encounters of a family, of at most {MOST:,}; sweep or draw less")
    for combination in product(*swept.values()):
        of_swept = dict(zip(swept, combination, strict=True))
        words = [
            value if isinstance(value, str) else f"{place[-1]} {value}"
            for place, value in of_swept.items()
            if place != SPEED
        ]
        for draw in range(num_samples if drawn else 1):
            values = of_swept | {place: each[draw] for place, each in drawn.items()}
            one = _with(family, values, ())
            if words and isinstance(family.get("name"), str):
                one["name"] = f"{family['name']}: {', '.join(words)}"
            if SPEED in drawn:
                one["is_speed_swept"] = False
            yield one


def _leaves(value: Any, place: KeyPath) -> Iterator[tuple[KeyPath, Any]]:  # noqa: ANN401
    """What is swept or drawn; a shape has lists of its own."""
    if isinstance(value, dict):
        if set(value) == {"from", "to"}:
            yield place, value
        elif place[-1:] != ("body",):
            for key, inner in value.items():
                yield from _leaves(inner, (*place, key))
    elif isinstance(value, list | tuple):
        if any(isinstance(each, dict) for each in value):
            for number, inner in enumerate(value):
                yield from _leaves(inner, (*place, number))
        elif place not in (("obstacles",), ("name",)):
            yield place, value


def _between(place: KeyPath, ends: dict[str, Any], draws: int, generator: np.random.Generator) -> list[float]:
    low, high = ends["from"], ends["to"]
    for end in (low, high):
        if isinstance(end, bool) or not isinstance(end, int | float) or not math.isfinite(end):
            raise ValueError(f"{'.'.join(map(str, place))}: two numbers from and to are needed; got {end!r}")
    if low >= high:
        raise ValueError(f"{'.'.join(map(str, place))}: from {low:g} must be below to {high:g}")
    evenly = (generator.permutation(draws) + generator.random(draws)) / draws
    return [float(value) for value in low + evenly * (high - low)]


def _with(value: Any, values: dict[KeyPath, Any], place: KeyPath) -> Any:  # noqa: ANN401
    if place in values:
        return values[place]
    if isinstance(value, dict):
        return {key: _with(inner, values, (*place, key)) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_with(inner, values, (*place, number)) for number, inner in enumerate(value)]
    return value
