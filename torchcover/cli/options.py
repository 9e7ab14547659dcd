"""Options: those of `evaluate`, as its settings declare them, and those that the command line adds."""

import inspect
import os
from collections.abc import Callable, Sequence
from functools import update_wrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from torchcover.encounters.criterion import Criterion
from torchcover.evaluation.settings import FILES, OPTIONS, Settings, wanted_files
from torchcover.recordings.corrections import Corrections

if TYPE_CHECKING:
    from torchcover.recordings import Recording
    from torchcover.simulation import RegionsOfInterest

Command = Callable[..., None]


# The groups of `--help`, by the names of options; what is in none stands under "Options".
PANELS = {
    "What": "scenario frames vehicle sensor_model weather target heading encounters requirements aggregations "
    "redundancy metrics thresholds_m threshold_m hits reference estimate phases worlds",
    "Where": "ask region height grid cell_m band_frame probe raster",
    "How exact": "steps rays every_s seed target_error only_detection budget evaluations optimiser fresh_worlds "
    "per_world",
    "Output": "out files rerun explain film",
    "How it runs": "device workers no_cache resume skip_bad_frames",
    "Of a recording": " ".join(["recording_format vehicle_frame mount sensors window_s", *Corrections.__annotations__]),
}
PANEL_OF = {name: panel for panel, names in PANELS.items() for name in names.split()}


def with_options(parameters: Sequence[inspect.Parameter]) -> Callable[[Command], Command]:
    """A decorator: the command has these options, too, and gets those that were given as keywords.

    Args:
        parameters: From `of_evaluate`, `of_criterion` or `parameters_of`.
    """
    shared = {each.name for each in parameters}

    def decorate(command: Command) -> Command:
        def called(**given: Any) -> None:  # noqa: ANN401  (as typer has read them)
            command(**{name: value for name, value in given.items() if name not in shared or value is not None})

        own = [each for each in parameters_of(command) if each.kind is not inspect.Parameter.VAR_KEYWORD]
        update_wrapper(called, command)
        for each in (*own, *parameters):
            for said in get_args(each.annotation)[1:]:
                said.rich_help_panel = PANEL_OF.get(each.name, said.rich_help_panel)
        # What typer reads.
        called.__signature__ = inspect.Signature([*own, *parameters])  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in (*own, *parameters)}
        return called

    return decorate


def of_evaluate(*names: str) -> list[inspect.Parameter]:
    """Options of `evaluate`, as `Settings` declares them: their names there, with dashes for underscores."""
    return [_parameter(name) for name in names]


def of_criterion() -> list[inspect.Parameter]:
    """What `Criterion` declares."""
    return _of_document(Criterion)


def of_corrections() -> list[inspect.Parameter]:
    """What `Corrections` declares."""
    return _of_document(Corrections, ending="_s")


def _of_document(document: type, ending: str = "") -> list[inspect.Parameter]:
    found = []
    for name, said in document.__annotations__.items():
        kind, words = get_args(said)
        option = f"--{name.removesuffix(ending).replace('_', '-')}"
        annotation: Any = Annotated[kind, typer.Option(option, help=words)]
        usual = getattr(document, name)
        found.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=usual, annotation=annotation))
    return found


def parameters_of(command: Command) -> list[inspect.Parameter]:
    """What a command takes."""
    hints = get_type_hints(command, include_extras=True)
    return [each.replace(annotation=hints[each.name]) for each in inspect.signature(command).parameters.values()]


def _parameter(name: str) -> inspect.Parameter:
    option, usual = OPTIONS[name], getattr(Settings, name)
    shown = usual if type(usual) in (bool, int, str) else None
    kind = option.typed or get_args(Settings.__annotations__[name])[0]
    told = typer.Option(f"--{name.replace('_', '-')}", help=option.words, min=option.minimum)
    annotation: Any = Annotated[kind if shown is not None else kind | None, told]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=shown, annotation=annotation)


def check_out(folder: Path) -> Path:
    """Find out before the run, not after it, whether its results can be written.

    Raises:
        ValueError: The folder, or the first of its parents that exists, is a file, a link to nothing, or may not be
            written to.
    """
    nearest = next(place for place in (folder, *folder.absolute().parents) if os.path.lexists(place))
    if not nearest.exists():
        raise ValueError(f"--out {folder}: {nearest} is a link to what is not there")
    if not nearest.is_dir():
        raise ValueError(f"--out {folder}: {nearest} is a file, not a folder")
    if not os.access(nearest, os.W_OK):
        raise ValueError(f"--out {folder}: {nearest} may not be written to; choose another folder")
    return folder


def _check_files(files: str) -> str:
    wanted_files(files)
    return files


Rig = Annotated[str, typer.Argument(help="Rig: a built-in name (see `list`) or a YAML file.")]
Format = Annotated[str | None, typer.Option("--format", help="Format of the recording, if it is not recognised.")]
VehicleFrame = Annotated[
    str | None, typer.Option("--vehicle-frame", help="Of a bag: the vehicle's frame (base_footprint, else base_link).")
]
Mount = Annotated[
    list[str] | None,
    typer.Option(help="Of a bag: SENSOR=x,y,z or SENSOR=x,y,z,yaw,pitch,roll on the vehicle, metres and degrees."),
]
Out = Annotated[Path, typer.Option(help="Folder for the results.", callback=check_out)]
ALL_FILES = ",".join(FILES)
Files = Annotated[
    str, typer.Option(help="What to write beside `summary.json`: any of numbers, maps, page.", callback=_check_files)
]


def opened(
    frames: Path,
    recording_format: str | None,
    vehicle: str | None,
    vehicle_frame: str | None,
    mount: Sequence[str] | None,
) -> "Recording":
    """The recording that a command line names, with what it tells of it."""
    from torchcover.geometry import rigid, rotation_from_euler
    from torchcover.recordings import open_recording

    told = {}
    for text in mount or ():
        sensor, _, numbers = text.partition("=")
        x, y, z, *turn = _numbers(
            "--mount", text, numbers, ("x", "y", "z", "yaw", "pitch", "roll")[: 6 if numbers.count(",") > 2 else 3]
        )
        told[sensor] = rigid(rotation_from_euler(*(turn or (0.0, 0.0, 0.0))), [x, y, z])
    recording = open_recording(frames, recording_format, vehicle_frame=vehicle_frame, mounts=told)
    if vehicle is not None:
        from torchcover.simulation.recorded_rig import recorded_body

        recording.body = recorded_body(recording, vehicle)
    return recording


def asked(
    file: Path | None, regions: Sequence[str] | None, heights: Sequence[str] | None, grid: str | None
) -> "RegionsOfInterest | None":
    """What is asked about; None if nothing is said of it.

    Args:
        file: YAML; what options give replaces what it says.
        regions: NAME:x0,x1,y0,y1 each.
        heights: NAME:z0,z1 each.
        grid: x0,x1,y0,y1.

    Raises:
        FileNotFoundError: No such file.
        ValueError: What cannot be read, or makes no sense; a name that is given twice.
    """
    if file is None and not (regions or heights or grid):
        return None
    from pydantic import ValidationError

    from torchcover.simulation import RegionsOfInterest
    from torchcover.simulation.documents import explain

    content = {} if file is None else RegionsOfInterest.load(file).model_dump(exclude_unset=True)
    if regions:
        sides = _named("--region", regions, ("x0", "x1", "y0", "y1"))
        content["regions"] = {name: {"x_m": side[:2], "y_m": side[2:]} for name, side in sides.items()}
    if heights:
        content["heights"] = _named("--height", heights, ("z0", "z1"))
    if grid:
        side = _numbers("--grid", grid, grid, ("x0", "x1", "y0", "y1"))
        content["grid"] = {**content.get("grid", {}), "x_m": side[:2], "y_m": side[2:]}
    try:
        return RegionsOfInterest.model_validate(content)
    except ValidationError as error:
        raise ValueError(explain(error)) from error


def _named(option: str, given: Sequence[str], bounds: Sequence[str]) -> dict[str, tuple[float, ...]]:
    found: dict[str, tuple[float, ...]] = {}
    for text in given:
        name, colon, numbers = text.rpartition(":")
        if not (colon and name):
            raise ValueError(f"{option} {text}: NAME:{','.join(bounds)} is needed, in metres")
        if name in found:
            raise ValueError(f"{option} {text}: the name {name!r} is given already; choose another")
        found[name] = _numbers(option, text, numbers, bounds)
    return found


def _numbers(option: str, text: str, numbers: str, bounds: Sequence[str]) -> tuple[float, ...]:
    try:
        found = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        found = ()
    if len(found) != len(bounds):
        raise ValueError(f"{option} {text}: {len(bounds)} numbers {','.join(bounds)} in metres are needed")
    return found
