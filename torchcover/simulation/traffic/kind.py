"""Base classes of the traffic of a scenario: recorded traffic, and traffic generated from a seed."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from torchcover.geometry.arrays import Float64
from torchcover.simulation.builtin import hash_builtin_documents
from torchcover.simulation.documents import Document
from torchcover.simulation.scene import Actor, Scene, count_time_steps
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.fleet import Fleet, load_bodies
from torchcover.simulation.traffic.scenery import Scenery


class Traffic(Document):
    """Description of traffic that builds scenes with an ego vehicle.

    Args:
        time_step_s: Time between two frames, at least 0.01 s.
    """

    # True if each run repeats the same scene, which adds no information; False if each run has another scene.
    is_repeating: ClassVar[bool]

    time_step_s: Annotated[float, Field(ge=0.01)] = 0.1

    @property
    def sampling_note(self) -> str:
        """Note for results on sampled parts of a recorded scene; empty if everything or nothing is sampled."""
        return ""

    @property
    @abstractmethod
    def num_time_steps(self) -> int:
        """Number of frames of a run."""

    def check(self) -> None:
        """Check before a run that scenes can be built.

        Raises:
            ImportError: A package is missing; the message names it.
        """

    @abstractmethod
    def build_scene(self, seed: int, ego_mesh: Mesh | None = None) -> Scene:
        """Build the scene of one run.

        Args:
            seed: Seed of all sampled parts; the same seed gives the same scene.
            ego_mesh: Body of the ego vehicle in the vehicle frame; the built-in SUV if None.

        Returns:
            Static meshes, ego vehicle and actors.
        """


# Road users per kilometer of lane; higher densities leave no room.
VehiclesPerKm = Annotated[float, Field(ge=0.0, le=200.0)]
PeoplePerKm = Annotated[float, Field(ge=0.0, le=1000.0)]
# Static scenery, the ego vehicle, and the other moving actors.
SceneParts = tuple[Scenery, Actor, tuple[Actor, ...]]


class ProceduralTraffic(Traffic):
    """Traffic that is generated from parameters and a seed.

    Args:
        duration_s: Length of the run, at most an hour.
        time_step_s: Time between two frames, at least 0.01 s.
    """

    is_repeating: ClassVar[bool] = False

    # Streets are as long as the path of the ego vehicle: the traffic on them grows with the square of the duration.
    duration_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 60.0

    def build_scene(self, seed: int, ego_mesh: Mesh | None = None, bodies: Mapping[str, Mesh] | None = None) -> Scene:
        """Build the scene of one run.

        The ground is at z = 0 without hills, and road users never overlap. Traffic is simulated around the ego vehicle
        far enough for sensors with a range of 250 m.

        Args:
            seed: Seed of all sampled parts; the same seed and meshes give the same scene.
            ego_mesh: Body of the ego vehicle in the vehicle frame; the built-in SUV if None.
            bodies: Mesh of each kind in `CATEGORIES`; the built-in ones if None.

        Returns:
            Static meshes, ego vehicle and actors.

        Raises:
            ValueError: `bodies` lacks a kind.
        """
        generator = np.random.default_rng(seed)
        fleet = Fleet(load_bodies() if bodies is None else bodies, ego_mesh, generator)
        num_intervals = max(1, int(np.ceil(self.duration_s / self.time_step_s - 1e-9)))
        times_s = self.time_step_s * np.arange(num_intervals + 1, dtype=np.float64)
        scenery, ego, actors = self._build(fleet, times_s, generator)
        return Scene(
            static_meshes=scenery.static_meshes,
            ego=ego,
            actors=actors,
            time_step_s=self.time_step_s,
            duration_s=self.duration_s,
            static_actors=tuple(fleet.parked),
            ground_mesh_indices=scenery.ground_indices,
            num_omitted_road_users=fleet.omitted_count,
        )

    def collect_content(self) -> dict[str, Any]:
        """Return the settings and the hashes of the vehicles that determine the scenes."""
        return {**super().collect_content(), "vehicles": hash_builtin_documents("vehicles")}

    @property
    def num_time_steps(self) -> int:
        """Number of frames of a run."""
        return count_time_steps(self.duration_s, self.time_step_s)

    @abstractmethod
    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> SceneParts:
        """Build static scenery, ego vehicle and actors at (T,) times from 0 to the end, T >= 2."""
