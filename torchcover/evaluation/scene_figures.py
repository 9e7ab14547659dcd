"""Pictures before any measurement: a rig on its vehicle, what its cameras see, frames of a scenario from above."""

from collections.abc import Iterator, Sequence

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
from torchcover.simulation.world import Scene

PATCH_PLACES = 12  # along each side of a mount region
FLAT = 0.9  # the least cosine between a face's normal and z
# A picture needs fewer points than a measurement.
REFERENCE = PaperReference(rows=256, columns=512)


def list_cameras(rig: Rig) -> list[CameraSensor]:
    """Those of its sensors that make images."""
    return [sensor for sensor in rig.sensors if isinstance(sensor, CameraSensor)]


def plot_rig_figures(
    rig: Rig, scenario: Scenario, *, vehicle: str | None = None, frame_index: int = 0, seed: int = 0
) -> Iterator[tuple[str, Figure]]:
    """A rig on the ego of a scenario, and the depth images of its cameras, if it has any.

    Args:
        rig: The rig.
        scenario: Whose ego carries it, and what its cameras see.
        vehicle: What carries it instead.
        frame_index: Time step of the depth images.
        seed: Seed of the traffic.

    Returns:
        What to add to the name of the rig, ``""`` or ``"_depth"``, and the figure.
    """
    frames = _frames(scenario, rig, vehicle, frame_index, seed)
    scene, step_of_world = frames.simulator.get_scene_geometry(frame_index)
    ego = scene.scene.ego.mesh
    length, width, height = scene.ego_box.size_m
    subtitle = f"on {frames.scenario.ego_name} in {scenario.name}, {length:.2f} x {width:.2f} x {height:.2f} m"
    yield "", plot_rig(ego.vertices_m, ego.faces, build_sensor_views(rig.sensors), title=rig.name, subtitle=subtitle)
    if cameras := list_cameras(rig):
        instant = scene.get_snapshot(step_of_world)
        images = {
            camera.name: instant.render_range_image(
                camera.mount.to_matrix(), camera.compute_directions(), max_range_m=scenario.compute_max_range_m(camera)
            )
            for camera in cameras
        }
        time_s = step_of_world * scene.scene.time_step_s
        when = f"on {frames.scenario.ego_name} in {scenario.name}, step {frame_index}, t = {time_s:g} s, seed {seed}"
        yield "_depth", plot_depth_images(images, title=f"{rig.name}: distance along the ray", subtitle=when)


def plot_scenario(
    scenario: Scenario, rig: Rig, frame_indices: Sequence[int], *, vehicle: str | None = None, seed: int = 0
) -> Iterator[Figure]:
    """Frames of a scenario from above: its actors, the points of a rig, those of the reference.

    Args:
        scenario: The scenario.
        rig: Whose points.
        frame_indices: The frames.
        vehicle: What carries it, instead of the scenario's ego.
        seed: Seed of the simulation.
    """
    frames = _frames(scenario, rig, vehicle, max(frame_indices), seed)
    x_m, y_m = frames.scenario.find_room_bounds_m() or (GRID_X_M, GRID_Y_M)
    for step in frame_indices:
        frame = frames[step]
        scene, step_of_world = frames.simulator.get_scene_geometry(step)
        time_s, ego = step_of_world * scene.scene.time_step_s, scene.scene.ego.trajectory
        yield plot_scene(
            x_m,
            y_m,
            static_faces=_standing(scene.scene, time_s),
            ego_outline_m=scene.ego_box.outline_m,
            actors=_actor_marks(scene.scene, time_s),
            sensor_points=frame.sensor.numpy(),
            reference_points=frame.reference.numpy(),
            title=f"{scenario.name}, step {step}",
            subtitle=f"t = {time_s:g} s, seed {seed}; points of {rig.name} on {frames.scenario.ego_name}",
            path_m=transform_points(invert(ego.interpolate(time_s)), ego.positions_m)[:, :2] if ego.is_moving else None,
        )


def plot_vehicle_figure(vehicle: Vehicle) -> Figure:
    """A vehicle from all sides, with its mount regions.

    Raises:
        ValueError: Nothing of the vehicle is seen in a part of a region.
    """
    mesh = vehicle.build_mesh()
    skin, size_m = Skin(mesh), BoundingBox.from_points(mesh.vertices_m).size_m
    patches = [_patch(name, region, skin) for name, region in vehicle.mount_regions.items()]
    subtitle = f"{' x '.join(f'{extent:.2f}' for extent in size_m)} m; {len(patches) or 'no'} mount regions"
    return plot_vehicle(mesh.vertices_m, mesh.faces, patches, title=vehicle.name, subtitle=subtitle)


def _patch(name: str, region: MountRegion, skin: Skin) -> SkinPatch:
    shares = np.linspace(0.0, 1.0, PATCH_PLACES).tolist()
    try:
        places_m = [[region.find_mount_point(skin, u, v).position_m for v in shares] for u in shares]
    except ValueError as error:
        raise ValueError(f"mount region {name!r}: {error}") from error
    return SkinPatch(name, region.side, np.array(places_m))


def _frames(scenario: Scenario, rig: Rig, vehicle: str | None, step: int, seed: int) -> SimulatedFrames:
    ego = set_ego(scenario, {rig.name: rig}, vehicle).compute_ego_box()
    reference = None if is_roadside([rig], ego) else REFERENCE
    return SimulatedFrames(scenario, rig, num_frames=step + 1, seed=seed, vehicle=vehicle, reference_sensor=reference)


def _standing(world: Scene, time_s: float) -> StaticFaces:
    """The scenery within the picture, from above, by its height over the ground below it."""
    vehicle_T_world = invert(world.ego.trajectory.interpolate(time_s))
    low, high = np.array([(GRID_X_M[end], GRID_Y_M[end]) for end in (0, 1)])
    standing, terrain = [np.empty((0, 3, 3))], [np.empty((0, 3, 3))]
    for mesh in world.static_meshes:
        corners = transform_points(vehicle_T_world, mesh.vertices_m)[mesh.faces]
        # What faces up everywhere is the ground, and no body on it.
        lies = (_normals(corners)[:, 2] > 0).all()
        # What reaches into the picture may have its middle, and the ground below that, outside.
        inside = ((corners[..., :2].max(axis=1) > low) & (corners[..., :2].min(axis=1) < high)).all(axis=1)
        (terrain if lies else standing).append(corners if lies else corners[inside])
    corners = np.concatenate(standing)
    ground_m = _ground_m(np.concatenate(terrain), corners.mean(axis=1)[:, :2])
    return StaticFaces(corners[..., :2], _heights_m(corners) - ground_m)


def _ground_m(terrain_m: Matrix, places_m: Matrix) -> Matrix:
    """(N,) height at (N, 2) places of the lowest of (G, 3, 3) faces; 0, that of the vehicle, where there is none."""
    faces = shapely.polygons(terrain_m[..., :2])
    place, face = shapely.STRtree(faces).query(shapely.points(places_m), predicate="intersects")
    normals, corners = _normals(terrain_m)[face], terrain_m[face, 0]
    away_m = ((places_m[place] - corners[:, :2]) * normals[:, :2]).sum(axis=1)
    heights_m = np.full(len(places_m), np.inf)
    np.minimum.at(heights_m, place, corners[:, 2] - away_m / normals[:, 2])
    return np.where(np.isfinite(heights_m), heights_m, 0.0)


def _normals(corners_m: Matrix) -> Matrix:
    """(F, 3) of (F, 3, 3) faces, as long as these are large."""
    return np.asarray(np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]))


def _heights_m(corners_m: Matrix) -> Matrix:
    """(F,) the highest point of each of (F, 3, 3) faces; of flat ones the middle, for a pavement may be on a slope."""
    normals = _normals(corners_m)
    flat = np.abs(normals[:, 2]) > FLAT * np.linalg.norm(normals, axis=1)
    return np.asarray(np.where(flat, corners_m[..., 2].mean(axis=1), corners_m[..., 2].max(axis=1)))


def _actor_marks(world: Scene, time_s: float) -> list[ActorMark]:
    vehicle_T_world = invert(world.ego.trajectory.interpolate(time_s))
    there = [
        actor
        for actor in world.objects
        if np.isfinite(actor.trajectory.interpolate_positions_m(np.array([time_s]))).all()
    ]
    marks = []
    for actor in there:
        corners = BoundingBox.from_points(actor.mesh.vertices_m).outline_m
        vehicle_T_actor = vehicle_T_world @ actor.trajectory.interpolate(time_s)
        outline_m = transform_points(vehicle_T_actor, np.column_stack([corners, np.zeros(len(corners))]))[:, :2]
        marks.append(ActorMark(actor.category, outline_m))
    return marks
