"""`torchcover show`: which of the two is meant, a rig or a scenario; its pictures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track

from torchcover.evaluation import cameras_of, rig_pictures, scenario_pictures
from torchcover.evaluation.rig_names import as_called
from torchcover.evaluation.settings import DEFAULT_SCENARIO
from torchcover.files import BadFileError
from torchcover.report import check_film, write_film
from torchcover.simulation import Scenario, builtin_names
from torchcover.simulation.documents import read_mapping

DEFAULT_RIG = "front_roof_128"
# A film shows this much, at this pace; both may be a little off, for steps are whole.
FILM_S, PER_S = 10.0, 5.0


def run(
    name: str,
    *,
    scenario: str | None,
    rig: str | None,
    vehicle: str | None,
    step: int | None,
    seed: int | None,
    film: Path | None,
    out: Path,
) -> None:
    """Print what it says of itself; draw it to `out/NAME.png`, what a rig's cameras measure to `out/NAME_depth.png`.

    A film shows what follows in a scenario instead.

    Raises:
        ValueError: The name of neither or of both, an option for the other kind, or a document that is not valid.
        FileNotFoundError: No such file.
    """
    console = Console()
    if _is_rig(name):
        _refuse("a scenario", {"--rig": rig, "--film": film}, f"{name!r} is a rig")
        shown = as_called(name)
        if not cameras_of(shown):
            _refuse("a scenario or cameras", {"--step": step, "--seed": seed}, f"{name!r} is a rig without cameras")
        world = Scenario.load(scenario or DEFAULT_SCENARIO)
        _say(console, shown.description)
        _write(
            console, out / Path(name).stem, rig_pictures(shown, world, vehicle=vehicle, step=step or 0, seed=seed or 0)
        )
        return
    _refuse("a rig", {"--scenario": scenario}, f"{name!r} is a scenario")
    if film is not None:
        check_film(film)
    world, seen_by = Scenario.load(name), as_called(rig or DEFAULT_RIG)
    steps = range(step or 0, (step or 0) + 1) if film is None else _steps_of_film(world, step or 0)
    figures = scenario_pictures(world, seen_by, steps, vehicle=vehicle, seed=seed or 0)
    _say(console, world.description)
    if film is None:
        _write(console, out / Path(name).stem, (("", figure) for figure in figures))
        return
    film.parent.mkdir(parents=True, exist_ok=True)
    drawn = track(figures, "pictures", total=len(steps), console=console)
    write_film(film, drawn, per_s=1 / (world.step_s * steps.step))
    console.print(f"Wrote {film}", markup=False, soft_wrap=True)


def _say(console: Console, description: str) -> None:
    if description:
        console.print(" ".join(description.split()), markup=False, highlight=False)


def _write(console: Console, stem: Path, figures: Iterable[tuple[str, Figure]]) -> None:
    for suffix, figure in figures:
        path = stem.with_name(f"{stem.name}{suffix}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=figure.dpi)
        console.print(f"Wrote {path}", markup=False, soft_wrap=True)


def _steps_of_film(world: Scenario, first: int) -> range:
    every = max(round(1 / (PER_S * world.step_s)), 1)
    return range(first, first + max(round(FILM_S / world.step_s), every) + 1, every)


def _is_rig(name: str) -> bool:
    if Path(name).suffix in (".yaml", ".yml"):
        return _has_sensors(Path(name))
    rigs, scenarios = builtin_names("rigs"), builtin_names("scenarios")
    if (name in rigs) == (name in scenarios):
        which = "both a rig and a scenario: give the YAML file" if name in rigs else "neither a .yaml file nor built in"
        raise ValueError(f"{name!r} is {which}; rigs: {', '.join(rigs)}; scenarios: {', '.join(scenarios)}")
    return name in rigs


def _has_sensors(path: Path) -> bool:
    try:
        return "sensors" in read_mapping(path)
    except BadFileError:
        return False  # whatever loads it says what is wrong


def _refuse(kind: str, options: dict[str, Any], reason: str) -> None:
    given = [option for option, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{', '.join(given)}: for {kind} only, and {reason}")
