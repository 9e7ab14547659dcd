"""A search space: the rig that a search starts from, what of it is free, what it must keep to, and what counts."""

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Self

import numpy as np
from pydantic import Field, NonNegativeFloat, model_validator

from torchcover.placement.constraints import Constraints, check_prices, find_placement_error, get_price_eur
from torchcover.placement.free_sensor import FreeSensor, Variable, VariableValue, mirror_sensor
from torchcover.placement.host_vehicle import NamedRig, PlacementSpace
from torchcover.placement.queries import Queries
from torchcover.simulation import Lidar, LidarModel, Rig, Sensor
from torchcover.simulation.documents import NameOrFile

# How many candidates are looked at before a space is refused as one without any that can be.
TRIES = 256


class SearchSpace(PlacementSpace):
    """Where sensors may go, and what a good place is.

    Args:
        name: What files and pages call it.
        description: What it is.
        start: The rig that is made better, by its name or its file: what is not free stays as it is.
        scenario: One or several, by name or file: they count alike.
        vehicle: What carries the rig, by name or file; if not given, what `start` is simulated on.
        free: Name of a sensor of `start` -> what of it is free.
        constraints: What a rig must keep to.
        prices_eur: Prices in euros, by model, by the name of a sensor that has none, and of `mount`, which each sensor needs.
        objectives: One to three, by name. One is made as large as it gets; of several, what one gains is weighed
            against what the others lose.
        not_worse: What must not be worse than with `start`: names of usual regions, of which detection within 0.4 m in
            both bands counts, or objectives.
        requirements: What must be kept, by name or file, as of `torchcover check`.

    Raises:
        ValueError: Nothing in it can be searched, for a reason that the message tells.

    Warns:
        UserWarning: The rig that the search starts from is none of the space.

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
        >>> space.rig({"roof.pitch_deg": 5.0}, "found").sensors[0].mount.pitch_deg
        5.0
    """

    start: NamedRig
    free: dict[str, FreeSensor] = Field(min_length=1)
    constraints: Constraints = Constraints()
    prices_eur: dict[NameOrFile, NonNegativeFloat] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_sensors(self) -> Self:
        sensors = {sensor.name: sensor for sensor in self.start.sensors}
        for name, free in self.free.items():
            if name not in sensors:
                raise ValueError(f"free.{name}: {self.start.name!r} has no such sensor; it has {', '.join(sensors)}")
            if free.model is not None and not isinstance(sensors[name], Lidar):
                raise ValueError(f"free.{name}.model: only a LiDAR has a model to choose")
            for model in free.model or ():
                try:
                    LidarModel.load(model)
                except FileNotFoundError as error:
                    raise ValueError(f"free.{name}.model: {error}") from error
            if free.mirror_of is not None and (free.mirror_of not in self.free or self.free[free.mirror_of].mirror_of):
                others = [other for other, one in self.free.items() if one.mirror_of is None]
                raise ValueError(
                    f"free.{name}.mirror_of: a free sensor is needed, one of {', '.join(others) or 'none'}; got "
                    f"{free.mirror_of!r}"
                )
        if not self.variables:
            raise ValueError("free: every number is set, so that there is nothing to search; give two for a range")
        check_prices(self.prices_eur, self.constraints.max_cost_eur, self.start.sensors, self.free)
        return self

    @model_validator(mode="after")
    def _check_places(self) -> Self:
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
            self._check_place(name)
        queries = Queries.from_objectives(host.outline_m, self.scored_objectives)
        queries.check(self.start)
        self._check_constraints()
        outside = self._outside()
        if outside:
            warnings.warn(
                f"{self.name}: {self.start.name!r} is none of the space ({'; '.join(outside)}): candidates are "
                "compared with it all the same",
                stacklevel=2,
            )
        return self

    def _check_place(self, name: str) -> None:
        complaint = "it is there in none of them"
        for values in self._tries():
            try:
                sensor = self._sensor(name, values)
            except ValueError as error:
                complaint = str(error)
                continue
            wrong = find_placement_error(sensor, self.host.skin) if sensor is not None else complaint
            if wrong is None:
                return
            complaint = wrong
        raise ValueError(f"free.{name}: in none of {TRIES} places of its ranges can it be: {complaint}")

    def _check_constraints(self) -> None:
        broken: Counter[str] = Counter()
        for values in self._tries():
            try:
                violations = self.find_violations(self.build_rig(values, self.name))
            except ValueError as error:
                violations = (str(error),)
            if not violations:
                return
            broken.update(violations[:1])
        raise ValueError(
            f"constraints: none of {TRIES} candidates keeps to them; as of one: {broken.most_common(1)[0][0]}"
        )

    def _tries(self) -> Iterator[dict[str, VariableValue]]:
        """Values all over the space; the same ones every time."""
        for shares in np.random.default_rng(0).random((TRIES, len(self.variables))).tolist():
            yield {
                variable.name: variable.get_value(share) for variable, share in zip(self.variables, shares, strict=True)
            }

    def _outside(self) -> list[str]:
        """Why the rig that the search starts from is none of the space."""
        values, known = self._values_of_start(), {variable.name: variable for variable in self.variables}
        out = [f"{name} is {value}" for name, value in values.items() if not known[name].is_allowed(value)]
        return out or list(self.find_violations(self.start))

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """What is free, in the order of the file."""
        return tuple(variable for name, free in self.free.items() for variable in free.list_variables(name))

    @property
    def base_rig(self) -> Rig:
        """The start."""
        return self.start

    def build_rig(self, values: Mapping[str, VariableValue], name: str) -> Rig:
        """The rig that values make.

        Args:
            values: Of all `variables`, by name.
            name: What the rig is called.

        Returns:
            The rig; its description says what it was made from.

        Raises:
            ValueError: A value is missing, unknown or outside; no sensor is left, or one would be where the vehicle has
                no skin to mount it on.
        """
        known = {variable.name: variable for variable in self.variables}
        if values.keys() != known.keys():
            odd = ", ".join(sorted(values.keys() ^ known.keys()))
            raise ValueError(f"values of {', '.join(known)} are needed; missing or unknown: {odd}")
        for variable in self.variables:
            variable.check(values[variable.name])
        sensors = [self._sensor(sensor.name, values) for sensor in self.start.sensors]
        if all(sensor is None for sensor in sensors):
            raise ValueError("no sensor is left")
        told = ", ".join(
            f"{key} {value:g}" if isinstance(value, float) else f"{key} {value}" for key, value in values.items()
        )
        return Rig(
            name=name,
            description=f"Found by a placement search in the space {self.name!r}, from the rig {self.start.name!r}, of "
            f"which it keeps all else: {told}.",
            vehicle=self.vehicle or self.start.vehicle,
            sensors=tuple(sensor for sensor in sensors if sensor is not None),
        )

    def _sensor(self, name: str, values: Mapping[str, VariableValue]) -> Sensor | None:
        """A sensor of the start, as the values have it."""
        start = next(sensor for sensor in self.start.sensors if sensor.name == name)
        free = self.free.get(name)
        if free is None:
            return start
        if free.mirror_of is not None:
            return mirror_sensor(start, self._sensor(free.mirror_of, values))
        return free.build_sensor(start, values, self.host)

    def get_start_values(self) -> dict[str, VariableValue]:
        """Values of the rig that the search starts from, of those variables of which it has one in the space.

        A sensor that is free on a mount region has none there.
        """
        known = {variable.name: variable for variable in self.variables}
        return {name: value for name, value in self._values_of_start().items() if known[name].is_allowed(value)}

    def _values_of_start(self) -> dict[str, VariableValue]:
        return {
            name: value
            for sensor in self.start.sensors
            if sensor.name in self.free
            for name, value in self.free[sensor.name].get_start_values(sensor, self.host).items()
        }

    def find_violations(self, rig: Rig) -> tuple[str, ...]:
        """Why a rig cannot be, in words; nothing if it can. Self-hits are not among it: they are known after a scan."""
        wrong = (find_placement_error(sensor, self.host.skin) for sensor in rig.sensors if sensor.name in self.free)
        places = tuple(each for each in wrong if each is not None)
        return (*places, *self.constraints.find_violations(rig, self.free, self.compute_cost_eur(rig)))

    def compute_cost_eur(self, rig: Rig) -> float | None:
        """What a rig costs: its models, and a mount for each; None if the space has no prices."""
        if not self.prices_eur:
            return None
        return sum(
            get_price_eur(self.prices_eur, sensor.name, getattr(sensor, "model", None)) for sensor in rig.sensors
        )
