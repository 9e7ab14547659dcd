"""What a rig and a reference sensor saw at one step."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.instant import Instant, Scan
from torchcover.simulation.reference_sensor import ReferenceScan
from torchcover.simulation.scene import Scene

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Observation:
    """The clouds of one step in the vehicle frame (x forward, y left, z up, metres), without points of the ego itself.

    Args:
        clouds: Name of each rig -> (N, 3) float32 points of all its sensors, in their order.
        sensor_points: Name of each rig -> how many of its points are of each of its sensors.
        reference: (M, 3) float32 points of the reference sensor.
        reference_weights: (M,) float32 square metres that each of them stands for; None if they count the same.
        drawn: (objects,) how many points the reference drew on each of `World.objects`, from `ReferenceScan`.
        counts: How many rays there were, how many of them the ego took, and what was left out, by name.
    """

    clouds: Mapping[str, Float32]
    sensor_points: Mapping[str, Sequence[int]]
    reference: Float32
    reference_weights: Float32 | None
    drawn: NDArray[np.int64] | None
    counts: Mapping[str, int]


def counts_of(scene: Scene, instant: Instant, scans: Sequence[Scan], reference: ReferenceScan) -> dict[str, int]:
    """The counts of an observation.

    Args:
        scene: The geometry.
        instant: The scene at the step.
        scans: Of all sensors of all rigs.
        reference: Of the reference sensor.
    """
    return {
        **_ray_counts("sensor", scans),
        **_ray_counts("reference", [reference]),
        "reference_poses_redrawn": reference.redrawn,
        **_left_out(scene, instant, scans, reference),
    }


def _ray_counts(source: str, scans: Sequence[Scan | ReferenceScan]) -> dict[str, int]:
    return {
        f"{source}_rays": sum(scan.rays for scan in scans),
        f"{source}_self_hits": sum(scan.self_hits for scan in scans),
    }


def _left_out(scene: Scene, instant: Instant, scans: Sequence[Scan], reference: ReferenceScan) -> dict[str, int]:
    """What this step did not need, beside the number of all that there were of the kind."""
    rays = sum(scan.rays for scan in scans)
    pairs = (rays + reference.rays) * len(instant.moving)
    return {
        "moving_bodies": len(instant.moving) + instant.out_of_range,
        "moving_bodies_out_of_range": instant.out_of_range,
        "ray_body_pairs": pairs,
        "ray_body_pairs_left_out": pairs - reference.body_casts - sum(scan.body_casts for scan in scans),
        "sensor_rays_reused": 0 if scene.moves else rays,
        "sensor_self_hits_reused": sum(scan.self_hits for scan in scans) if scene.knows_self_hits else 0,
    }
