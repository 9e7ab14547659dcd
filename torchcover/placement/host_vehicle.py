"""The host vehicle of a search or a selection, and what both documents have in common."""

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

MAX_OBJECTIVES = 3  # a front of more cannot be plotted
NOT_WORSE = "not worse: "  # prefix of the name of a number that must not become worse
REQUIRED = "required: "  # prefix of the name of a number that a requirement bounds


def _vehicle(given: str) -> str:
    if Path(given).suffix and not is_file_name(given):
        raise ValueError(f"the name of a vehicle, or the path of its YAML file, is needed; got {given!r}")
    return given


# A rig, or the name or the file of one.
NamedRig = Annotated[Rig, build_name_validator(Rig)]
# One name or file, or several.
NamesOrFiles = Annotated[tuple[NameOrFile, ...], SEVERAL, Field(min_length=1)]
# A vehicle's.
VehicleNameOrFile = Annotated[NameOrFile, AfterValidator(_vehicle)]


class HostVehicle(NamedTuple):
    """The vehicle that all candidates are mounted on: its name, its surface, and its mount regions by name."""

    name: str
    skin: Skin
    mount_regions: dict[str, MountRegion]

    @property
    def outline_m(self) -> Float64:
        """(4, 2) corners x, y of the vehicle."""
        return BoundingBox.from_points(self.skin.mesh.vertices_m).outline_m

    @classmethod
    def from_scenarios(cls, scenarios: Sequence[Scenario]) -> "HostVehicle":
        """Return the ego vehicle of all scenarios.

        ValueError: they have different ones. FileNotFoundError: a mesh or vehicle file is missing.
        """
        first, *others = scenarios
        shape = first.ego.shape if first.ego else None
        if any((other.ego.shape if other.ego else None) != shape for other in others):
            egos = ", ".join(f"{each.name} {each.ego_name}" for each in scenarios)
            raise ValueError(f"scenario: their egos differ ({egos}), but a rig is mounted on one; say which by vehicle")
        return cls(first.ego_name, Skin(first.build_ego_mesh()), get_mount_regions(shape))

    def get_mount_region(self, name: str) -> MountRegion:
        """Return a mount region. ValueError: there is none of this name; the message lists the others."""
        if name not in self.mount_regions:
            told = ", ".join(self.mount_regions) or "none at all: add mount_regions to its document"
            raise ValueError(f"region: {self.name} has no {name!r}; it has {told}")
        return self.mount_regions[name]


class PlacementSpace(FileDocument):
    """Base of a search space and a selection: the scenarios, the host vehicle, objectives and requirements."""

    kind: ClassVar[str] = "a search space"
    name: str
    description: str = ""
    scenario: NamesOrFiles
    vehicle: VehicleNameOrFile | None = None
    objectives: dict[NonEmptyName, Objective] = Field(min_length=1, max_length=MAX_OBJECTIVES)
    not_worse: tuple[NonEmptyName | Objective, ...] = ()
    requirements: Annotated[Requirements, build_name_validator(Requirements)] | None = None

    @property
    def base_rig(self) -> Rig | None:
        """The rig that is there in any case."""
        raise NotImplementedError

    @cached_property
    def scored_objectives(self) -> dict[str, Objective]:
        """Numbers that rigs are scored by: the objectives, those that must not be worse, and those of requirements."""
        kept = [Objective(region=one) if isinstance(one, str) else one for one in self.not_worse]
        named = {f"{NOT_WORSE}{one.description}": one for one in kept}
        return self.objectives | named | {name: one for name, (one, _) in self._required.items()}

    @property
    def bounds(self) -> dict[str, float]:
        """Bounds of the requirements, by the names of their numbers: the least, or of lower ones the largest value."""
        return {name: bound for name, (_, bound) in self._required.items()}

    @cached_property
    def _required(self) -> dict[str, tuple[Objective, float]]:
        """Numbers of regions with their bounds; those of targets and encounters are measured apart."""
        required, numbers = self.requirements, dict[str, tuple[Objective, float]]()
        for one in required.requirements if required else ():
            if required is None or not isinstance(one, RegionRequirement):
                continue
            usual_m, own_m = PAPER_HEIGHTS.get(one.band), required.heights.get(one.band)
            if usual_m is None or own_m not in (None, usual_m):
                raise ValueError(
                    f"requirements: a search has the bands {dict(PAPER_HEIGHTS)} alone, and {one.band!r} is {own_m} "
                    "there; leave heights out, or check what was found"
                )
            region = {one.region: required.regions[one.region]} if one.region in required.regions else one.region
            for key in (one.number, *(f"{one.number}_without_{name}" for name in one.failing_sensors)):
                each = Objective(number=key, region=region, band=one.band)
                numbers |= {f"{REQUIRED}{each.description}, {bound.text}": (each, bound.value) for bound in one.bounds}
        return numbers

    @cached_property
    def non_region_requirements(self) -> Requirements | None:
        """The requirements of targets and encounters; None if there are none."""
        required = self.requirements
        others = [one for one in required.requirements if not isinstance(one, RegionRequirement)] if required else []
        return required.model_copy(update={"requirements": tuple(others)}) if required and others else None

    @cached_property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The scenarios, each with the host vehicle as its ego."""
        rigs = {self.base_rig.name: self.base_rig} if self.base_rig else {}
        return tuple(set_ego(Scenario.load(each), rigs, self.vehicle) for each in self.scenario)

    @cached_property
    def host(self) -> HostVehicle:
        """The host vehicle."""
        return HostVehicle.from_scenarios(self.scenarios)
