"""What a rig must see, as YAML: of bodies at places, of regions, in encounters; and whether numbers keep it."""

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    PositiveFloat,
    PositiveInt,
    Tag,
    ValidationInfo,
    model_validator,
)

from torchcover.coverage import AGGREGATIONS
from torchcover.coverage.quantity import (
    RADIUS,
    make_cells_quantity,
    make_detection_quantity,
    make_redundancy_quantity,
    make_sensor_count_quantity,
)
from torchcover.encounters import Criterion, EncounterSet
from torchcover.encounters.criterion import MOST_LATENCY_S
from torchcover.geometry import BoundingBox
from torchcover.simulation import RegionsOfInterest, Sensor, list_builtin_names
from torchcover.simulation.documents import (
    SEVERAL,
    Bounds,
    BuiltInDocument,
    Coordinate,
    Document,
    NameOrFile,
    build_name_validator,
    resolve_path,
)
from torchcover.simulation.kinds import SENSORS
from torchcover.targets import SIDES, TARGETS
from torchcover.targets.placing import find_sides
from torchcover.targets.survey import HITS, THRESHOLD_M

Float64 = NDArray[np.float64]
Side = Literal["front", "rear", "left", "right"]
State = Literal["kept", "not kept", "not checked"]
Corners = tuple[tuple[Coordinate, Coordinate], ...]

KINDS, ANY = tuple(SENSORS), "any"
# Of a mean over steps, what rounding makes of it.
ROUNDING = 1e-9
# Steps to a side of a place, and the worst places that are named.
MOST_STEPS, TOLD = 1000, 5
# What tables call numbers whose keys say too little.
CALLED = {"ttc_s": "seconds to collision", "spare_s": "seconds to spare"}
# Regions are called alike around any vehicle, and places are about as large.
SOME_VEHICLE = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))


class Bound(NamedTuple):
    """What a number must not be below, or above."""

    key: str
    value: float
    is_minimum: bool = True

    @property
    def text(self) -> str:
        """As in `points >= 5`."""
        return f"{CALLED.get(self.key, self.key)} {'>=' if self.is_minimum else '<='} {self.value:g}"


class Readings(NamedTuple):
    """(N,) values of a number, NaN where unknown, the ends of their 95 % intervals, and where each was measured.

    Both ends are the value where it is exact, and NaN where there is no interval; inf if it may be anything above. In
    `occupied_count` other places there was no room for a body.
    """

    value: Float64
    low: Float64
    high: Float64
    locations: Sequence[str]
    occupied_count: int = 0


class Verdict(NamedTuple):
    """Whether a bound is kept.

    `value`, `low` and `high` are of the worst that is known; `margin` is what it has beyond the bound, in its unit:
    what it lacks if negative, and NaN if that is not checked. Of `total_count` places, regions or encounters, `not_met_count` do not
    keep it and `undecided_count` are not checked; `worst_locations` names the worst of them, else of all. Others had `occupied_count`.
    """

    requirement: str
    bound: Bound
    state: State
    value: float
    low: float
    high: float
    margin: float
    total_count: int
    not_met_count: int
    undecided_count: int
    worst_locations: tuple[str, ...]
    occupied_count: int = 0


def judge_requirements(requirements: "Requirements", readings: Sequence[Mapping[str, Readings]]) -> list[Verdict]:
    """Judge every bound: kept if all of every interval keeps it, not kept if all of one does not, else not checked.

    Args:
        requirements: What is required.
        readings: Of each requirement in turn, the numbers of its bounds, by key; with none in it, nothing is checked.

    Example:
        >>> child = {"target": "child", "at": {"within_m": 2.0}, "points": 5}
        >>> asked, points = Requirements.model_validate({"requirements": [child]}), np.array([9.0, 3.0])
        >>> one, = verdicts(asked, [{"points": Readings(points, points, points, ["ahead", "behind"])}])
        >>> one.state, one.margin, one.where
        ('not kept', -2.0, ('behind',))
    """
    pairs = zip(requirements.requirements, readings, strict=True)
    return [_judged(one.text, bound, numbers[bound.key]) for one, numbers in pairs for bound in one.bounds]


def _judged(words: str, bound: Bound, measured: Readings) -> Verdict:
    sign = 1.0 if bound.is_minimum else -1.0
    beyond, *ends = (sign * (each - bound.value) for each in measured[:3])
    kept, failed = np.minimum(*ends) >= -ROUNDING, np.maximum(*ends) < -ROUNDING  # NaN is neither
    unknown, order = ~(kept | failed), np.argsort(beyond, kind="stable")  # NaN is last
    told = order[(failed if failed.any() else unknown if unknown.any() else kept)[order]][:TOLD].tolist()
    of_worst = (float(each[order[0]]) if len(order) else np.nan for each in (*measured[:3], beyond))
    state: State = "not kept" if failed.any() else "kept" if len(kept) and kept.all() else "not checked"
    (value, low, high, margin), where = of_worst, tuple(measured.locations[k] for k in told)
    margin = np.nan if state == "not checked" else margin
    counts = len(kept), int(failed.sum()), int(unknown.sum())
    return Verdict(words, bound, state, value, low, high, margin, *counts, where, measured.occupied_count)


def _check_called(what: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Refuse names that nothing has, with the nearest."""
    names = list(known)
    for name in given:
        if name not in names:
            near = get_close_matches(name, names, n=1)
            meant = f"is {near[0]!r} meant?" if near else f"there are {', '.join(names) or 'none'}"
            raise ValueError(f"no {what} is called {name!r}; {meant}")


class TargetPositions(Document):
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
        spacing_m: How far apart bodies are put.

    Example:
        >>> car = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> TargetPositions(x_m=(-1.0, -0.2), relative_to="rear", step_m=2.0).positions_m(car).tolist()
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
    spacing_m: Annotated[float, Field(ge=0.01)] = 0.2

    @model_validator(mode="after")
    def _check_one_of(self) -> Self:
        forms = (self.within_m, self.x_m or self.y_m, self.polygon_m, self.line_m, self.points_m)
        if sum(form is not None for form in forms) != 1:
            raise ValueError("give one of within_m, x_m and y_m, polygon_m, line_m, points_m")
        if (self.sides and not self.within_m) or (self.relative_to and self.within_m):
            raise ValueError("sides are of within_m, and relative_to is of the others")
        if self.polygon_m and not shapely.Polygon(self.polygon_m).is_valid:
            raise ValueError("polygon_m: its sides cross, or lie on each other")
        self.compute_positions_m(SOME_VEHICLE)  # not too many
        return self

    def compute_positions_m(self, vehicle: BoundingBox) -> Float64:
        """(P, 2) in the frame of a vehicle. ValueError: more than 1000 to a side."""
        low_m, high_m = np.array(vehicle.lower_m[:2]), np.array(vehicle.upper_m[:2])
        towards = {None: (0, 0), "front": (1, 0), "rear": (-1, 0), "left": (0, 1), "right": (0, -1)}[self.relative_to]
        origin_m = (low_m + high_m + (high_m - low_m) * towards) / 2 * bool(self.relative_to)
        places_m: Float64 = np.array(self.points_m or (), dtype=np.float64)
        if self.line_m is not None:
            line = shapely.LineString(self.line_m)
            places_m = shapely.get_coordinates(line.interpolate(self._between(0.0, line.length)))
        elif self.points_m is None:
            own_m = np.stack([low_m, high_m], axis=1) - origin_m[:, None]
            (x0, x1), (y0, y1) = self.x_m or own_m[0], self.y_m or own_m[1]
            area = shapely.Polygon(self.polygon_m) if self.polygon_m else shapely.box(x0, y0, x1, y1)
            area = area.buffer(self.within_m or 0.0)
            x0, y0, x1, y1 = area.bounds
            there_m = np.stack(np.meshgrid(self._between(x0, x1), self._between(y0, y1)), axis=-1).reshape(-1, 2)
            there = shapely.intersects_xy(area, there_m)
            if self.within_m:
                there &= np.isin(find_sides(vehicle, there_m), [*map(SIDES.index, self.sides or SIDES)])
            places_m = there_m[there]
        return np.asarray(origin_m + places_m)

    def _between(self, low_m: float, high_m: float) -> Float64:
        """Both ends, and as many steps in between as it takes."""
        steps = int(np.ceil((high_m - low_m) / self.spacing_m - ROUNDING))
        if steps > MOST_STEPS:
            raise ValueError(f"a place of {high_m - low_m:g} m in steps of {self.spacing_m:g} m; take a larger step_m")
        return np.linspace(low_m, high_m, steps + 1)


Names = Annotated[tuple[str, ...], SEVERAL]


class _Requirement(Document):
    """What each has.

    Args:
        name: What tables call it.
        failing_sensors: Sensors that may fail, one at a time: a name or several, or "any".
    """

    name: str = ""
    failing_sensors: Names = ()

    @property
    def bounds(self) -> list[Bound]:
        """What is required."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _check_bounds(self) -> Self:
        if not self.bounds:
            raise ValueError("nothing is required: give a number that it must have")
        return self

    def format_text(self, text: str) -> str:
        """What it says, after its own name."""
        lost = f", also without {' or '.join(self.failing_sensors)}" * bool(self.failing_sensors)
        return f"{self.name}: " * bool(self.name) + text + lost

    def find_failing_sensors(self, sensor_names: Sequence[str]) -> list[str]:
        """Those of a rig's sensors that may fail. ValueError: the rig has none of a name."""
        _check_called("sensor", self.failing_sensors, [*sensor_names, ANY])
        return list(sensor_names if ANY in self.failing_sensors else self.failing_sensors)


def _target(given: str, info: ValidationInfo) -> str:
    if Path(given).suffix:
        return str(resolve_path(Path(given), info))
    _check_called("target", [given], [*TARGETS, *list_builtin_names("vehicles")])
    return given


class TargetRequirement(_Requirement):
    """What must be seen of a body wherever it is put.

    Args:
        target: "child", a built-in vehicle, the YAML file of one, or a mesh, as of `torchcover targets`.
        positions: A place, or the name of one of the file's.
        counted_sensors: Only these sensors count: a name or a kind ("lidar", "camera", "radar"), or several; all if not given.
        detection_points: Points that are enough for `sensors` and `visual_angle_deg`.
        points: Least number of points on it, in every step.
        pixels: Least number of pixels of the full image of one camera, in every step.
        sensors: Least number of sensors with enough points each, in every step.
        share: Least share of its visible surface within 0.4 m of a point on it, over all steps.
        visual_angle_deg: Least angle from its foot to its top, at a sensor that has enough points in every step.
    """

    target: Annotated[str, AfterValidator(_target)]
    positions: Annotated[
        Annotated[str, Tag("(name)")] | Annotated[TargetPositions, Tag("(place)")],
        Discriminator(lambda given: "(name)" if isinstance(given, str) else "(place)"),
    ]
    counted_sensors: Annotated[Names, Field(min_length=1)] = KINDS
    detection_points: PositiveInt = HITS
    points: PositiveFloat | None = None
    pixels: PositiveFloat | None = None
    sensors: PositiveInt | None = None
    share: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    visual_angle_deg: Annotated[float, Field(gt=0.0, lt=180.0)] | None = None

    @property
    def bounds(self) -> list[Bound]:
        """What is required."""
        keys = ("points", "pixels", "sensors", "share", "visual_angle_deg")
        return [Bound(key, getattr(self, key)) for key in keys if getattr(self, key)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        left = len(set(self.counted_sensors)) - any(one in (ANY, *self.counted_sensors) for one in self.failing_sensors)
        few = (self.sensors or 1) > left and not set(KINDS).intersection(self.counted_sensors)
        if few or (self.pixels and {"lidar", "radar"}.issuperset(self.counted_sensors)):
            both = ", ".join(bound.text for bound in self.bounds)
            raise ValueError(f"requirements contradict each other: {self.text}: {both}")
        return self

    @property
    def text(self) -> str:
        """Of what, where, by which sensors."""
        place = {} if isinstance(self.positions, str) else self.positions.model_dump(exclude_unset=True, mode="json")
        at = " ".join(f"{key} {value}" for key, value in place.items()) or self.positions
        by = f", by {', '.join(self.counted_sensors)}" * (
            self.counted_sensors != KINDS
        ) + f", hits {self.detection_points}" * (self.detection_points != HITS)
        return self.format_text(f"{Path(TARGETS.get(self.target, self.target)).stem}, {at}{by}")

    def group_sensors(self, sensors: Sequence[Sensor]) -> dict[str, list[int]]:
        """Numbers of the sensors that count, and of those without each that may fail; by what is then said of where."""
        _check_called("sensor", self.counted_sensors, [*(one.name for one in sensors), *KINDS])
        of_kinds = tuple(of for kind, of in SENSORS.items() if kind in self.counted_sensors)
        counts = [k for k, one in enumerate(sensors) if one.name in self.counted_sensors or isinstance(one, of_kinds)]
        names = self.find_failing_sensors([one.name for one in sensors])
        lost = [k for k in counts if sensors[k].name in names]  # the others change nothing
        return {"": counts} | {f", without {sensors[k].name}": [each for each in counts if each != k] for k in lost}


class RegionRequirement(_Requirement):
    """What a number of a region must be.

    Args:
        region: As the file's `regions` call it; without these, as the usual table: "20m", "front_3m", ...
        band: Of the height band.
        number: By the name of its column in `summary.csv`: "detection_0.4m", "radius_m", "seen_by_two_0.4m", ...
        min_value: What it must not be below, if more of it is better.
        max_value: What it must not be above, if less of it is.
    """

    region: str
    band: str
    number: str
    min_value: float | None = None
    max_value: float | None = None

    @property
    def bounds(self) -> list[Bound]:
        """What is required."""
        both = (self.min_value, True), (self.max_value, False)
        return [Bound(self.number, value, is_least) for value, is_least in both if value is not None]

    @property
    def threshold_m(self) -> float | None:
        """In the name of the number; None if there is none."""
        found = re.search(r"_(\d+(?:\.\d+)?)m$", self.number)
        return float(found[1]) if found else None

    @model_validator(mode="after")
    def _check(self) -> Self:
        threshold_m = self.threshold_m or THRESHOLD_M
        both = RADIUS, make_detection_quantity(threshold_m)
        known = [
            *both,
            *map(make_cells_quantity, both),
            make_sensor_count_quantity(threshold_m),
            make_redundancy_quantity(threshold_m),
        ]
        known += [
            one for of in AGGREGATIONS for one in (of.from_keys({self.number}) or of.parse(of.example)).quantities
        ]
        _check_called("number of a region", [self.number], [one.key for one in known])
        quantity = next(one for one in known if one.key == self.number)
        better, right, wrong = ("less", "most", "least") if quantity.lower_is_better else ("more", "least", "most")
        if getattr(self, wrong) is not None:
            raise ValueError(f"{wrong}: of {self.number} {better} is better; {right} is meant")
        most = 1.0 if quantity.unit == "share" else np.inf
        if any(not 0.0 < bound.value <= most for bound in self.bounds):
            raise ValueError(f"{self.bounds[0].text}: it is above 0{' and at most 1' * (most == 1)}")
        if self.failing_sensors and quantity not in both:
            raise ValueError(f"without: radius_m and detections are known without a sensor; got {self.number}")
        return self

    @property
    def text(self) -> str:
        """Where."""
        return self.format_text(f"{self.region} {self.band}")


class BrakingModel(Document):
    """What braking needs: v / (2 x deceleration) + latency_s.

    Args:
        deceleration_mps2: Of the brakes, in m/s2.
        latency_s: From the detection to the brakes.
    """

    deceleration_mps2: PositiveFloat = 9.0
    latency_s: Annotated[float, Field(ge=0, le=MOST_LATENCY_S)] = 0.5


class EncounterRequirement(_Requirement):
    """When the other must be detected in each encounter of a set: in every phase of the looks, and every draw.

    Args:
        encounters: A set, built in or a YAML file, as of `torchcover encounter`.
        ttc_s: Least time to collision at detection.
        braking: So early that braking still prevents it.
        points: So many points on the other, `pixels` and `consecutive_scans` are a detection, as of `Criterion`.
        pixels: Of a camera.
        consecutive_scans: In a row.
    """

    encounters: Annotated[EncounterSet, build_name_validator(EncounterSet)]
    ttc_s: PositiveFloat | None = None
    braking: BrakingModel | None = None
    points: PositiveInt = Criterion.points
    pixels: PositiveInt = Criterion.pixels
    consecutive_scans: PositiveInt = Criterion.consecutive_scans

    @property
    def bounds(self) -> list[Bound]:
        """What is required: `spare_s` is what the time to collision has beyond what braking needs."""
        ttc = [] if self.ttc_s is None else [Bound("ttc_s", self.ttc_s)]
        return ttc if self.braking is None else [*ttc, Bound("spare_s", 0.0)]

    @property
    def criterion(self) -> Criterion:
        """What is detected, and what is in time."""
        brakes = self.braking or BrakingModel()
        return Criterion(self.points, self.pixels, self.consecutive_scans, brakes.deceleration_mps2, brakes.latency_s)

    @property
    def text(self) -> str:
        """In which encounters, and by what."""
        given: dict[str, float] = self.model_dump(include=self.model_fields_set & {"points", "pixels", "looks"})
        given |= self.braking.model_dump() if self.braking else {}
        return self.format_text(
            ", ".join((self.encounters.name, *(f"{key} {value:g}" for key, value in given.items())))
        )


def _kind(content: Any) -> str | None:  # noqa: ANN401
    keys = content if isinstance(content, dict) else getattr(content, "model_fields_set", ())
    return next((f"({key})" for key in ("target", "region", "encounters") if key in keys), None)


AnyRequirement = Annotated[
    Annotated[TargetRequirement, Tag("(target)")]
    | Annotated[RegionRequirement, Tag("(region)")]
    | Annotated[EncounterRequirement, Tag("(encounters)")],
    Discriminator(_kind, custom_error_type="kind", custom_error_message="give target, region or encounters"),
]


class Requirements(BuiltInDocument, RegionsOfInterest):
    """Requirements of a rig on any vehicle; `regions`, `heights` and `grid` are those of `RegionsOfInterest`.

    Args:
        name: What tables call them.
        description: What they are, and where their numbers come from.
        scenario: The world; not given, regions are in that of `evaluate`, and bodies on flat ground.
        position_sets: By name.
        requirements: All of them must be kept.
    """

    kind: ClassVar[str] = "a set of requirements"
    folder: ClassVar[str] = "requirements"

    name: str = "requirements"
    description: str = ""
    scenario: NameOrFile | None = None
    position_sets: dict[str, TargetPositions] = Field(default_factory=dict)
    requirements: Annotated[tuple[AnyRequirement, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        with warnings.catch_warnings(action="ignore"):  # of what lies within a vehicle, which is not known yet
            asked = self.build_query_plan(SOME_VEHICLE.outline_m)
        for one in self.requirements:
            if isinstance(one, TargetRequirement) and isinstance(one.positions, str):
                _check_called("place", [one.positions], self.position_sets)
            if isinstance(one, RegionRequirement):
                _check_called("region", [one.region], [region.name for region in asked.regions])
                _check_called("height band", [one.band], asked.grid.heights)
        told = Counter(f"{one.text}: {bound.text}" for one in self.requirements for bound in one.bounds)
        if (twice := told.most_common(1)[0])[1] > 1:
            raise ValueError(f"several requirements read {twice[0]!r}; give each a name, or leave all but one out")
        return self
