"""What a rig must see, as YAML: of bodies at places, of regions, in encounters; and whether numbers keep it."""

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Tag,
    ValidationInfo,
    model_validator,
)

from torchcover.coverage import AGGREGATIONS
from torchcover.encounters import Criterion, EncounterSet
from torchcover.geometry import BoundingBox
from torchcover.simulation import RegionsOfInterest, Sensor, builtin_names
from torchcover.simulation.documents import Bounds, BuiltIn, Coordinate, Document, NameOrFile, beside, is_file_name
from torchcover.simulation.kinds import SENSORS
from torchcover.targets import SIDES, TARGETS, Raster
from torchcover.targets.raster import from_outline_m, side_of

Float64 = NDArray[np.float64]
Share = Annotated[float, Field(gt=0.0, le=1.0)]
Side = Literal["front", "rear", "left", "right"]
State = Literal["kept", "not kept", "not checked"]
Corners = tuple[tuple[Coordinate, Coordinate], ...]

KINDS = tuple(SENSORS)
# Of a mean over steps, what rounding makes of it.
ROUNDING = 1e-9
MOST_STEPS = 1000
# Numbers of a region that are no aggregation's, and what they may have been meant for.
PLAIN = re.compile(r"(?:known_)?radius_m|(?:known_detection|detection|sensors|seen_by_two)_(\d+(?:\.\d+)?)m")
LIKE = ("radius_m", "known_radius_m", "detection_0.4m", "known_detection_0.4m", "sensors_0.4m", "seen_by_two_0.4m")
# Of some vehicle: regions are called alike around any.
SOME_OUTLINE_M = np.array([[-2.0, -1.0], [2.0, 1.0]])


class Bound(NamedTuple):
    """What a number must not be below, or above."""

    key: str
    value: float
    is_least: bool = True

    @property
    def words(self) -> str:
        """As in `points >= 5`."""
        return f"{self.key} {'>=' if self.is_least else '<='} {self.value:g}"


class Readings(NamedTuple):
    """(N,) values of a number, NaN where unknown, the ends of their 95 % intervals, and where each was measured.

    Both ends are the value where it is exact, and NaN where there is no interval.
    """

    value: Float64
    low: Float64
    high: Float64
    where: Sequence[str]


class Verdict(NamedTuple):
    """Whether a bound is kept.

    `value`, `low` and `high` are of the worst that is known; `margin` is what it has beyond the bound, in its unit:
    what it lacks if negative. Of `count` places, regions or encounters, `failed` do not keep it and `unknown` are not
    checked; `where` names the worst of them, else of all.
    """

    requirement: str
    bound: Bound
    state: State
    value: float
    low: float
    high: float
    margin: float
    count: int  # type: ignore[assignment]  # hides tuple.count
    failed: int
    unknown: int
    where: tuple[str, ...]


def verdicts(requirements: "Requirements", measured: Sequence[Mapping[str, Readings]], tell: int = 5) -> list[Verdict]:
    """Judge every bound: kept if all of every interval keeps it, not kept if all of one does not, else not checked.

    Args:
        requirements: What is required.
        measured: Of each requirement in turn, the numbers of its bounds, by key; with none in it, nothing is checked.
        tell: How many of the worst places to name.

    Example:
        >>> child = {"target": "child", "at": {"within_m": 2.0}, "points": 5}
        >>> asked, points = Requirements.model_validate({"requirements": [child]}), np.array([9.0, 3.0])
        >>> one, = verdicts(asked, [{"points": Readings(points, points, points, ["ahead", "behind"])}])
        >>> one.state, one.margin, one.where
        ('not kept', -2.0, ('behind',))
    """
    pairs = zip(requirements.requirements, measured, strict=True)
    return [_judged(one.words, bound, numbers[bound.key], tell) for one, numbers in pairs for bound in one.bounds]


def _judged(words: str, bound: Bound, measured: Readings, tell: int) -> Verdict:
    sign = 1.0 if bound.is_least else -1.0
    margin, *ends = (sign * (each - bound.value) for each in measured[:3])
    kept, failed = np.minimum(*ends) >= -ROUNDING, np.maximum(*ends) < -ROUNDING  # NaN is neither
    unknown, order = ~(kept | failed), np.argsort(margin, kind="stable")  # NaN is last
    told = order[(failed if failed.any() else unknown if unknown.any() else kept)[order]][:tell].tolist()
    worst = [float(each[order[0]]) if len(order) else np.nan for each in (*measured[:3], margin)]
    state: State = "not kept" if failed.any() else "kept" if len(kept) and kept.all() else "not checked"
    counts, where = (len(kept), int(failed.sum()), int(unknown.sum())), tuple(measured.where[k] for k in told)
    return Verdict(words, bound, state, *worst, *counts, where)  # type: ignore[call-arg, arg-type]  # of these lengths


def check_called(what: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Refuse names that nothing has.

    Raises:
        ValueError: Such a one; with the nearest.
    """
    names = list(known)
    for name in given:
        if name not in names:
            near = get_close_matches(name, names, n=1)
            meant = f"is {near[0]!r} meant?" if near else f"there are {', '.join(names) or 'none'}"
            raise ValueError(f"no {what} is called {name!r}; {meant}")


class BodyPlaces(Document):
    """Where the middle of a body is put: one of five, in metres.

    Args:
        within_m: All around, up to this distance from the vehicle's box.
        sides: With `within_m`: there only, from corners at 45 degrees.
        x_m: Bounds forward of a rectangle; the vehicle's length if only y_m is given.
        y_m: Bounds to the left; the vehicle's width if only x_m is given.
        polygon_m: Corners x, y of an area, one after the other around it.
        line_m: Corners x, y of a line.
        points_m: Points x, y, at each of which there must be room.
        relative_to: The side of the vehicle's box from whose middle all x and y count; if not given, from its origin.
        step_m: How far apart bodies are put.

    Example:
        >>> car = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> BodyPlaces(x_m=(-1.0, -0.2), relative_to="rear", step_m=2.0).positions_m(car).tolist()
        [[-3.0, -1.0], [-2.2, -1.0], [-3.0, 1.0], [-2.2, 1.0]]
    """

    within_m: PositiveFloat | None = None
    sides: tuple[Side, ...] | None = Field(default=None, min_length=1)
    x_m: Bounds | None = None
    y_m: Bounds | None = None
    polygon_m: Annotated[Corners, Field(min_length=3)] | None = None
    line_m: Annotated[Corners, Field(min_length=2)] | None = None
    points_m: Annotated[Corners, Field(min_length=1)] | None = None
    relative_to: Side | None = None
    step_m: Annotated[float, Field(ge=0.01)] = 0.2

    @model_validator(mode="after")
    def _check_one_of(self) -> Self:
        forms = (self.within_m, self.x_m or self.y_m, self.polygon_m, self.line_m, self.points_m)
        if sum(form is not None for form in forms) != 1:
            raise ValueError("give one of within_m, x_m and y_m, polygon_m, line_m, points_m")
        if (self.sides and not self.within_m) or (self.relative_to and self.within_m):
            raise ValueError("sides are of within_m, and relative_to is of the others")
        if self.polygon_m and not shapely.Polygon(self.polygon_m).is_valid:
            raise ValueError("polygon_m: its sides cross, or lie on each other")
        return self

    def positions_m(self, vehicle: BoundingBox) -> Float64:
        """(P, 2) in the frame of a vehicle.

        Raises:
            ValueError: More than 1000 to a side.
        """
        low_m, high_m = np.array(vehicle.lower_m[:2]), np.array(vehicle.upper_m[:2])
        towards = {None: (0, 0), "front": (1, 0), "rear": (-1, 0), "left": (0, 1), "right": (0, -1)}[self.relative_to]
        middle_m = (low_m + high_m) / 2 if self.relative_to else np.zeros(2)
        origin_m = middle_m + (high_m - low_m) / 2 * towards
        places_m: Float64 = np.array(self.points_m or (), dtype=np.float64)
        if self.within_m is not None:
            around_m, sides = Raster.around(vehicle, self.within_m, self.step_m).positions_m, self.sides or SIDES
            near = np.linalg.norm(from_outline_m(vehicle, around_m), axis=1) <= self.within_m
            places_m = around_m[near & np.isin(side_of(vehicle, around_m), [-1, *map(SIDES.index, sides)])]
        elif self.line_m is not None:
            line = shapely.LineString(self.line_m)
            places_m = shapely.get_coordinates(line.interpolate(self._between(0.0, line.length)))
        elif self.points_m is None:
            own_m = np.stack([low_m, high_m], axis=1) - origin_m[:, None]
            (x0, x1), (y0, y1) = self.x_m or own_m[0], self.y_m or own_m[1]
            area = shapely.Polygon(self.polygon_m) if self.polygon_m else shapely.box(x0, y0, x1, y1)
            x0, y0, x1, y1 = area.bounds
            there_m = np.stack(np.meshgrid(self._between(x0, x1), self._between(y0, y1)), axis=-1).reshape(-1, 2)
            places_m = there_m[shapely.intersects_xy(area, there_m)]
        in_vehicle_m: Float64 = origin_m + places_m
        return in_vehicle_m

    def _between(self, low_m: float, high_m: float) -> Float64:
        """Both ends, and as many steps in between as it takes."""
        steps = int(np.ceil((high_m - low_m) / self.step_m - ROUNDING))
        if steps > MOST_STEPS:
            raise ValueError(f"a place of {high_m - low_m:g} m in steps of {self.step_m:g} m; take a larger step_m")
        return np.linspace(low_m, high_m, steps + 1)


class _Requirement(Document):
    """What each has.

    Args:
        name: What tables call it.
        without: Sensors that may fail, one at a time: names, or "any".
    """

    name: str = ""
    without: Literal["any"] | tuple[str, ...] = ()

    @property
    def bounds(self) -> list[Bound]:
        """What is required."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _check_bounds(self) -> Self:
        if not self.bounds:
            raise ValueError("nothing is required: give a number that it must have")
        return self

    def told(self, words: str) -> str:
        """What it says, after its own name."""
        lost = self.without if isinstance(self.without, str) else " or ".join(self.without)
        return f"{self.name}: " * bool(self.name) + words + f", also without {lost}" * bool(lost)

    def failing(self, sensors: Sequence[str]) -> list[str]:
        """Those of a rig's sensors that may fail.

        Raises:
            ValueError: The rig has none of a name.
        """
        if self.without != "any":
            check_called("sensor", self.without, sensors)
        return list(sensors if self.without == "any" else self.without)


def _target(given: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (whatever stood in the file)
    if isinstance(given, str) and Path(given).suffix:
        return str(beside(Path(given), info))
    if isinstance(given, str):
        check_called("target", [given], [*TARGETS, *builtin_names("vehicles")])
    return given


class TargetRequirement(_Requirement):
    """What must be seen of a body wherever it is put.

    Args:
        target: "child", a built-in vehicle, the YAML file of one, or a mesh, as of `torchcover targets`.
        at: A place, or the name of one of the file's.
        by: Only these sensors count: a name or a kind ("lidar", "camera", "radar"), or several; all if not given.
        hits: Points that are enough for `sensors`, `seen` and `visual_angle_deg`.
        points: Least number of points on it, in every step.
        pixels: Least number of pixels of the full image of one camera, in every step.
        sensors: Least number of sensors with enough points each, in every step.
        seen: Least share of the steps with enough points.
        share: Least share of its visible surface within 0.4 m of a point on it, over all steps.
        visual_angle_deg: Least angle from its foot to its top, at a sensor that has enough points in every step.
    """

    target: Annotated[str, BeforeValidator(_target)]
    at: str | BodyPlaces
    by: str | Annotated[tuple[str, ...], Field(min_length=1)] = KINDS
    hits: PositiveInt = 5
    points: PositiveFloat | None = None
    pixels: PositiveFloat | None = None
    sensors: PositiveFloat | None = None
    seen: Share | None = None
    share: Share | None = None
    visual_angle_deg: PositiveFloat | None = None

    @property
    def bounds(self) -> list[Bound]:
        """What is required."""
        keys = ("points", "pixels", "sensors", "seen", "share", "visual_angle_deg")
        return [Bound(key, getattr(self, key)) for key in keys if getattr(self, key)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        few = self.sensors and self.sensors > len(self._by) and not set(KINDS).intersection(self._by)
        if few or (self.pixels and {"lidar", "radar"}.issuperset(self._by)):
            both = ", ".join(bound.words for bound in self.bounds)
            raise ValueError(f"requirements contradict each other: {self.words}: {both}")
        return self

    @property
    def _by(self) -> tuple[str, ...]:
        return (self.by,) if isinstance(self.by, str) else self.by

    @property
    def words(self) -> str:
        """Of what, where, by which sensors."""
        place = {} if isinstance(self.at, str) else self.at.model_dump(exclude_unset=True, mode="json")
        at = " ".join(f"{key} {value}" for key, value in place.items()) or self.at
        return self.told(f"{self.target}, {at}" + f", by {', '.join(self._by)}" * (self.by != KINDS))

    def failing(self, sensors: Sequence[str]) -> list[str]:
        """As of all."""
        check_called("sensor", self._by, [*sensors, *KINDS])
        return super().failing(sensors)

    def groups(self, sensors: Sequence[Sensor]) -> dict[str, list[int]]:
        """Numbers of the sensors that count, and of those without each that may fail; by what is then said of where."""
        of_kinds = tuple(of for kind, of in SENSORS.items() if kind in self._by)
        counts = [k for k, one in enumerate(sensors) if one.name in self._by or isinstance(one, of_kinds)]
        names = self.failing([one.name for one in sensors])
        lost = [k for k in counts if sensors[k].name in names]  # the others change nothing
        return {"": counts} | {f", without {sensors[k].name}": [each for each in counts if each != k] for k in lost}


class RegionRequirement(_Requirement):
    """What a number of a region must be.

    Args:
        region: As the file's `regions` call it; without these, as the usual table: "20m", "front_3m", ...
        height: Of the height band.
        number: By the name of its column in `summary.csv`: "detection_0.4m", "radius_m", "seen_by_two_0.4m", ...
        least: What it must not be below.
        most: What it must not be above.
    """

    region: str
    height: str
    number: str
    least: float = -np.inf
    most: float = np.inf

    @property
    def bounds(self) -> list[Bound]:
        """What is required."""
        both = Bound(self.number, self.least), Bound(self.number, self.most, is_least=False)
        return [bound for bound in both if np.isfinite(bound.value)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not PLAIN.fullmatch(self.number) and not any(kind.of_keys({self.number}) for kind in AGGREGATIONS):
            check_called("number of a region", [self.number], LIKE)
        if self.least > 1.0 and ("detection_" in self.number or "seen_by" in self.number):
            raise ValueError(f"least: {self.number} is a share of at most 1; got {self.least:g}")
        if self.without and self.number != "radius_m" and not self.number.startswith("detection_"):
            raise ValueError(f"without: radius_m and detections are known without a sensor; got {self.number}")
        return self

    @property
    def words(self) -> str:
        """Where."""
        return self.told(f"{self.region} {self.height}")


class InTime(Document):
    """What braking needs: v / (2 x deceleration) + latency_s.

    Args:
        deceleration: Of the brakes, in m/s2.
        latency_s: From the detection to the brakes.
    """

    deceleration: PositiveFloat = 9.0
    latency_s: NonNegativeFloat = 0.5


def _encounters(given: Any, info: ValidationInfo) -> Any:  # noqa: ANN401
    if isinstance(given, str) and is_file_name(given):
        return EncounterSet.load(beside(Path(given), info))
    if isinstance(given, str):
        check_called("set of encounters", [given], builtin_names("encounters"))
        return EncounterSet.load(given)
    return given


class EncounterRequirement(_Requirement):
    """When the other must be detected in each encounter of a set: in every phase of the looks, and every draw.

    Args:
        encounters: A set, built in or a YAML file, as of `torchcover encounter`.
        ttc_s: Least time to collision at detection.
        in_time: So early that braking still prevents it.
        points: So many points on the other, `pixels` and `looks` are a detection, as of `Criterion`.
        pixels: Of a camera.
        looks: In a row.
    """

    encounters: Annotated[EncounterSet, BeforeValidator(_encounters)]
    ttc_s: PositiveFloat | None = None
    in_time: InTime | None = None
    points: PositiveInt = Criterion.points
    pixels: PositiveInt = Criterion.pixels
    looks: PositiveInt = Criterion.looks

    @property
    def bounds(self) -> list[Bound]:
        """What is required: `spare_s` is what the time to collision has beyond what braking needs."""
        ttc = [] if self.ttc_s is None else [Bound("ttc_s", self.ttc_s)]
        return ttc if self.in_time is None else [*ttc, Bound("spare_s", 0.0)]

    @property
    def criterion(self) -> Criterion:
        """What is detected, and what is in time."""
        brakes = self.in_time or InTime()
        return Criterion(self.points, self.pixels, self.looks, brakes.deceleration, brakes.latency_s)

    @property
    def words(self) -> str:
        """In which encounters."""
        return self.told(self.encounters.name)


def _kind(content: Any) -> str | None:  # noqa: ANN401
    keys = content if isinstance(content, dict) else getattr(content, "model_fields_set", ())
    return next((key for key in ("target", "region", "encounters") if key in keys), None)


AnyRequirement = Annotated[
    Annotated[TargetRequirement, Tag("target")]
    | Annotated[RegionRequirement, Tag("region")]
    | Annotated[EncounterRequirement, Tag("encounters")],
    Discriminator(_kind, custom_error_type="kind", custom_error_message="give target, region or encounters"),
]


class Requirements(BuiltIn, RegionsOfInterest):
    """Requirements of a rig on any vehicle; `regions`, `heights` and `grid` are those of `RegionsOfInterest`.

    Args:
        name: What tables call them.
        description: What they are, and where their numbers come from.
        scenario: The world; not given, regions are in that of `evaluate`, and bodies on flat ground.
        places: By name.
        requirements: All of them must be kept.
    """

    folder: ClassVar[str] = "requirements"

    name: str = "requirements"
    description: str = ""
    scenario: NameOrFile | None = None
    places: dict[str, BodyPlaces] = Field(default_factory=dict)
    requirements: Annotated[tuple[AnyRequirement, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        with warnings.catch_warnings(action="ignore"):  # of what lies within a vehicle, which is not known yet
            asked = self.around(SOME_OUTLINE_M)
        ends: dict[tuple[str, ...], tuple[float, float]] = {}
        for one in self.requirements:
            if isinstance(one, TargetRequirement) and isinstance(one.at, str):
                check_called("place", [one.at], self.places)
            if isinstance(one, RegionRequirement):
                check_called("region", [one.region], [region.name for region in asked.regions])
                check_called("height band", [one.height], asked.grid.heights)
                place = one.region, one.height, one.number
                least, most = ends.get(place, (-np.inf, np.inf))
                ends[place] = least, most = max(least, one.least), min(most, one.most)
                if least > most:
                    words = f"{' '.join(place)} is to be at least {least:g} and at most {most:g}"
                    raise ValueError(f"requirements contradict each other: {words}")
        return self
