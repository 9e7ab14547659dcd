"""Visibility of a test target for a rig at every position around the vehicle."""

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
from torchcover.targets.counting import count_target_points
from torchcover.targets.placing import Heading, Raster, build_poses, compute_yaws_rad, is_point_inside
from torchcover.targets.result import FREE, OCCUPIED, OUTSIDE, PositionVisibility, TargetMap
from torchcover.targets.surface import NUM_SAMPLES, Target, TargetSurface
from torchcover.targets.target_frames import NUM_VIEWPOINTS, TargetFrames

# Points that are enough to detect a target, as in Waymo's easier level of difficulty.
DETECTION_POINTS = 5
# Threshold of the metric of Uecker & Zöllner 2024, also for the surface of targets.
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
    detection_points: int = DETECTION_POINTS,
    threshold_m: float = THRESHOLD_M,
    heading: Heading = "narrow",
) -> TargetMap:
    """Measure the visibility of a test target at every position around the vehicle.

    Rays and sensor models are those of `Simulator`. A ray of a LiDAR or a camera gives a point on the target if it hits
    the target before anything else, the ego vehicle included, within the range limits of the sensor, and does not drop
    out. A resolution cell of a radar gives a point if the center of its hits is on the target. The same rays drop out
    at all positions. All rays of a frame are cast at the same time, whatever the `scan` of a sensor; this is exact
    where the target, its occluders and the vehicle move alike.

    Args:
        rig: The sensors.
        scenario: The scenario with the ego vehicle; the target is at one position at a time, so that targets never hide
            each other.
        target: Test target, upright and at its own height above the local ground; positions without ground are
            `OUTSIDE`.
        raster: Positions; default: up to 5 m from the vehicle in cells of 0.2 m.
        num_frames: Number of frames that are averaged.
        frame_interval_s: Time between two frames; default: the time step of the scenario.
        seed: Seed of traffic, viewpoints, noise and drop-out.
        detection_points: Points that are enough to detect the target.
        threshold_m: Largest distance from a measured point at which a point of the surface counts as detected.
        heading: Orientation of the target: "narrow" or "wide" side to the vehicle, or its yaw in degrees.

    Returns:
        Maps over the raster.

    Raises:
        FileNotFoundError: A mesh, vehicle or trajectory file is missing.
        ValueError: A value is out of range, the target is larger than the raster, or `Simulator` refuses the rig.

    Example:
        >>> courtyard, pole = Scenario.load("courtyard"), Target.load("pole")
        >>> raster = Raster((4.0, 8.0), (-1.0, 1.0), 1.0)
        >>> target_map = measure_target_visibility(Rig.load("front_roof_128"), courtyard, pole, raster)
        >>> target_map.points.shape, bool((target_map.points > 0).any())
        ((2, 4), True)
    """
    scenario = set_ego(scenario, {rig.name: rig})
    vehicle_box = scenario.compute_ego_box()
    raster = Raster.from_vehicle(vehicle_box) if raster is None else raster
    check_target_fits(target, raster)
    positions = measure_visibility_at_positions(
        rig, scenario, target, raster.positions_m, num_frames=num_frames, frame_interval_s=frame_interval_s, seed=seed,
        detection_points=detection_points, threshold_m=threshold_m, heading=heading,
    )  # fmt: skip
    maps = {name: array.reshape(*array.shape[:-1], *raster.shape) for name, array in vars(positions).items()}
    return TargetMap(
        rig=rig.name,
        scenario=scenario.name,
        target=target.name,
        target_size_m=target.solid.bounding_box.size_m,
        target_bottom_m=target.bottom_m,
        heading=heading,
        raster=raster,
        vehicle_box=vehicle_box,
        vehicle_outline_m=compute_vehicle_outline_m(scenario),
        sensor_model=rig.sensor_model,
        sensor_names=rig.sensor_names,
        sensor_positions_m=np.array([sensor.mount.to_matrix()[:2, 3] for sensor in rig.sensors]),
        detection_points=detection_points,
        threshold_m=threshold_m,
        seed=seed,
        num_frames=num_frames,
        **maps,
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
    detection_points: int = DETECTION_POINTS,
    threshold_m: float = THRESHOLD_M,
    heading: Heading = "narrow",
) -> PositionVisibility:
    """Measure the visibility of a test target at given positions, for some sensors of a rig.

    Args:
        rig: The rig.
        scenario: The scenario with the ego vehicle.
        target: The test target.
        positions_m: (P, 2) positions in the vehicle frame.
        counted_sensors: Indices of the sensors whose points count; default: all. The others still occlude.
        num_frames: As in `measure_target_visibility`, like all further arguments.
        frame_interval_s: Time between two frames.
        seed: Seed of all random numbers.
        detection_points: Points that are enough to detect the target.
        threshold_m: Largest distance from a measured point to a detected point of the surface.
        heading: Orientation of the target.

    Returns:
        Arrays over the positions.

    Raises:
        FileNotFoundError: A mesh, vehicle or trajectory file is missing.
        ValueError: A value is out of range.
    """
    check_options(num_frames, seed, detection_points, threshold_m)
    scenario = set_ego(scenario, {rig.name: rig})
    vehicle_box, target_box = scenario.compute_ego_box(), target.solid.bounding_box
    check_memory(rig, len(positions_m), num_frames)
    poses = build_poses(positions_m, compute_yaws_rad(heading, target_box, vehicle_box, positions_m))
    # A target cannot stand where the vehicle or one of its sensors is.
    is_occupied = find_overlaps(target_box, poses, vehicle_box.corners_m)
    for sensor in rig.sensors:
        is_occupied |= is_point_inside(target_box, poses, sensor.mount.to_matrix()[:3, 3])
    evaluated = np.flatnonzero(~is_occupied)
    poses = poses[evaluated]
    surface = TargetSurface.from_target(target)
    frame_stride = 1 if frame_interval_s is None else scenario.count_time_steps(frame_interval_s)
    target_frames = TargetFrames(
        rig, scenario, target, surface, poses, num_frames=num_frames, frame_stride=frame_stride, seed=seed
    )
    sensor_indices = range(len(rig.sensors)) if counted_sensors is None else counted_sensors
    mounted_sensors = [target_frames.mounted_sensors[index] for index in sensor_indices]
    counted_frames = []
    for frame in target_frames:
        sensor_frames = [frame.sensor_frames[index] for index in sensor_indices]
        counted_frames.append(frame._replace(sensor_frames=sensor_frames))
    sums = count_target_points(
        target, surface, poses, mounted_sensors, counted_frames,
        detection_points=detection_points, threshold_m=threshold_m,
    )  # fmt: skip

    def fill_positions(values: NDArray[Any], fill_value: float = np.nan) -> NDArray[Any]:
        """Spread values of the evaluated positions over all positions."""
        array = np.full((*values.shape[:-1], len(positions_m)), fill_value, dtype=values.dtype)
        array[..., evaluated] = values
        return array

    # Means are over the frames with room for the target; NaN without any.
    has_free_frame = sums.free_frames > 0
    free_frames = np.where(has_free_frame, sums.free_frames, np.nan)
    visible_samples = np.where(sums.visible_samples > 0, sums.visible_samples, np.nan)
    visible_m2 = sums.visible_samples / free_frames * surface.sample_area_m2 / target_frames.viewpoints_per_frame
    return PositionVisibility(
        state=fill_positions(np.where(has_free_frame, FREE, OUTSIDE).astype(np.uint8), OCCUPIED),
        free_frames=fill_positions(sums.free_frames, 0),
        sensor_points=fill_positions(sums.sensor_points / free_frames),
        detecting_sensors=fill_positions(sums.detecting_sensors / free_frames),
        detected_share=fill_positions(sums.detected_frames / free_frames),
        min_points=fill_positions(np.where(has_free_frame, sums.min_points, np.nan)),
        min_sensors=fill_positions(np.where(has_free_frame, sums.min_sensors, np.nan)),
        surface_share=fill_positions(sums.detected_samples / visible_samples),
        visible_m2=fill_positions(visible_m2),
    )


def compute_vehicle_outline_m(scenario: Scenario) -> Float64:
    """Compute the (K, 2) convex hull of the ego vehicle in bird's-eye view."""
    from shapely import MultiPoint

    return np.array(MultiPoint(scenario.build_ego_mesh().vertices_m[:, :2]).convex_hull.exterior.coords)[:-1]


def check_options(num_frames: int, seed: int, detection_points: int, threshold_m: float) -> None:
    """Check that counts and the threshold are in range.

    Args:
        num_frames: At least 1.
        seed: At least 0.
        detection_points: At least 1.
        threshold_m: Positive and finite.

    Raises:
        ValueError: A value is out of range.
    """
    minima = (("num_frames", num_frames, 1), ("seed", seed, 0), ("detection_points", detection_points, 1))
    for name, value, minimum in minima:
        if value < minimum:
            raise ValueError(f"{name}: a number >= {minimum} is needed; got {value}")
    if not 0 < threshold_m < math.inf:
        raise ValueError(f"threshold: a length above 0 m is needed; got {threshold_m}")


def check_target_fits(target: Target, raster: Raster) -> None:
    """Check that a raster is not smaller than the target, which hints at a mesh in millimeters.

    Args:
        target: The test target.
        raster: Its positions.

    Raises:
        ValueError: The target is longer or wider than the raster.
    """
    length_m, width_m, _ = target.solid.bounding_box.size_m
    raster_x_m, raster_y_m = (high - low for low, high in (raster.x_bounds_m, raster.y_bounds_m))
    if max(length_m, width_m) > max(raster_x_m, raster_y_m) or min(length_m, width_m) > min(raster_x_m, raster_y_m):
        raise ValueError(
            f"target {target.name!r} is {length_m:.3g} x {width_m:.3g} m, larger than the raster of {raster_x_m:.3g} x "
            f"{raster_y_m:.3g} m; use a larger raster, or set the unit of its mesh in a vehicle file"
        )


def check_memory(rig: Rig, num_positions: int, num_frames: int) -> None:
    """Check that a run fits into memory.

    Args:
        rig: The rig, whose ray ends are kept for all frames.
        num_positions: Number of target positions.
        num_frames: Number of frames.

    Raises:
        ValueError: The run needs more memory than there is.
    """
    bytes_per_ray = 21  # range, hit flag and two random numbers
    bytes_per_position = 500  # pose, sums and intermediate results
    num_rays = sum(sensor.num_rays for sensor in rig.sensors)
    bytes_per_position += max(NUM_VIEWPOINTS, num_frames) * NUM_SAMPLES // 8 + 8 * len(rig.sensors)
    check_memory_fits(
        f"{num_positions:,} target positions and {num_frames:,} frames of {num_rays:,} rays",
        bytes_per_ray * num_rays * num_frames + num_positions * bytes_per_position,
        "use fewer frames or larger cells of the raster",
    )
