"""A choice: candidates at given places, how many of them may be taken, and what a good choice is."""

from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from itertools import product
from typing import Annotated, Any, Self

import numpy as np
from pydantic import (
    Field,
    NonNegativeFloat,
    PlainValidator,
    PositiveFloat,
    PositiveInt,
    ValidationInfo,
    model_validator,
)

from torchcover.geometry.arrays import Float64
from torchcover.placement.constraints import APART_M, MOUNT
from torchcover.placement.free_sensor import HEIGHT_M, pose_of
from torchcover.placement.host_vehicle import HostVehicle, NamedRig, VehicleSpace
from torchcover.placement.queries import Queries
from torchcover.placement.selection_solver import SelectionLimits
from torchcover.simulation import Document, Pose, Rig, Sensor
from torchcover.simulation.rig import read_sensor

MOST_CANDIDATES = 2000


def _sensor(given: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401  (whatever stood in the file)
    """A sensor as a rig has it, without a name and a mount."""
    if isinstance(given, dict) and (own := [key for key in ("name", "mount") if key in given]):
        raise ValueError(f"{' and '.join(own)}: the places make them; leave them out")
    return read_sensor({"name": "sensor", **given} if isinstance(given, dict) else given, info)


class MountGrid(Document):
    """Places all over mount regions of the vehicle, each with all of some headings and pitches.

    Args:
        region: The regions.
        spacing_m: From one place to the next, about.
        height_m: Above the skin.
        yaw_deg: Headings, from where the region faces.
        pitch_deg: Pitches; positive turns the nose down.
    """

    region: tuple[str, ...] = Field(min_length=1)
    spacing_m: PositiveFloat
    height_m: PositiveFloat = HEIGHT_M
    yaw_deg: tuple[float, ...] = Field(default=(0.0,), min_length=1)
    pitch_deg: tuple[float, ...] = Field(default=(0.0,), min_length=1)

    def poses(self, host: HostVehicle) -> Iterator[tuple[str, Pose]]:
        """Names and poses; where a window of a region has nothing of the body, there is none.

        ValueError: the vehicle has no such region.
        """
        for name in self.region:
            region = host.region(name)
            spans = [bounds[1] - bounds[0] for bounds in (region.x_m, region.y_m, region.z_m) if bounds is not None]
            counts = [max(round(span / self.spacing_m), 1) for span in spans]
            shares = [((np.arange(count) + 0.5) / count).tolist() for count in counts]
            for number, (u, v) in enumerate(product(*shares)):
                try:
                    point = region.on(host.skin, u, v)
                except ValueError:
                    continue
                x, y, z = (point.place_m + self.height_m * point.outward).tolist()
                for yaw, pitch in product(self.yaw_deg, self.pitch_deg):
                    turned = f"_yaw{yaw:g}" * (len(self.yaw_deg) > 1) + f"_pitch{pitch:g}" * (len(self.pitch_deg) > 1)
                    yield f"{name}_{number}{turned}", pose_of(x, y, z, region.heading_deg + yaw, pitch, 0.0)


class CandidateGroup(Document):
    """A sensor, and where it may be.

    Args:
        sensor: As a rig has it, without name and mount.
        places: Poses, by name; and, or,
        grid: places all over mount regions.

    Example:
        >>> corner = CandidateGroup(
        ...     sensor={"type": "lidar", "model": "velodyne_vlp16"},
        ...     places={"left": {"x_m": 0.4, "y_m": 0.25, "z_m": 0.3}},
        ... )
        >>> corner.places["left"].y_m, corner.sensor.model
        (0.25, 'velodyne_vlp16')
    """

    sensor: Annotated[Sensor, PlainValidator(_sensor)]
    places: dict[str, Pose] = Field(default_factory=dict)
    grid: MountGrid | None = None

    @model_validator(mode="after")
    def _check_places(self) -> Self:
        if not self.places and self.grid is None:
            raise ValueError("places, grid: at least one of the two is needed; got neither")
        return self

    def sensors(self, group: str, host: HostVehicle) -> Iterator[Sensor]:
        """A sensor at each place on a vehicle, called after the group and the place.

        ValueError: the vehicle has no such region.
        """
        places = list(self.places.items())
        if self.grid is not None:
            places += self.grid.poses(host)
        assert isinstance(self.sensor, Document)  # as all sensors of a rig
        for place, pose in places:
            yield self.sensor.model_copy(update={"name": f"{group}_{place}", "mount": pose})


class ChoiceLimits(Document):
    """What a choice must keep to.

    Args:
        at_most: Sensors that are chosen; all candidates if not given.
        max_cost_eur: What they may cost; see `cost` of the choice.
        max_self_hits: Share of its rays that may end on the vehicle, of each of them.
        min_distance_m: Between any two sensors.
    """

    at_most: PositiveInt | None = None
    max_cost_eur: NonNegativeFloat | None = None
    max_self_hits: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    min_distance_m: NonNegativeFloat = APART_M

    @model_validator(mode="after")
    def _check_any(self) -> Self:
        if self.at_most is None and self.max_cost_eur is None:
            raise ValueError("at_most, max_cost_eur: one of the two is needed, or all candidates would be chosen")
        return self


class ChoiceSpace(VehicleSpace):
    """Which and how many: some of many candidates, which are given.

    Args:
        name: What files and pages call it.
        description: What it is.
        always: Sensors that are there in any case: a rig, by name or file.
        scenario: One or several, by name or file: they count alike.
        vehicle: What carries the sensors, by name or file; if not given, that of `always`, or the scenario's own.
        candidates: Groups by name, each a sensor and its places.
        choose: How many, for how much, how far apart.
        cost: Prices in euros, by group, and of `mount`, which each sensor needs.
        now: Names of the candidates that are there today, as `GROUP_PLACE`: the choice is compared with them; if not
            given, with a choice that is drawn, the middle one of many.
        objectives: One to three detections, by name. One is made as large as it gets; of several there is the best of
            each, and one between.
        not_worse: Detections of which `now` has no more: names of usual regions, or objectives.
        requirements: What must be kept of regions, by name or file, as of `torchcover check`.

    Raises:
        ValueError: Nothing in it can be chosen, for a reason that the message tells.

    Example:
        >>> corners = {"front": {"x_m": 1.5, "z_m": 1.9}, "rear": {"x_m": -1.5, "z_m": 1.9, "yaw_deg": 180.0}}
        >>> choice = ChoiceSpace(
        ...     name="ends",
        ...     scenario="courtyard",
        ...     candidates={"end": {"sensor": {"type": "lidar", "model": "velodyne_vlp16"}, "places": corners}},
        ...     choose={"at_most": 1},
        ...     objectives={"near": {"band": "ground", "region": "front_3m"}},
        ... )
        >>> [sensor.name for sensor in choice.sensors]
        ['end_front', 'end_rear']
    """

    always: NamedRig | None = None
    candidates: dict[Annotated[str, Field(min_length=1)], CandidateGroup] = Field(min_length=1)
    choose: ChoiceLimits
    cost: dict[str, NonNegativeFloat] = Field(default_factory=dict)
    now: tuple[str, ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _check_candidates(self) -> Self:
        try:
            candidates = [sensor.name for sensor in self.sensors]
        except FileNotFoundError as error:
            raise ValueError(str(error)) from error
        counts = Counter([*candidates, *(sensor.name for sensor in (self.always.sensors if self.always else ()))])
        if twice := sorted(name for name, count in counts.items() if count > 1):
            raise ValueError(f"candidates: two sensors are called {twice[0]}; names are those of group and place")
        if not candidates:
            raise ValueError("candidates: there is none; the regions of the grids have nothing of the vehicle's skin")
        if len(candidates) > MOST_CANDIDATES:
            raise ValueError(f"candidates: at most {MOST_CANDIDATES:,} are looked at; got {len(candidates):,}")
        self._check_prices()
        now = Counter(self.now or ())
        if unknown := [name for name in now if name not in candidates]:
            raise ValueError(f"now: {', '.join(unknown)}: no candidate; they are {', '.join(candidates[:20])}")
        if twice := [name for name, count in now.items() if count > 1]:
            raise ValueError(f"now: {twice[0]} is there once at most; it is named twice")
        return self

    @model_validator(mode="after")
    def _check_asked(self) -> Self:
        if self.to_check is not None:
            raise ValueError(
                "requirements: candidates are chosen by regions; check the choice for bodies and encounters"
            )
        if self.not_worse and not self.now:
            raise ValueError("not_worse: say what is there today, now, or there is nothing to be worse than")
        queries = Queries.around(self.host.outline_m, self.numbers)
        for name, one in self.numbers.items():
            if not one.key.startswith("detection_") or "_without_" in one.key:
                wanted = f"a detection, as in detection: 0.4; got {one.key!r}"
                raise ValueError(f"objective {name!r}: candidates are chosen by {wanted}")
        queries.check(self.rig(self.sensors[:1], self.name))
        return self

    def _check_prices(self) -> None:
        known = {MOUNT, *self.candidates}
        if unknown := [key for key in self.cost if key not in known]:
            raise ValueError(f"cost: {', '.join(unknown)}: no group of candidates, and not {MOUNT!r}")
        if self.choose.max_cost_eur is None:
            return
        if missing := [group for group in self.candidates if group not in self.cost]:
            raise ValueError(f"cost: no price of {', '.join(missing)}, and choose.max_cost_eur needs it")
        cheapest = min(self.prices)
        if cheapest > self.choose.max_cost_eur:
            raise ValueError(
                f"choose.max_cost_eur: {self.choose.max_cost_eur:g}, but the cheapest candidate costs {cheapest:g}"
            )

    @property
    def first_rig(self) -> Rig | None:
        """Sensors that are there in any case."""
        return self.always

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        """The candidates, group by group."""
        host, found = self.host, list[Sensor]()
        for name, group in self.candidates.items():
            try:
                found += group.sensors(name, host)
            except ValueError as error:
                raise ValueError(f"candidates.{name}.grid.{error}") from error
        return tuple(found)

    @cached_property
    def prices(self) -> tuple[float, ...]:
        """What each candidate costs, with its mount; nothing where there are no prices."""
        return tuple(
            self.cost.get(name, 0.0) + (self.cost.get(MOUNT, 0.0) if self.cost else 0.0)
            for name, group in self.candidates.items()
            for _ in group.sensors(name, self.host)
        )

    def limits(self, kept: list[int]) -> SelectionLimits:
        """What a subset of some candidates must keep to.

        Args:
            kept: Numbers of the candidates that can be mounted.
        """
        places_m = np.array([self.sensors[one].mount.matrix()[:3, 3] for one in kept]).reshape(-1, 3)
        apart_m = np.linalg.norm(places_m[:, None] - places_m[None], axis=2)
        most_to_pay = self.choose.max_cost_eur
        return SelectionLimits(
            max_sensors=min(self.choose.at_most or len(kept), len(kept)),
            prices_eur=[self.prices[one] for one in kept] if self.cost else (),
            max_cost_eur=np.inf if most_to_pay is None else most_to_pay,
            compatible=apart_m >= self.choose.min_distance_m,
        )

    def too_close(self, one: Sensor) -> bool:
        """Whether a candidate would be where a sensor is that is always there."""
        place_m = one.mount.matrix()[:3, 3]
        others: list[Float64] = [other.mount.matrix()[:3, 3] for other in (self.always.sensors if self.always else ())]
        return any(np.linalg.norm(place_m - other) < self.choose.min_distance_m for other in others)

    def rig(self, chosen: tuple[Sensor, ...], name: str) -> Rig:
        """The rig of what is always there and of some candidates.

        Raises:
            ValueError: That is no sensor at all.
        """
        return Rig(
            name=name,
            description=f"Chosen by a placement search in {self.name!r}, of {len(self.sensors)} candidates.",
            vehicle=self.vehicle or (self.always.vehicle if self.always else None),
            sensors=(*(self.always.sensors if self.always else ()), *chosen),
        )
