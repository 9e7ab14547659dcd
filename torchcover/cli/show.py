"""`torchcover show`: which of the two is meant, a rig or a scenario; its pictures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console

from torchcover.evaluation import cameras_of, rig_pictures, scenario_picture
from torchcover.evaluation.rig_names import as_called
from torchcover.evaluation.settings import DEFAULT_SCENARIO
from torchcover.files import BadFileError
from torchcover.simulation import Scenario, builtin_names
from torchcover.simulation.documents import read_mapping

DEFAULT_RIG = "front_roof_128"


def run(
    name: str,
    *,
    scenario: str | None,
    rig: str | None,
    vehicle: str | None,
    step: int | None,
    seed: int | None,
    out: Path,
) -> None:
    """Print what it says of itself; draw it to `out/NAME.png`, what a rig's cameras measure to `out/NAME_depth.png`.

    Raises:
        ValueError: The name of neither or of both, an option for the other kind, or a document that is not valid.
        FileNotFoundError: No such file.
    """
    figures: Iterable[tuple[str, Figure]]
    if _is_rig(name):
        _refuse("a scenario", {"--rig": rig}, f"{name!r} is a rig")
        shown = as_called(name)
        if not cameras_of(shown):
            _refuse("a scenario or cameras", {"--step": step, "--seed": seed}, f"{name!r} is a rig without cameras")
        world, description = Scenario.load(scenario or DEFAULT_SCENARIO), shown.description
        figures = rig_pictures(shown, world, vehicle=vehicle, step=step or 0, seed=seed or 0)
    else:
        _refuse("a rig", {"--scenario": scenario}, f"{name!r} is a scenario")
        world, seen_by = Scenario.load(name), as_called(rig or DEFAULT_RIG)
        description = world.description
        figures = [("", scenario_picture(world, seen_by, vehicle=vehicle, step=step or 0, seed=seed or 0))]
    console = Console()
    if description:
        console.print(" ".join(description.split()), markup=False, highlight=False)
    for suffix, figure in figures:
        path = out / f"{Path(name).stem}{suffix}.png"
        out.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=figure.dpi)
        console.print(f"Wrote {path}", markup=False, soft_wrap=True)


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
