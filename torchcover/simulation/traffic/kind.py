"""Traffic of a scenario, recorded or generated, and the base of all kinds that are generated from a seed."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from torchcover.geometry.arrays import Float64
from torchcover.simulation.builtin import hash_builtin_documents
from torchcover.simulation.documents import Document
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.fleet import Fleet, load_bodies
from torchcover.simulation.traffic.scenery import Scenery
from torchcover.simulation.world import Actor, Scene, count_time_steps

MIN_TIME_STEP_S = 0.01


class Traffic(Document):
    """What makes a world with an ego in it, and says how long a run through it is.

    Args:
        time_step_s: Time between two frames.
    """

    # Whether a run is followed by the same again, which says nothing new, or by another world.
    is_repeating: ClassVar[bool]

    time_step_s: Annotated[float, Field(ge=MIN_TIME_STEP_S)] = 0.1

    @property
    def sampling_note(self) -> str:
        """What of a recording was not recorded, for results; no words where all is drawn, or nothing."""
        return ""

    @property
    @abstractmethod
    def num_time_steps(self) -> int:
        """Number of instants of a run."""

    def check(self) -> None:
        """Find out before a run whether a world can be built; ImportError if something is not installed."""

    @abstractmethod
    def build_scene(self, seed: int, ego_mesh: Mesh | None = None) -> Scene:
        """Build the world; the same for the same seed of whatever is drawn, and ego, the built-in SUV if not given."""


# Streets are as long as the ego's way: what moves on them grows with the square of the duration.
MAX_DURATION_S = 3600.0
# To a kilometre of a lane; more have no room.
VehiclesPerKm = Annotated[float, Field(ge=0.0, le=200.0)]
PeoplePerKm = Annotated[float, Field(ge=0.0, le=1000.0)]
# What rests, the ego, and who else moves.
SceneParts = tuple[Scenery, Actor, tuple[Actor, ...]]


class ProceduralTraffic(Traffic):
    """Traffic that is made from parameters and a seed.

    Args:
        duration_s: Length of the run.
        time_step_s: Time between two frames.
    """

    is_repeating: ClassVar[bool] = False

    duration_s: Annotated[float, Field(gt=0.0, le=MAX_DURATION_S)] = 60.0

    def build_scene(self, seed: int, ego_mesh: Mesh | None = None, bodies: Mapping[str, Mesh] | None = None) -> Scene:
        """Build the world; the same for the same seed and meshes, of the ego and of each kind in `CATEGORIES`.

        Those that are not given are built in. Without hills the ground is z = 0; nobody ever overlaps anybody, and the
        ego is followed closely enough for sensors of up to 250 m range.
        """
        generator = np.random.default_rng(seed)
        fleet = Fleet(load_bodies() if bodies is None else bodies, ego_mesh, generator)
        steps = max(1, int(np.ceil(self.duration_s / self.time_step_s - 1e-9)))
        times_s = self.time_step_s * np.arange(steps + 1, dtype=np.float64)
        scenery, driver, others = self._build(fleet, times_s, generator)
        return Scene(
            static_meshes=scenery.static_meshes,
            ego=driver,
            actors=others,
            time_step_s=self.time_step_s,
            duration_s=self.duration_s,
            static_actors=tuple(fleet.parked),
            ground_mesh_indices=scenery.ground_indices,
            num_omitted_road_users=fleet.omitted_count,
        )

    def collect_content(self) -> dict[str, Any]:
        """Its keys, and the vehicles that may be in it."""
        return {**super().collect_content(), "vehicles": hash_builtin_documents("vehicles")}

    @property
    def num_time_steps(self) -> int:
        """Number of instants."""
        return count_time_steps(self.duration_s, self.time_step_s)

    @abstractmethod
    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> SceneParts:
        """What rests, the ego, and who else moves, at (T,) times from 0 to the end, T >= 2."""
