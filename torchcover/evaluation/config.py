"""Settings of a run in a file: `torchcover evaluate --config run.yaml`; `torchcover config` prints the defaults.

Each setting is declared here once, with its type, default and description. The first sentence of a description is the
help of its option; all sentences are comments in the printed file and documentation of `evaluate` in Python.
"""

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, ValidationError

from torchcover.files import explain_validation_error
from torchcover.recordings.settings import RecordingSettings

Names = tuple[str, ...]


class EvaluateConfig(BaseModel):
    """Settings of a run that a file can contain; settings without a value are derived from the others."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    scenario: str | None = Field(
        None,
        description="Scenario: a built-in name or a YAML file (courtyard). Several scenarios are evaluated one by one "
        "and mixed: `urban,highway`, or with weights `urban=0.7,highway=0.3` (default: equal weights). Python also "
        "takes a sequence, or a mapping to weights.",
    )
    num_frames: Annotated[int, Field(ge=1, strict=True)] | None = Field(
        None,
        description="Frames to simulate (64), or maximum number of frames of a recording (all). With a target error, "
        "the maximum number of frames to simulate (4096).",
    )
    seed: Annotated[int, Field(ge=0, strict=True)] = Field(0, description="Seed of the simulation.")
    vehicle: str | None = Field(
        None,
        description="Host vehicle: a built-in name, a YAML file or a mesh in meters. Default: the ego vehicle of the "
        "scenario, else the vehicle that the rigs name, else an SUV. With a recording: the body whose returns are "
        "removed, if the recording does not define it; also x0,x1,y0,y1,z0,z1 in meters.",
    )
    sensor_model: Literal["ideal", "real"] | None = Field(
        None,
        description="Sensor model: `real` (range-limited returns) or `ideal` (every ray hit is a point). Default: "
        "`real` for sensors whose range at 10 % reflectivity is known, `ideal` with the `paper` reference.",
    )
    weather: Names = Field(
        (),
        description="Weather instead of the scenario's: a built-in name such as fog_100m, or a YAML file. With "
        "several, every rig is evaluated in each; `compare` of one rig also evaluates it in `clear`.",
    )
    regions: str | None = Field(
        None,
        description="YAML file of regions (also polygons), height bands and grid. Default: the paper's regions in "
        "front of the vehicle, and the near field on its four sides.",
    )
    test_targets: Names | None = Field(
        None,
        description="Test targets around the vehicle, named as in `targets`; `none` places none. Default: child, "
        "adult, cyclist and pole, unless regions are given.",
    )
    cell_m: StrictFloat | None = Field(
        None, description="Side of a grid cell in meters (0.25); takes precedence over the file of `regions`."
    )
    thresholds_m: tuple[StrictFloat, ...] = Field(
        (0.4,), description="Detection thresholds in meters; may be repeated."
    )
    aggregations: Names = Field(
        (),
        description="Maps and numbers of regions in addition to means: `maximum`, `quantiles:0.5,0.9`, ...; any other "
        "name lists all. Python also takes objects, as in `CoverageMetric`.",
    )
    reference: str | None = Field(
        None,
        description="Reference: `surface` (points evenly on visible surfaces) or `paper`. Default: `surface`. With a "
        "recording on the command line: `recorded`, or `accumulated` from the recording itself.",
    )
    num_rays: Annotated[int, Field(ge=1, strict=True)] | None = Field(
        None, description="Reference rays per frame (surface: 16384; paper: 1048576, a square)."
    )
    average: Literal["area", "cells"] | None = Field(
        None,
        description="Average of a region: over its visible surface (`area`) or its observed cells (`cells`, as in the "
        "paper). Default: `area`, which needs the `surface` reference.",
    )
    band_frame: Literal["ground", "vehicle"] | None = Field(
        None,
        description="Origin of the height bands: the local `ground` or z = 0 of the `vehicle` frame. Default: "
        "`ground`; the `paper` reference and recordings without ground heights only have `vehicle`.",
    )
    frame_interval_s: StrictFloat | None = Field(
        None,
        description="Seconds between frames; consecutive frames are correlated. Default: 10 in traffic, which starts "
        "again in another city every minute, else an interval that spreads the frames over the scenario.",
    )
    target_error: Names = Field(
        (),
        description="Stop at this standard error: 0.1% of all detection rates, or 0.02m of all radii. Both may be "
        "given; a percentage is in percentage points. Of the default regions only those in front of the vehicle count. "
        "`num_frames` is the maximum.",
    )
    only_detection: StrictBool = Field(
        False,
        description="Compute only the detection rates of regions: no radii, coarse maps, no test targets by default. "
        "Few reference rays (2048); only sensor rays that can change the detection rate are cast.",
    )
    redundancy: StrictBool = Field(
        False, description="Report how many sensors detect each surface, and the loss if a sensor fails."
    )
    metrics: Names = Field(
        (),
        description="Published coverage metrics on the same frames: `all`, or names such as `k_cover` "
        "(docs/metrics.md).",
    )
    device: str = Field("cpu", description="Device of search and sums, with Warp also of rays: cpu or cuda.")
    num_workers: Annotated[int, Field(ge=0, strict=True)] | None = Field(
        None, description="Worker processes that make frames; 0: none. Default: as many as shorten the run."
    )
    no_cache: StrictBool = Field(
        False,
        description="Build all scenes again and store none. Otherwise scenes that an earlier run stored in "
        "~/.cache/torchcover are read, up to TORCHCOVER_CACHE_GB gigabytes (1).",
    )
    skip_bad_frames: StrictBool = Field(False, description="Skip and count frames that cannot be read.")
    rerun: str | None = Field(
        None, description="File (.rrd) of clouds, boxes, rigs and maps for the Rerun viewer (extra `rerun`)."
    )
    recording: RecordingSettings = Field(
        RecordingSettings(),
        description="Settings of the recording; they take precedence over `recording.yaml` in its folder.",
    )

    def get_changed_settings(self) -> dict[str, Any]:
        """Return the keyword arguments of `evaluate` that differ from their defaults."""
        changed = {}
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if name not in ("rerun", "recording") and value != field.default:
                changed[name] = value
        return changed


DESCRIPTIONS = {name: field.description or "" for name, field in EvaluateConfig.model_fields.items()}
# Settings that `torchcover study` takes: they change the run time of a simulation or the accuracy of its numbers.
STUDY_SETTINGS = (
    "scenario", "seed", "vehicle", "sensor_model", "regions", "cell_m", "thresholds_m", "reference", "num_rays",
    "average", "band_frame", "frame_interval_s", "only_detection", "device", "num_workers",
)  # fmt: skip


class LoadedConfig(NamedTuple):
    """A configuration and its origin.

    Args:
        config: The settings.
        record: For `summary.json`: the file, its settings, and those that an option replaced; empty without a file.
    """

    config: EvaluateConfig
    record: dict[str, Any]


def load_config(
    path: Path | None, assignments: Sequence[str] = (), options: Mapping[str, Any] | None = None
) -> LoadedConfig:
    """Load the settings of a run.

    `--set KEY=VALUE` takes precedence over the file, and an option with the name of the setting over both.

    Args:
        path: YAML file of `EvaluateConfig`; None for the defaults.
        assignments: Texts KEY=VALUE; a key of the recording as in recording.units=mm. Values are YAML.
        options: Name of a setting -> value of its option.

    Returns:
        The settings and their origin.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: Not YAML, an unknown or repeated key, a value of a wrong type or unit.
        ValueError: An assignment with an unknown key or a wrong value.
    """
    from torchcover.files import guard_reader  # imports NumPy, whose number of threads has to be set before

    content = {} if path is None else guard_reader("settings of a run")(_read_config)(path)
    merged: dict[str, Any] = {**content, "recording": dict(content.get("recording") or {})}
    for text in assignments:
        _apply_assignment(merged, text)
    merged |= options or {}
    # The file was valid by itself, so a mistake is one of the assignments.
    try:
        config = EvaluateConfig.model_validate(merged)
    except ValidationError as error:
        raise ValueError(f"--set {'; --set '.join(explain_validation_error(error))}") from error
    if path is None:
        return LoadedConfig(config, {})
    replaced = {}
    for name, value in content.items():
        if merged[name] != value:
            replaced[name] = {"file": value, "option": merged[name]}
    return LoadedConfig(config, {"file": str(path), "settings": content, "replaced": replaced})


def _read_config(path: Path) -> dict[str, Any]:
    """Read and validate a file of settings."""
    from torchcover.files import parse_yaml, read_short_text

    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"a YAML mapping of settings is needed (`torchcover config`); got {type(content).__name__}")
    try:
        EvaluateConfig.model_validate(content)
    except ValidationError as error:
        from torchcover.simulation.document_keys import SETTINGS_KIND, find_other_kind

        kind = find_other_kind(SETTINGS_KIND, content)
        mistakes = "; ".join(explain_validation_error(error))
        raise ValueError(f"this is {kind}; {SETTINGS_KIND} is needed" if kind else mistakes) from error
    return content


def _apply_assignment(content: dict[str, Any], text: str) -> None:
    """Set one value of the content of a file of settings from a text KEY=VALUE."""
    from torchcover.files import parse_yaml

    key, equals, value = text.partition("=")
    is_of_recording = key.startswith("recording.")
    name = key.removeprefix("recording.")
    fields = RecordingSettings.model_fields if is_of_recording else EvaluateConfig.model_fields
    if not equals or name not in fields:
        keys = [*EvaluateConfig.model_fields, *(f"recording.{field}" for field in RecordingSettings.model_fields)]
        raise ValueError(f"--set {text}: KEY=VALUE is needed, with one of these keys: {', '.join(keys)}")
    target = content["recording"] if is_of_recording else content
    # Lists are accepted without brackets; thresholds are the only list of numbers.
    is_list = isinstance(fields[name].default, tuple) or name == "test_targets"
    if is_list and not value.startswith("["):
        items = [item.strip() for item in value.split(",")]
        target[name] = [parse_yaml(item) for item in items] if name == "thresholds_m" else items
    else:
        target[name] = parse_yaml(value)


def format_defaults() -> str:
    """Format all settings with their defaults as YAML; a comment describes each."""
    return "\n".join(_format_fields(EvaluateConfig)) + "\n"


def _format_fields(model: type[BaseModel], indent: str = "") -> Iterator[str]:
    """Format the fields of a model as lines of YAML."""
    for name, field in model.model_fields.items():
        comment = f"{indent}# "
        yield textwrap.fill(field.description or "", 118, initial_indent=comment, subsequent_indent=comment)
        if isinstance(field.default, BaseModel):
            # The defaults are comments: every key that the file gives takes precedence over `recording.yaml`.
            yield f"{indent}{name}: {{}}"
            for line in _format_fields(type(field.default), indent + "  "):
                yield "#" + line.replace("\n", "\n#")
        else:
            yield f"{indent}{name}: {json.dumps(field.default)}"
