"""Implementation of `torchcover show`: figures of a rig, a scenario or a vehicle."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.progress import track

from torchcover.evaluation import list_cameras, plot_rig_figures, plot_scenario, plot_vehicle_figure
from torchcover.evaluation.rig_names import load_named_rig
from torchcover.evaluation.settings import DEFAULT_SCENARIO
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
from torchcover.simulation.mounted_sensor import describe_self_hits
from torchcover.simulation.rig import set_ego

DEFAULT_RIG = "front_roof_128"
# Kind of a document -> key that only documents of this kind have.
KIND_KEYS = {"rig": "sensors", "scenario": "ego", "vehicle": "parts"}


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
    """Print the description of an item and plot it to `out/NAME.png`, depth images of a rig to `out/NAME_depth.png`.

    Args:
        name: Rig, scenario or vehicle: a built-in name, a YAML file, or a mesh of a vehicle.
        scenario: For a rig: scenario with its ego vehicle; None: the default.
        rig: For a scenario: rig whose points are plotted; None: the default.
        vehicle: For a rig or a scenario: host vehicle; None: the ego vehicle of the scenario.
        frame_index: For a rig or a scenario: frame; None: the first.
        seed: For a rig or a scenario: seed of the simulation; None: 0.
        animation: For a scenario: file of an animation instead of a figure.
        out: Folder of the figures.

    Raises:
        ValueError: Unknown or ambiguous name, an option for another kind of item, or an invalid document.
        FileNotFoundError: No such file.
    """
    kind = _find_kind(name)
    if kind == "vehicle":
        values: dict[str, Any] = {"--scenario": scenario, "--rig": rig, "--vehicle": vehicle}
        values |= {"--frame-index": frame_index, "--seed": seed}
        _reject_options("rigs and scenarios", values, f"{name!r} is a vehicle")
        _reject_options("a scenario", {"--animation": animation}, f"{name!r} is a vehicle")
        _show_vehicle(name, out)
    elif kind == "rig":
        _reject_options("a scenario", {"--rig": rig, "--animation": animation}, f"{name!r} is a rig")
        _show_rig(name, scenario or DEFAULT_SCENARIO, vehicle, frame_index, seed, out)
    else:
        _reject_options("a rig", {"--scenario": scenario}, f"{name!r} is a scenario")
        _show_scenario(name, rig or DEFAULT_RIG, vehicle, frame_index or 0, seed or 0, animation, out)


def _show_vehicle(name: str, out: Path) -> None:
    """Print the size of a vehicle and plot it."""
    shape = create_body_shape(name)
    if isinstance(shape, VehicleShape):
        vehicle = Vehicle.load(name)
    else:
        vehicle = Vehicle(name=shape.path.name, parts=(Body(name="body", shape=shape),))
    _print_text(vehicle.description)
    size_m = np.ptp(build_actor_mesh(name, shape).vertices_m, axis=0)  # warns about doubtful sizes
    _print_text(f"{size_m[0]:.2f} m long (x, forward), {size_m[1]:.2f} m wide (y), {size_m[2]:.2f} m high (z, up)")
    vertices_m = np.concatenate([mesh.vertices_m for part in vehicle.parts for mesh in part.build_meshes()])
    lower_m, upper_m = vertices_m.min(axis=0), vertices_m.max(axis=0)
    offset_m = -np.append((lower_m + upper_m)[:2] / 2, lower_m[2])
    if np.abs(offset_m).max() >= 0.01:  # the last printed digit
        x, y, z = offset_m.round(2) + 0.0  # no negative zero
        _print_text(
            f"Moved by x {x:+.2f}, y {y:+.2f}, z {z:+.2f} m: mounting positions are relative to the ground below the "
            "center of the bounding box"
        )
    _print_text(describe_windows(shape))
    _write_figures(out / Path(name).stem, [("", plot_vehicle_figure(vehicle))])


def _show_rig(
    name: str, scenario_name: str, vehicle: str | None, frame_index: int | None, seed: int | None, out: Path
) -> None:
    """Print the self hits of a rig, and plot it with the depth images of its cameras."""
    rig = load_named_rig(name)
    if not list_cameras(rig):
        values = {"--frame-index": frame_index, "--seed": seed}
        _reject_options("a scenario or cameras", values, f"{name!r} is a rig without cameras")
    scenario = Scenario.load(scenario_name)
    _print_text(rig.description)
    ego_mesh = set_ego(scenario, {name: rig}, vehicle).build_ego_mesh()
    self_hits = describe_self_hits(rig.sensors, rig.build_occluder_mesh(ego_mesh))
    _print_text(self_hits or "No ray hits the ego vehicle.")
    figures = plot_rig_figures(rig, scenario, vehicle=vehicle, frame_index=frame_index or 0, seed=seed or 0)
    _write_figures(out / Path(name).stem, figures)


def _show_scenario(
    name: str, rig_name: str, vehicle: str | None, frame_index: int, seed: int, animation: Path | None, out: Path
) -> None:
    """Plot one frame of a scenario, or write an animation from that frame on."""
    if animation is not None:
        check_animation(animation)
    scenario, rig = Scenario.load(name), load_named_rig(rig_name)
    frame_indices = range(frame_index, frame_index + 1)
    if animation is not None:
        frame_indices = select_animation_frames(scenario.effective_time_step_s, frame_index)
    figures = plot_scenario(scenario, rig, frame_indices, vehicle=vehicle, seed=seed)
    _print_text(scenario.description)
    if animation is None:
        _write_figures(out / Path(name).stem, (("", figure) for figure in figures))
        return
    console = Terminal()
    tracked = track(figures, "pictures", total=len(frame_indices), console=console)
    frames_per_s = 1 / (scenario.effective_time_step_s * frame_indices.step)
    write_animation(animation, tracked, frames_per_s=frames_per_s)
    console.print(f"Wrote {animation}", markup=False, soft_wrap=True)


def select_animation_frames(
    time_step_s: float, first: int, *, duration_s: float = 10.0, frames_per_s: float = 5.0
) -> range:
    """Select the frames of an animation; duration and rate are approximate because time steps are discrete.

    Args:
        time_step_s: Time step of the scenario.
        first: Index of the first frame.
        duration_s: Duration of the animation.
        frames_per_s: Frame rate.

    Returns:
        Indices of the frames.
    """
    stride = max(round(1 / (frames_per_s * time_step_s)), 1)
    return range(first, first + max(round(duration_s / time_step_s), stride) + 1, stride)


def _print_text(text: str) -> None:
    """Print a text as one paragraph; nothing if it is empty."""
    if text:
        Terminal().print(" ".join(text.split()), markup=False, highlight=False)


def _write_figures(stem: Path, figures: Iterable[tuple[str, Figure]]) -> None:
    """Write figures to files named by stem and suffix."""
    for suffix, figure in figures:
        path = stem.with_name(f"{stem.name}{suffix}.png")
        write_atomically(path, partial(figure.savefig, dpi=figure.dpi))
        Terminal().print(f"Wrote {path}", markup=False, soft_wrap=True)


def _find_kind(name: str) -> str:
    """Find the kind of an item: rig, scenario or vehicle."""
    suffix = Path(name).suffix
    if suffix in (".yaml", ".yml"):
        try:
            keys = read_mapping(Path(name))
        except BadFileError:
            return "scenario"  # loading it explains the mistake
        return next((kind for kind, key in KIND_KEYS.items() if key in keys), "scenario")
    if suffix:
        return "vehicle"  # a mesh
    names_by_kind = {kind: list_builtin_names(f"{kind}s") for kind in KIND_KEYS}
    kinds = [kind for kind, names in names_by_kind.items() if name in names]
    if len(kinds) > 1:
        raise ValueError(f"{name!r} is both a {' and a '.join(kinds)}: give the YAML file")
    if not kinds:
        suggestion = suggest_names(name, sorted(set().union(*names_by_kind.values())))
        raise ValueError(f"{name!r} is neither a .yaml file nor built in; {suggestion}")
    return kinds[0]


def _reject_options(kind: str, values: dict[str, Any], reason: str) -> None:
    """Reject options that have a value but apply to another kind of item."""
    wrong = [option for option, value in values.items() if value is not None]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: for {kind} only, and {reason}")
