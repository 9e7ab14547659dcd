"""The arguments of `evaluate`, read into one form each; `EvaluateConfig` describes those that a file can hold."""

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
    from torchcover.frames import FrameSource
    from torchcover.simulation import RegionsOfInterest, Rig, Scenario, Weather

    AnyRig: TypeAlias = Rig | str | Path
    AnyScenario: TypeAlias = Scenario | str | Path

DEFAULT_SCENARIO = "courtyard"
DEFAULT_STEPS = 64
# With a target error; as many as the paper averages.
MAX_STEPS = 4096
# A process with torch and the geometry of a small scenario.
BYTES_PER_WORKER = 300e6
# Beside `summary.json`.
FILES = ("numbers", "maps", "page")


def parse_file_kinds(file_kinds: str | Iterable[str]) -> frozenset[str]:
    """What is to be written of a result.

    `file_kinds`: of `FILES`: names, or a text as in `numbers,page`. ValueError: another name, or none.

    Example:
        >>> sorted(parse_file_kinds("page, numbers"))
        ['numbers', 'page']
    """
    names = [name.strip() for name in file_kinds.split(",")] if isinstance(file_kinds, str) else list(file_kinds)
    if not names or not set(names).issubset(FILES):
        raise ValueError(f"files: {', '.join(FILES)}, one or more of them, are needed; got {file_kinds!r}")
    return frozenset(names)


def load_contrib() -> Any:  # noqa: ANN401  (a package that nothing imports)
    """Load the metrics of others, which only runs that name one need."""
    return import_module("torchcover.contrib")


def _rigs(given: "AnyRig | Sequence[AnyRig] | None") -> "tuple[AnyRig, ...]":
    if given is None:
        return ()
    return (given,) if isinstance(given, str) or not isinstance(given, Sequence) else tuple(given)


def _mixture(given: object) -> "dict[str, tuple[AnyScenario, float]] | None":
    """Several scenarios and their shares.

    ValueError: one that is given twice, a recording, or weights that are no numbers, negative, or all 0.
    """
    if isinstance(given, str) and any(sign in given for sign in ",=") and not Path(given).exists():
        parts = [part.strip().partition("=") for part in given.split(",")]
        for name, *_ in parts:
            _named(name)
        if len({sign for _, sign, _ in parts}) > 1:
            raise ValueError(f"scenario {given}: every one needs a weight, or none")
        given = {name: weight or 1.0 for name, _, weight in parts} if parts[0][1] else [name for name, *_ in parts]
        if len(given) < len(parts):
            raise ValueError(f"scenario: one of {', '.join(name for name, *_ in parts)} is given twice")
    if isinstance(given, str) or not isinstance(given, Mapping | Sequence):
        return None
    weights = dict(given) if isinstance(given, Mapping) else {}
    names = [_named(one) for one in given]
    if len({name.lower() for name in names}) < len(names):
        raise ValueError(f"scenario: one of {', '.join(names)} is given twice, or two are called alike")
    try:
        numbers = [float(weights.get(one, 1.0)) for one in given] if weights else [1.0] * len(names)
    except (TypeError, ValueError):
        numbers = []
    if not (all(math.isfinite(number) and number >= 0.0 for number in numbers) and 0.0 < sum(numbers) < math.inf):
        said = ", ".join(f"{name}={weight}" for name, weight in zip(names, weights.values(), strict=False))
        raise ValueError(f"scenario: weights of 0 or more are needed, not all 0; got {said or 'no scenario'}")
    return {name: (one, number / sum(numbers)) for name, one, number in zip(names, given, numbers, strict=True)}


def _named(scenario: object) -> str:
    """What a kind of world is called; one that there is not is refused."""
    if not isinstance(scenario, str | Path):
        name: object = getattr(scenario, "name", None)
        if not isinstance(name, str):
            raise TypeError(f"scenario: names, paths or Scenario objects are needed; got {type(scenario).__name__}")
        return name
    if not str(scenario):
        raise ValueError("scenario: one of several has no name")
    if Path(scenario).is_dir():
        raise ValueError(f"scenario {scenario}: a folder; a recording is no scenario: measure it apart, by `frames`")
    from torchcover.simulation.documents import find_document

    return find_document("scenarios", scenario).stem


def _thresholds(given: "float | Iterable[float]") -> tuple[float, ...]:
    each = tuple(given) if isinstance(given, Iterable) else (given,)
    if not all(isinstance(threshold, Real) for threshold in each):
        raise TypeError(f"thresholds_m: metres are needed, as in 0.4 or (0.4, 1.0); got {given!r}")
    return tuple(float(threshold) for threshold in each)


def _aggregations(given: "str | Sequence[Aggregation | str]") -> "tuple[Aggregation, ...]":
    if not given:
        return ()
    from torchcover.coverage import parse_aggregation

    each = [given] if isinstance(given, str) else given
    if not isinstance(each, Sequence):  # what is in it the metric checks
        raise TypeError(
            f"aggregations: names such as maximum, or a sequence of them or of objects such as Maximum(), are needed; "
            f"got {given!r}"
        )
    return tuple(parse_aggregation(one) if isinstance(one, str) else one for one in each)


def _metrics(given: str | Iterable[str]) -> tuple[str, ...]:
    if not given:
        return ()
    names: tuple[str, ...] = load_contrib().parse_metric_names(given)
    return names


def _asked(given: "RegionsOfInterest | str | Path | None") -> "RegionsOfInterest | None":
    if given is None:
        return None
    from torchcover.simulation import RegionsOfInterest

    if isinstance(given, str | Path):
        return RegionsOfInterest.load(given)
    if not isinstance(given, RegionsOfInterest):
        raise TypeError(f"ask: RegionsOfInterest(...) or the path of a YAML file is needed; got {given!r}")
    return given


def _target(given: "TargetError | str | Sequence[str] | None") -> "TargetError | None":
    if given is None:
        return None
    from torchcover.evaluation.target_error import TargetError

    return given if isinstance(given, TargetError) else TargetError.parse(given)


def _weather(given: "Weather | str | Path | Sequence[Weather | str | Path]") -> "tuple[Weather, ...]":
    if not given:
        return ()
    from torchcover.simulation import Weather

    each = [given] if isinstance(given, (Weather, str, Path)) else given
    return tuple(one if isinstance(one, Weather) else Weather.load(one) for one in each)


def _probes(given: "str | Path | Iterable[str | Path] | None") -> "tuple[str | Path, ...] | None":
    each = (given,) if isinstance(given, str | Path) else None if given is None else tuple(given)
    if each and "none" in each and len(each) > 1:
        raise ValueError(f"test_targets: none, or targets; got {', '.join(map(str, each))}")
    return () if each == ("none",) else each


DEFAULTS = EvaluateConfig()


@dataclass(frozen=True, eq=False)
class Settings:
    """The arguments of `evaluate`; None where nothing was given.

    Raises:
        ValueError: A number of steps below 1, an unknown measure, more workers than the memory has room for.
        TypeError: One of a wrong kind.
    """

    rigs: Annotated[
        ConvertedField["AnyRig | Sequence[AnyRig] | None", "tuple[AnyRig, ...]"],
        "A rig, the name of a built-in one, or the path of a YAML file; or several, which are measured in the same "
        "frames against the same reference, and of which the others are compared with the first. With `frames`: which "
        "of its rigs, all if not given; or what its only one is, so that the maps show its sensors.",
    ] = ConvertedField(_rigs, None)
    scenario: "AnyScenario | Sequence[AnyScenario] | Mapping[str, float] | None" = None
    _: KW_ONLY
    frames: Annotated[
        "FrameSource | str | Path | None", "A recording, or any source of frames, instead of a scenario."
    ] = None
    num_frames: int | None = None
    seed: int = DEFAULTS.seed
    vehicle: str | Path | None = None
    sensor_model: Literal["ideal", "real"] | None = None
    weather: ConvertedField["Weather | str | Path | Sequence[Weather | str | Path]", "tuple[Weather, ...]"] = (
        ConvertedField(_weather, DEFAULTS.weather)
    )
    regions: ConvertedField["RegionsOfInterest | str | Path | None", "RegionsOfInterest | None"] = ConvertedField(
        _asked, None
    )
    test_targets: ConvertedField["str | Path | Iterable[str | Path] | None", "tuple[str | Path, ...] | None"] = (
        ConvertedField(_probes, None)
    )
    cell_m: float | None = None
    thresholds_m: ConvertedField[float | Iterable[float], tuple[float, ...]] = ConvertedField(
        _thresholds, DEFAULTS.thresholds_m
    )
    aggregations: ConvertedField["str | Sequence[Aggregation | str]", "tuple[Aggregation, ...]"] = ConvertedField(
        _aggregations, DEFAULTS.aggregations
    )
    reference: str | None = None
    num_rays: int | None = None
    average: Literal["area", "cells"] | None = None
    band_frame: Literal["ground", "vehicle"] | None = None
    frame_interval_s: float | None = None
    target_error: ConvertedField["TargetError | str | Sequence[str] | None", "TargetError | None"] = ConvertedField(
        _target, None
    )
    only_detection: bool = DEFAULTS.only_detection
    redundancy: bool = DEFAULTS.redundancy
    metrics: ConvertedField[str | Iterable[str], tuple[str, ...]] = ConvertedField(_metrics, DEFAULTS.metrics)
    device: ConvertedField["str | torch.device", str] = ConvertedField(str, DEFAULTS.device)
    num_workers: int | None = None
    no_cache: bool = DEFAULTS.no_cache
    skip_bad_frames: bool = DEFAULTS.skip_bad_frames
    observers: Annotated[
        "Mapping[str, AnyObserver]",
        "What else looks at the same frames, by name; what they compute is in `Result.observed`.",
    ] = field(default_factory=dict)
    checkpoint: Annotated[
        "Checkpoint | str | Path | None",
        "File (`.npz`) that the run is saved to every minute and at its end. If it is there, the run goes on from it, "
        "to the same bits, and with more steps if that is asked for; or `Checkpoint(path, resume=False)`. Observers "
        "need `state_dict` and `load_state_dict` then.",
    ] = None
    ranks: Annotated[
        "Ranks | None",
        "Processes that share the run, from `join_ranks()`; all of them call this, and get the same result.",
    ] = None
    progress: Annotated[bool, "Whether to show a bar."] = False
    config_record: Annotated[
        "Mapping[str, object]", "The file of settings that the run was given, for `summary.json`; see `load_config`."
    ] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.num_frames is not None and self.num_frames < 1:
            raise ValueError(f"steps: at least 1 is needed; got {self.num_frames}")
        check_memory_fits(f"{self.num_workers or 0:,} workers", BYTES_PER_WORKER * (self.num_workers or 0), "use fewer")
        if self.average not in (None, "area", "cells"):
            raise ValueError(f"average {self.average}: `area` or `cells` is needed")
        if self.band_frame not in (None, "ground", "vehicle"):
            raise ValueError(f"band_frame {self.band_frame}: `ground` or `vehicle` is needed")
        if self.sensor_model not in (None, "ideal", "real"):
            raise ValueError(f"sensor_model {self.sensor_model}: `ideal` or `real` is needed")
        if self.reference == "paper" and self.band_frame == "ground":
            raise ValueError("band_frame ground: the paper's reference has bands over z of the vehicle; leave it out")
        radii = self.target_error is not None and self.target_error.radius_m is not None
        needs = radii or self.aggregations or self.redundancy or self.metrics or self.observers
        if self.only_detection and (needs or not self.thresholds_m):
            raise ValueError(
                "only_detection: there are no radii, no aggregations, redundancy, metrics or observers then, and there "
                "has to be a threshold; leave one of them out"
            )

    @cached_property
    def mixture(self) -> "Mapping[str, tuple[AnyScenario, float]] | None":
        """Name of each scenario -> what was given, and its share; None of a single one."""
        return _mixture(self.scenario)

    @property
    def single_scenario(self) -> "AnyScenario":
        """The scenario, for what is done in one world.

        Raises:
            ValueError: There are several.
        """
        if self.mixture is not None:
            raise ValueError(f"scenario: one at a time here; got {', '.join(self.mixture)} (`evaluate` takes several)")
        return cast("AnyScenario", DEFAULT_SCENARIO if self.scenario is None else self.scenario)

    @property
    def needs_boxes(self) -> bool:
        """Whether a metric is about objects, so that frames are to have them."""
        if not self.metrics:
            return False
        published = load_contrib().PUBLISHED
        return any("boxes" in published[name].needs for name in self.metrics)

    def check_recording(self) -> None:
        """Find out whether anything was set that a recording decides itself.

        Raises:
            ValueError: The vehicle, the sensor model, the reference sensor, its rays or the time between steps was set.
        """
        if self.sensor_model is not None or self.weather:
            raise ValueError("sensor_model and weather are for simulations; a recording has the points that returned")
        if self.only_detection:
            raise ValueError("only_detection: for simulations; a recording has all its points")
        if self.vehicle is not None and not isinstance(self.frames, str | Path):
            raise ValueError("vehicle: for simulations and paths of recordings; frames have their own (recording.body)")
        if self.test_targets:
            raise ValueError("test_targets: not for recordings, which have no scene to put a body into")
        if any(setting is not None for setting in (self.reference, self.num_rays, self.frame_interval_s)):
            raise ValueError(
                "reference, rays and frame_interval_s are for simulations; a recording has its reference points"
            )
