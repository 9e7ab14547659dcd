"""Simulated recordings: what a LiDAR records as a reference, and the surface that it has seen."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from torchcover import BevGrid, forward_regions
from torchcover.geometry import invert, transform
from torchcover.simulation import Lidar
from torchcover.simulation.patches import Bounds
from torchcover.simulation.rays import into_tiles, pixels_in_tiles
from torchcover.simulation.sight import sight
from torchcover.simulation.surface_points import SurfaceStrata

REGIONS = forward_regions()
GRID = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.25)
STRATA = [(region.x, region.y, band) for region in REGIONS for band in GRID.heights.values()]
BOXES = Bounds(*np.array(STRATA, dtype=np.float64).transpose(2, 0, 1))
NOISE_M = 0.02
TRUTH_RAYS = 32_768
# A target a little above its surface, lest that hides it.
ABOVE_M = 1e-3
WITHIN_M = 260.0
# Points this near to the box of a moving body count as its own.
BODY_SLACK_M = 0.1

SPINNING = Lidar(name="spinning", model="hesai_pandar128", columns=1800, mount={"x_m": -0.8, "z_m": 1.95})
SOLID_STATE = Lidar(
    name="solid-state",
    channels=128,
    vertical_fov_deg=(-12.5, 12.5),
    horizontal_fov_deg=120.0,
    columns=1200,
    max_range_m=200.0,
    mount={"x_m": 0.2, "y_m": 0.4, "z_m": 1.8},
)
# Six scans within a second before and after, in the vehicle frame of the instant.
ACCUMULATED = SPINNING.model_copy(update={"name": "accumulated", "columns": 900})
AROUND = range(-10, 11, 4)


@dataclass
class Cloud:
    """Points, what is wrong from the rig's view, and what they count for.

    `row` and `column` of the ray that made a point, and whether it lies `on_moving` bodies; (N,) each.
    """

    points_m: np.ndarray
    weights: np.ndarray
    on_moving: np.ndarray
    row: np.ndarray
    column: np.ndarray
    radius_m: np.ndarray | None = None

    def where(self, kept):
        return Cloud(*(None if part is None else part[kept] for part in vars(self).values()))


def recorded_and_true(frames, index, lidar, generator):
    """The cloud recorded at an instant, and points with square metres of the surface that the LiDAR sees."""
    scene, step = frames.simulator.scene_of(index)
    ego, step_s = scene.world.ego.trajectory, scene.world.time_step_s
    steps = [step + k for k in AROUND if 0 <= step + k < scene.world.steps] if lidar is ACCUMULATED else [step]
    instants = [scene.at(number, within_m=WITHIN_M) for number in steps]
    poses = [invert(ego.at(number * step_s)) @ ego.at(step * step_s) for number in steps]
    scans = [scanned(lidar, instant, pose, generator) for instant, pose in zip(instants, poses, strict=True)]
    recorded = joined(scans)
    now = scene.at(step, within_m=WITHIN_M)
    surface = scene.surface(BOXES.lower_m.min(axis=0), BOXES.upper_m.max(axis=0))
    beyond = np.eye(4)
    beyond[0, 3] = 1e7
    at_rest = replace(now, moving=())
    moving = replace(now, static_T_vehicle=beyond @ now.static_T_vehicle)
    true = [seen(lidar, surface.near(at_rest, BOXES), instants, poses, generator, on_moving=False)]
    true.append(seen(lidar, surface.near(moving, BOXES), [now], [np.eye(4)], generator, on_moving=True))
    return recorded, joined(true)


def scanned(lidar, instant, pose, generator):
    """One scan, in the vehicle frame from which `pose` leads to that of its instant."""
    directions, mount = lidar.directions(), lidar.mount.matrix()
    scan = instant.scan(mount, into_tiles(directions), max_range_m=lidar.max_range_m)
    ray = pixels_in_tiles(directions)[scan.ray]
    way_m = scan.points.astype(np.float64) - mount[:3, 3]
    way_m *= 1 + generator.normal(0.0, NOISE_M, (len(way_m), 1)) / np.linalg.norm(way_m, axis=1, keepdims=True)
    points_m = mount[:3, 3] + way_m
    on_moving = np.zeros(len(points_m), dtype=bool)
    moving = instant.moving
    for part_T_vehicle, body, box_m in zip(moving.part_T_vehicle, moving.body, moving.corners_m, strict=True):
        if body != instant.ego:
            corners_m = transform(part_T_vehicle, box_m)
            low, high = corners_m.min(axis=0) - BODY_SLACK_M, corners_m.max(axis=0) + BODY_SLACK_M
            own_m = transform(part_T_vehicle, points_m)
            on_moving |= ((own_m >= low) & (own_m <= high)).all(axis=1)
    points_m = transform(invert(pose), points_m)
    cloud = Cloud(points_m, np.ones(len(points_m)), on_moving, *np.divmod(ray, directions.shape[2]))
    return cloud.where(GRID.cell_of(torch.from_numpy(points_m)).numpy() >= 0)


def seen(lidar, patches, instants, poses, generator, *, on_moving):
    """Points drawn evenly on a surface that the LiDAR sees from any of its places, with their square metres."""
    strata, clouds = SurfaceStrata(patches, BOXES), []
    places_m = [transform(invert(pose), lidar.mount.matrix()[:3, 3][None])[0] for pose in poses]
    views = list(zip(places_m, instants, poses, strict=True))
    for place_m, instant, pose in views:
        drawn = strata.draw(place_m, TRUTH_RAYS / (len(views) * len(STRATA)), generator)
        drawn = type(drawn)(*(part[in_sight(lidar, instant, pose, drawn)] for part in drawn))
        # What several places see is drawn from each of them.
        times = np.zeros(len(drawn.points_m))
        for other_m, other_instant, other_pose in views:
            front = ((other_m - drawn.points_m) * drawn.normals).sum(axis=1) > 0
            times += front & in_sight(lidar, other_instant, other_pose, drawn)
        weights, none = 1 / (drawn.per_m2 * np.maximum(times, 1)), np.zeros(len(times), dtype=np.int64)
        clouds.append(Cloud(drawn.points_m, weights, np.full(len(times), on_moving), none, none))
    return joined(clouds)


def in_sight(lidar, instant, pose, drawn):
    """Which points lie within the field of view and are not hidden."""
    targets_m = transform(pose, (drawn.points_m + np.float32(ABOVE_M) * drawn.normals).astype(np.float64))
    x, y, z = transform(invert(lidar.mount.matrix()), targets_m).T
    elevation_deg, rows_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y))), np.array(lidar.rows_deg())
    inside = (elevation_deg >= rows_deg.min()) & (elevation_deg <= rows_deg.max())
    inside &= np.abs(np.rad2deg(np.arctan2(y, x))) <= lidar.horizontal_fov_deg / 2
    inside &= x**2 + y**2 + z**2 <= lidar.max_range_m**2
    where = np.flatnonzero(inside)
    if len(where):
        inside[where] = sight(instant, lidar.mount.matrix()[:3, 3], targets_m[where].astype(np.float32)).seen
    return inside


def joined(clouds):
    parts = zip(*(list(vars(cloud).values())[:-1] for cloud in clouds), strict=True)
    return Cloud(*map(np.concatenate, parts))
