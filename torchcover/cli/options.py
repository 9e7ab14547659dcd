"""Options: those of `evaluate`, as its settings declare them, and those that the command line adds."""

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from functools import update_wrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_type_hints

import typer

from torchcover.encounters.criterion import Criterion
from torchcover.evaluation.config import EvaluateConfig, load_config
from torchcover.evaluation.settings import FILES, parse_file_kinds

if TYPE_CHECKING:
    from torchcover.recordings import Recording, RecordingSettings
    from torchcover.simulation import RegionsOfInterest

Command = Callable[..., None]


# The groups of `--help`, by the names of options; what is in none stands under "Options".
PANELS = {
    "What": "scenario frames sensors vehicle sensor_model weather target heading encounters requirements "
    "redundancy thresholds_m threshold_m detection_points reference average num_start_offsets num_scenes",
    "Where": "regions region raster",
    "How exact": "num_frames num_rays frame_interval_s seed target_error budget num_evaluations num_held_out_scenes frames_per_scene",
    "Output": "out files explain animation",
    "How it runs": "config assignments device num_workers resume",
}
# Types of options that are no texts.
OPTION_TYPES: dict[str, Any] = {
    "num_frames": int,
    "num_rays": int,
    "num_workers": int,
    "frame_interval_s": float,
    "regions": Path,
    "weather": list[str],
    "thresholds_m": list[float],
    "target_error": list[str],
    "sensor_model": Literal["ideal", "real"],
    "average": Literal["area", "cells"],
}
PANEL_OF = {name: panel for panel, names in PANELS.items() for name in names.split()}


def with_options(parameters: Sequence[inspect.Parameter]) -> Callable[[Command], Command]:
    """A decorator: the command has these options, too, and gets those that were given as keywords.

    Args:
        parameters: From `build_setting_options`, `build_criterion_options` or `get_parameters`.
    """
    shared = {each.name for each in parameters}

    def decorate(command: Command) -> Command:
        def called(**given: Any) -> None:  # noqa: ANN401  (as typer has read them)
            command(**{name: value for name, value in given.items() if name not in shared or value is not None})

        own = [each for each in get_parameters(command) if each.kind is not inspect.Parameter.VAR_KEYWORD]
        update_wrapper(called, command)
        for each in (*own, *parameters):
            for said in get_args(each.annotation)[1:]:
                said.rich_help_panel = PANEL_OF.get(each.name, said.rich_help_panel)
        # What typer reads.
        called.__signature__ = inspect.Signature([*own, *parameters])  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in (*own, *parameters)}
        return called

    return decorate


def build_setting_options(*names: str) -> list[inspect.Parameter]:
    """Options of settings of `EvaluateConfig`: their names there, with dashes for underscores."""
    return [_parameter(name) for name in names]


def build_criterion_options() -> list[inspect.Parameter]:
    """What `Criterion` declares."""
    return _of_document(Criterion)


def _of_document(document: type) -> list[inspect.Parameter]:
    found = []
    for name, said in document.__annotations__.items():
        kind, words = get_args(said)
        option = f"--{name.replace('_', '-')}"
        annotation: Any = Annotated[kind, typer.Option(option, help=words)]
        usual = getattr(document, name)
        found.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=usual, annotation=annotation))
    return found


def get_parameters(command: Command) -> list[inspect.Parameter]:
    """What a command takes."""
    hints = get_type_hints(command, include_extras=True)
    return [each.replace(annotation=hints[each.name]) for each in inspect.signature(command).parameters.values()]


def shorten_help(description: str) -> str:
    """The first sentence of a description; `torchcover config` has all of it."""
    return description.partition(". ")[0].removesuffix(".") + "."


def _parameter(name: str) -> inspect.Parameter:
    field = EvaluateConfig.model_fields[name]
    default = field.default if type(field.default) in (bool, int, str) else None
    kind: Any = OPTION_TYPES.get(name, type(default) if default is not None else str)
    minimum = 0 if name in ("seed", "num_workers") else 1 if kind is int else None
    option = typer.Option(f"--{name.replace('_', '-')}", help=shorten_help(field.description or ""), min=minimum)
    annotation: Any = Annotated[kind if default is not None else kind | None, option]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


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
    parse_file_kinds(files)
    return files


RigArgument = Annotated[str, typer.Argument(help="Rig: a built-in name (see `list`) or a YAML file.")]
ConfigOption = Annotated[
    Path | None, typer.Option(help="YAML file of settings; `torchcover config` writes all of them with their defaults.")
]
AssignmentsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="KEY=VALUE: any setting of `torchcover config`, as in cell_m=0.5, or of the recording, as in "
        "recording.units=mm; may be repeated, and wins over --config.",
    ),
]
OutOption = Annotated[Path, typer.Option(help="Folder for the results.", callback=check_out)]
ALL_FILES = ",".join(FILES)
FilesOption = Annotated[
    str, typer.Option(help="What to write beside `summary.json`: any of numbers, maps, page.", callback=_check_files)
]


def find_changed_settings(option_values: Mapping[str, Any]) -> dict[str, Any]:
    """The options that differ from their defaults, as values of `EvaluateConfig`."""
    fields = EvaluateConfig.model_fields
    values = {name: str(value) if isinstance(value, Path) else value for name, value in option_values.items()}
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    return {name: value for name, value in values.items() if value not in (None, fields[name].default)}


def load_recording_settings(assignments: Sequence[str] | None) -> "RecordingSettings":
    """The settings of the recording that `--set recording.KEY=VALUE` gives, for commands that take no others.

    Raises:
        ValueError: Another setting, or as `load_config`.
    """
    if others := [text for text in assignments or () if not text.startswith("recording.")]:
        raise ValueError(f"--set {others[0]}: here only settings of the recording, as in recording.units=mm")
    return load_config(None, assignments or ()).config.recording


def open_recording(frames: Path, settings: "RecordingSettings", vehicle: str | None = None) -> "Recording":
    """Open the recording that a command line names, with the body of its vehicle if that is given."""
    from torchcover.recordings import open_recording as open_

    recording = open_(frames, settings)
    if vehicle is not None:
        from torchcover.simulation.recorded_rig import build_ego_box

        recording.ego_box = build_ego_box(recording, vehicle)
    return recording


def combine_regions(regions_file: Path | None, regions: Sequence[str] | None) -> "RegionsOfInterest | None":
    """The regions of interest of a command line; None if it names none.

    Args:
        regions_file: YAML file of `RegionsOfInterest`; options replace its regions.
        regions: NAME:x0,x1,y0,y1 each.

    Raises:
        FileNotFoundError: No such file.
        ValueError: A text that cannot be read or makes no sense, or a name that is given twice.
    """
    if regions_file is None and not regions:
        return None
    from pydantic import ValidationError

    from torchcover.simulation import RegionsOfInterest
    from torchcover.simulation.documents import explain_document_error

    content = {} if regions_file is None else RegionsOfInterest.load(regions_file).model_dump(exclude_unset=True)
    if regions:
        sides = _named("--region", regions, ("x0", "x1", "y0", "y1"))
        content["regions"] = {name: {"x_m": side[:2], "y_m": side[2:]} for name, side in sides.items()}
    try:
        return RegionsOfInterest.model_validate(content)
    except ValidationError as error:
        raise ValueError(explain_document_error(error)) from error


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
