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
from torchcover.placement.free_sensor import HEIGHT_M, build_pose
from torchcover.placement.host_vehicle import HostVehicle, NamedRig, PlacementSpace
from torchcover.placement.queries import Queries
from torchcover.placement.selection_solver import SelectionLimits
from torchcover.simulation import Document, Pose, Rig, Sensor
from torchcover.simulation.rig import parse_sensor

MOST_CANDIDATES = 2000


def _sensor(given: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401  (whatever stood in the file)
    """A sensor as a rig has it, without a name and a mount."""
    if isinstance(given, dict) and (own := [key for key in ("name", "mount") if key in given]):
        raise ValueError(f"{' and '.join(own)}: the places make them; leave them out")
    return parse_sensor({"name": "sensor", **given} if isinstance(given, dict) else given, info)


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

    def generate_poses(self, host: HostVehicle) -> Iterator[tuple[str, Pose]]:
        """Names and poses; where a window of a region has nothing of the body, there is none.

        ValueError: the vehicle has no such region.
        """
        for name in self.region:
            region = host.get_mount_region(name)
            spans = [bounds[1] - bounds[0] for bounds in (region.x_m, region.y_m, region.z_m) if bounds is not None]
            counts = [max(round(span / self.spacing_m), 1) for span in spans]
            shares = [((np.arange(count) + 0.5) / count).tolist() for count in counts]
            for number, (u, v) in enumerate(product(*shares)):
                try:
                    point = region.find_mount_point(host.skin, u, v)
                except ValueError:
                    continue
                x, y, z = (point.position_m + self.height_m * point.normal).tolist()
                for yaw, pitch in product(self.yaw_deg, self.pitch_deg):
                    turned = f"_yaw{yaw:g}" * (len(self.yaw_deg) > 1) + f"_pitch{pitch:g}" * (len(self.pitch_deg) > 1)
                    yield f"{name}_{number}{turned}", build_pose(x, y, z, region.heading_deg + yaw, pitch, 0.0)


class CandidateGroup(Document):
    """A sensor, and where it may be.

    Args:
        sensor: As a rig has it, without name and mount.
        mounts: Poses, by name; and, or,
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
    mounts: dict[str, Pose] = Field(default_factory=dict)
    grid: MountGrid | None = None

    @model_validator(mode="after")
    def _check_places(self) -> Self:
        if not self.mounts and self.grid is None:
            raise ValueError("places, grid: at least one of the two is needed; got neither")
        return self

    def build_sensors(self, group_name: str, host: HostVehicle) -> Iterator[Sensor]:
        """A sensor at each place on a vehicle, called after the group and the place.

        ValueError: the vehicle has no such region.
        """
        places = list(self.mounts.items())
        if self.grid is not None:
            places += self.grid.generate_poses(host)
        assert isinstance(self.sensor, Document)  # as all sensors of a rig
        for place, pose in places:
            yield self.sensor.model_copy(update={"name": f"{group_name}_{place}", "mount": pose})


class SelectionConstraints(Document):
    """What a choice must keep to.

    Args:
        max_sensors: Sensors that are chosen; all candidates if not given.
        max_cost_eur: What they may cost; see `cost` of the choice.
        max_self_hit_share: Share of its rays that may end on the vehicle, of each of them.
        min_distance_m: Between any two sensors.
    """

    max_sensors: PositiveInt | None = None
    max_cost_eur: NonNegativeFloat | None = None
    max_self_hit_share: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    min_distance_m: NonNegativeFloat = APART_M

    @model_validator(mode="after")
    def _check_any(self) -> Self:
        if self.max_sensors is None and self.max_cost_eur is None:
            raise ValueError("max_sensors, max_cost_eur: one of the two is needed, or all candidates would be chosen")
        return self


class SelectionSpace(PlacementSpace):
    """Which and how many: some of many candidates, which are given.

    Args:
        name: What files and pages call it.
        description: What it is.
        fixed_rig: Sensors that are there in any case: a rig, by name or file.
        scenario: One or several, by name or file: they count alike.
        vehicle: What carries the sensors, by name or file; if not given, that of `fixed_rig`, or the scenario's own.
        candidates: Groups by name, each a sensor and its places.
        constraints: How many, for how much, how far apart.
        prices_eur: Prices in euros, by group, and of `mount`, which each sensor needs.
        baseline: Names of the candidates that are there today, as `GROUP_PLACE`: the choice is compared with them; if not
            given, with a choice that is drawn, the middle one of many.
        objectives: One to three detections, by name. One is made as large as it gets; of several there is the best of
            each, and one between.
        not_worse: Detections of which `baseline` has no more: names of usual regions, or objectives.
        requirements: What must be kept of regions, by name or file, as of `torchcover check`.

    Raises:
        ValueError: Nothing in it can be chosen, for a reason that the message tells.

    Example:
        >>> corners = {"front": {"x_m": 1.5, "z_m": 1.9}, "rear": {"x_m": -1.5, "z_m": 1.9, "yaw_deg": 180.0}}
        >>> choice = SelectionSpace(
        ...     name="ends",
        ...     scenario="courtyard",
        ...     candidates={"end": {"sensor": {"type": "lidar", "model": "velodyne_vlp16"}, "places": corners}},
        ...     choose={"max_sensors": 1},
        ...     objectives={"near": {"band": "ground", "region": "front_3m"}},
        ... )
        >>> [sensor.name for sensor in choice.sensors]
        ['end_front', 'end_rear']
    """

    fixed_rig: NamedRig | None = None
    candidates: dict[Annotated[str, Field(min_length=1)], CandidateGroup] = Field(min_length=1)
    constraints: SelectionConstraints
    prices_eur: dict[str, NonNegativeFloat] = Field(default_factory=dict)
    baseline: tuple[str, ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _check_candidates(self) -> Self:
        try:
            candidates = [sensor.name for sensor in self.sensors]
        except FileNotFoundError as error:
            raise ValueError(str(error)) from error
        counts = Counter([*candidates, *(sensor.name for sensor in (self.fixed_rig.sensors if self.fixed_rig else ()))])
        if twice := sorted(name for name, count in counts.items() if count > 1):
            raise ValueError(f"candidates: two sensors are called {twice[0]}; names are those of group and place")
        if not candidates:
            raise ValueError("candidates: there is none; the regions of the grids have nothing of the vehicle's skin")
        if len(candidates) > MOST_CANDIDATES:
            raise ValueError(f"candidates: at most {MOST_CANDIDATES:,} are looked at; got {len(candidates):,}")
        self._check_prices()
        now = Counter(self.baseline or ())
        if unknown := [name for name in now if name not in candidates]:
            raise ValueError(f"now: {', '.join(unknown)}: no candidate; they are {', '.join(candidates[:20])}")
        if twice := [name for name, count in now.items() if count > 1]:
            raise ValueError(f"now: {twice[0]} is there once at most; it is named twice")
        return self

    @model_validator(mode="after")
    def _check_asked(self) -> Self:
        if self.non_region_requirements is not None:
            raise ValueError(
                "requirements: candidates are chosen by regions; check the choice for bodies and encounters"
            )
        if self.not_worse and not self.baseline:
            raise ValueError("not_worse: say what is there today, now, or there is nothing to be worse than")
        queries = Queries.from_objectives(self.host.outline_m, self.scored_objectives)
        for name, one in self.scored_objectives.items():
            if not one.key.startswith("detection_") or "_without_" in one.key:
                wanted = f"a detection, as in detection: 0.4; got {one.key!r}"
                raise ValueError(f"objective {name!r}: candidates are chosen by {wanted}")
        queries.check(self.build_rig(self.sensors[:1], self.name))
        return self

    def _check_prices(self) -> None:
        known = {MOUNT, *self.candidates}
        if unknown := [key for key in self.prices_eur if key not in known]:
            raise ValueError(f"cost: {', '.join(unknown)}: no group of candidates, and not {MOUNT!r}")
        if self.constraints.max_cost_eur is None:
            return
        if missing := [group for group in self.candidates if group not in self.prices_eur]:
            raise ValueError(f"cost: no price of {', '.join(missing)}, and choose.max_cost_eur needs it")
        cheapest = min(self.candidate_prices_eur)
        if cheapest > self.constraints.max_cost_eur:
            raise ValueError(
                f"choose.max_cost_eur: {self.constraints.max_cost_eur:g}, but the cheapest candidate costs {cheapest:g}"
            )

    @property
    def base_rig(self) -> Rig | None:
        """Sensors that are there in any case."""
        return self.fixed_rig

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        """The candidates, group by group."""
        host, found = self.host, list[Sensor]()
        for name, group in self.candidates.items():
            try:
                found += group.build_sensors(name, host)
            except ValueError as error:
                raise ValueError(f"candidates.{name}.grid.{error}") from error
        return tuple(found)

    @cached_property
    def candidate_prices_eur(self) -> tuple[float, ...]:
        """What each candidate costs, with its mount; nothing where there are no prices."""
        return tuple(
            self.prices_eur.get(name, 0.0) + (self.prices_eur.get(MOUNT, 0.0) if self.prices_eur else 0.0)
            for name, group in self.candidates.items()
            for _ in group.build_sensors(name, self.host)
        )

    def build_limits(self, indices: list[int]) -> SelectionLimits:
        """What a subset of some candidates must keep to.

        Args:
            indices: Numbers of the candidates that can be mounted.
        """
        places_m = np.array([self.sensors[one].mount.to_matrix()[:3, 3] for one in indices]).reshape(-1, 3)
        apart_m = np.linalg.norm(places_m[:, None] - places_m[None], axis=2)
        most_to_pay = self.constraints.max_cost_eur
        return SelectionLimits(
            max_sensors=min(self.constraints.max_sensors or len(indices), len(indices)),
            prices_eur=[self.candidate_prices_eur[one] for one in indices] if self.prices_eur else (),
            max_cost_eur=np.inf if most_to_pay is None else most_to_pay,
            compatible=apart_m >= self.constraints.min_distance_m,
        )

    def is_too_close(self, sensor: Sensor) -> bool:
        """Whether a candidate would be where a sensor is that is always there."""
        place_m = sensor.mount.to_matrix()[:3, 3]
        others: list[Float64] = [
            other.mount.to_matrix()[:3, 3] for other in (self.fixed_rig.sensors if self.fixed_rig else ())
        ]
        return any(np.linalg.norm(place_m - other) < self.constraints.min_distance_m for other in others)

    def build_rig(self, selected: tuple[Sensor, ...], name: str) -> Rig:
        """The rig of what is always there and of some candidates.

        Raises:
            ValueError: That is no sensor at all.
        """
        return Rig(
            name=name,
            description=f"Chosen by a placement search in {self.name!r}, of {len(self.sensors)} candidates.",
            vehicle=self.vehicle or (self.fixed_rig.vehicle if self.fixed_rig else None),
            sensors=(*(self.fixed_rig.sensors if self.fixed_rig else ()), *selected),
        )
