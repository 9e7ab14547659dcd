"""What there is to measure: which rigs, what they are called, in which frames."""

import hashlib
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch

from torchcover import __version__
from torchcover.coverage import Region
from torchcover.evaluation.config import DESCRIPTIONS
from torchcover.evaluation.observers import AnyObserver
from torchcover.evaluation.progress import show_wait
from torchcover.evaluation.settings import DEFAULT_STEPS, MAX_STEPS, Settings
from torchcover.frames import FrameSource, RigSubset
from torchcover.recordings import RecordedFrames, open_recording
from torchcover.simulation import (
    QueryPlan,
    RegionsOfInterest,
    Rig,
    Scenario,
    Sensor,
    SimulatedFrames,
    Weather,
    create_reference_sensor,
    list_builtin_names,
    set_ego,
)
from torchcover.simulation.recorded_rig import build_ego_box
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME
from torchcover.simulation.scenario import ROOM_M
from torchcover.simulation.simulated_frames import DEFAULT_REFERENCE

AnyRig = Rig | str | Path
AnyScenario = Scenario | str | Path
SourceT = TypeVar("SourceT", bound=FrameSource, covariant=True)

# Steps that follow each other are alike, and every minute is another city.
EVERY_S_IN_TRAFFIC = 10.0
# Of the reference where only detections are asked for. Fewer save rays, but take more steps, and worlds, to an error.
FEW_RAYS = 2048
# Where warnings point to: the call of `evaluate`, beyond its own function, the one around that, and ours.
CALLER = 4
# Options that frames, what is asked and observers say by what they are, and those that change no result.
TOLD_OTHERWISE = {
    "scenario",
    "seed",
    "vehicle",
    "reference",
    "num_rays",
    "frame_interval_s",
    "regions",
    "cell_m",
    "band_frame",
}
TOLD_OTHERWISE |= {
    "sensor_model",
    "weather",
    "metrics",
    "num_frames",
    "device",
    "num_workers",
    "no_cache",
    "skip_bad_frames",
}
TOLD_OTHERWISE |= {"recording", "rerun"}
# Of an identity, what is longer is told by its hash.
MAX_TOLD = 40


class Task(NamedTuple, Generic[SourceT]):
    """Which rigs are measured in which frames, under the names that they have in tables and files.

    `rig_sources` is what the user called each rig, None if it was not named; `sensors` its sensors, where they are known;
    `num_frames` how many frames to use at most.
    """

    frames: SourceT
    rig_sources: Mapping[str, str | None]
    sensors: Mapping[str, Sequence[Sensor]]
    description: Mapping[str, object]
    query_plan: QueryPlan
    num_frames: int | None = None

    @property
    def rigs(self) -> tuple[str, ...]:
        """What the rigs are called in tables and files."""
        return tuple(self.rig_sources)

    def get_sensor_names(self) -> Mapping[str, Sequence[str]]:
        """Name of each rig -> names of its sensors. ValueError: it is unknown which points are of which sensor."""
        known = self.frames.sensor_names
        if unknown := [rig for rig in self.rigs if rig not in known]:
            raise ValueError(f"redundancy: unknown which points of {', '.join(unknown)} are of which sensor")
        return known


def build_task(settings: Settings) -> Task[FrameSource]:
    """Simulate a scenario, or read a recording.

    Raises:
        ValueError: No rig, a scenario and a recording, settings for the other of the two, a rig that is not there.
        FileNotFoundError: An unknown name or file.
        TypeError: Frames that do not say whose they are.

    Warns:
        UserWarning: What looks wrong; see `FrameSource.doubts`.
    """
    for rig in settings.rigs:
        if not isinstance(rig, Rig) and Path(rig).suffix == ".npz":
            raise ValueError(f"{rig} is measured already: read it by Coverage.load, or compare it with others")
    frames = settings.frames
    if frames is None:
        is_first = settings.ranks is None or settings.ranks.rank == 0
        with show_wait("preparing the scene", is_shown=settings.progress and is_first):  # meshes may be large
            return build_simulation_task(settings)
    if settings.scenario is not None:
        raise ValueError("scenario and frames exclude each other: simulate a scenario or read a recording")
    settings.check_recording()
    if isinstance(frames, str | Path):
        recording = open_recording(frames)
        if settings.vehicle is not None:
            recording.ego_box = build_ego_box(recording, settings.vehicle)
        source: FrameSource = RecordedFrames(recording, use_ground_model=settings.band_frame != "vehicle")
    else:
        source = frames
    if missing := [name for name in vars(FrameSource) if not name.startswith("_") and not hasattr(source, name)]:
        raise TypeError(
            f"frames: a recording's path or a torchcover.data.FrameSource is needed; got {type(source).__name__}, "
            f"which has no {', '.join(missing)}; for a list of frames, or a dataset, feed observers: "
            "torchcover.evaluation.observe(frames, observers)"
        )
    if settings.skip_bad_frames and isinstance(source, RecordedFrames):
        source.skip_unreadable_sweeps()
    for doubt in source.check(settings.num_frames):
        warnings.warn(doubt, stacklevel=CALLER)
    return _recording(source, settings)


def build_simulation_task(settings: Settings, *, needs_boxes: bool = False) -> Task[SimulatedFrames]:
    """Simulate a scenario.

    Args:
        settings: Of `evaluate`.
        needs_boxes: Whether frames are to have objects, even if no metric is about them.

    Raises:
        ValueError, FileNotFoundError: As `build_task`.
    """
    rigs, scenario = settings.rigs, settings.single_scenario
    if not rigs:
        raise ValueError("which rig? Give a built-in name (see `torchcover list`) or a YAML file, or a recording")
    names = make_rig_names(rigs)
    sensor_model = settings.sensor_model or ("ideal" if settings.reference == "paper" else None)
    carried = {name: load_rig(rig).apply_sensor_model(sensor_model) for name, rig in zip(names, rigs, strict=True)}
    given = {name: format_rig_source(rig) for name, rig in zip(names, rigs, strict=True)}
    if settings.weather:
        carried, given = _in_weather(carried, given, settings.weather)
    loaded_world = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
    world = set_ego(loaded_world, carried, settings.vehicle)
    band_frame = settings.band_frame or ("vehicle" if settings.reference == "paper" else DEFAULT_BAND_FRAME)
    asked = (settings.regions or RegionsOfInterest()).build_query_plan(
        world.compute_ego_box().outline_m, settings.cell_m, band_frame, _within(world, carried)
    )
    few = settings.only_detection and settings.reference in (None, DEFAULT_REFERENCE)
    rays = FEW_RAYS if few and settings.num_rays is None else settings.num_rays
    most = DEFAULT_STEPS if settings.target_error is None else MAX_STEPS
    frames = SimulatedFrames(
        world,
        rigs=carried,
        num_frames=most if settings.num_frames is None else settings.num_frames,
        seed=settings.seed,
        frame_interval_s=compute_frame_interval_s(world, settings.frame_interval_s),
        reference_sensor=create_reference_sensor(settings.reference, rays, asked),
        boxes=needs_boxes or settings.needs_boxes,
        search_radius_m=max(settings.thresholds_m) if settings.only_detection else None,
        max_cached_bytes=0.0,  # steps come in order: no world is needed again
        no_cache=settings.no_cache,
        device=find_ray_device(settings),
    )
    frames.simulator.check_run(frames.num_frames)
    # A path says more than the name within the file.
    description = {**frames.description, "scenario": world.name if loaded_world is scenario else str(scenario)}
    description |= {"config": settings.config_record} if settings.config_record else {}
    return Task(frames, given, frames.sensors, description, asked, _most_steps(frames, settings))


def find_ray_device(settings: Settings) -> str | None:
    """The GPU that casts rays, if that of the run can: workers are forked, and cast by Embree."""
    device = settings.ranks.get_device(settings.device) if settings.ranks else settings.device
    on_a_gpu = device.startswith("cuda") and not settings.num_workers and find_spec("warp")
    return str(get_device(device)) if on_a_gpu else None


def get_device(name: str) -> torch.device:
    """The device of this name. ValueError: it cannot be used here."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device, dtype=torch.float64).item()  # the device `meta` has no values
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        said = str(error).splitlines()[0].partition(". ")[0]  # some go on for pages
        raise ValueError(f"device {name}: cannot be used here ({said}); try cpu") from error
    return device


def _in_weather(
    carried: Mapping[str, Rig], given: Mapping[str, str], weather: Sequence[Weather]
) -> tuple[dict[str, Rig], dict[str, str]]:
    """Each rig in each weather, which its name tells if there are several; and what the user called them."""
    if len(weather) == 1:
        return {name: rig.model_copy(update={"weather": weather[0]}) for name, rig in carried.items()}, dict(given)
    if len({one.name for one in weather}) < len(weather):
        raise ValueError(
            f"weather: two are called alike, {', '.join(one.name for one in weather)}; name each another way"
        )
    each = {f"{name}, {one.name}": (name, one) for name in carried for one in weather}
    in_each = {both: carried[name].model_copy(update={"weather": one}) for both, (name, one) in each.items()}
    return in_each, {both: given[name] for both, (name, _) in each.items()}


def _most_steps(frames: SimulatedFrames, settings: Settings) -> int | None:
    """Where a target error ends a run at the latest: what repeats and moves has no more to say than its instants."""
    distinct = frames.simulator.num_distinct_frames
    if settings.num_frames is not None or settings.target_error is None or distinct in (None, 1):
        return None
    return max(DEFAULT_STEPS, distinct)


def _recording(frames: FrameSource, settings: Settings) -> Task[FrameSource]:
    rigs = settings.rigs
    names = make_rig_names(rigs or list(frames.rigs))
    only_one = len(names) == len(frames.rigs) == 1  # which goes by any name
    chosen = RigSubset(frames, dict(zip(names, frames.rigs if only_one else names, strict=True)))
    named = dict(zip(names, rigs, strict=True)) if rigs else {}
    given = {name: format_rig_source(named[name]) if named else None for name in names}
    # A name that is in the recording may be a name only; any other has to be that of a rig.
    documents = {name: rig for name, rig in named.items() if is_rig_document(rig) or name not in frames.rigs}
    sensors = {**chosen.sensors, **{name: load_rig(rig).sensors for name, rig in documents.items()}}
    band_frame = settings.band_frame or ("ground" if frames.has_heights() else "vehicle")
    asked = (settings.regions or RegionsOfInterest()).build_query_plan(
        frames.ego_outline_m, settings.cell_m, band_frame
    )
    description = {**frames.description, **({"config": settings.config_record} if settings.config_record else {})}
    return Task(chosen, given, sensors, description, asked, settings.num_frames)


def _within(world: Scenario, rigs: Mapping[str, Rig]) -> Region | None:
    """The room that the ego is in, or what its sensors reach; None if both are large."""
    reach_m = max(
        world.compute_max_range_m(sensor, rig.weather) + float(np.linalg.norm(sensor.mount.to_matrix()[:2, 3]))
        for rig in rigs.values()
        for sensor in rig.sensors
    )
    room = world.find_room_bounds_m()
    if reach_m > ROOM_M:
        return Region("room", *room) if room else None
    (x0, x1), (y0, y1) = room or ((-reach_m, reach_m), (-reach_m, reach_m))
    within = (max(x0, -reach_m), min(x1, reach_m)), (max(y0, -reach_m), min(y1, reach_m))
    return Region("room" if within == room else "range", *within)


def compute_frame_interval_s(scenario: Scenario, frame_interval_s: float | None) -> float:
    """Time between two steps: what was given, else 10 s in traffic, else what spreads the steps over the scenario.

    That is the golden share of its instants, round and round: any number of steps lies evenly over all of it, and no
    instant comes again before all have been seen.
    """
    if frame_interval_s is not None:
        return frame_interval_s
    if scenario.num_distinct_time_steps is None:
        return EVERY_S_IN_TRAFFIC
    share = (math.sqrt(5) - 1) / 2 * scenario.num_distinct_time_steps
    each_once = (
        steps
        for steps in range(1, scenario.num_distinct_time_steps + 1)
        if math.gcd(steps, scenario.num_distinct_time_steps) == 1
    )
    return min(each_once, key=lambda steps: abs(steps - share)) * scenario.effective_time_step_s


def make_rig_names(rigs: Sequence[AnyRig]) -> list[str]:
    """What the columns are called: the rigs' names; numbered where two would be the same."""
    return make_unique_names([_name(rig) for rig in rigs])


def make_unique_names(stems: Sequence[str]) -> list[str]:
    """Names of which no two are the same, for no file system; numbered where they would be.

    Example:
        >>> distinct(["roof", "Roof", "grille"])
        ['roof', 'Roof_2', 'grille']
    """
    names: list[str] = []
    for stem in stems:
        name, number = stem, 2
        while name.lower() in (other.lower() for other in names):
            name, number = f"{stem}_{number}", number + 1
        names.append(name)
    return names


def load_rig(rig: AnyRig) -> Rig:
    """The rig itself. FileNotFoundError: no such file or built-in name. ValueError: the file is not a rig."""
    return rig if isinstance(rig, Rig) else Rig.load(rig)


def load_named_rig(rig: AnyRig) -> Rig:
    """The rig itself, under the name that tables and files of every command have for it.

    FileNotFoundError: as `loaded`. ValueError: as `loaded`.
    """
    return load_rig(rig).model_copy(update={"name": _name(rig)})


def is_rig_document(rig: AnyRig) -> bool:
    """Whether there is more to it than a name: a rig, the path of one, or the name of a built-in one."""
    return isinstance(rig, Rig) or _is_file(rig) or str(rig) in list_builtin_names("rigs")


def format_rig_source(rig: AnyRig) -> str:
    """What the user called it."""
    return rig.name if isinstance(rig, Rig) else str(rig)


def _name(rig: AnyRig) -> str:
    return load_rig(rig).name if isinstance(rig, Rig) or _is_file(rig) else str(rig)


def _is_file(rig: str | Path) -> bool:
    return Path(rig).suffix in (".yaml", ".yml")


def build_run_identity(
    task: Task[FrameSource], settings: Settings, others: Mapping[str, AnyObserver], num_ranks: int = 1
) -> dict[str, str]:
    """All that the result of a run depends on, by name: not the steps, of which there may be more later, nor who works.

    Ranks share the run, each with its own part of it. What is a document or a table is told by its hash.
    """
    kinds = {name: f"{type(one).__module__}.{type(one).__qualname__}" for name, one in others.items()}
    everything = {
        "torchcover": __version__,
        **task.frames.content,
        "rigs": task.rigs,
        **_asked(task.query_plan),
        **{name: getattr(settings, name) for name in DESCRIPTIONS if name not in TOLD_OTHERWISE},
        "observers": kinds,
        "ranks": num_ranks,
    }
    return {name: _told(value) for name, value in everything.items()}


def _asked(asked: QueryPlan) -> dict[str, object]:
    grid = asked.grid
    return {
        "cell_m": grid.cell_m,
        "grid": [grid.x_m, grid.y_m],
        "heights": list(grid.heights.items()),
        "band_frame": grid.band_frame,
        "regions": [[region.name, region.x_m, region.y_m, region.corners_m] for region in asked.regions],
    }


def _told(value: object) -> str:
    text = json.dumps(value, sort_keys=True, default=repr)
    return text if len(text) <= MAX_TOLD else f"#{hashlib.sha256(text.encode()).hexdigest()}"
