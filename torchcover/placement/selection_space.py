"""Selection space: candidate sensors at given mounts, the constraints of a selection, and its objectives."""

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

from torchcover.placement.constraints import MOUNT
from torchcover.placement.free_sensor import DEFAULT_HEIGHT_M, build_pose
from torchcover.placement.host_vehicle import HostVehicle, NamedRig, PlacementSpace
from torchcover.placement.queries import Queries
from torchcover.placement.selection_solver import SelectionLimits
from torchcover.simulation import Document, Pose, Rig, Sensor
from torchcover.simulation.rig import parse_sensor


def _read_group_sensor(content: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401  (any content of a YAML file)
    """Read a sensor as in a rig, but without name and mount."""
    if not isinstance(content, dict):
        return parse_sensor(content, info)
    if unused := [key for key in ("name", "mount") if key in content]:
        raise ValueError(f"{' and '.join(unused)}: mounts and grid define them; remove them")
    return parse_sensor({"name": "sensor", **content}, info)


class MountGrid(Document):
    """Grid of mounts on regions of the vehicle, with all combinations of headings and pitches.

    Args:
        region: Mount regions.
        spacing_m: Approximate distance between two mounts in meters.
        height_m: Height above the skin in meters.
        yaw_deg: Yaw angles, relative to the heading of the region.
        pitch_deg: Pitch angles, positive nose down.
    """

    region: tuple[str, ...] = Field(min_length=1)
    spacing_m: PositiveFloat
    height_m: PositiveFloat = DEFAULT_HEIGHT_M
    yaw_deg: tuple[float, ...] = Field(default=(0.0,), min_length=1)
    pitch_deg: tuple[float, ...] = Field(default=(0.0,), min_length=1)

    def generate_poses(self, host: HostVehicle) -> Iterator[tuple[str, Pose]]:
        """Yield names and poses of the mounts; parts of a region without skin have none.

        Args:
            host: The host vehicle.

        Raises:
            ValueError: The vehicle has no such region.
        """
        for region_name in self.region:
            region = host.get_mount_region(region_name)
            fractions = []
            for bounds in (region.x_m, region.y_m, region.z_m):
                if bounds is not None:
                    count = max(round((bounds[1] - bounds[0]) / self.spacing_m), 1)
                    fractions.append(((np.arange(count) + 0.5) / count).tolist())
            for number, (u, v) in enumerate(product(*fractions)):
                try:
                    point = region.find_mount_point(host.skin, u, v)
                except ValueError:
                    continue
                x_m, y_m, z_m = (point.position_m + self.height_m * point.normal).tolist()
                for yaw_deg, pitch_deg in product(self.yaw_deg, self.pitch_deg):
                    name = f"{region_name}_{number}"
                    name += f"_yaw{yaw_deg:g}" * (len(self.yaw_deg) > 1)
                    name += f"_pitch{pitch_deg:g}" * (len(self.pitch_deg) > 1)
                    yield name, build_pose(x_m, y_m, z_m, region.heading_deg + yaw_deg, pitch_deg, 0.0)


class CandidateGroup(Document):
    """Sensor with all its possible mounts; at least one of `mounts` and `grid` is needed.

    Args:
        sensor: Sensor as in a rig, without name and mount.
        mounts: Poses by name.
        grid: Mounts on regions of the vehicle.

    Example:
        >>> corner = CandidateGroup(
        ...     sensor={"type": "lidar", "model": "velodyne_vlp16"},
        ...     mounts={"left": {"x_m": 0.4, "y_m": 0.25, "z_m": 0.3}},
        ... )
        >>> corner.mounts["left"].y_m, corner.sensor.model
        (0.25, 'velodyne_vlp16')
    """

    sensor: Annotated[Sensor, PlainValidator(_read_group_sensor)]
    mounts: dict[str, Pose] = Field(default_factory=dict)
    grid: MountGrid | None = None

    @model_validator(mode="after")
    def _check_mounts(self) -> Self:
        """Check that a group has mounts or a grid of mounts."""
        if not self.mounts and self.grid is None:
            raise ValueError("mounts, grid: got neither; give at least one of the two")
        return self

    def build_sensors(self, group_name: str, host: HostVehicle) -> Iterator[Sensor]:
        """Yield the sensor at each mount, named `GROUP_MOUNT`.

        Args:
            group_name: Name of the group.
            host: The host vehicle.

        Raises:
            ValueError: The vehicle has no such region.
        """
        mounts = list(self.mounts.items())
        if self.grid is not None:
            mounts += self.grid.generate_poses(host)
        assert isinstance(self.sensor, Document)  # all sensors of a rig are documents
        for mount_name, pose in mounts:
            yield self.sensor.model_copy(update={"name": f"{group_name}_{mount_name}", "mount": pose})


class SelectionConstraints(Document):
    """Constraints of a selection; at least one of `max_sensors` and `max_cost_eur` is needed.

    Args:
        max_sensors: Maximum number of selected sensors.
        max_cost_eur: Maximum cost of the selected sensors in EUR, from `prices_eur` of the space.
        max_self_hit_share: Maximum share of rays of each candidate that hit the vehicle.
        min_distance_m: Minimum distance between any two sensors in meters.
    """

    max_sensors: PositiveInt | None = None
    max_cost_eur: NonNegativeFloat | None = None
    max_self_hit_share: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    min_distance_m: NonNegativeFloat = 0.1

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        """Check that the number of sensors or their cost is limited."""
        if self.max_sensors is None and self.max_cost_eur is None:
            raise ValueError("max_sensors, max_cost_eur: got neither, which selects all candidates; give one")
        return self


class SelectionSpace(PlacementSpace):
    """Candidate sensors from which a selection is made.

    Args:
        name: Name for files and pages.
        description: Description of the space.
        fixed_rig: Rig with sensors that are part of every selection, by name or file.
        scenario: One or several scenarios, by name or file, with equal weights.
        vehicle: Host vehicle, by name or file; by default that of `fixed_rig`, or the ego vehicle of the scenario.
        candidates: Groups by name, each a sensor with its mounts.
        constraints: Maximum number and cost of sensors, and their distance.
        prices_eur: Prices in EUR, by group, and of the "mount" of each sensor.
        baseline: Names `GROUP_MOUNT` of the candidates of today's rig, which the selection is compared with; by default
            the median of random selections.
        objectives: One to three detection rates, by name. Several give a compromise and the best of each.
        not_worse: Detection rates that must not be worse than those of `baseline`: names of regions of `evaluate`, or
            objectives.
        requirements: Requirements of regions, by name or file, as in `torchcover check`.

    Raises:
        ValueError: No selection is possible, or a key is wrong.

    Example:
        >>> ends = {"front": {"x_m": 1.5, "z_m": 1.9}, "rear": {"x_m": -1.5, "z_m": 1.9, "yaw_deg": 180.0}}
        >>> space = SelectionSpace(
        ...     name="ends",
        ...     scenario="courtyard",
        ...     candidates={"end": {"sensor": {"type": "lidar", "model": "velodyne_vlp16"}, "mounts": ends}},
        ...     constraints={"max_sensors": 1},
        ...     objectives={"near": {"band": "ground", "region": "front_3m"}},
        ... )
        >>> [sensor.name for sensor in space.sensors]
        ['end_front', 'end_rear']
    """

    fixed_rig: NamedRig | None = None
    candidates: dict[Annotated[str, Field(min_length=1)], CandidateGroup] = Field(min_length=1)
    constraints: SelectionConstraints
    prices_eur: dict[str, NonNegativeFloat] = Field(default_factory=dict)
    baseline: tuple[str, ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _check_candidates(self) -> Self:
        """Check the names and the number of candidates, and the baseline."""
        try:
            names = [sensor.name for sensor in self.sensors]
        except FileNotFoundError as error:
            raise ValueError(str(error)) from error
        counts = Counter([*names, *(sensor.name for sensor in self._fixed_sensors)])
        if repeated := sorted(name for name, count in counts.items() if count > 1):
            raise ValueError(f"candidates: two sensors are named {repeated[0]}; rename a group or a mount")
        if not names:
            raise ValueError("candidates: the regions of the grids have no skin; choose other regions")
        max_candidates = 2000  # the solver needs minutes for more
        if len(names) > max_candidates:
            raise ValueError(f"candidates: got {len(names):,}; give at most {max_candidates:,}")
        self._check_prices()
        baseline = Counter(self.baseline or ())
        if unknown := [name for name in baseline if name not in names]:
            raise ValueError(f"baseline: {', '.join(unknown)} is no candidate; they are {', '.join(names[:20])}")
        if repeated := [name for name, count in baseline.items() if count > 1]:
            raise ValueError(f"baseline: {repeated[0]} is named twice; name each candidate once")
        return self

    @model_validator(mode="after")
    def _check_objectives(self) -> Self:
        """Check that all objectives and requirements can be computed for points."""
        if self.non_region_requirements is not None:
            raise ValueError(
                "requirements: a selection supports only requirements of regions; check the selected rig for targets "
                "and encounters"
            )
        if self.not_worse and not self.baseline:
            raise ValueError("not_worse: there is no baseline to compare with; add baseline")
        queries = Queries.from_objectives(self.scored_objectives, self.host.outline_m)
        for name, objective in self.scored_objectives.items():
            if not objective.key.startswith("detection_") or "_without_" in objective.key:
                raise ValueError(
                    f"objective {name!r}: got {objective.key!r}, but a selection needs a detection rate, as in "
                    "threshold_m: 0.4"
                )
        queries.check(self.build_rig(self.sensors[:1], self.name))
        return self

    def _check_prices(self) -> None:
        """Check that each price has a group and that a cost limit can be met."""
        if unknown := [key for key in self.prices_eur if key not in {MOUNT, *self.candidates}]:
            raise ValueError(f"prices_eur: {', '.join(unknown)} is no group of candidates, and not {MOUNT!r}")
        if self.constraints.max_cost_eur is None:
            return
        if missing := [group for group in self.candidates if group not in self.prices_eur]:
            raise ValueError(f"prices_eur: {', '.join(missing)} has no price, which constraints.max_cost_eur needs")
        lowest_price_eur = min(self.candidate_prices_eur)
        if lowest_price_eur > self.constraints.max_cost_eur:
            raise ValueError(
                f"constraints.max_cost_eur: got {self.constraints.max_cost_eur:g}, but the cheapest candidate costs "
                f"{lowest_price_eur:g}; raise it"
            )

    @property
    def base_rig(self) -> Rig | None:
        """Rig with the sensors that are part of every selection."""
        return self.fixed_rig

    @property
    def _fixed_sensors(self) -> tuple[Sensor, ...]:
        return self.fixed_rig.sensors if self.fixed_rig else ()

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        """Candidates, group by group."""
        sensors: list[Sensor] = []
        for name, group in self.candidates.items():
            try:
                sensors += group.build_sensors(name, self.host)
            except ValueError as error:
                raise ValueError(f"candidates.{name}.grid.{error}") from error
        return tuple(sensors)

    @cached_property
    def candidate_prices_eur(self) -> tuple[float, ...]:
        """Price of each candidate with its mount in EUR; 0 without prices."""
        prices_eur: list[float] = []
        for name, group in self.candidates.items():
            price_eur = self.prices_eur.get(name, 0.0) + self.prices_eur.get(MOUNT, 0.0)
            prices_eur += [price_eur for _ in group.build_sensors(name, self.host)]
        return tuple(prices_eur)

    def build_limits(self, indices: list[int]) -> SelectionLimits:
        """Build the limits of a selection among some candidates.

        Args:
            indices: Indices of the candidates in `sensors`.
        """
        positions_m = np.array([self.sensors[index].mount.to_matrix()[:3, 3] for index in indices]).reshape(-1, 3)
        distances_m = np.linalg.norm(positions_m[:, None] - positions_m[None], axis=2)
        max_cost_eur = self.constraints.max_cost_eur
        return SelectionLimits(
            max_sensors=min(self.constraints.max_sensors or len(indices), len(indices)),
            prices_eur=[self.candidate_prices_eur[index] for index in indices] if self.prices_eur else (),
            max_cost_eur=np.inf if max_cost_eur is None else max_cost_eur,
            compatible=distances_m >= self.constraints.min_distance_m,
        )

    def is_too_close(self, sensor: Sensor) -> bool:
        """Return whether a candidate is too close to a sensor of `fixed_rig`.

        Args:
            sensor: The candidate.
        """
        position_m = sensor.mount.to_matrix()[:3, 3]
        offsets_m = [position_m - fixed.mount.to_matrix()[:3, 3] for fixed in self._fixed_sensors]
        return any(np.linalg.norm(offset_m) < self.constraints.min_distance_m for offset_m in offsets_m)

    def build_rig(self, selected: tuple[Sensor, ...], name: str) -> Rig:
        """Build the rig of the fixed sensors and some candidates.

        Args:
            selected: The candidates.
            name: Name of the rig.

        Raises:
            ValueError: The rig has no sensor.
        """
        return Rig(
            name=name,
            description=f"Selected by a placement search in {self.name!r} from {len(self.sensors)} candidates.",
            vehicle=self.vehicle or (self.fixed_rig.vehicle if self.fixed_rig else None),
            sensors=(*self._fixed_sensors, *selected),
        )
