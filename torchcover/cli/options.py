"""Options of commands: settings of `evaluate`, and those that only the command line has."""

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


# Headings of `--help` in their order, each with the names of its options; other options are below the last heading.
OPTION_GROUPS = {
    "Scene and sensors": "scenario frames sensors vehicle sensor_model weather target heading encounters requirements",
    "Measurement": "regions region raster thresholds_m threshold_m detection_points reference average redundancy "
    "points pixels consecutive_scans deceleration_mps2 latency_s max_ttc_s",
    "Accuracy": "num_frames num_rays frame_interval_s seed target_error budget num_evaluations num_scenes "
    "num_held_out_scenes frames_per_scene num_start_offsets",
    "Output": "out files explain animation layout",
    "Execution": "config assignments device num_workers resume",
}
# Types of options that are not derived from their defaults.
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


def with_options(parameters: Sequence[inspect.Parameter]) -> Callable[[Command], Command]:
    """Decorate a command so that it has more options, which it receives as keyword arguments.

    Args:
        parameters: From `build_setting_options`, `build_criterion_options` or `get_parameters`.

    Returns:
        A decorator. The command receives only options with a value.
    """
    added = {parameter.name for parameter in parameters}

    def decorate(command: Command) -> Command:
        def call_with_values(**values: Any) -> None:  # noqa: ANN401  (values of typer)
            """Call the command without options that have no value."""
            command(**{name: value for name, value in values.items() if name not in added or value is not None})

        declared = [item for item in get_parameters(command) if item.kind is not inspect.Parameter.VAR_KEYWORD]
        keywords = [item.replace(kind=inspect.Parameter.KEYWORD_ONLY) for item in (*declared, *parameters)]
        all_parameters = sorted(keywords, key=_assign_group)
        update_wrapper(call_with_values, command)
        # Typer reads both attributes.
        call_with_values.__signature__ = inspect.Signature(all_parameters)  # type: ignore[attr-defined]
        call_with_values.__annotations__ = {item.name: item.annotation for item in all_parameters}
        return call_with_values

    return decorate


def _assign_group(parameter: inspect.Parameter) -> int:
    """Set the heading of a parameter in `--help` and return the index of its group; arguments come first."""
    for info in get_args(parameter.annotation)[1:]:
        if isinstance(info, typer.models.OptionInfo):
            for index, (heading, names) in enumerate(OPTION_GROUPS.items()):
                if parameter.name in names.split():
                    info.rich_help_panel = heading
                    return index
            return len(OPTION_GROUPS)
    return -1


def build_setting_options(*names: str) -> list[inspect.Parameter]:
    """Build options of settings of `EvaluateConfig`, with the first sentence of their descriptions.

    Args:
        names: Names of the settings; an option has dashes for underscores.
    """
    options = []
    for name in names:
        field = EvaluateConfig.model_fields[name]
        # The default None marks a setting that was not given; other settings determine its value.
        default = field.default if type(field.default) in (bool, int, str) else None
        value_type: Any = OPTION_TYPES.get(name, str if default is None else type(default))
        # Typer rejects smaller values before any file is read.
        minimum = None
        if value_type is int:
            minimum = 0 if name in ("seed", "num_workers") else 1
        help_text = shorten_help(field.description or "")
        info = typer.Option(format_option_name(name), help=help_text, min=minimum)
        annotation: Any = Annotated[value_type | None if default is None else value_type, info]
        options.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation))
    return options


def build_criterion_options() -> list[inspect.Parameter]:
    """Build options of the fields of `Criterion`."""
    options = []
    for name, annotation in Criterion.__annotations__.items():
        value_type, description = get_args(annotation)
        option: Any = Annotated[value_type, typer.Option(format_option_name(name), help=description)]
        default = getattr(Criterion, name)
        options.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=option))
    return options


def get_parameters(command: Command) -> list[inspect.Parameter]:
    """Return the parameters of a command with resolved annotations."""
    hints = get_type_hints(command, include_extras=True)
    return [item.replace(annotation=hints[item.name]) for item in inspect.signature(command).parameters.values()]


def format_option_name(name: str) -> str:
    """Format the name of a setting as an option, as in `--num-frames`."""
    return f"--{name.replace('_', '-')}"


def shorten_help(description: str) -> str:
    """Return the first sentence of a description; `torchcover config` prints all of it."""
    return description.partition(". ")[0].removesuffix(".") + "."


def check_out(folder: Path) -> Path:
    """Check before a run that its results can be written.

    Args:
        folder: Folder of the results, which may not exist yet.

    Returns:
        The folder.

    Raises:
        ValueError: The folder, or the first of its parents that exists, is a file, a broken link, or not writable.
    """
    nearest = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not nearest.exists():
        raise ValueError(f"--out {folder}: {nearest} is a broken link")
    if not nearest.is_dir():
        raise ValueError(f"--out {folder}: {nearest} is a file, not a folder")
    if not os.access(nearest, os.W_OK):
        raise ValueError(f"--out {folder}: {nearest} is not writable; choose another folder")
    return folder


def _check_files(files: str) -> str:
    """Check the value of `--files` before a run."""
    parse_file_kinds(files)
    return files


RigArgument = Annotated[str, typer.Argument(help="Rig: a built-in name (see `list`) or a YAML file.")]
RigsArgument = Annotated[list[str], typer.Argument(help="Rigs: built-in names (see `list`) or YAML files.")]
ConfigOption = Annotated[Path | None, typer.Option(help="YAML file of settings; `torchcover config` prints all.")]
AssignmentsOption = Annotated[
    list[str] | None, typer.Option("--set", help="KEY=VALUE of --config, as in cell_m=0.5 or recording.units=mm.")
]
OutOption = Annotated[Path, typer.Option(help="Folder for the results.", callback=check_out)]
FilesOption = Annotated[str, typer.Option(help="Kinds of files in addition to `summary.json`.", callback=_check_files)]
ALL_FILES = ",".join(FILES)


def find_changed_settings(option_values: Mapping[str, Any]) -> dict[str, Any]:
    """Select the options that differ from their defaults, as values of `EvaluateConfig`.

    Args:
        option_values: Name of a setting -> value of its option.
    """
    changed = {}
    for name, value in option_values.items():
        converted = str(value) if isinstance(value, Path) else tuple(value) if isinstance(value, list) else value
        if converted not in (None, EvaluateConfig.model_fields[name].default):
            changed[name] = converted
    return changed


def load_recording_settings(assignments: Sequence[str] | None) -> "RecordingSettings":
    """Load the settings of a recording for commands that have no other settings.

    Args:
        assignments: Values of `--set`, as in recording.units=mm.

    Raises:
        ValueError: A setting of something else, or as in `load_config`.
    """
    for text in assignments or ():
        if not text.startswith("recording."):
            raise ValueError(f"--set {text}: this command only has settings of the recording, as in recording.units=mm")
    return load_config(None, assignments or ()).config.recording


def open_recording(path: Path, settings: "RecordingSettings", vehicle: str | None = None) -> "Recording":
    """Open the recording of a command line.

    Args:
        path: Folder or file of the recording.
        settings: Settings of the recording.
        vehicle: Body of the ego vehicle; None: the recording defines it.
    """
    from torchcover import recordings

    recording = recordings.open_recording(path, settings)
    if vehicle is not None:
        from torchcover.simulation.recorded_rig import build_ego_box

        recording.ego_box = build_ego_box(recording, vehicle)
    return recording


def combine_regions(regions_file: Path | None, regions: Sequence[str] | None) -> "RegionsOfInterest | None":
    """Combine `--regions` and `--region`.

    Args:
        regions_file: YAML file of `RegionsOfInterest`; `--region` replaces its regions.
        regions: Texts NAME:x0,x1,y0,y1.

    Returns:
        The regions of interest; None if there are none.

    Raises:
        FileNotFoundError: No such file.
        ValueError: An invalid text or region, or a repeated name.
    """
    if regions_file is None and not regions:
        return None
    from pydantic import ValidationError

    from torchcover.simulation import RegionsOfInterest
    from torchcover.simulation.documents import explain_document_error

    # Only keys of the file: all other keys keep their defaults.
    content = {} if regions_file is None else RegionsOfInterest.load(regions_file).model_dump(exclude_unset=True)
    if regions:
        content["regions"] = {}
    for text in regions or ():
        name, bounds_m = _parse_region(text)
        if name in content["regions"]:
            raise ValueError(f"--region {text}: the name {name!r} is repeated; choose another")
        content["regions"][name] = {"x_m": bounds_m[:2], "y_m": bounds_m[2:]}
    try:
        return RegionsOfInterest.model_validate(content)
    except ValidationError as error:
        raise ValueError(explain_document_error(error)) from error


def _parse_region(text: str) -> tuple[str, list[float]]:
    """Parse NAME:x0,x1,y0,y1."""
    name, _, numbers = text.rpartition(":")  # a name may contain colons
    if not name:
        raise ValueError(f"--region {text}: NAME:x0,x1,y0,y1 is needed, in meters")
    try:
        bounds_m = [float(number) for number in numbers.split(",")]
    except ValueError:
        bounds_m = []
    if len(bounds_m) != 4:
        raise ValueError(f"--region {text}: 4 numbers x0,x1,y0,y1 in meters are needed")
    return name, bounds_m
