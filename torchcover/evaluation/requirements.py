"""Requirements as YAML documents: on test targets at positions, on numbers of regions, and on encounters."""

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
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
from torchcover.coverage.quantities import (
    RADIUS,
    make_cells_quantity,
    make_detection_quantity,
    make_redundancy_quantity,
    make_sensor_count_quantity,
)
from torchcover.encounters import Criterion, EncounterSet
from torchcover.encounters.criterion import MAX_LATENCY_S
from torchcover.estimation import Quantity
from torchcover.evaluation.target_positions import EXAMPLE_VEHICLE, TargetPositions
from torchcover.evaluation.verdicts import Bound
from torchcover.simulation import RegionsOfInterest, Sensor, list_builtin_names
from torchcover.simulation.documents import (
    SEVERAL,
    BuiltInDocument,
    Document,
    NameOrFile,
    build_name_validator,
    resolve_path,
)
from torchcover.simulation.kinds import SENSORS
from torchcover.targets import TARGETS
from torchcover.targets.visibility import DETECTION_POINTS, THRESHOLD_M

Names = Annotated[tuple[str, ...], SEVERAL]

SENSOR_KINDS = tuple(SENSORS)
# Value of `failing_sensors` that stands for every sensor.
ANY_SENSOR = "any"


def _check_names(kind: str, names: Iterable[str], valid_names: Iterable[str]) -> None:
    """Raise ValueError for an unknown name, with the most similar valid one."""
    valid = list(valid_names)
    for name in names:
        if name not in valid:
            similar = get_close_matches(name, valid, n=1)
            advice = f"is {similar[0]!r} meant?" if similar else f"there are {', '.join(valid) or 'none'}"
            raise ValueError(f"no {kind} is called {name!r}; {advice}")


class _Requirement(Document):
    """Common fields of all requirements.

    Args:
        name: Name in tables.
        failing_sensors: The requirement must also hold without each of these sensors, one at a time; "any" for all.
    """

    name: str = ""
    failing_sensors: Names = ()

    @property
    def bounds(self) -> list[Bound]:
        """Bounds of the requirement."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _check_bounds(self) -> Self:
        """Raise ValueError if no number has a bound."""
        if not self.bounds:
            raise ValueError("nothing is required: give a number that it must have")
        return self

    def format_text(self, text: str) -> str:
        """Add the name and the failing sensors to the text of a requirement.

        Args:
            text: Text of the requirement itself.
        """
        name = f"{self.name}: " if self.name else ""
        failures = f", also without {' or '.join(self.failing_sensors)}" if self.failing_sensors else ""
        return name + text + failures

    def find_failing_sensors(self, sensor_names: Sequence[str]) -> list[str]:
        """Find the sensors of a rig that may fail.

        Args:
            sensor_names: Names of all sensors of the rig.

        Returns:
            Names of the sensors without which the requirement must also hold.

        Raises:
            ValueError: The rig lacks a sensor of this name.
        """
        _check_names("sensor", self.failing_sensors, [*sensor_names, ANY_SENSOR])
        return list(sensor_names if ANY_SENSOR in self.failing_sensors else self.failing_sensors)


def _validate_target(target: str, info: ValidationInfo) -> str:
    """Resolve the path of a target, or check its name."""
    if Path(target).suffix:
        return str(resolve_path(Path(target), info))
    _check_names("target", [target], [*TARGETS, *list_builtin_names("vehicles")])
    return target


class TargetRequirement(_Requirement):
    """Requirement on a test target at every position of a set, in every frame.

    Args:
        target: "child", a built-in vehicle, the YAML file of one, or a mesh file, as in `torchcover targets`.
        positions: Positions, or the name of a set in `position_sets`.
        counted_sensors: Names or kinds ("lidar", "camera", "radar") of the sensors that count; all if not given.
        detection_points: Points on the target with which a sensor counts for `sensors` and `visual_angle_deg`.
        points: Minimum number of points on the target in each frame.
        pixels: Minimum number of pixels in the full image of one camera in each frame.
        sensors: Minimum number of sensors that detect the target in each frame.
        share: Minimum share of its visible surface within 0.4 m of a point on it, over all frames.
        visual_angle_deg: Minimum vertical angle of the target at a sensor that detects it in each frame.
    """

    target: Annotated[str, AfterValidator(_validate_target)]
    positions: Annotated[
        Annotated[str, Tag("(name)")] | Annotated[TargetPositions, Tag("(positions)")],
        Discriminator(lambda content: "(name)" if isinstance(content, str) else "(positions)"),
    ]
    counted_sensors: Annotated[Names, Field(min_length=1)] = SENSOR_KINDS
    detection_points: PositiveInt = DETECTION_POINTS
    points: PositiveFloat | None = None
    pixels: PositiveFloat | None = None
    sensors: PositiveInt | None = None
    share: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    visual_angle_deg: Annotated[float, Field(gt=0.0, lt=180.0)] | None = None

    @property
    def bounds(self) -> list[Bound]:
        """Bounds of the requirement; all are minima."""
        keys = ("points", "pixels", "sensors", "share", "visual_angle_deg")
        return [Bound(key, getattr(self, key)) for key in keys if getattr(self, key)]

    @model_validator(mode="after")
    def _check_contradictions(self) -> Self:
        """Raise ValueError if the counted sensors can never meet the bounds."""
        names, failing = set(self.counted_sensors), set(self.failing_sensors)
        has_kind = bool(names.intersection(SENSOR_KINDS))
        num_remaining = len(names) - bool(failing & {ANY_SENSOR, *names})
        too_few_sensors = (self.sensors or 1) > num_remaining and not has_kind
        pixels_without_camera = self.pixels and names <= {"lidar", "radar"}
        if too_few_sensors or pixels_without_camera:
            bounds = ", ".join(bound.text for bound in self.bounds)
            raise ValueError(f"requirements contradict each other: {self.text}: {bounds}")
        return self

    @property
    def text(self) -> str:
        """Target, positions and sensors in words."""
        target = Path(TARGETS.get(self.target, self.target)).stem
        positions = self.positions
        if not isinstance(positions, str):
            fields = positions.model_dump(exclude_unset=True, mode="json")
            positions = " ".join(f"{key} {value}" for key, value in fields.items())
        text = f"{target}, {positions}"
        if self.counted_sensors != SENSOR_KINDS:
            text += f", by {', '.join(self.counted_sensors)}"
        if self.detection_points != DETECTION_POINTS:
            text += f", detection_points {self.detection_points}"
        return self.format_text(text)

    def group_sensors(self, sensors: Sequence[Sensor]) -> dict[str, list[int]]:
        """Group the sensors that count: all of them, and without each one that may fail.

        Args:
            sensors: Sensors of the rig.

        Returns:
            Text for the location -> indices of the sensors: "" for all, ", without NAME" for a failure.

        Raises:
            ValueError: The rig lacks a sensor of a name.
        """
        _check_names("sensor", self.counted_sensors, [*(sensor.name for sensor in sensors), *SENSOR_KINDS])
        kinds = tuple(sensor_class for kind, sensor_class in SENSORS.items() if kind in self.counted_sensors)
        counted = []
        for index, sensor in enumerate(sensors):
            if sensor.name in self.counted_sensors or isinstance(sensor, kinds):
                counted.append(index)
        failing_names = self.find_failing_sensors([sensor.name for sensor in sensors])
        groups = {"": counted}
        for failing in counted:  # the failure of any other sensor changes nothing
            if sensors[failing].name in failing_names:
                groups[f", without {sensors[failing].name}"] = [index for index in counted if index != failing]
        return groups


class RegionRequirement(_Requirement):
    """Requirement on a number of a region in one height band.

    Args:
        region: Name in the `regions` of the file; without these a usual region: "20m", "front_3m", ...
        band: Name of the height band.
        number: Column of `summary.csv`: "detection_0.4m", "radius_m", "detected_by_two_0.4m", ...
        min_value: Minimum, for numbers of which more is better.
        max_value: Maximum, for numbers of which less is better.
    """

    region: str
    band: str
    number: str
    min_value: float | None = None
    max_value: float | None = None

    @property
    def bounds(self) -> list[Bound]:
        """The bound."""
        limits = (self.min_value, True), (self.max_value, False)
        return [Bound(self.number, value, is_minimum) for value, is_minimum in limits if value is not None]

    @property
    def threshold_m(self) -> float | None:
        """Detection threshold in the name of the number in meters; None if there is none."""
        match = re.search(r"_(\d+(?:\.\d+)?)m$", self.number)
        return float(match[1]) if match else None

    @model_validator(mode="after")
    def _check_number(self) -> Self:
        """Raise ValueError for an unknown number, or a bound in the wrong direction or out of range."""
        threshold_m = self.threshold_m or THRESHOLD_M
        main_quantities = RADIUS, make_detection_quantity(threshold_m)
        quantities = {quantity.key: quantity for quantity in self._list_quantities(main_quantities, threshold_m)}
        _check_names("number of a region", [self.number], quantities)
        quantity = quantities[self.number]
        better, right, wrong = ("more", "min_value", "max_value")
        if quantity.lower_is_better:
            better, right, wrong = ("less", "max_value", "min_value")
        if getattr(self, wrong) is not None:
            raise ValueError(f"{wrong}: of {self.number} {better} is better; {right} is meant")
        upper_limit = 1.0 if quantity.unit == "share" else np.inf
        if any(not 0.0 < bound.value <= upper_limit for bound in self.bounds):
            range_text = "above 0 and at most 1" if upper_limit == 1 else "above 0"
            raise ValueError(f"{self.bounds[0].text}: a value {range_text} is needed")
        if self.failing_sensors and quantity not in main_quantities:
            raise ValueError(
                f"failing_sensors: only radius_m and detection rates are measured without a sensor; got {self.number}"
            )
        return self

    def _list_quantities(self, main_quantities: Sequence[Quantity], threshold_m: float) -> list[Quantity]:
        """List all quantities of a region at a threshold."""
        quantities = [
            *main_quantities,
            *(make_cells_quantity(quantity) for quantity in main_quantities),
            make_sensor_count_quantity(threshold_m),
            make_redundancy_quantity(threshold_m),
        ]
        for kind in AGGREGATIONS:
            aggregation = kind.from_keys({self.number}) or kind.parse(kind.example)
            quantities.extend(aggregation.quantities)
        return quantities

    @property
    def text(self) -> str:
        """Region and band."""
        return self.format_text(f"{self.region} {self.band}")


class BrakingModel(Document):
    """Time that braking needs: v / (2 x deceleration_mps2) + latency_s.

    Args:
        deceleration_mps2: Deceleration of the brakes in m/s2.
        latency_s: Seconds from the detection to the start of braking.
    """

    deceleration_mps2: PositiveFloat = 9.0
    latency_s: Annotated[float, Field(ge=0, le=MAX_LATENCY_S)] = 0.5


class EncounterRequirement(_Requirement):
    """Requirement on the time to collision at first detection in every encounter of a set, with every start offset.

    Args:
        encounters: Built-in set or YAML file, as in `torchcover encounter`.
        ttc_s: Minimum time to collision at first detection.
        braking: Brakes that must still prevent the collision after the first detection.
        points: Points on the road user for a detection, as in `Criterion`.
        pixels: Pixels in the full image of one camera for a detection.
        consecutive_scans: Number of consecutive scans for a detection.
    """

    encounters: Annotated[EncounterSet, build_name_validator(EncounterSet)]
    ttc_s: PositiveFloat | None = None
    braking: BrakingModel | None = None
    points: PositiveInt = Criterion.points
    pixels: PositiveInt = Criterion.pixels
    consecutive_scans: PositiveInt = Criterion.consecutive_scans

    @property
    def bounds(self) -> list[Bound]:
        """Bounds; `braking_margin_s` is the time to collision beyond the time that braking needs."""
        bounds = []
        if self.ttc_s is not None:
            bounds.append(Bound("ttc_s", self.ttc_s))
        if self.braking is not None:
            bounds.append(Bound("braking_margin_s", 0.0))
        return bounds

    @property
    def criterion(self) -> Criterion:
        """Criterion for a detection, with the brakes."""
        brakes = self.braking or BrakingModel()
        return Criterion(self.points, self.pixels, self.consecutive_scans, brakes.deceleration_mps2, brakes.latency_s)

    @property
    def text(self) -> str:
        """Set of encounters and criterion in words."""
        criterion_fields = self.model_fields_set & {"points", "pixels", "consecutive_scans"}
        values: dict[str, float] = self.model_dump(include=criterion_fields)
        if self.braking:
            values |= self.braking.model_dump()
        parts = [self.encounters.name]
        parts += [f"{key} {value:g}" for key, value in values.items()]
        return self.format_text(", ".join(parts))


def _find_kind(content: Any) -> str | None:  # noqa: ANN401  (content of a YAML file)
    """Find the key that tells the kinds of requirements apart."""
    keys = content if isinstance(content, dict) else getattr(content, "model_fields_set", ())
    return next((f"({key})" for key in ("target", "region", "encounters") if key in keys), None)


AnyRequirement = Annotated[
    Annotated[TargetRequirement, Tag("(target)")]
    | Annotated[RegionRequirement, Tag("(region)")]
    | Annotated[EncounterRequirement, Tag("(encounters)")],
    Discriminator(_find_kind, custom_error_type="kind", custom_error_message="give target, region or encounters"),
]


class Requirements(BuiltInDocument, RegionsOfInterest):
    """Requirements on a rig on any vehicle; `regions`, `heights` and `grid` are as in `RegionsOfInterest`.

    Args:
        name: Name in tables.
        description: Content, and the sources of the numbers.
        scenario: Scenario; if not given, regions use that of `evaluate`, and test targets stand on flat ground.
        position_sets: Name -> positions.
        requirements: Requirements, all of which must be met.

    Raises:
        ValueError: Unknown names, requirements that contradict or repeat each other.

    Example:
        >>> child = {"target": "child", "positions": {"within_m": 2.0}, "points": 5}
        >>> Requirements.model_validate({"requirements": [child]}).requirements[0].text
        'child_110cm, within_m 2.0'
    """

    kind: ClassVar[str] = "a set of requirements"
    folder: ClassVar[str] = "requirements"

    name: str = "requirements"
    description: str = ""
    scenario: NameOrFile | None = None
    position_sets: dict[str, TargetPositions] = Field(default_factory=dict)
    requirements: Annotated[tuple[AnyRequirement, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check_references(self) -> Self:
        """Raise ValueError for unknown positions, regions and bands, and for repeated requirements."""
        with warnings.catch_warnings(action="ignore"):  # regions inside the vehicle, which is not known yet
            query_plan = self.build_query_plan(EXAMPLE_VEHICLE.outline_m)
        region_names = [region.name for region in query_plan.regions]
        texts = Counter[str]()
        for requirement in self.requirements:
            if isinstance(requirement, TargetRequirement) and isinstance(requirement.positions, str):
                _check_names("position set", [requirement.positions], self.position_sets)
            if isinstance(requirement, RegionRequirement):
                _check_names("region", [requirement.region], region_names)
                _check_names("height band", [requirement.band], query_plan.grid.heights)
            texts.update(f"{requirement.text}: {bound.text}" for bound in requirement.bounds)
        text, count = texts.most_common(1)[0]
        if count > 1:
            raise ValueError(f"several requirements read {text!r}; give each a name, or remove all but one")
        return self
