"""Pictures before any measurement: a rig on its vehicle, what its cameras see, a frame of a scenario from above."""

from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from torchcover.data import GRID_X_M, GRID_Y_M, SimulatedFrames
from torchcover.evaluation.sensor_drawings import sensor_views
from torchcover.geometry import BoundingBox, invert, transform
from torchcover.geometry.rigid import Matrix
from torchcover.report import ActorMark, draw_depths, draw_rig, draw_scene
from torchcover.simulation import CameraSensor, PaperReference, Rig, Scenario
from torchcover.simulation.world import Actor, World

# A picture needs fewer points than a measurement.
REFERENCE = PaperReference(rows=256, columns=512)


def cameras_of(rig: Rig) -> list[CameraSensor]:
    """Those of its sensors that make images."""
    return [sensor for sensor in rig.sensors if isinstance(sensor, CameraSensor)]


def rig_pictures(
    rig: Rig, scenario: Scenario, *, vehicle: str | None = None, step: int = 0, seed: int = 0
) -> Iterator[tuple[str, Figure]]:
    """A rig on the ego of a scenario, and the depth images of its cameras, if it has any.

    Args:
        rig: The rig.
        scenario: Whose ego carries it, and what its cameras see.
        vehicle: What carries it instead.
        step: Time step of the depth images.
        seed: Seed of the traffic.

    Returns:
        What to add to the name of the rig, ``""`` or ``"_depth"``, and the figure.
    """
    frames = _frames(scenario, rig, vehicle, step, seed)
    scene, step_of_world = frames.simulator.scene_of(step)
    ego = scene.world.ego.mesh
    length, width, height = scene.ego_box.size_m
    subtitle = f"on {frames.scenario.ego_name} in {scenario.name}, {length:.2f} x {width:.2f} x {height:.2f} m"
    yield "", draw_rig(ego.vertices_m, ego.faces, sensor_views(rig.sensors), title=rig.name, subtitle=subtitle)
    if cameras := cameras_of(rig):
        instant = scene.at(step_of_world)
        images = {
            camera.name: instant.range_image(camera.mount.matrix(), camera.directions(), max_range_m=camera.max_range_m)
            for camera in cameras
        }
        time_s = step_of_world * scene.world.time_step_s
        when = f"on {frames.scenario.ego_name} in {scenario.name}, step {step}, t = {time_s:g} s, seed {seed}"
        yield "_depth", draw_depths(images, title=f"{rig.name}: distance along the ray", subtitle=when)


def scenario_picture(
    scenario: Scenario, rig: Rig, *, vehicle: str | None = None, step: int = 0, seed: int = 0
) -> Figure:
    """A frame of a scenario from above: its actors, the points of a rig, those of the reference.

    Args:
        scenario: The scenario.
        rig: Whose points.
        vehicle: What carries it, instead of the scenario's ego.
        step: The frame.
        seed: Seed of the simulation.
    """
    frames = _frames(scenario, rig, vehicle, step, seed)
    frame = frames[step]
    scene, step_of_world = frames.simulator.scene_of(step)
    time_s = step_of_world * scene.world.time_step_s
    return draw_scene(
        GRID_X_M,
        GRID_Y_M,
        ego_outline_m=scene.ego_box.outline_m,
        actors=_actor_marks(scene.world, time_s),
        sensor=frame.sensor.numpy(),
        reference=frame.reference.numpy(),
        title=f"{scenario.name}, step {step}",
        subtitle=f"t = {time_s:g} s, seed {seed}; points of {rig.name} on {frames.scenario.ego_name}",
    )


def _frames(scenario: Scenario, rig: Rig, vehicle: str | None, step: int, seed: int) -> SimulatedFrames:
    return SimulatedFrames(scenario, rig, steps=step + 1, seed=seed, vehicle=vehicle, reference_sensor=REFERENCE)


def _actor_marks(world: World, time_s: float) -> list[ActorMark]:
    vehicle_T_world = invert(world.ego.trajectory.at(time_s))
    there = [actor for actor in world.actors if np.isfinite(actor.trajectory.positions_at(np.array([time_s]))).all()]
    return [ActorMark(actor.category, _footprint_m(actor, vehicle_T_world, time_s)) for actor in there]


def _footprint_m(actor: Actor, vehicle_T_world: Matrix, time_s: float) -> Matrix:
    corners = BoundingBox.around(actor.mesh.vertices_m).outline_m
    on_ground = np.column_stack([corners, np.zeros(len(corners))])
    return transform(vehicle_T_world @ actor.trajectory.at(time_s), on_ground)[:, :2]
