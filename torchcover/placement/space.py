"""Search space of a placement search: the start, its free variables, constraints and objectives."""

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import chain
from typing import ClassVar, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, model_validator

from torchcover.placement.constraints import Constraints, check_prices, find_placement_error, get_price_eur
from torchcover.placement.free_sensor import FreeSensor, Variable, VariableValue, mirror_sensor
from torchcover.placement.host_vehicle import NamedRig, PlacementSpace
from torchcover.placement.queries import Queries
from torchcover.simulation import Lidar, LidarModel, Rig, Sensor
from torchcover.simulation.documents import NameOrFile


class SearchSpace(PlacementSpace):
    """Search space of a placement search.

    Args:
        name: Name for files and pages.
        description: Description of the space.
        start: Rig to improve, by name or file; everything that is not free stays as it is.
        scenario: One or several scenarios, by name or file, with equal weights.
        vehicle: Host vehicle, by name or file; by default the vehicle that `start` is simulated on.
        free: Name of a sensor of `start` -> its free variables.
        constraints: Constraints of every candidate.
        prices_eur: Prices in EUR, by LiDAR model, by name of a sensor without a model, and of the "mount" of a sensor.
        objectives: One to three objectives, by name. Several give a compromise and the best of each.
        not_worse: Numbers that must not be worse than at the start: names of regions of `evaluate`, for detection
            within 0.4 m in both bands, or objectives.
        requirements: Requirements that candidates should meet, by name or file, as in `torchcover check`.

    Raises:
        ValueError: The space contains no possible candidate, or a key is wrong.

    Warns:
        UserWarning: The start is not in the space.

    Example:
        >>> space = SearchSpace(
        ...     name="pitch",
        ...     start="front_roof_32",
        ...     scenario="courtyard",
        ...     free={"roof": {"pitch_deg": (-10.0, 15.0)}},
        ...     objectives={"near": {"band": "ground", "region": "20m"}},
        ... )
        >>> space.variables
        (FreeNumber(name='roof.pitch_deg', low=-10.0, high=15.0),)
        >>> space.build_rig({"roof.pitch_deg": 5.0}, "candidate").sensors[0].mount.pitch_deg
        5.0
    """

    num_samples: ClassVar[int] = 256  # candidates without a possible one among them, after which a space is refused
    start: NamedRig
    free: dict[str, FreeSensor] = Field(min_length=1)
    constraints: Constraints = Constraints()
    prices_eur: dict[NameOrFile, NonNegativeFloat] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_sensors(self) -> Self:
        """Check that each free sensor exists and has free variables."""
        sensors = {sensor.name: sensor for sensor in self.start.sensors}
        for name, free in self.free.items():
            if name not in sensors:
                raise ValueError(f"free.{name}: {self.start.name!r} has no such sensor; it has {', '.join(sensors)}")
            if free.model is not None and not isinstance(sensors[name], Lidar):
                raise ValueError(f"free.{name}.model: the sensor is no LiDAR and has no models; remove it")
            for model in free.model or ():
                try:
                    LidarModel.load(model)
                except FileNotFoundError as error:
                    raise ValueError(f"free.{name}.model: {error}") from error
            if free.mirror_of is not None and (free.mirror_of not in self.free or self.free[free.mirror_of].mirror_of):
                names = ", ".join(name for name in self.free if self.free[name].mirror_of is None) or "none"
                raise ValueError(f"free.{name}.mirror_of: got {free.mirror_of!r}; give a free sensor, one of {names}")
        if not self.variables:
            raise ValueError("free: all numbers are fixed; give [smallest, largest] for at least one")
        check_prices(self.prices_eur, self.constraints.max_cost_eur, self.start.sensors, self.free)
        return self

    @model_validator(mode="after")
    def _check_candidates(self) -> Self:
        """Check by samples that the space contains a possible candidate, and that results have its numbers."""
        try:
            host = self.host
        except FileNotFoundError as error:
            raise ValueError(str(error)) from error
        for name, free in self.free.items():
            for region in (free.region,) if isinstance(free.region, str) else free.region or ():
                try:
                    host.get_mount_region(region)
                except ValueError as error:
                    raise ValueError(f"free.{name}.{error}") from error
        for name in self.free:
            self._check_positions(name)
        queries = Queries.from_objectives(self.scored_objectives, host.outline_m)
        queries.check(self.start)
        self._check_constraints()
        if reasons := self._explain_start_outside():
            warnings.warn(
                f"{self.name}: the start {self.start.name!r} is outside the space ({'; '.join(reasons)}); candidates "
                "are compared with it anyway",
                stacklevel=2,
            )
        return self

    def _check_positions(self, sensor_name: str) -> None:
        """Raise ValueError if a sensor is impossible in all samples of the space."""
        reason = "the sensor is absent in all of them"
        for values in self._sample_values():
            try:
                sensor = self._build_sensor(sensor_name, values)
            except ValueError as error:
                reason = str(error)
                continue
            placement_error = find_placement_error(sensor, self.host.skin) if sensor is not None else reason
            if placement_error is None:
                return
            reason = placement_error
        raise ValueError(f"free.{sensor_name}: none of {self.num_samples} sampled positions is possible: {reason}")

    def _check_constraints(self) -> None:
        """Raise ValueError if all samples of the space violate a constraint."""
        counts: Counter[str] = Counter()
        for values in self._sample_values():
            try:
                violations = self.find_violations(self.build_rig(values, self.name))
            except ValueError as error:
                violations = (str(error),)
            if not violations:
                return
            counts.update(violations[:1])
        raise ValueError(
            f"constraints: none of {self.num_samples} sampled candidates satisfies them; most common: "
            f"{counts.most_common(1)[0][0]}"
        )

    def _sample_values(self) -> Iterator[dict[str, VariableValue]]:
        """Yield the same uniformly distributed values in every call."""
        for fractions in np.random.default_rng(0).random((self.num_samples, len(self.variables))).tolist():
            pairs = zip(self.variables, fractions, strict=True)
            yield {variable.name: variable.get_value(fraction) for variable, fraction in pairs}

    def _explain_start_outside(self) -> list[str]:
        """Return the reasons why the start is outside the space."""
        variables = {variable.name: variable for variable in self.variables}
        values = self._get_all_start_values()
        reasons = [f"{name} is {value}" for name, value in values.items() if not variables[name].is_allowed(value)]
        return reasons or list(self.find_violations(self.start))

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """Free variables, in the order of the file."""
        return tuple(chain.from_iterable(free.list_variables(name) for name, free in self.free.items()))

    @property
    def base_rig(self) -> Rig:
        """The start."""
        return self.start

    def build_rig(self, values: Mapping[str, VariableValue], name: str) -> Rig:
        """Build the rig that values of the variables define.

        Args:
            values: Values of all variables, by name.
            name: Name of the rig.

        Returns:
            The rig; its description lists the values.

        Raises:
            ValueError: A value is missing, unknown or not allowed; no sensor is left; the vehicle's body is not at a
                position.
        """
        names = {variable.name for variable in self.variables}
        if values.keys() != names:
            different = ", ".join(sorted(values.keys() ^ names))
            listed = ", ".join(variable.name for variable in self.variables)
            raise ValueError(f"values: missing or unknown: {different}; give {listed}")
        for variable in self.variables:
            variable.check(values[variable.name])
        sensors = [self._build_sensor(sensor.name, values) for sensor in self.start.sensors]
        if all(sensor is None for sensor in sensors):
            raise ValueError("no sensor is left")
        texts = [f"{key} {value:g}" if isinstance(value, float) else f"{key} {value}" for key, value in values.items()]
        return Rig(
            name=name,
            description=f"Result of a placement search in the space {self.name!r}: the rig {self.start.name!r} with "
            f"{', '.join(texts)}.",
            vehicle=self.vehicle or self.start.vehicle,
            sensors=tuple(sensor for sensor in sensors if sensor is not None),
        )

    def _build_sensor(self, name: str, values: Mapping[str, VariableValue]) -> Sensor | None:
        """Build a sensor of the start with values of the variables; None if they exclude it."""
        start_sensor = next(sensor for sensor in self.start.sensors if sensor.name == name)
        free = self.free.get(name)
        if free is None:
            return start_sensor
        if free.mirror_of is not None:
            return mirror_sensor(start_sensor, self._build_sensor(free.mirror_of, values))
        return free.build_sensor(start_sensor, values, self.host)

    def get_start_values(self) -> dict[str, VariableValue]:
        """Return the values of the start, without variables whose value in the start is unknown or not allowed."""
        variables = {variable.name: variable for variable in self.variables}
        values = self._get_all_start_values()
        return {name: values[name] for name in values if variables[name].is_allowed(values[name])}

    def _get_all_start_values(self) -> dict[str, VariableValue]:
        """Return the values of the start that are known, also those outside their bounds."""
        values: dict[str, VariableValue] = {}
        for sensor in self.start.sensors:
            if sensor.name in self.free:
                values |= self.free[sensor.name].get_start_values(sensor, self.host)
        return values

    def find_violations(self, rig: Rig) -> tuple[str, ...]:
        """Describe why a rig is impossible, except for self hits, which need a scan.

        Args:
            rig: The rig.

        Returns:
            One sentence for each reason; empty if the rig is possible.
        """
        free_sensors = [sensor for sensor in rig.sensors if sensor.name in self.free]
        errors = [find_placement_error(sensor, self.host.skin) for sensor in free_sensors]
        cost_eur = self.compute_cost_eur(rig)
        return (*(error for error in errors if error), *self.constraints.find_violations(rig, self.free, cost_eur))

    def compute_cost_eur(self, rig: Rig) -> float | None:
        """Compute the cost of a rig: its sensors and their mounts.

        Args:
            rig: The rig.

        Returns:
            Cost in EUR; None if the space has no prices.
        """
        if not self.prices_eur:
            return None
        models = {sensor.name: getattr(sensor, "model", None) for sensor in rig.sensors}
        return sum(get_price_eur(self.prices_eur, name, model) for name, model in models.items())
