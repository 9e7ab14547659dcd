"""Put a target at every place around a vehicle, and see what its rig gets of it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import find_overlaps
from torchcover.geometry.arrays import Float64
from torchcover.simulation.memory import check_memory_fits
from torchcover.simulation.rig import Rig, set_ego
from torchcover.simulation.scenario import Scenario
from torchcover.targets.counting import PLACES, TargetFrames, count_target_points
from torchcover.targets.placing import Heading, Raster, build_poses, compute_yaws_rad, is_point_inside
from torchcover.targets.result import FREE, OCCUPIED, OUTSIDE, PositionVisibility, TargetMap
from torchcover.targets.surface import SAMPLES, Target, TargetSurface

# Of one step: where each ends, on what, two random numbers. Of one cell: poses, sums, and what is made on the way.
BYTES_PER_RAY = 21
BYTES_PER_CELL = 500

HITS = 5
THRESHOLD_M = 0.4


def measure_target_visibility(
    rig: Rig,
    scenario: Scenario,
    target: Target,
    raster: Raster | None = None,
    *,
    num_frames: int = 1,
    frame_interval_s: float | None = None,
    seed: int = 0,
    detection_points: int = HITS,
    threshold_m: float = THRESHOLD_M,
    heading: Heading = "narrow",
) -> TargetMap:
    """What a rig sees of a target, for every place around the vehicle.

    Rays are those of `Simulator`, and points what a sensor makes of their hits. Of a LiDAR or a camera, each ray that
    meets the target before anything else, the vehicle's own body included, gives one, within the sensor's ranges, less
    those that drop out. Of a radar, a cell gives one if the hit in the middle of its hits is on the target. All places
    see the same rays drop out. All rays are cast at the time of the step, whatever the `scan` of a sensor: exact where
    vehicle and target rest or drive alike, but for what hides the target and drives otherwise.

    Args:
        rig: The sensors.
        scenario: The world, whose ego carries them. The target is in none of it: other targets hide nothing.
        target: What is placed, upright, at its own height above the local ground; where there is none, the place is
            `OUTSIDE`.
        raster: Where; within 5 m of the vehicle in steps of 0.2 m if not given.
        num_frames: How many steps are averaged.
        frame_interval_s: Time between two of them; the scenario's time step if not given.
        seed: Of traffic, random places, noise and drop-out.
        detection_points: How many points are enough to see it.
        threshold_m: How near a measured point on the target must be to a point of its surface, for the share.
        heading: Which side of it the vehicle sees: "narrow" (fewest points), "wide" (most), or its yaw in degrees.

    Raises:
        FileNotFoundError: A mesh, vehicle or trajectory file is missing.
        ValueError: A number out of its bounds, a target larger than the raster, or what `Simulator` refuses.

    Example:
        >>> courtyard, pole = Scenario.load("courtyard"), Target.load("pole")
        >>> raster = Raster((4.0, 8.0), (-1.0, 1.0), 1.0)
        >>> target_map = measure_target_visibility(Rig.load("front_roof_128"), courtyard, pole, raster)
        >>> target_map.points.shape, bool((target_map.points > 0).any())
        ((2, 4), True)
    """
    scenario = set_ego(scenario, {rig.name: rig})
    vehicle = scenario.compute_ego_box()
    raster = Raster.from_vehicle(vehicle) if raster is None else raster
    _check_size(target, raster)
    spots = measure_visibility_at_positions(
        rig, scenario, target, raster.positions_m,
        num_frames=num_frames, frame_interval_s=frame_interval_s, seed=seed, detection_points=detection_points, threshold_m=threshold_m, heading=heading,
    )  # fmt: skip
    return TargetMap(
        rig=rig.name,
        scenario=scenario.name,
        target=target.name,
        target_size_m=target.solid.bounding_box.size_m,
        target_bottom_m=target.bottom_m,
        heading=heading,
        raster=raster,
        vehicle_box=vehicle,
        vehicle_outline_m=_outline_m(scenario),
        sensor_model=rig.sensor_model,
        sensor_names=tuple(sensor.name for sensor in rig.sensors),
        sensor_positions_m=np.array([sensor.mount.to_matrix()[:2, 3] for sensor in rig.sensors]),
        detection_points=detection_points,
        threshold_m=threshold_m,
        seed=seed,
        num_frames=num_frames,
        **{name: array.reshape(*array.shape[:-1], *raster.shape) for name, array in vars(spots).items()},
    )


def measure_visibility_at_positions(
    rig: Rig,
    scenario: Scenario,
    target: Target,
    positions_m: Float64,
    counted_sensors: Sequence[int] | None = None,
    *,
    num_frames: int = 1,
    frame_interval_s: float | None = None,
    seed: int = 0,
    detection_points: int = HITS,
    threshold_m: float = THRESHOLD_M,
    heading: Heading = "narrow",
) -> PositionVisibility:
    """What some sensors see of a target at places; all that is not said here is as in `survey`.

    `positions_m`: (P, 2) where, in the vehicle frame; `counted_sensors`: numbers of the sensors that count, all if not given;
    the others are in the way as ever.
    """
    _check(num_frames, seed, detection_points, threshold_m)
    scenario = set_ego(scenario, {rig.name: rig})
    vehicle, box = scenario.compute_ego_box(), target.solid.bounding_box
    _check_memory(rig, len(positions_m), num_frames)
    vehicle_T_target = build_poses(positions_m, compute_yaws_rad(heading, box, vehicle, positions_m))
    occupied = find_overlaps(box, vehicle_T_target, vehicle.corners_m)
    for sensor in rig.sensors:
        occupied |= is_point_inside(box, vehicle_T_target, sensor.mount.to_matrix()[:3, 3])
    surface, elsewhere = TargetSurface.from_target(target), np.flatnonzero(~occupied)
    every_steps = 1 if frame_interval_s is None else scenario.count_time_steps(frame_interval_s)
    around = vehicle_T_target[elsewhere]
    run = TargetFrames(
        rig, scenario, target, surface, around, num_frames=num_frames, frame_stride=every_steps, seed=seed
    )
    some = range(len(rig.sensors)) if counted_sensors is None else counted_sensors
    every = run.mounted_sensors
    mounted = [every[k] for k in some]
    taken = [step._replace(sensor_frames=[step.sensor_frames[k] for k in some]) for step in run]
    sums = count_target_points(
        target, surface, around, mounted, taken, detection_points=detection_points, threshold_m=threshold_m
    )

    def spread(values: NDArray[Any], empty: float = np.nan) -> NDArray[Any]:
        everywhere = np.full((*values.shape[:-1], len(positions_m)), empty, dtype=values.dtype)
        everywhere[..., elsewhere] = values
        return everywhere

    steps_with = np.where(sums.free_frames > 0, sums.free_frames, np.nan)
    visible = np.where(sums.visible_samples > 0, sums.visible_samples, np.nan)
    return PositionVisibility(
        state=spread(np.where(sums.free_frames > 0, FREE, OUTSIDE).astype(np.uint8), OCCUPIED),
        free_frames=spread(sums.free_frames, 0),
        sensor_points=spread(sums.sensor_points / steps_with),
        detecting_sensors=spread(sums.detecting_sensors / steps_with),
        detected_share=spread(sums.detected_frames / steps_with),
        min_points=spread(np.where(sums.free_frames > 0, sums.min_points, np.nan)),
        min_sensors=spread(np.where(sums.free_frames > 0, sums.min_sensors, np.nan)),
        surface_share=spread(sums.detected_samples / visible),
        visible_m2=spread(sums.visible_samples / steps_with * surface.sample_area_m2 / run.viewpoints_per_frame),
    )


def _outline_m(scenario: Scenario) -> Float64:
    """(K, 2) the smallest convex outline of the vehicle, seen from above."""
    from shapely import MultiPoint

    return np.array(MultiPoint(scenario.build_ego_mesh().vertices_m[:, :2]).convex_hull.exterior.coords)[:-1]


def _check(num_frames: int, seed: int, detection_points: int, threshold_m: float) -> None:
    for name, value, least in (
        ("num_frames", num_frames, 1),
        ("seed", seed, 0),
        ("detection_points", detection_points, 1),
    ):
        if value < least:
            raise ValueError(f"{name}: a number >= {least} is needed; got {value}")
    if not 0 < threshold_m < math.inf:
        raise ValueError(f"threshold: metres above 0 are needed; got {threshold_m}")


def _check_size(target: Target, raster: Raster) -> None:
    length_m, width_m, _ = target.solid.bounding_box.size_m
    wide_m, high_m = raster.x_bounds_m[1] - raster.x_bounds_m[0], raster.y_bounds_m[1] - raster.y_bounds_m[0]
    if max(length_m, width_m) > max(wide_m, high_m) or min(length_m, width_m) > min(wide_m, high_m):
        raise ValueError(
            f"target {target.name!r} is {length_m:.3g} x {width_m:.3g} m, larger than the raster of {wide_m:.3g} x "
            f"{high_m:.3g} m; take a larger raster, or set the unit of its mesh in a vehicle file"
        )


def _check_memory(rig: Rig, cells: int, steps: int) -> None:
    rays = sum(sensor.num_rays for sensor in rig.sensors)
    places = max(PLACES, steps)
    needed_bytes = BYTES_PER_RAY * rays * steps + cells * (
        BYTES_PER_CELL + places * SAMPLES // 8 + 8 * len(rig.sensors)
    )
    check_memory_fits(
        f"{cells:,} places and {steps:,} steps of {rays:,} rays",
        needed_bytes,
        "use fewer steps or a larger step of the raster",
    )
