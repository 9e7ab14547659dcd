"""The settings of a run in a file: `torchcover evaluate --config run.yaml`; `torchcover config` writes the defaults.

Each setting is declared here once, with its type, default and description: for the file, the options of the command
line, the documentation of `evaluate` and `study`.
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
    """All settings of a run that a file can hold; those without a value follow from the others."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    scenario: str | None = Field(
        None,
        description="Scenario: a built-in name or a YAML file (courtyard). Or several kinds of world, each measured "
        "apart and then mixed: `urban,highway`, with weights `urban=0.7,highway=0.3` (equal if not given); in Python "
        "also a sequence, or a mapping to weights.",
    )
    num_frames: Annotated[int, Field(ge=1, strict=True)] | None = Field(
        None,
        description="Steps to simulate (64; with a target error at most, 4096), or frames of a recording to use at "
        "most (all).",
    )
    seed: Annotated[int, Field(ge=0, strict=True)] = Field(0, description="Seed of the simulation.")
    vehicle: str | None = Field(
        None,
        description="What carries the rigs: a built-in vehicle, a YAML file or a mesh in meters. Not given: the "
        "scenario's own ego vehicle, else the vehicle that the rigs name, else an SUV. Of a recording: the body whose "
        "returns are removed, where it does not say it; or x0,x1,y0,y1,z0,z1 in meters.",
    )
    sensor_model: Literal["ideal", "real"] | None = Field(
        None,
        description="Sensor model: `real`, range-limited returns (default where the range at 10 % reflectivity is "
        "known), or `ideal`, every hit is a point (default of the `paper` reference).",
    )
    weather: Names = Field(
        (),
        description="Weather in place of the scenario's: a built-in name as fog_100m (see `list`) or a YAML file. In "
        "several, every rig is measured in each; `compare` of one rig compares it with `clear`.",
    )
    regions: str | None = Field(
        None,
        description="YAML file of regions, also polygons, height bands and grid. Not given: the paper's regions in "
        "front, and the near field on the four sides of the vehicle.",
    )
    test_targets: Names | None = Field(
        None,
        description="Test targets that are placed next to the vehicle, as of `targets`; `none` places none. Not given: "
        "child, adult, cyclist and pole where no regions are given.",
    )
    cell_m: StrictFloat | None = Field(None, description="Side of a grid cell in meters, whatever `ask` says (0.25).")
    thresholds_m: tuple[StrictFloat, ...] = Field(
        (0.4,), description="Detection thresholds in meters; may be repeated."
    )
    aggregations: Names = Field(
        (),
        description="Maps and numbers of regions other than means, as in `maximum` or `quantiles:0.5,0.9`; any other "
        "name lists all. In Python also objects, as in `CoverageMetric`.",
    )
    reference: str | None = Field(
        None,
        description="Reference sensor: `surface`, points sampled evenly on visible surfaces (default), or `paper`. Of "
        "a recording on the command line: `recorded`, or `accumulated` from the recording itself.",
    )
    num_rays: Annotated[int, Field(ge=1, strict=True)] | None = Field(
        None, description="Rays of the reference sensor per frame (surface: 16384; paper: 1048576, a square)."
    )
    average: Literal["area", "cells"] | None = Field(
        None,
        description="Average of a region: `area`, over its visible surface (default; needs `surface`), or `known`, "
        "over its observed cells, as in the paper.",
    )
    band_frame: Literal["ground", "vehicle"] | None = Field(
        None,
        description="Height bands are above the local `ground` (default) or z of the `vehicle` frame (`paper` and "
        "recordings without heights have no other).",
    )
    frame_interval_s: StrictFloat | None = Field(
        None,
        description="Seconds between frames; consecutive frames are correlated. Not given: 10 in traffic, which starts "
        "anew in another city every minute, else a value that spreads the frames over the scenario.",
    )
    target_error: Names = Field(
        (),
        description="Stop once every number (of the usual regions, those in front) has this standard error: 0.1% (of "
        "each detection rate, in percentage points) or 0.02m (of each radius); both may be given. `steps` is then the "
        "maximum.",
    )
    only_detection: StrictBool = Field(
        False,
        description="Only the detection rates of regions: no radii, rough maps, and no test targets unless given. Few "
        "reference points (2048 rays), and only those rays of the rig are cast that can change its detection rate.",
    )
    redundancy: StrictBool = Field(
        False, description="Report by how many sensors surfaces are observed, and what is lost if a sensor fails."
    )
    metrics: Names = Field(
        (),
        description="Coverage metrics that others published, on the same frames: `all`, or names such as `k_cover` "
        "(docs/metrics.md).",
    )
    device: str = Field("cpu", description="Device of the search and the sums, with Warp of rays too: cpu, cuda, ...")
    num_workers: Annotated[int, Field(ge=0, strict=True)] | None = Field(
        None, description="Processes that make frames; 0 makes them in this one. Not given: as many as help."
    )
    no_cache: StrictBool = Field(
        False,
        description="Build all scenes anew and store none. Else scenes are read from ~/.cache/torchcover where an "
        "earlier run has left them, up to TORCHCOVER_CACHE_GB gigabytes (1).",
    )
    skip_bad_frames: StrictBool = Field(False, description="Skip and count frames that cannot be read.")
    rerun: str | None = Field(
        None, description="File (.rrd) of clouds, boxes, rigs and maps for the Rerun viewer (extra `rerun`)."
    )
    recording: RecordingSettings = Field(
        RecordingSettings(), description="How to read the recording; these win over `recording.yaml` in its folder."
    )

    def get_changed_settings(self) -> dict[str, Any]:
        """The keyword arguments of `evaluate` that differ from their defaults."""
        given = {name: getattr(self, name) for name in type(self).model_fields if name not in ("rerun", "recording")}
        return {name: value for name, value in given.items() if value != type(self).model_fields[name].default}


DESCRIPTIONS = {name: field.description or "" for name, field in EvaluateConfig.model_fields.items()}
# Settings that `torchcover study` takes: those that change what one run of a simulation costs or how exact it is.
STUDY_SETTINGS = (
    "scenario", "seed", "vehicle", "sensor_model", "regions", "cell_m", "thresholds_m", "reference", "num_rays", "average",
    "band_frame", "frame_interval_s", "only_detection", "device", "num_workers",
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
    """Load settings from a file; `--set KEY=VALUE` wins over the file, and an option of its own name over both.

    Args:
        path: YAML file of `EvaluateConfig`; None for the defaults.
        assignments: Texts KEY=VALUE; a key of the recording as in recording.units=mm. Values are YAML.
        options: Name of a setting -> value that the command line gives.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: Not YAML, an unknown or doubled key, a value of a wrong type or unit.
        ValueError: An assignment that is no setting.
    """
    from torchcover.files import guard_reader  # loads NumPy, whose threads have to be set before

    content = {} if path is None else guard_reader("settings of a run")(_read_config)(path)
    merged: dict[str, Any] = {**content, "recording": dict(content.get("recording") or {})}
    for text in assignments:
        _assign(merged, text)
    merged |= options or {}
    try:
        config = EvaluateConfig.model_validate(merged)
    except ValidationError as error:
        raise ValueError(f"--set {'; --set '.join(explain_validation_error(error))}") from error
    if path is None:
        return LoadedConfig(config, {})
    replaced = {
        name: {"file": value, "option": merged[name]} for name, value in content.items() if merged[name] != value
    }
    return LoadedConfig(config, {"file": str(path), "settings": content, "replaced": replaced})


def _read_config(path: Path) -> dict[str, Any]:
    from torchcover.files import parse_yaml, read_short_text

    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"a YAML mapping of settings is needed (`torchcover config`); got {type(content).__name__}")
    try:
        EvaluateConfig.model_validate(content)
    except ValidationError as error:
        from torchcover.simulation.documents import SETTINGS_KIND, find_other_kind

        other = find_other_kind(SETTINGS_KIND, content)
        mistakes = "; ".join(explain_validation_error(error))
        raise ValueError(f"this is {other}; {SETTINGS_KIND} is needed" if other else mistakes) from error
    return content


def _assign(content: dict[str, Any], text: str) -> None:
    from torchcover.files import parse_yaml

    key, equals, value = text.partition("=")
    group, dot, name = key.partition(".")
    fields = RecordingSettings.model_fields if dot else EvaluateConfig.model_fields
    if not equals or (dot and group != "recording") or (name if dot else key) not in fields:
        known = ", ".join(
            [*EvaluateConfig.model_fields, *(f"recording.{name}" for name in RecordingSettings.model_fields)]
        )
        raise ValueError(f"--set {text}: KEY=VALUE is needed, with one of these keys: {known}")
    target, entry = (content["recording"], name) if dot else (content, key)
    is_list = isinstance(fields[entry].default, tuple) or entry == "test_targets"
    if is_list and not value.startswith("["):
        parts = [part.strip() for part in value.split(",")]
        target[entry] = [parse_yaml(part) for part in parts] if entry == "thresholds_m" else parts
    else:
        target[entry] = parse_yaml(value)


def format_defaults() -> str:
    """Return a YAML text of all settings with their defaults; a comment describes each."""
    return "\n".join(_describe_fields(EvaluateConfig)) + "\n"


def _describe_fields(model: type[BaseModel], indent: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        comment = f"{indent}# "
        yield textwrap.fill(field.description or "", 118, initial_indent=comment, subsequent_indent=comment)
        if isinstance(field.default, BaseModel):
            # As comments: a setting of the recording that is given wins over `recording.yaml`, defaults are not.
            yield f"{indent}{name}: {{}}"
            for line in _describe_fields(type(field.default), indent + "  "):
                yield "#" + line.replace("\n", "\n#")
        else:
            yield f"{indent}{name}: {json.dumps(field.default)}"
