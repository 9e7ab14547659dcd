"""Figures before a measurement: a rig on its vehicle, depth images of its cameras, frames in bird's-eye view."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import shapely
from matplotlib.figure import Figure

from torchcover.evaluation.result_page import build_sensor_views
from torchcover.geometry import BoundingBox, invert, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.report import ActorMark, SkinPatch, StaticFaces, plot_depth_images, plot_rig, plot_scene, plot_vehicle
from torchcover.simulation import GRID_X_M, GRID_Y_M, CameraSensor, PaperReference, Rig, Scenario, SimulatedFrames
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.mount_regions import MountRegion, Skin
from torchcover.simulation.rig import is_roadside, set_ego
from torchcover.simulation.scene import Scene


@dataclass(frozen=True)
class SceneFigureParams:
    """Parameters of figures of scenes.

    Args:
        patch_points: Number of points along each side of a mount region.
        reference_rows: Rows of the reference sensor; a figure needs fewer points than a measurement.
        reference_columns: Columns of the reference sensor.
        min_level_cosine: Faces are level if the cosine between their normal and the z axis exceeds this value.
    """

    patch_points: int = 12
    reference_rows: int = 256
    reference_columns: int = 512
    min_level_cosine: float = 0.9


PARAMS = SceneFigureParams()


def list_cameras(rig: Rig) -> list[CameraSensor]:
    """List the cameras of a rig.

    Args:
        rig: The rig.
    """
    return [sensor for sensor in rig.sensors if isinstance(sensor, CameraSensor)]


def plot_rig_figures(
    rig: Rig, scenario: Scenario, *, vehicle: str | None = None, frame_index: int = 0, seed: int = 0
) -> Iterator[tuple[str, Figure]]:
    """Plot a rig on the ego vehicle of a scenario, and the depth images of its cameras.

    Args:
        rig: The rig.
        scenario: Scenario of the depth images; its ego vehicle carries the rig.
        vehicle: Vehicle that replaces the ego vehicle.
        frame_index: Frame of the depth images.
        seed: Seed of the traffic.

    Returns:
        Suffix of the file name, "" or "_depth", and figure; without cameras only the first one.
    """
    frames = _create_frames(scenario, rig, vehicle, frame_index, seed)
    geometry, time_step = frames.simulator.get_scene_geometry(frame_index)
    ego_mesh = geometry.scene.ego.mesh
    length, width, height = geometry.ego_box.size_m
    location = f"on {frames.scenario.ego_name} in {scenario.name}"
    subtitle = f"{location}, {length:.2f} x {width:.2f} x {height:.2f} m"
    views = build_sensor_views(rig.sensors)
    yield "", plot_rig(ego_mesh.vertices_m, ego_mesh.faces, views, title=rig.name, subtitle=subtitle)
    cameras = list_cameras(rig)
    if not cameras:
        return
    snapshot = geometry.get_snapshot(time_step)
    images = {}
    for camera in cameras:
        images[camera.name] = snapshot.render_range_image(
            camera.mount.to_matrix(), camera.compute_directions(), max_range_m=scenario.compute_max_range_m(camera)
        )
    time_s = time_step * geometry.scene.time_step_s
    subtitle = f"{location}, frame {frame_index}, t = {time_s:g} s, seed {seed}"
    yield "_depth", plot_depth_images(images, title=f"{rig.name}: distance along the ray", subtitle=subtitle)


def plot_scenario(
    scenario: Scenario, rig: Rig, frame_indices: Sequence[int], *, vehicle: str | None = None, seed: int = 0
) -> Iterator[Figure]:
    """Plot frames of a scenario in bird's-eye view: actors, points of a rig and reference points.

    Args:
        scenario: The scenario.
        rig: The rig.
        frame_indices: Indices of the frames.
        vehicle: Vehicle that replaces the ego vehicle.
        seed: Seed of the simulation.

    Returns:
        One figure for each frame.
    """
    frames = _create_frames(scenario, rig, vehicle, max(frame_indices), seed)
    # Figures show a whole room, or the default grid outdoors.
    x_m, y_m = frames.scenario.find_room_bounds_m() or (GRID_X_M, GRID_Y_M)
    for frame_index in frame_indices:
        frame = frames[frame_index]
        geometry, time_step = frames.simulator.get_scene_geometry(frame_index)
        time_s, trajectory = time_step * geometry.scene.time_step_s, geometry.scene.ego.trajectory
        vehicle_T_world = invert(trajectory.interpolate(time_s))
        path_m = transform_points(vehicle_T_world, trajectory.positions_m)[:, :2] if trajectory.is_moving else None
        yield plot_scene(
            x_m,
            y_m,
            static_faces=_find_static_faces(geometry.scene, vehicle_T_world),
            ego_outline_m=geometry.ego_box.outline_m,
            actors=_build_actor_marks(geometry.scene, vehicle_T_world, time_s),
            sensor_points=frame.sensor.numpy(),
            reference_points=frame.reference.numpy(),
            title=f"{scenario.name}, frame {frame_index}",
            subtitle=f"t = {time_s:g} s, seed {seed}; points of {rig.name} on {frames.scenario.ego_name}",
            path_m=path_m,
        )


def plot_vehicle_figure(vehicle: Vehicle) -> Figure:
    """Plot a vehicle from five sides with its mount regions.

    Args:
        vehicle: The vehicle.

    Returns:
        Figure outside pyplot.

    Raises:
        ValueError: A part of a mount region has no surface of the vehicle.
    """
    mesh = vehicle.build_mesh()
    skin, size_m = Skin(mesh), BoundingBox.from_points(mesh.vertices_m).size_m
    patches = [_build_patch(name, region, skin) for name, region in vehicle.mount_regions.items()]
    subtitle = f"{' x '.join(f'{extent:.2f}' for extent in size_m)} m; {len(patches) or 'no'} mount regions"
    return plot_vehicle(mesh.vertices_m, mesh.faces, patches, title=vehicle.name, subtitle=subtitle)


def _build_patch(name: str, region: MountRegion, skin: Skin) -> SkinPatch:
    """Sample the surface of a mount region."""
    shares = np.linspace(0.0, 1.0, PARAMS.patch_points).tolist()
    points_m = []
    try:
        for u, v in product(shares, shares):
            points_m.append(region.find_mount_point(skin, u, v).position_m)
    except ValueError as error:
        raise ValueError(f"mount region {name!r}: {error}") from error
    return SkinPatch(name, region.side, np.reshape(points_m, (len(shares), len(shares), 3)))


def _create_frames(scenario: Scenario, rig: Rig, vehicle: str | None, last_frame: int, seed: int) -> SimulatedFrames:
    """Create the frames up to `last_frame`; a roadside rig needs its own reference sensor."""
    ego_box = set_ego(scenario, {rig.name: rig}, vehicle).compute_ego_box()
    reference = None
    if not is_roadside([rig], ego_box):
        reference = PaperReference(rows=PARAMS.reference_rows, columns=PARAMS.reference_columns)
    num_frames = last_frame + 1
    return SimulatedFrames(scenario, rig, num_frames=num_frames, seed=seed, vehicle=vehicle, reference_sensor=reference)


def _find_static_faces(scene: Scene, vehicle_T_world: Matrix) -> StaticFaces:
    """Find the static faces within the figure, and their heights above the ground below them."""
    (x_min_m, x_max_m), (y_min_m, y_max_m) = GRID_X_M, GRID_Y_M
    lower_m, upper_m = np.array([x_min_m, y_min_m]), np.array([x_max_m, y_max_m])
    obstacles, terrain = [np.empty((0, 3, 3))], [np.empty((0, 3, 3))]
    for mesh in scene.static_meshes:
        corners_m = transform_points(vehicle_T_world, mesh.vertices_m)[mesh.faces]
        if (_compute_normals(corners_m)[:, 2] > 0).all():  # a mesh whose faces all point up is ground
            terrain.append(corners_m)  # complete, since the center of an obstacle may be outside the figure
            continue
        is_inside = (corners_m[..., :2].max(axis=1) > lower_m) & (corners_m[..., :2].min(axis=1) < upper_m)
        obstacles.append(corners_m[is_inside.all(axis=1)])
    corners_m = np.concatenate(obstacles)
    ground_m = _compute_ground_heights_m(np.concatenate(terrain), corners_m.mean(axis=1)[:, :2])
    return StaticFaces(corners_m[..., :2], _compute_face_heights_m(corners_m) - ground_m)


def _compute_ground_heights_m(terrain_m: Matrix, positions_m: Matrix) -> Matrix:
    """Compute the height of the lowest terrain face at each position.

    Args:
        terrain_m: (G, 3, 3) corners of faces.
        positions_m: (N, 2) positions x, y.

    Returns:
        (N,) heights; 0, the height of the vehicle frame, where there is no terrain.
    """
    polygons = shapely.polygons(terrain_m[..., :2])
    position, face = shapely.STRtree(polygons).query(shapely.points(positions_m), predicate="intersects")
    normals, corners_m = _compute_normals(terrain_m)[face], terrain_m[face, 0]
    slope_m = ((positions_m[position] - corners_m[:, :2]) * normals[:, :2]).sum(axis=1)
    # The lowest face counts, since a bridge is no ground for the obstacles below it.
    heights_m = np.full(len(positions_m), np.inf)
    np.minimum.at(heights_m, position, corners_m[:, 2] - slope_m / normals[:, 2])
    return np.where(np.isfinite(heights_m), heights_m, 0.0)


def _compute_normals(corners_m: Matrix) -> Matrix:
    """Compute the (F, 3) normals of (F, 3, 3) faces; their length is twice the area."""
    return np.asarray(np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]))


def _compute_face_heights_m(corners_m: Matrix) -> Matrix:
    """Compute the (F,) height of the highest corner of (F, 3, 3) faces; of level ones, such as sidewalks, the mean."""
    normals = _compute_normals(corners_m)
    is_level = np.abs(normals[:, 2]) > PARAMS.min_level_cosine * np.linalg.norm(normals, axis=1)
    return np.asarray(np.where(is_level, corners_m[..., 2].mean(axis=1), corners_m[..., 2].max(axis=1)))


def _build_actor_marks(scene: Scene, vehicle_T_world: Matrix, time_s: float) -> list[ActorMark]:
    """Build the outlines of the objects that are present at a time."""
    marks = []
    for actor in scene.objects:
        if not np.isfinite(actor.trajectory.interpolate_positions_m(np.array([time_s]))).all():
            continue
        corners_m = BoundingBox.from_points(actor.mesh.vertices_m).outline_m
        base_m = np.column_stack([corners_m, np.zeros(len(corners_m))])
        vehicle_T_actor = vehicle_T_world @ actor.trajectory.interpolate(time_s)
        marks.append(ActorMark(actor.category, transform_points(vehicle_T_actor, base_m)[:, :2]))
    return marks
