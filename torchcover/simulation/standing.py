"""A hint where bodies that move do not stand on the ground: then hardly anything of it is seen, or known."""

import warnings

import numpy as np

from torchcover.geometry.arrays import Int64
from torchcover.simulation.local_ground import ROUNDING_M
from torchcover.simulation.scene import Scene

# Nearer than this is near enough, above or below.
NEAR_M = 1.0
# Instants that are looked at, and how far about the ego.
LOOKS = 8
WITHIN_M = 100.0


def warn_of_floating(name: str, scene: Scene, steps: Int64) -> None:
    """Warn if the ego, or more than half of the others that move, have no ground near the bottoms of their bodies."""
    found = np.concatenate([_grounded(scene, step) for step in steps[:: -(-len(steps) // LOOKS)].tolist()])
    of_ego, of_others = found[found[:, 0] > 0, 1], found[found[:, 0] == 0, 1]
    for who, grounded, share in (("the ego", of_ego, 0.0), ("others that move", of_others, 0.5)):
        missing = int((grounded == 0).sum())
        if missing > share * len(grounded):
            warnings.warn(
                f"{name}: {missing} of {len(grounded)} times that were looked at, {who} had no ground within "
                f"{NEAR_M:g} m below or above the wheels, so that little of it will be known; is the ground a mesh in "
                "the same frame, and z that of the bottom? Traffic of type 'tracks' without `ground` makes ground that "
                "follows the tracks",
                stacklevel=4,
            )


def _grounded(scene: Scene, step: int) -> Int64:
    """(bodies, 2) whether each that is there at a step is the ego, and whether it has ground."""
    instant = scene.at(step, within_m=WITHIN_M)
    up = scene.world.ego.trajectory.at(step * scene.world.time_step_s)[2, :3]
    others = instant.moving.vehicle_T_part[instant.moving.body != instant.ego, :3, 3]
    places_m = np.concatenate([np.zeros((1, 3)), others])
    is_ego = np.arange(len(places_m)) == 0
    heights_m = instant.heights_m((places_m + NEAR_M * up).astype(np.float32))
    return np.column_stack([is_ego, heights_m <= 2 * NEAR_M + ROUNDING_M]).astype(np.int64)
