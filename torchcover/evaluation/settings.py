"""All that can be said to `evaluate`: each argument once, with its words and its form on the command line.

Nothing heavy is imported here: the command line takes its options from it, and `--help` answers at once.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from importlib import import_module
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, cast

from torchcover.evaluation.arguments import Option, Read, options_of
from torchcover.simulation.memory import check_fits

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


def wanted_files(given: str | Iterable[str]) -> frozenset[str]:
    """What is to be written of a result.

    `given`: of `FILES`: names, or a text as in `numbers,page`. ValueError: another name, or none.

    Example:
        >>> sorted(wanted_files("page, numbers"))
        ['numbers', 'page']
    """
    names = [name.strip() for name in given.split(",")] if isinstance(given, str) else list(given)
    if not names or not set(names).issubset(FILES):
        raise ValueError(f"files: {', '.join(FILES)}, one or more of them, are needed; got {given!r}")
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
    from torchcover.simulation.documents import found

    return found("scenarios", scenario).stem


def _thresholds(given: "float | Iterable[float]") -> tuple[float, ...]:
    each = tuple(given) if isinstance(given, Iterable) else (given,)
    if not all(isinstance(threshold, Real) for threshold in each):
        raise TypeError(f"thresholds_m: metres are needed, as in 0.4 or (0.4, 1.0); got {given!r}")
    return tuple(float(threshold) for threshold in each)


def _aggregations(given: "str | Sequence[Aggregation | str]") -> "tuple[Aggregation, ...]":
    if not given:
        return ()
    from torchcover.coverage import aggregation_named

    each = [given] if isinstance(given, str) else given
    if not isinstance(each, Sequence):  # what is in it the metric checks
        raise TypeError(
            f"aggregations: names such as maximum, or a sequence of them or of objects such as Maximum(), are needed; "
            f"got {given!r}"
        )
    return tuple(aggregation_named(one) if isinstance(one, str) else one for one in each)


def _metrics(given: str | Iterable[str]) -> tuple[str, ...]:
    if not given:
        return ()
    names: tuple[str, ...] = load_contrib().metric_names(given)
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
        raise ValueError(f"probe: none, or bodies; got {', '.join(map(str, each))}")
    return () if each == ("none",) else each


@dataclass(frozen=True, eq=False)
class Settings:
    """The arguments of `evaluate`; None where nothing was given.

    Raises:
        ValueError: A number of steps below 1, an unknown measure, more workers than the memory has room for.
        TypeError: One of a wrong kind.
    """

    rigs: Annotated[
        Read["AnyRig | Sequence[AnyRig] | None", "tuple[AnyRig, ...]"],
        "A rig, the name of a built-in one, or the path of a YAML file; or several, which are measured in the same "
        "frames against the same reference, and of which the others are compared with the first. With `frames`: which "
        "of its rigs, all if not given; or what its only one is, so that the maps show its sensors.",
    ] = Read(_rigs, None)
    scenario: Annotated[
        "AnyScenario | Sequence[AnyScenario] | Mapping[str, float] | None",
        Option(
            "Scenario: a built-in name or a YAML file (courtyard). Or several kinds of world, each measured apart and "
            "then mixed: `urban,highway`, with weights `urban=0.7,highway=0.3` (equal if not given); in Python also a "
            "sequence, or a mapping to weights.",
            str,
            in_study=True,
        ),
    ] = None
    _: KW_ONLY
    frames: Annotated[
        "FrameSource | str | Path | None", "A recording, or any source of frames, instead of a scenario."
    ] = None
    steps: Annotated[
        int | None,
        Option(
            "Steps to simulate (64; with a target error at most, 4096), or frames of a recording to use at most (all).",
            minimum=1,
        ),
    ] = None
    seed: Annotated[int, Option("Seed of the simulation.", minimum=0, in_study=True)] = 0
    vehicle: Annotated[
        str | Path | None,
        Option(
            "What carries the rigs: a built-in vehicle, a YAML file or a mesh in metres. Not given: the scenario's own "
            "ego, else the vehicle that the rigs name, else an SUV. Of a recording: what is no return from the world, "
            "where it does not say it; or x0,x1,y0,y1,z0,z1 in metres.",
            str,
            in_study=True,
        ),
    ] = None
    sensor_model: Annotated[
        Literal["ideal", "real"] | None,
        Option(
            "What sensors make of their hits: `real`, a LiDAR has no point where too little light returns (default "
            "where its range at 10 % is known), or `ideal`, every hit is a point (default of the `paper` reference).",
            in_study=True,
        ),
    ] = None
    weather: Annotated[
        Read["Weather | str | Path | Sequence[Weather | str | Path]", "tuple[Weather, ...]"],
        Option(
            "Weather in place of the scenario's: a built-in name as fog_100m (see `list`) or a YAML file. In several, "
            "every rig is measured in each; `compare` of one rig puts it beside `clear`.",
            list[str],
        ),
    ] = Read(_weather, ())
    ask: Annotated[
        Read["RegionsOfInterest | str | Path | None", "RegionsOfInterest | None"],
        Option(
            "Regions, also polygons, height bands and grid, in a YAML file. Not given: the paper's regions in front, "
            "and the near field on the four sides of the vehicle.",
            Path,
            in_study=True,
        ),
    ] = Read(_asked, None)
    probe: Annotated[
        Read["str | Path | Iterable[str | Path] | None", "tuple[str | Path, ...] | None"],
        Option(
            "Body that is put in free places beside the vehicle, as of `targets`; may be repeated; `none` puts none. "
            "Not given: child, adult, cyclist and pole where nothing else is asked about.",
            list[str],
        ),
    ] = Read(_probes, None)
    cell_m: Annotated[
        float | None, Option("Side of a grid cell in metres, whatever `ask` says (0.25).", in_study=True)
    ] = None
    thresholds_m: Annotated[
        Read[float | Iterable[float], tuple[float, ...]],
        Option("Detection thresholds in metres (0.4); may be repeated.", list[float], in_study=True),
    ] = Read(_thresholds, (0.4,))
    aggregations: Annotated[
        Read["str | Sequence[Aggregation | str]", "tuple[Aggregation, ...]"],
        Option(
            "Maps and numbers of regions other than means, as in `maximum` or `quantiles:0.5,0.9`; any other name "
            "lists all; may be repeated. In Python also objects, as in `CoverageMetric`.",
            list[str],
        ),
    ] = Read(_aggregations, ())
    reference: Annotated[
        str | None,
        Option(
            "Reference sensor: `surface`, points drawn evenly on what can be seen (default), or `paper`. On the "
            "command line with --frames: `recorded`, or `accumulated` from the recording itself.",
            in_study=True,
        ),
    ] = None
    rays: Annotated[
        int | None,
        Option(
            "Rays of the reference sensor at each step (surface: 16384; paper: 1048576, a square).",
            minimum=1,
            in_study=True,
        ),
    ] = None
    estimate: Annotated[
        Literal["area", "known"] | None,
        Option(
            "What the number of a region is a mean over: `area`, its visible surface (default; needs `surface`), or "
            "`known`, its known cells, as in the paper.",
            in_study=True,
        ),
    ] = None
    band_frame: Annotated[
        Literal["ground", "vehicle"] | None,
        Option(
            "What height bands are over: `ground`, the local ground (default), or `vehicle`, z of the vehicle (`paper` "
            "and recordings without heights have no other).",
            in_study=True,
        ),
    ] = None
    every_s: Annotated[
        float | None,
        Option(
            "Seconds between one step and the next; steps that follow each other are alike. Not given: 10 in traffic, "
            "which starts anew in another city every minute, else what spreads the steps over the scenario.",
            in_study=True,
        ),
    ] = None
    target_error: Annotated[
        Read["TargetError | str | Sequence[str] | None", "TargetError | None"],
        Option(
            "Stop once every number (of the usual regions, those in front) is this good: 0.1% (standard error of each "
            "detection, in percentage points) or 0.02m (of each radius); both may be given. `steps` is then the most.",
            list[str],
        ),
    ] = Read(_target, None)
    only_detection: Annotated[
        bool,
        Option(
            "Only the detections of regions: no radii, rough maps, and no bodies unless given. Few reference points "
            "(2048 rays), and of the rig only those rays are cast that can change their detection: for target errors, "
            "with more steps.",
            in_study=True,
        ),
    ] = False
    redundancy: Annotated[
        bool, Option("Say by how many sensors places are seen, and what is lost when each one fails.")
    ] = False
    metrics: Annotated[
        Read[str | Iterable[str], tuple[str, ...]],
        Option(
            "Coverage metrics that others published, on the same frames: `all`, or names as in `k_cover,s_mig` "
            "(docs/metrics.md).",
            str,
        ),
    ] = Read(_metrics, ())
    device: Annotated[
        Read["str | torch.device", str],
        Option("Where the search and the sums run, with Warp rays too: cpu, cuda, cuda:1, ...", str, in_study=True),
    ] = Read(str, "cpu")
    workers: Annotated[
        int | None,
        Option(
            "Processes that make frames; 0 makes them in this one. Not given: of a simulation, as many as help.",
            minimum=0,
            in_study=True,
        ),
    ] = None
    no_cache: Annotated[
        bool,
        Option(
            "Build all worlds anew and keep none on disk. Else those that are drawn are read from ~/.cache/torchcover "
            "where an earlier run has left them, which has room for TORCHCOVER_CACHE_GB gigabytes (1)."
        ),
    ] = False
    skip_bad_frames: Annotated[bool, Option("Skip and count frames that cannot be read, instead of stopping.")] = False
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
        "Processes that share the run, from `joined_ranks()`; all of them call this, and get the same result.",
    ] = None
    progress: Annotated[bool, "Whether to show a bar."] = False

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps: at least 1 is needed; got {self.steps}")
        check_fits(f"{self.workers or 0:,} workers", BYTES_PER_WORKER * (self.workers or 0), "use fewer")
        if self.estimate not in (None, "area", "known"):
            raise ValueError(f"estimate {self.estimate}: `area` or `known` is needed")
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
    def one_scenario(self) -> "AnyScenario":
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
        if self.probe:
            raise ValueError("probe: not for recordings, which have no scene to put a body into")
        if any(setting is not None for setting in (self.reference, self.rays, self.every_s)):
            raise ValueError("reference, rays and every_s are for simulations; a recording has its reference points")


OPTIONS = options_of(Settings)
