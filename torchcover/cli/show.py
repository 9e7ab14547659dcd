"""`torchcover show`: what is meant, a rig, a scenario or a vehicle; its pictures."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.progress import track

from torchcover.evaluation import list_cameras, plot_rig_figures, plot_scenario, plot_vehicle_figure
from torchcover.evaluation.settings import DEFAULT_SCENARIO
from torchcover.evaluation.task import load_named_rig
from torchcover.files import BadFileError, write_atomically
from torchcover.report import Terminal, check_animation, write_animation
from torchcover.simulation import Scenario, list_builtin_names
from torchcover.simulation.bodies import (
    Body,
    Vehicle,
    VehicleShape,
    build_actor_mesh,
    create_body_shape,
    describe_windows,
)
from torchcover.simulation.documents import read_mapping, suggest_names
from torchcover.simulation.rig import set_ego
from torchcover.simulation.shapes import MeshFile
from torchcover.simulation.sight import describe_self_hits

DEFAULT_RIG = "front_roof_128"
# Kinds of documents, and the key that only such a one has.
KINDS = {"rig": "sensors", "scenario": "ego", "vehicle": "parts"}
# A film shows this much, at this pace; both may be a little off, for steps are whole.
FILM_S, PER_S = 10.0, 5.0
# What is told of how a body is moved has so many metres in its last place.
SMALLEST_MOVE_M = 0.01


def show_item(
    name: str,
    *,
    scenario: str | None,
    rig: str | None,
    vehicle: str | None = None,
    frame_index: int | None,
    seed: int | None,
    animation: Path | None,
    out: Path,
) -> None:
    """Print what it says of itself; draw it to `out/NAME.png`, what a rig's cameras measure to `out/NAME_depth.png`.

    A film shows what follows in a scenario instead.

    Raises:
        ValueError: The name of none or of several, an option for another kind, or a document that is not valid.
        FileNotFoundError: No such file.
    """
    console, kind = Terminal(), _kind(name)
    if kind == "vehicle":
        given = {"--scenario": scenario, "--rig": rig, "--vehicle": vehicle, "--frame-index": frame_index, "--seed": seed}
        _refuse("rigs and scenarios", given, f"{name!r} is a vehicle")
        _refuse("a scenario", {"--animation": animation}, f"{name!r} is a vehicle")
        shape = create_body_shape(name)
        body = Vehicle.load(name) if isinstance(shape, VehicleShape) else _of_mesh(shape)
        _say(console, body.description)
        length_m, width_m, height_m = np.ptp(
            build_actor_mesh(name, shape).vertices_m, axis=0
        )  # with what is doubtful of it
        _say(console, f"{length_m:.2f} m long (x, forward), {width_m:.2f} m wide (y), {height_m:.2f} m high (z, up)")
        corners_m = np.concatenate([mesh.vertices_m for part in body.parts for mesh in part.build_meshes()])
        moved_m = -np.append((corners_m.min(axis=0) + corners_m.max(axis=0))[:2] / 2, corners_m[:, 2].min())
        if np.abs(moved_m).max() >= SMALLEST_MOVE_M:
            by = ", ".join(f"{axis} {metres:+.2f}" for axis, metres in zip("xyz", moved_m.round(2) + 0.0, strict=True))
            _say(console, f"Moved by {by} m: mounts are measured from the ground under the middle of its bounding box")
        _say(console, describe_windows(shape))
        _write(console, out / Path(name).stem, [("", plot_vehicle_figure(body))])
        return
    if kind == "rig":
        _refuse("a scenario", {"--rig": rig, "--animation": animation}, f"{name!r} is a rig")
        shown = load_named_rig(name)
        if not list_cameras(shown):
            _refuse(
                "a scenario or cameras", {"--frame-index": frame_index, "--seed": seed}, f"{name!r} is a rig without cameras"
            )
        world = Scenario.load(scenario or DEFAULT_SCENARIO)
        _say(console, shown.description)
        ego = set_ego(world, {name: shown}, vehicle).build_ego_mesh()
        _say(
            console,
            describe_self_hits(shown.sensors, shown.build_occluder_mesh(ego)) or "No ray ends on the own vehicle.",
        )
        _write(
            console,
            out / Path(name).stem,
            plot_rig_figures(shown, world, vehicle=vehicle, frame_index=frame_index or 0, seed=seed or 0),
        )
        return
    _refuse("a rig", {"--scenario": scenario}, f"{name!r} is a scenario")
    if animation is not None:
        check_animation(animation)
    world, seen_by = Scenario.load(name), load_named_rig(rig or DEFAULT_RIG)
    steps = (
        range(frame_index or 0, (frame_index or 0) + 1)
        if animation is None
        else _steps_of_film(world, frame_index or 0)
    )
    figures = plot_scenario(world, seen_by, steps, vehicle=vehicle, seed=seed or 0)
    _say(console, world.description)
    if animation is None:
        _write(console, out / Path(name).stem, (("", figure) for figure in figures))
        return
    drawn = track(figures, "pictures", total=len(steps), console=console)
    write_animation(animation, drawn, frames_per_s=1 / (world.effective_time_step_s * steps.step))
    console.print(f"Wrote {animation}", markup=False, soft_wrap=True)


def _of_mesh(shape: MeshFile) -> Vehicle:
    return Vehicle(name=shape.path.name, parts=(Body(name="body", shape=shape),))


def _say(console: Terminal, description: str) -> None:
    if description:
        console.print(" ".join(description.split()), markup=False, highlight=False)


def _write(console: Terminal, stem: Path, figures: Iterable[tuple[str, Figure]]) -> None:
    for suffix, figure in figures:
        path = stem.with_name(f"{stem.name}{suffix}.png")
        write_atomically(path, partial(figure.savefig, dpi=figure.dpi))
        console.print(f"Wrote {path}", markup=False, soft_wrap=True)


def _steps_of_film(world: Scenario, first: int) -> range:
    every = max(round(1 / (PER_S * world.effective_time_step_s)), 1)
    return range(first, first + max(round(FILM_S / world.effective_time_step_s), every) + 1, every)


def _kind(name: str) -> str:
    if Path(name).suffix in (".yaml", ".yml"):
        try:
            keys = read_mapping(Path(name))
        except BadFileError:
            return "scenario"  # whatever loads it says what is wrong
        return next((kind for kind, key in KINDS.items() if key in keys), "scenario")
    if Path(name).suffix:
        return "vehicle"  # a mesh
    of = {kind: list_builtin_names(f"{kind}s") for kind in KINDS}
    kinds = [kind for kind, names in of.items() if name in names]
    if len(kinds) != 1:
        both = f"both a {' and a '.join(kinds)}: give the YAML file"
        meant = suggest_names(name, sorted(set().union(*of.values())))
        raise ValueError(f"{name!r} is {both if kinds else f'neither a .yaml file nor built in; {meant}'}")
    return kinds[0]


def _refuse(kind: str, options: dict[str, Any], reason: str) -> None:
    given = [option for option, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{', '.join(given)}: for {kind} only, and {reason}")
