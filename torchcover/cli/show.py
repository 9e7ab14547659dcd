"""`torchcover show`: a rig on its vehicle and what its cameras see, or a frame of a scenario from above."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console

from torchcover.cli.run import DEFAULT_SCENARIO, GRID_X_M, GRID_Y_M, outline_m, sensor_views
from torchcover.data import SimulatedFrames
from torchcover.geometry import BoundingBox, invert, transform
from torchcover.geometry.rigid import Matrix
from torchcover.report import ActorMark, draw_depths, draw_rig, draw_scene
from torchcover.simulation import CameraSensor, PaperReference, Rig, Scenario, builtin_names
from torchcover.simulation.instant import Instant
from torchcover.simulation.world import Actor, World

DEFAULT_RIG = "front_roof_128"
# A picture needs fewer points than a measurement.
REFERENCE = PaperReference(rows=256, columns=512)


def run(name: str, *, scenario: str | None, rig: str | None, step: int | None, seed: int | None, out: Path) -> None:
    """Draw what has this name into `out/NAME.png`, and the depth images of a rig's cameras into `out/NAME_depth.png`.

    Raises:
        ValueError: The name of neither or of both, an option for the other kind, or a document that is not valid.
        FileNotFoundError: No such file.
    """
    if _is_rig(name):
        _refuse("a scenario", {"--rig": rig}, f"{name!r} is a rig")
        shown = Rig.load(name)
        if not _cameras(shown):
            _refuse("a scenario or cameras", {"--step": step, "--seed": seed}, f"{name!r} is a rig without cameras")
        figures = _draw_rig(shown, Scenario.load(scenario or DEFAULT_SCENARIO), step or 0, seed or 0)
    else:
        _refuse("a rig", {"--scenario": scenario}, f"{name!r} is a scenario")
        figures = {"": _draw_scenario(Scenario.load(name), Rig.load(rig or DEFAULT_RIG), step or 0, seed or 0)}
    out.mkdir(parents=True, exist_ok=True)
    for suffix, figure in figures.items():
        path = out / f"{Path(name).stem}{suffix}.png"
        figure.savefig(path, dpi=figure.dpi)
        Console().print(f"Wrote {path}", soft_wrap=True)


def _is_rig(name: str) -> bool:
    if Path(name).suffix in (".yaml", ".yml"):
        return _has_sensors(Path(name))
    rigs, scenarios = builtin_names("rigs"), builtin_names("scenarios")
    if (name in rigs) == (name in scenarios):
        which = "both a rig and a scenario: give the YAML file" if name in rigs else "neither a .yaml file nor built in"
        raise ValueError(f"{name!r} is {which}; rigs: {', '.join(rigs)}; scenarios: {', '.join(scenarios)}")
    return name in rigs


def _has_sensors(path: Path) -> bool:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
        return False  # whatever loads it says what is wrong
    return isinstance(content, dict) and "sensors" in content


def _refuse(kind: str, options: dict[str, Any], reason: str) -> None:
    given = [option for option, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{', '.join(given)}: for {kind} only, and {reason}")


def _cameras(rig: Rig) -> list[CameraSensor]:
    return [sensor for sensor in rig.sensors if isinstance(sensor, CameraSensor)]


def _draw_rig(rig: Rig, scenario: Scenario, step: int, seed: int) -> dict[str, Figure]:
    """The rig on its vehicle, and the depth images if it has cameras, by the suffix of the file name."""
    frames = SimulatedFrames(scenario, rig, steps=step + 1, seed=seed, reference_sensor=REFERENCE)
    scene, step_of_world = frames.scene_of(step)
    ego = scene.world.ego.mesh
    length, width, height = BoundingBox.around(ego.vertices_m).size_m
    subtitle = f"on the ego of {scenario.name}, {length:.2f} x {width:.2f} x {height:.2f} m"
    figures = {"": draw_rig(ego.vertices_m, ego.faces, sensor_views(rig), title=rig.name, subtitle=subtitle)}
    if cameras := _cameras(rig):
        instant = scene.at(step_of_world)
        images = {camera.name: _depth_image(camera, instant) for camera in cameras}
        when = f"{scenario.name}, step {step}, t = {step_of_world * scene.world.time_step_s:g} s, seed {seed}"
        figures["_depth"] = draw_depths(images, title=f"{rig.name}: distance along the ray", subtitle=when)
    return figures


def _depth_image(camera: CameraSensor, instant: Instant) -> NDArray[np.float32]:
    return instant.range_image(camera.mount.matrix(), camera.directions(), max_range_m=camera.max_range_m)


def _draw_scenario(scenario: Scenario, rig: Rig, step: int, seed: int) -> Figure:
    frames = SimulatedFrames(scenario, rig, steps=step + 1, seed=seed, reference_sensor=REFERENCE)
    frame = frames[step]
    scene, step_of_world = frames.scene_of(step)
    world = scene.world
    time_s = step_of_world * world.time_step_s
    return draw_scene(
        GRID_X_M,
        GRID_Y_M,
        ego_outline_m=outline_m(BoundingBox.around(world.ego.mesh.vertices_m)),
        actors=_actor_marks(world, time_s),
        sensor=frame.sensor.numpy(),
        reference=frame.reference.numpy(),
        title=f"{scenario.name}, step {step}",
        subtitle=f"t = {time_s:g} s, seed {seed}; points of {rig.name}",
    )


def _actor_marks(world: World, time_s: float) -> list[ActorMark]:
    vehicle_T_world = invert(world.ego.trajectory.at(time_s))
    there = [actor for actor in world.actors if np.isfinite(actor.trajectory.positions_at(np.array([time_s]))).all()]
    return [ActorMark(actor.category, _footprint_m(actor, vehicle_T_world, time_s)) for actor in there]


def _footprint_m(actor: Actor, vehicle_T_world: Matrix, time_s: float) -> Matrix:
    corners = outline_m(BoundingBox.around(actor.mesh.vertices_m))
    on_ground = np.column_stack([corners, np.zeros(len(corners))])
    return transform(vehicle_T_world @ actor.trajectory.at(time_s), on_ground)[:, :2]
