"""Encounters as documents: a few numbers each, some of which are swept or sampled."""

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
from torchcover.simulation.documents import BuiltInDocument, Document, build_name_validator, explain_document_error
from torchcover.simulation.returns import CLEAR, Weather

KeyPath = tuple[str | int, ...]

# Limit of a family; its evaluation takes hours.
MAX_ENCOUNTERS = 10_000
# Speed of the ego vehicle, which has its own column in tables; values of other keys become part of the name.
EGO_SPEED_KEY = ("ego", "speed_kmh")


def convert_vehicle_name(content: Any) -> Any:  # noqa: ANN401  (any content of a file)
    """Convert the name or file of a vehicle to a shape; return other content unchanged."""
    return {"type": "vehicle", "vehicle": content} if isinstance(content, str) else content


@lru_cache(maxsize=64)
def load_vehicle(name: str) -> Vehicle:
    """Load a vehicle once; a set of encounters has few different ones."""
    return Vehicle.load(name)


def check_body_exists(shape: Shape) -> Shape:
    """Check that the vehicle of a shape exists.

    Args:
        shape: Shape of a road user or an obstacle.

    Returns:
        The shape.

    Raises:
        ValueError: There is no such vehicle or file.
    """
    try:
        if isinstance(shape, VehicleShape):
            load_vehicle(shape.vehicle)
    except FileNotFoundError as error:
        raise ValueError(str(error)) from error
    return shape


SpeedKmh = Annotated[float, Field(ge=-500.0, le=500.0)]
BodyShape = Annotated[Shape, BeforeValidator(convert_vehicle_name), AfterValidator(check_body_exists)]


class EncounterPath(Document):
    """Path to the meeting point at constant speed: straight, or through a bend.

    Args:
        speed_kmh: Speed; negative in reverse.
        radius_m: Radius of the bend, positive to the left; default: straight.
        turn_deg: Angle of the bend before the meeting point, and again behind it; the path is straight beyond.
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
        """Signed speed in meters per second."""
        return self.speed_kmh / 3.6


class EncounteredRoadUser(EncounterPath):
    """Road user on a collision course with the ego vehicle.

    Args:
        speed_kmh: Speed; negative in reverse.
        radius_m: Radius of the bend, positive to the left; default: straight.
        turn_deg: Angle of the bend before the meeting point, and again behind it.
        body: A built-in vehicle (people, too), the YAML file of a vehicle, or a shape.
        yaw_deg: Heading at the meeting point relative to the ego vehicle, counterclockwise: 90 crosses from the right.
        approach_distance_m: Length of its path to the meeting point; it appears there. Default: as long as the
            encounter lasts.
        impact_location: Lateral position of its center at the meeting point: 0 at the right side of the ego vehicle,
            1 at its left side.
    """

    body: BodyShape
    yaw_deg: float = 90.0
    approach_distance_m: PositiveFloat | None = None
    impact_location: float = 0.5


class Obstacle(Document):
    """Static occluder next to the path of the ego vehicle; the obstacles of one side form rows, the nearest first.

    Args:
        body: As for `EncounteredRoadUser`.
        side: Side of the path of the ego vehicle, extended straight through the meeting point.
        position: Before or beyond the meeting point.
        lateral_gap_m: Gap between its side and the side of the ego vehicle.
        longitudinal_gap_m: Gap to the outline of the road user at the meeting point, or to the previous obstacle of the
            row.
        yaw_deg: Heading relative to the ego vehicle, counterclockwise.
    """

    body: BodyShape
    side: Literal["left", "right"] = "right"
    position: Literal["before", "beyond"] = "before"
    lateral_gap_m: float = 1.0
    longitudinal_gap_m: float = 1.0
    yaw_deg: float = 0.0


class Encounter(Document):
    """Two paths that meet: the center of the ego vehicle's front (rear in reverse) reaches the path of the road user.

    Args:
        name: Name in tables.
        ego: Path of the vehicle that carries the rig.
        road_user: The other road user.
        obstacles: Occluders.
        weather: Built-in weather or a YAML file; default: clear.
        max_lead_time_s: Time from the begin to the meeting point; shorter if the road user appears later.
        is_speed_swept: True if tables have a row for this speed of the ego vehicle, False for a sampled speed.
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
            raise ValueError("neither vehicle moves: ego.speed_kmh and road_user.speed_kmh are 0")
        return self

    @property
    def speed_kmh(self) -> float:
        """Speed of the ego vehicle."""
        return self.ego.speed_kmh

    @property
    def description(self) -> str:
        """Name and speed, for messages."""
        return f"encounter {self.name!r} at {self.speed_kmh:g} km/h"

    @property
    def approach_speed_mps(self) -> float:
        """Speed of the road user towards the ego vehicle along its path; negative if it drives ahead.

        Example:
            >>> road_user = {"body": "hatchback", "speed_kmh": 54, "yaw_deg": 180}
            >>> content = {"name": "oncoming", "ego": {"speed_kmh": 90}, "road_user": road_user}
            >>> round(Encounter.model_validate(content).approach_speed_mps, 9)
            15.0
        """
        along_path_mps = self.road_user.speed_mps * math.cos(math.radians(self.road_user.yaw_deg))
        return -math.copysign(1.0, self.ego.speed_mps) * along_path_mps

    @property
    def lead_time_s(self) -> float:
        """Time from the begin of the encounter to the meeting point."""
        speed_mps, distance_m = abs(self.road_user.speed_mps), self.road_user.approach_distance_m
        if distance_m is None or speed_mps == 0:
            return self.max_lead_time_s
        return min(self.max_lead_time_s, distance_m / speed_mps)


class EncounterSet(BuiltInDocument):
    """Families of encounters. Any value of a family may be swept, as a list, or sampled, as `{from: 1.0, to: 1.4}`.

    All lists are combined with each other, and each combination with the same `num_samples` sampled values, which
    cover each range evenly (a Latin hypercube).

    Args:
        name: Name in tables.
        description: Contents and source of the numbers.
        num_samples: Number of samples.
        seed: Seed of the samples.
        encounters: The families in a file; in Python all their encounters.

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
    def _expand_families(cls, content: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (any content of a file)
        families = content.get("encounters") if isinstance(content, dict) else None
        if not isinstance(families, list | tuple):
            return content  # refused field by field
        num_samples, seed = content.get("num_samples", 16), content.get("seed", 0)
        are_integers = isinstance(num_samples, int) and isinstance(seed, int)
        if not (are_integers and 1 <= num_samples <= MAX_ENCOUNTERS and seed >= 0):
            return content
        encounters = list[Any]()
        family_of_name = dict[str, int]()
        for family_index, family in enumerate(families):
            if not isinstance(family, dict):
                encounters.append(family)
                continue
            try:
                for values in expand_family(family, num_samples, np.random.default_rng([seed, family_index])):
                    encounter = Encounter.model_validate(values, context=info.context)
                    encounters.append(encounter)
                    first_index = family_of_name.setdefault(encounter.name, family_index)
                    if first_index < family_index:
                        raise ValueError(f"the name {encounter.name!r} is already used by encounters.{first_index}")
            except ValueError as error:
                message = explain_document_error(error) if isinstance(error, ValidationError) else error
                raise ValueError(f"encounters.{family_index}: {message}") from error
        return {**content, "encounters": tuple(encounters)}

    @model_validator(mode="after")
    def _check_directions(self) -> Self:
        forward_names = {encounter.name for encounter in self.encounters if encounter.speed_kmh > 0}
        for encounter in self.encounters:
            if encounter.speed_kmh < 0 and encounter.name in forward_names:
                raise ValueError(
                    f"encounters: {encounter.name!r} has speeds forward and in reverse; make an encounter of each"
                )
        return self


def expand_family(family: dict[str, Any], num_samples: int, generator: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Iterate over the encounters of a family, each with one value where the family has a list or a range.

    Args:
        family: Content of the file.
        num_samples: Number of samples of each range.
        generator: Source of the random numbers.

    Yields:
        Content of each encounter.

    Raises:
        ValueError: An empty list, an invalid range, or too many encounters.
    """
    swept_values, sampled_values = dict[KeyPath, Any](), dict[KeyPath, Any]()
    for key_path, value in iterate_varied_values(family, ()):
        if isinstance(value, dict):
            sampled_values[key_path] = sample_range(key_path, value, num_samples, generator)
        elif len(value) == 0:
            raise ValueError(f"{format_key_path(key_path)}: a list of values is empty")
        else:
            swept_values[key_path] = value
    samples_per_combination = num_samples if sampled_values else 1
    num_encounters = samples_per_combination * math.prod([len(values) for values in swept_values.values()])
    if num_encounters > MAX_ENCOUNTERS:
        raise ValueError(
            f"{num_encounters:,} encounters of a family exceed the limit of {MAX_ENCOUNTERS:,}; sweep or sample fewer "
            "values"
        )
    for combination in product(*swept_values.values()):
        values = dict(zip(swept_values, combination, strict=True))
        labels = format_swept_values(values)
        for sample in range(samples_per_combination):
            values |= {key_path: samples[sample] for key_path, samples in sampled_values.items()}
            encounter = replace_values(family, values, ())
            if labels and isinstance(family.get("name"), str):
                encounter["name"] = f"{family['name']}: {labels}"
            if EGO_SPEED_KEY in sampled_values:
                encounter["is_speed_swept"] = False
            yield encounter


def format_swept_values(values: dict[KeyPath, Any]) -> str:
    """Format the swept values of an encounter for its name, except for the speed of the ego vehicle.

    Args:
        values: Values by their path.

    Returns:
        Texts such as `van, yaw_deg 90`.
    """
    labels = []
    for key_path, value in values.items():
        if key_path != EGO_SPEED_KEY:
            labels.append(value if isinstance(value, str) else f"{key_path[-1]} {value}")
    return ", ".join(labels)


def format_key_path(key_path: KeyPath) -> str:
    """Format the path of a key in a document, such as `ego.speed_kmh`."""
    return ".".join(str(key) for key in key_path)


def iterate_varied_values(value: Any, key_path: KeyPath) -> Iterator[tuple[KeyPath, Any]]:  # noqa: ANN401
    """Iterate over the lists and ranges of a family.

    Args:
        value: The family, or a part of it.
        key_path: Path of the part.

    Yields:
        Path and value of each list or range. Shapes are skipped, as their lists are no sweeps.
    """
    if isinstance(value, dict):
        if set(value) == {"from", "to"}:
            yield key_path, value
        elif key_path[-1:] != ("body",):
            for key, inner in value.items():
                yield from iterate_varied_values(inner, (*key_path, key))
    elif isinstance(value, list | tuple):
        if any(isinstance(inner, dict) for inner in value):
            for index, inner in enumerate(value):
                yield from iterate_varied_values(inner, (*key_path, index))
        elif key_path not in (("obstacles",), ("name",)):
            yield key_path, value


def sample_range(
    key_path: KeyPath, bounds: dict[str, Any], num_samples: int, generator: np.random.Generator
) -> list[float]:
    """Sample a range so that each of `num_samples` equal parts has one value, in random order.

    Args:
        key_path: Path of the range, for messages.
        bounds: Content with the keys `from` and `to`.
        num_samples: Number of values.
        generator: Source of the random numbers.

    Returns:
        The values.

    Raises:
        ValueError: The bounds are no finite numbers in ascending order.
    """
    low, high = bounds["from"], bounds["to"]
    for bound in (low, high):
        if isinstance(bound, bool) or not isinstance(bound, int | float) or not math.isfinite(bound):
            raise ValueError(f"{format_key_path(key_path)}: two numbers from and to are needed; got {bound!r}")
    if low >= high:
        raise ValueError(f"{format_key_path(key_path)}: from {low:g} must be below to {high:g}")
    shares = (generator.permutation(num_samples) + generator.random(num_samples)) / num_samples
    samples: list[float] = (low + shares * (high - low)).tolist()
    return samples


def replace_values(value: Any, values: dict[KeyPath, Any], key_path: KeyPath) -> Any:  # noqa: ANN401
    """Replace the values at some paths of a document.

    Args:
        value: The document, or a part of it.
        values: New values by their path.
        key_path: Path of the part.

    Returns:
        Copy with the new values.
    """
    if key_path in values:
        return values[key_path]
    if isinstance(value, dict):
        return {key: replace_values(inner, values, (*key_path, key)) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [replace_values(inner, values, (*key_path, index)) for index, inner in enumerate(value)]
    return value
