"""Host vehicle of a placement search, and the settings that search spaces and selection spaces share."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

from pydantic import AfterValidator, Field

from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.evaluation.requirements import RegionRequirement, Requirements
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Float64
from torchcover.placement.objective import NonEmptyName, Objective
from torchcover.simulation import Rig, Scenario, set_ego
from torchcover.simulation.bodies import get_mount_regions
from torchcover.simulation.documents import SEVERAL, FileDocument, NameOrFile, build_name_validator, is_file_name
from torchcover.simulation.mount_regions import MountRegion, Skin

NOT_WORSE = "not worse: "  # prefix of the name of a number that must not become worse
REQUIRED = "required: "  # prefix of the name of a number that a requirement bounds


def _check_vehicle_name(name: str) -> str:
    """Check that a name with a suffix is a YAML file; return it."""
    if Path(name).suffix and not is_file_name(name):
        raise ValueError(f"got {name!r}; give the name of a vehicle or the path of its YAML file")
    return name


NamedRig = Annotated[Rig, build_name_validator(Rig)]
NamesOrFiles = Annotated[tuple[NameOrFile, ...], SEVERAL, Field(min_length=1)]
VehicleNameOrFile = Annotated[NameOrFile, AfterValidator(_check_vehicle_name)]


class HostVehicle(NamedTuple):
    """Vehicle that all candidates are mounted on.

    Args:
        name: Its name.
        skin: Its surface.
        mount_regions: Its mount regions by name.
    """

    name: str
    skin: Skin
    mount_regions: dict[str, MountRegion]

    @property
    def outline_m(self) -> Float64:
        """(4, 2) corners x, y of the vehicle in meters."""
        return BoundingBox.from_points(self.skin.mesh.vertices_m).outline_m

    @classmethod
    def from_scenarios(cls, scenarios: Sequence[Scenario]) -> "HostVehicle":
        """Return the common ego vehicle of scenarios.

        Args:
            scenarios: At least one scenario.

        Raises:
            ValueError: The scenarios have different ego vehicles.
            FileNotFoundError: A mesh or vehicle file is missing.
        """
        shapes = [scenario.ego.shape if scenario.ego else None for scenario in scenarios]
        if any(shape != shapes[0] for shape in shapes):
            vehicles = ", ".join(f"{scenario.name} {scenario.ego_name}" for scenario in scenarios)
            raise ValueError(f"scenario: the ego vehicles differ ({vehicles}), but a rig has one vehicle; set vehicle")
        return cls(scenarios[0].ego_name, Skin(scenarios[0].build_ego_mesh()), get_mount_regions(shapes[0]))

    def get_mount_region(self, name: str) -> MountRegion:
        """Return a mount region.

        Args:
            name: Name of the region.

        Raises:
            ValueError: The vehicle has no such region; the message lists its regions.
        """
        if name not in self.mount_regions:
            names = ", ".join(self.mount_regions) or "none; add mount_regions to its document"
            raise ValueError(f"region: {self.name} has no {name!r}; it has {names}")
        return self.mount_regions[name]


class PlacementSpace(FileDocument):
    """Base of search spaces and selection spaces: scenarios, host vehicle, objectives and requirements."""

    kind: ClassVar[str] = "a search space"
    name: str
    description: str = ""
    scenario: NamesOrFiles
    vehicle: VehicleNameOrFile | None = None
    objectives: dict[NonEmptyName, Objective] = Field(min_length=1, max_length=3)  # larger fronts cannot be plotted
    not_worse: tuple[NonEmptyName | Objective, ...] = ()
    requirements: Annotated[Requirements, build_name_validator(Requirements)] | None = None

    @property
    def base_rig(self) -> Rig | None:
        """Rig that every candidate starts from; None if there is none."""
        raise NotImplementedError

    @cached_property
    def scored_objectives(self) -> dict[str, Objective]:
        """Numbers that rigs are scored by: objectives, numbers that must not become worse, and bounded numbers."""
        scored = dict(self.objectives)
        for item in self.not_worse:
            objective = Objective(region=item) if isinstance(item, str) else item
            scored[f"{NOT_WORSE}{objective.description}"] = objective
        return scored | {name: objective for name, (objective, _) in self._bounded_objectives.items()}

    @property
    def bounds(self) -> dict[str, float]:
        """Bounds of the requirements by the names of their numbers: minima, or maxima where lower is better."""
        return {name: bound for name, (_, bound) in self._bounded_objectives.items()}

    @cached_property
    def _bounded_objectives(self) -> dict[str, tuple[Objective, float]]:
        """Numbers of regions with their bounds; requirements of targets and encounters are checked separately."""
        bounded: dict[str, tuple[Objective, float]] = {}
        if self.requirements is None:
            return bounded
        heights, regions = self.requirements.heights, self.requirements.regions
        for requirement in self.requirements.requirements:
            if not isinstance(requirement, RegionRequirement):
                continue
            band = requirement.band
            if PAPER_HEIGHTS.get(band) is None or heights.get(band) not in (None, PAPER_HEIGHTS[band]):
                raise ValueError(
                    f"requirements: a search has only the bands {dict(PAPER_HEIGHTS)}, but {band!r} is "
                    f"{heights.get(band)}; remove heights, or check the result of the search"
                )
            region = {requirement.region: regions[requirement.region]} if requirement.region in regions else None
            failures = [f"{requirement.number}_without_{sensor}" for sensor in requirement.failing_sensors]
            for key in (requirement.number, *failures):
                objective = Objective(number=key, region=region or requirement.region, band=band)
                for bound in requirement.bounds:
                    bounded[f"{REQUIRED}{objective.description}, {bound.text}"] = objective, bound.value
        return bounded

    @cached_property
    def non_region_requirements(self) -> Requirements | None:
        """Requirements of targets and encounters; None if there are none."""
        if self.requirements is None:
            return None
        selected = [item for item in self.requirements.requirements if not isinstance(item, RegionRequirement)]
        return self.requirements.model_copy(update={"requirements": tuple(selected)}) if selected else None

    @cached_property
    def scenarios(self) -> tuple[Scenario, ...]:
        """Scenarios, each with the host vehicle as its ego vehicle."""
        rigs = {self.base_rig.name: self.base_rig} if self.base_rig else {}
        return tuple(set_ego(Scenario.load(name), rigs, self.vehicle) for name in self.scenario)

    @cached_property
    def host(self) -> HostVehicle:
        """Host vehicle."""
        return HostVehicle.from_scenarios(self.scenarios)
