"""What all kinds of traffic have in common."""

from abc import abstractmethod
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveFloat

from torchcover.simulation.documents import Document
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.fleet import Fleet, load_bodies
from torchcover.simulation.world import Actor, World


class Procedural(Document):
    """Traffic that is made from parameters and a seed.

    Args:
        duration_s: Length of the run.
        time_step_s: Time between two frames.
    """

    duration_s: PositiveFloat = 60.0
    time_step_s: PositiveFloat = 0.1

    def world(self, seed: int, ego: Mesh | None = None, bodies: Mapping[str, Mesh] | None = None) -> World:
        """Build the world; the same for the same arguments.

        Args:
            seed: Draws the place and everybody in it.
            ego: Body of the ego, in the vehicle frame; the SUV of `bodies` if not given.
            bodies: A mesh for each kind of body (`fleet.CATEGORIES`); the built-in ones if not given.

        Returns:
            The world: the ground is z = 0, nobody ever overlaps anybody, and the ego is followed closely enough for
            sensors of up to 250 m range.

        Raises:
            ValueError: A kind has no body.
        """
        generator = np.random.default_rng(seed)
        fleet = Fleet(load_bodies() if bodies is None else bodies, ego, generator)
        steps = int(np.ceil(self.duration_s / self.time_step_s - 1e-9))
        times_s = self.time_step_s * np.arange(steps + 1, dtype=np.float64)
        static, driver, others = self._build(fleet, times_s, generator)
        return World(static, driver, others, self.time_step_s, self.duration_s, tuple(fleet.parked))

    @abstractmethod
    def _build(
        self, fleet: Fleet, times_s: NDArray[np.float64], generator: np.random.Generator
    ) -> tuple[tuple[Mesh, ...], Actor, tuple[Actor, ...]]:
        """What rests, the ego, and who else moves, at (T,) times from 0 to the end, T >= 2."""
