"""`torchcover show`: what is meant, a rig, a scenario or a vehicle; its pictures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console

from torchcover.evaluation import cameras_of, rig_pictures, scenario_picture, vehicle_picture
from torchcover.evaluation.rig_names import as_called
from torchcover.evaluation.settings import DEFAULT_SCENARIO
from torchcover.files import BadFileError
from torchcover.simulation import Scenario, builtin_names
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.documents import load_document, read_mapping

DEFAULT_RIG = "front_roof_128"
# Kinds of documents, and the key that only such a one has.
KINDS = {"rig": "sensors", "scenario": "ego", "vehicle": "parts"}


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
        ValueError: The name of none or of several, an option for another kind, or a document that is not valid.
        FileNotFoundError: No such file.
    """
    figures: Iterable[tuple[str, Figure]]
    kind = _kind(name)
    if kind == "rig":
        _refuse("a scenario", {"--rig": rig}, f"{name!r} is a rig")
        shown = as_called(name)
        if not cameras_of(shown):
            _refuse("a scenario or cameras", {"--step": step, "--seed": seed}, f"{name!r} is a rig without cameras")
        world, description = Scenario.load(scenario or DEFAULT_SCENARIO), shown.description
        figures = rig_pictures(shown, world, vehicle=vehicle, step=step or 0, seed=seed or 0)
    elif kind == "scenario":
        _refuse("a rig", {"--scenario": scenario}, f"{name!r} is a scenario")
        world, seen_by = Scenario.load(name), as_called(rig or DEFAULT_RIG)
        description = world.description
        figures = [("", scenario_picture(world, seen_by, vehicle=vehicle, step=step or 0, seed=seed or 0))]
    else:
        given = {"--scenario": scenario, "--rig": rig, "--vehicle": vehicle, "--step": step, "--seed": seed}
        _refuse("rigs and scenarios", given, f"{name!r} is a vehicle")
        body = load_document(Vehicle, "vehicles", name)
        description, figures = body.description, [("", vehicle_picture(body))]
    console = Console()
    if description:
        console.print(" ".join(description.split()), markup=False, highlight=False)
    for suffix, figure in figures:
        path = out / f"{Path(name).stem}{suffix}.png"
        out.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=figure.dpi)
        console.print(f"Wrote {path}", markup=False, soft_wrap=True)


def _kind(name: str) -> str:
    """Which of `KINDS` is meant."""
    if Path(name).suffix in (".yaml", ".yml"):
        return _kind_of_file(Path(name))
    of = {kind: builtin_names(f"{kind}s") for kind in KINDS}
    kinds = [kind for kind, names in of.items() if name in names]
    if len(kinds) != 1:
        both = f"both a {' and a '.join(kinds)}: give the YAML file"
        known = "; ".join(f"{kind}s: {', '.join(names)}" for kind, names in of.items())
        raise ValueError(f"{name!r} is {both if kinds else 'neither a .yaml file nor built in'}; {known}")
    return kinds[0]


def _kind_of_file(path: Path) -> str:
    try:
        keys = read_mapping(path)
    except BadFileError:
        return "scenario"  # whatever loads it says what is wrong
    return next((kind for kind, key in KINDS.items() if key in keys), "scenario")


def _refuse(kind: str, options: dict[str, Any], reason: str) -> None:
    given = [option for option, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{', '.join(given)}: for {kind} only, and {reason}")
