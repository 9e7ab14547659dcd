"""Arguments of `evaluate`, converted to one form each; `EvaluateConfig` describes those that a file can contain."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from importlib import import_module
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, cast

from torchcover.evaluation.arguments import ConvertedField
from torchcover.evaluation.config import EvaluateConfig
from torchcover.simulation.memory import check_memory_fits

if TYPE_CHECKING:
    import torch

    from torchcover.coverage import Aggregation
    from torchcover.evaluation.checkpoint import Checkpoint
    from torchcover.evaluation.observers import AnyObserver
    from torchcover.evaluation.ranks import Ranks
    from torchcover.evaluation.target_error import TargetError
    from torchcover.frames import FrameDataset
    from torchcover.simulation import RegionsOfInterest, Rig, Scenario, Weather

    AnyRig: TypeAlias = Rig | str | Path
    AnyScenario: TypeAlias = Scenario | str | Path
    Mixture: TypeAlias = dict[str, tuple[AnyScenario, float]]

DEFAULT_SCENARIO = "courtyard"
DEFAULT_NUM_FRAMES = 64
# Maximum number of frames with a target error; the paper averages as many.
MAX_NUM_FRAMES = 4096
# Memory of a worker process: torch and the geometry of a small scenario.
BYTES_PER_WORKER = 300e6
# Kinds of files that a result can write in addition to `summary.json`.
FILES = ("numbers", "maps", "page")


def parse_file_kinds(file_kinds: str | Iterable[str]) -> frozenset[str]:
    """Parse the kinds of files that a result writes.

    Args:
        file_kinds: Names of `FILES`, or a text such as `numbers,page`.

    Returns:
        The names.

    Raises:
        ValueError: Another name, or no name.

    Example:
        >>> sorted(parse_file_kinds("page, numbers"))
        ['numbers', 'page']
    """
    names = [name.strip() for name in file_kinds.split(",")] if isinstance(file_kinds, str) else list(file_kinds)
    if not names or not set(names).issubset(FILES):
        raise ValueError(f"files: {', '.join(FILES)}, one or more of them, are needed; got {file_kinds!r}")
    return frozenset(names)


def load_contrib() -> Any:  # noqa: ANN401  (a package that no other module may import)
    """Import the published metrics, which only runs with `metrics` need."""
    return import_module("torchcover.contrib")


def _convert_rigs(rigs: "AnyRig | Sequence[AnyRig] | None") -> "tuple[AnyRig, ...]":
    """Convert a rig or several to a tuple."""
    if rigs is None:
        return ()
    return (rigs,) if isinstance(rigs, str) or not isinstance(rigs, Sequence) else tuple(rigs)


def _convert_mixture(scenario: object) -> "Mixture | None":
    """Convert several scenarios to a mixture.

    Args:
        scenario: A sequence of scenarios, a mapping to weights, or a text such as `urban=0.7,highway=0.3`.

    Returns:
        Name of each scenario -> the scenario and its share, which sum up to 1; None for a single scenario.

    Raises:
        ValueError: A repeated scenario, a recording, or weights that are not numbers, negative, or all 0.
    """
    # A file may have a comma or an equals sign in its name.
    if isinstance(scenario, str) and ("," in scenario or "=" in scenario) and not Path(scenario).exists():
        scenario = _parse_mixture(scenario)
    if isinstance(scenario, str) or not isinstance(scenario, Mapping | Sequence):
        return None
    scenarios = list(scenario)
    weights = list(scenario.values()) if isinstance(scenario, Mapping) else [1.0] * len(scenarios)
    names = [_get_scenario_name(item) for item in scenarios]
    # The results of a scenario go to a folder with its name, and some file systems ignore case.
    if len({name.lower() for name in names}) < len(names):
        raise ValueError(f"scenario: different names are needed (case is ignored); got {', '.join(names)}")
    try:
        numbers = [float(weight) for weight in weights]
    except (TypeError, ValueError):
        numbers = []
    are_valid = all(math.isfinite(number) and number >= 0.0 for number in numbers)
    if not (are_valid and 0.0 < sum(numbers) < math.inf):
        text = ", ".join(f"{name}={weight}" for name, weight in zip(names, weights, strict=True))
        raise ValueError(f"scenario: weights of 0 or more are needed, not all 0; got {text or 'no scenario'}")
    shares = [number / sum(numbers) for number in numbers]
    return {name: (item, share) for name, item, share in zip(names, scenarios, shares, strict=True)}


def _parse_mixture(text: str) -> dict[str, str] | list[str]:
    """Parse names separated by commas, all with weights as in `urban=0.7` or all without."""
    parts = [part.strip().partition("=") for part in text.split(",")]
    names = [name for name, _, _ in parts]
    for name in names:
        _get_scenario_name(name)  # a misspelled name is reported before its weight
    if len({equals for _, equals, _ in parts}) > 1:
        raise ValueError(f"scenario {text}: a weight for every scenario is needed, or none")
    if len(set(names)) < len(names):
        raise ValueError(f"scenario: different names are needed (case is ignored); got {', '.join(names)}")
    return {name: weight or "1" for name, _, weight in parts} if parts[0][1] else names


def _get_scenario_name(scenario: object) -> str:
    """Return the name of a scenario; an unknown one is rejected."""
    if not isinstance(scenario, str | Path):
        name: object = getattr(scenario, "name", None)
        if not isinstance(name, str):
            raise TypeError(f"scenario: names, paths or Scenario objects are needed; got {type(scenario).__name__}")
        return name
    if not str(scenario):
        raise ValueError("scenario: one of several has no name")
    if Path(scenario).is_dir():
        raise ValueError(f"scenario {scenario}: a folder; evaluate a recording on its own, with `frames`")
    from torchcover.simulation.documents import find_document

    return find_document("scenarios", scenario).stem


def _convert_thresholds(thresholds_m: "float | Iterable[float]") -> tuple[float, ...]:
    """Convert a threshold or several to a tuple of floats."""
    values = tuple(thresholds_m) if isinstance(thresholds_m, Iterable) else (thresholds_m,)
    if not all(isinstance(value, Real) for value in values):
        raise TypeError(f"thresholds_m: meters are needed, as in 0.4 or (0.4, 1.0); got {thresholds_m!r}")
    return tuple(float(value) for value in values)


def _convert_aggregations(aggregations: "str | Sequence[Aggregation | str]") -> "tuple[Aggregation, ...]":
    """Convert names and objects to aggregations."""
    if not aggregations:
        return ()
    from torchcover.coverage import parse_aggregation

    items = [aggregations] if isinstance(aggregations, str) else aggregations
    if not isinstance(items, Sequence):  # the metric checks the items
        raise TypeError(
            f"aggregations: names such as maximum, or a sequence of them or of objects such as Maximum(), are needed; "
            f"got {aggregations!r}"
        )
    return tuple(parse_aggregation(item) if isinstance(item, str) else item for item in items)


def _convert_metrics(metrics: str | Iterable[str]) -> tuple[str, ...]:
    """Convert names of published metrics to a tuple of valid names."""
    if not metrics:
        return ()
    names: tuple[str, ...] = load_contrib().parse_metric_names(metrics)
    return names


def _convert_regions(regions: "RegionsOfInterest | str | Path | None") -> "RegionsOfInterest | None":
    """Load regions of interest from a file unless they are an object."""
    if regions is None:
        return None
    from torchcover.simulation import RegionsOfInterest

    if isinstance(regions, str | Path):
        return RegionsOfInterest.load(regions)
    if not isinstance(regions, RegionsOfInterest):
        raise TypeError(f"regions: RegionsOfInterest(...) or the path of a YAML file is needed; got {regions!r}")
    return regions


def _convert_target_error(target_error: "TargetError | str | Sequence[str] | None") -> "TargetError | None":
    """Parse a target error unless it is an object."""
    if target_error is None:
        return None
    from torchcover.evaluation.target_error import TargetError

    return target_error if isinstance(target_error, TargetError) else TargetError.parse(target_error)


def _convert_weather(weather: "Weather | str | Path | Sequence[Weather | str | Path]") -> "tuple[Weather, ...]":
    """Load one weather or several from names and files."""
    if not weather:
        return ()
    from torchcover.simulation import Weather

    items = [weather] if isinstance(weather, (Weather, str, Path)) else weather
    return tuple(item if isinstance(item, Weather) else Weather.load(item) for item in items)


def _convert_test_targets(targets: "str | Path | Iterable[str | Path] | None") -> "tuple[str | Path, ...] | None":
    """Convert names and files of test targets to a tuple, `none` to an empty one; None for the default."""
    if targets is None:
        return None
    items = (targets,) if isinstance(targets, str | Path) else tuple(targets)
    if "none" in items and len(items) > 1:
        raise ValueError(f"test_targets: none, or targets; got {', '.join(map(str, items))}")
    return () if items == ("none",) else items


DEFAULTS = EvaluateConfig()


@dataclass(frozen=True, eq=False)
class Settings:
    """Arguments of `evaluate`; None stands for an argument that was not given.

    Raises:
        ValueError: Fewer than 1 frame, an unknown average, too many workers for the memory, or contradictory settings.
        TypeError: A value of a wrong type.
    """

    rigs: Annotated[
        ConvertedField["AnyRig | Sequence[AnyRig] | None", "tuple[AnyRig, ...]"],
        "Rig, name of a built-in rig, or path of a YAML file. Several rigs are evaluated in the same frames against "
        "the same reference and compared with the first. With `frames`: names of its rigs (default: all), or the rig "
        "that recorded them, so that the maps show its sensors.",
    ] = ConvertedField(_convert_rigs, None)
    scenario: "AnyScenario | Sequence[AnyScenario] | Mapping[str, float] | None" = None
    _: KW_ONLY
    frames: Annotated[
        "FrameDataset | str | Path | None", "Recording, or another source of frames, instead of a scenario."
    ] = None
    num_frames: int | None = None
    seed: int = DEFAULTS.seed
    vehicle: str | Path | None = None
    sensor_model: Literal["ideal", "real"] | None = None
    weather: ConvertedField["Weather | str | Path | Sequence[Weather | str | Path]", "tuple[Weather, ...]"] = (
        ConvertedField(_convert_weather, DEFAULTS.weather)
    )
    regions: ConvertedField["RegionsOfInterest | str | Path | None", "RegionsOfInterest | None"] = ConvertedField(
        _convert_regions, None
    )
    test_targets: ConvertedField["str | Path | Iterable[str | Path] | None", "tuple[str | Path, ...] | None"] = (
        ConvertedField(_convert_test_targets, None)
    )
    cell_m: float | None = None
    thresholds_m: ConvertedField[float | Iterable[float], tuple[float, ...]] = ConvertedField(
        _convert_thresholds, DEFAULTS.thresholds_m
    )
    aggregations: ConvertedField["str | Sequence[Aggregation | str]", "tuple[Aggregation, ...]"] = ConvertedField(
        _convert_aggregations, DEFAULTS.aggregations
    )
    reference: str | None = None
    num_rays: int | None = None
    average: Literal["area", "cells"] | None = None
    band_frame: Literal["ground", "vehicle"] | None = None
    frame_interval_s: float | None = None
    target_error: ConvertedField["TargetError | str | Sequence[str] | None", "TargetError | None"] = ConvertedField(
        _convert_target_error, None
    )
    only_detection: bool = DEFAULTS.only_detection
    redundancy: bool = DEFAULTS.redundancy
    metrics: ConvertedField[str | Iterable[str], tuple[str, ...]] = ConvertedField(_convert_metrics, DEFAULTS.metrics)
    device: ConvertedField["str | torch.device", str] = ConvertedField(str, DEFAULTS.device)
    num_workers: int | None = None
    no_cache: bool = DEFAULTS.no_cache
    skip_bad_frames: bool = DEFAULTS.skip_bad_frames
    observers: Annotated[
        "Mapping[str, AnyObserver]", "Name -> observer of the same frames; `Result.observed` contains their results."
    ] = field(default_factory=dict)
    checkpoint: Annotated[
        "Checkpoint | str | Path | None",
        "File (`.npz`) to which the run is saved every minute and at its end. An existing file is resumed, with the "
        "same result to the last bit, also with a larger `num_frames`; `Checkpoint(path, resume=False)` replaces it. "
        "Observers then need `state_dict` and `load_state_dict`.",
    ] = None
    ranks: Annotated[
        "Ranks | None",
        "Processes that share the run, from `join_ranks()`; all of them call `evaluate` and get the same result.",
    ] = None
    progress: Annotated[bool, "Show a progress bar."] = False
    config_record: Annotated[
        "Mapping[str, object]", "Origin of the settings for `summary.json`, from `load_config`."
    ] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Settings from Python; those of files and options were checked by `EvaluateConfig`.
        if self.num_frames is not None and self.num_frames < 1:
            raise ValueError(f"num_frames: at least 1 is needed; got {self.num_frames}")
        check_memory_fits(f"{self.num_workers or 0:,} workers", BYTES_PER_WORKER * (self.num_workers or 0), "use fewer")
        for name, choices in (
            ("average", ("area", "cells")),
            ("band_frame", ("ground", "vehicle")),
            ("sensor_model", ("ideal", "real")),
        ):
            value = getattr(self, name)
            if value is not None and value not in choices:
                raise ValueError(f"{name} {value}: `{choices[0]}` or `{choices[1]}` is needed")
        if self.reference == "paper" and self.band_frame == "ground":
            raise ValueError("band_frame ground: the paper reference has height bands of the vehicle frame; omit it")
        # `only_detection` searches no further than the threshold, so that radii are unknown.
        needs_radii = self.target_error is not None and self.target_error.radius_m is not None
        needs_clouds = self.aggregations or self.redundancy or self.metrics or self.observers
        if self.only_detection and (needs_radii or needs_clouds or not self.thresholds_m):
            raise ValueError(
                "only_detection: excludes radii, aggregations, redundancy, metrics and observers, and needs a "
                "threshold; omit one of them"
            )

    @cached_property
    def mixture(self) -> "Mapping[str, tuple[AnyScenario, float]] | None":
        """Name of each scenario -> the scenario and its share; None if there is only one."""
        return _convert_mixture(self.scenario)

    @property
    def single_scenario(self) -> "AnyScenario":
        """The scenario, for runs that take only one.

        Raises:
            ValueError: There are several.
        """
        if self.mixture is not None:
            raise ValueError(
                f"scenario: a single one is needed here; got {', '.join(self.mixture)} (`evaluate` takes several)"
            )
        return cast("AnyScenario", DEFAULT_SCENARIO if self.scenario is None else self.scenario)

    @property
    def needs_boxes(self) -> bool:
        """True if a metric needs the bounding boxes of the frames."""
        if not self.metrics:
            return False
        published = load_contrib().PUBLISHED
        return any("boxes" in published[name].needs for name in self.metrics)

    def check_recording(self) -> None:
        """Check that no setting was given that a recording determines.

        Raises:
            ValueError: Vehicle, sensor model, weather, reference sensor, rays, frame interval, test targets or
                `only_detection` were given.
        """
        if self.sensor_model is not None or self.weather:
            raise ValueError("sensor_model and weather are for simulations; a recording contains real returns")
        if self.only_detection:
            raise ValueError("only_detection is for simulations; a recording contains all its points")
        if self.vehicle is not None and not isinstance(self.frames, str | Path):
            raise ValueError("vehicle is for simulations and paths of recordings; set the ego_box of the recording")
        if self.test_targets:
            raise ValueError("test_targets are for simulations; a recording has no scene to place them in")
        if any(setting is not None for setting in (self.reference, self.num_rays, self.frame_interval_s)):
            raise ValueError(
                "reference, num_rays and frame_interval_s are for simulations; a recording has its reference points"
            )
