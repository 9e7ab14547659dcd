"""Tasks of `evaluate`: the rigs with their names, the frames in which they are measured, grid and regions."""

import hashlib
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Generic, Literal, NamedTuple, TypeVar

import numpy as np
import torch

from torchcover import __version__
from torchcover.coverage import Region
from torchcover.evaluation.config import DESCRIPTIONS
from torchcover.evaluation.observers import AnyObserver
from torchcover.evaluation.progress import show_wait
from torchcover.evaluation.rig_names import AnyRig, format_rig_source, is_rig_document, load_rig, make_rig_names
from torchcover.evaluation.settings import DEFAULT_NUM_FRAMES, MAX_NUM_FRAMES, Settings
from torchcover.frames import FrameDataset, FrameMetadata, RigSubset
from torchcover.recordings import RecordedFrames, open_recording
from torchcover.simulation import (
    QueryPlan,
    RegionsOfInterest,
    Rig,
    Scenario,
    SimulatedFrames,
    Weather,
    create_reference_sensor,
    set_ego,
)
from torchcover.simulation.recorded_rig import build_ego_box
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME
from torchcover.simulation.scenario import ROOM_M
from torchcover.simulation.simulated_frames import DEFAULT_REFERENCE

AnyScenario = Scenario | str | Path
SourceT = TypeVar("SourceT", bound=FrameDataset, covariant=True)

# Stack level of warnings that point to the call of `evaluate`.
CALLER = 4
# Settings that are not part of the identity of a run: frames, query plan and observers describe their effect, or they
# do not change the result.
NOT_IN_IDENTITY = frozenset((
    "scenario", "seed", "vehicle", "reference", "num_rays", "frame_interval_s", "regions", "cell_m", "band_frame",
    "sensor_model", "weather", "metrics", "num_frames", "device", "num_workers", "no_cache", "skip_bad_frames",
    "recording", "rerun",
))  # fmt: skip


@dataclass(frozen=True)
class TaskParams:
    """Defaults of a simulated run.

    Args:
        traffic_frame_interval_s: Seconds between frames in traffic: consecutive frames are correlated, and every minute
            starts in another city.
        only_detection_rays: Rays of the surface reference for detection rates alone. Fewer rays would save time per
            frame, but need more frames and scenes for the same standard error.
    """

    traffic_frame_interval_s: float = 10.0
    only_detection_rays: int = 2048


class Task(NamedTuple, Generic[SourceT]):
    """Rigs and the frames in which they are measured.

    Args:
        frames: Source of the frames.
        rig_sources: Name of each rig in tables and files -> name or path that the user gave; None if not named.
        metadata: Metadata of the frames, with the sensors and the origin that the user gave.
        query_plan: Grid, height bands and regions.
        num_frames: Maximum number of frames; None for all.
    """

    frames: SourceT
    rig_sources: Mapping[str, str | None]
    metadata: FrameMetadata
    query_plan: QueryPlan
    num_frames: int | None = None


def build_task(settings: Settings) -> Task[FrameDataset]:
    """Prepare the simulation of a scenario, or a recording.

    Args:
        settings: Settings of `evaluate`.

    Raises:
        ValueError: No rig, both a scenario and a recording, settings of the other kind, an unknown rig of a recording.
        FileNotFoundError: Unknown name or file.
        TypeError: The frames are not a `FrameDataset`.

    Warns:
        UserWarning: Problems that `RecordedFrames.check` finds.
    """
    for rig in settings.rigs:
        if not isinstance(rig, Rig) and Path(rig).suffix == ".npz":
            raise ValueError(f"{rig} is measured already: read it by Coverage.load, or compare it with others")
    if settings.frames is None:
        is_first_rank = settings.ranks is None or settings.ranks.rank == 0
        # Large meshes may take long to load.
        with show_wait("preparing the scene", is_shown=settings.progress and is_first_rank):
            return build_simulation_task(settings)
    if settings.scenario is not None:
        raise ValueError("scenario and frames exclude each other: simulate a scenario or read a recording")
    settings.check_recording()
    source = _open_frames(settings.frames, settings)
    if not isinstance(source, FrameDataset):
        raise TypeError(
            f"frames: a recording's path or a torchcover.data.FrameDataset is needed; got {type(source).__name__}; for "
            "a list of frames, or a dataset, feed observers: torchcover.evaluation.observe(frames, observers)"
        )
    if isinstance(source, RecordedFrames):
        if settings.skip_bad_frames:
            source.skip_unreadable_sweeps()
        for problem in source.check(settings.num_frames):
            warnings.warn(problem, stacklevel=CALLER)
    return _build_recording_task(source, settings)


def _open_frames(frames: FrameDataset | str | Path, settings: Settings) -> FrameDataset:
    """Open a recording, or return the frames of the user."""
    if not isinstance(frames, str | Path):
        return frames
    recording = open_recording(frames)
    if settings.vehicle is not None:
        recording.ego_box = build_ego_box(recording, settings.vehicle)
    return RecordedFrames(recording, use_ground_model=settings.band_frame != "vehicle")


def build_simulation_task(
    settings: Settings, *, needs_boxes: bool = False, params: TaskParams = TaskParams()
) -> Task[SimulatedFrames]:
    """Prepare the simulation of a scenario.

    Args:
        settings: Settings of `evaluate`.
        needs_boxes: Whether frames have bounding boxes of objects even if no metric needs them.
        params: Defaults.

    Raises:
        ValueError: No rig, or settings that contradict each other.
        FileNotFoundError: Unknown name or file.
    """
    if not settings.rigs:
        raise ValueError("which rig? Give a built-in name (see `torchcover list`) or a YAML file, or a recording")
    is_paper_reference = settings.reference == "paper"
    rigs, rig_sources = _load_rigs(settings, "ideal" if is_paper_reference else None)
    loaded_scenario = settings.single_scenario
    if not isinstance(loaded_scenario, Scenario):
        loaded_scenario = Scenario.load(loaded_scenario)
    scenario = set_ego(loaded_scenario, rigs, settings.vehicle)
    query_plan = (settings.regions or RegionsOfInterest()).build_query_plan(
        scenario.compute_ego_box().outline_m,
        settings.cell_m,
        settings.band_frame or ("vehicle" if is_paper_reference else DEFAULT_BAND_FRAME),
        _find_limits(scenario, rigs),
    )
    num_rays = settings.num_rays
    if num_rays is None and settings.only_detection and settings.reference in (None, DEFAULT_REFERENCE):
        num_rays = params.only_detection_rays
    num_frames = settings.num_frames
    if num_frames is None:
        num_frames = DEFAULT_NUM_FRAMES if settings.target_error is None else MAX_NUM_FRAMES
    frames = SimulatedFrames(
        scenario,
        rigs=rigs,
        num_frames=num_frames,
        seed=settings.seed,
        frame_interval_s=compute_frame_interval_s(scenario, settings.frame_interval_s, params),
        reference_sensor=create_reference_sensor(settings.reference, num_rays, query_plan),
        boxes=needs_boxes or settings.needs_boxes,
        search_radius_m=max(settings.thresholds_m) if settings.only_detection else None,
        max_cached_bytes=0.0,  # frames are made in order, so that no scene is needed again
        no_cache=settings.no_cache,
        device=find_ray_device(settings),
    )
    frames.simulator.check_run(frames.num_frames)
    # A path identifies a scenario better than the name in its file.
    given_scenario = settings.single_scenario
    name = scenario.name if isinstance(given_scenario, Scenario) else str(given_scenario)
    metadata = frames.metadata
    description: dict[str, object] = {**metadata.description, "scenario": name}
    if settings.config_record:
        description["config"] = settings.config_record
    metadata = replace(metadata, description=description)
    return Task(frames, rig_sources, metadata, query_plan, _limit_frames(frames, settings))


def _load_rigs(
    settings: Settings, usual_sensor_model: Literal["ideal", "real"] | None
) -> tuple[dict[str, Rig], dict[str, str]]:
    """Load the rigs with their sensor model and weather; return them and their sources by name."""
    sensor_model = settings.sensor_model or usual_sensor_model
    rigs, rig_sources = {}, {}
    for name, rig in zip(make_rig_names(settings.rigs), settings.rigs, strict=True):
        rigs[name] = load_rig(rig).apply_sensor_model(sensor_model)
        rig_sources[name] = format_rig_source(rig)
    if settings.weather:
        return _set_weather(rigs, rig_sources, settings.weather)
    return rigs, rig_sources


def find_ray_device(settings: Settings) -> str | None:
    """Find the GPU that casts rays; None for Embree on the CPU, which forked workers need.

    Args:
        settings: Settings of `evaluate`.
    """
    device = settings.ranks.get_device(settings.device) if settings.ranks else settings.device
    uses_gpu = device.startswith("cuda") and not settings.num_workers and find_spec("warp")
    return str(get_device(device)) if uses_gpu else None


def get_device(name: str) -> torch.device:
    """Return the device of a name.

    Args:
        name: Name as in torch, such as "cpu" or "cuda:1".

    Raises:
        ValueError: The device cannot be used here.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device, dtype=torch.float64).item()  # fails on the device `meta`, which has no values
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        reason = str(error).splitlines()[0].partition(". ")[0]  # some messages have many pages
        raise ValueError(f"device {name}: cannot be used here ({reason}); try cpu") from error
    return device


def _set_weather(
    rigs: Mapping[str, Rig], rig_sources: Mapping[str, str], weather: Sequence[Weather]
) -> tuple[dict[str, Rig], dict[str, str]]:
    """Put each rig into each weather; names contain the weather if there are several."""
    weather_names = [one_weather.name for one_weather in weather]
    if len(set(weather_names)) < len(weather):
        raise ValueError(f"weather: two have the same name, {', '.join(weather_names)}; name each another way")
    weather_rigs, weather_sources = {}, {}
    for name, rig in rigs.items():
        for one_weather in weather:
            full_name = name if len(weather) == 1 else f"{name}, {one_weather.name}"
            weather_rigs[full_name] = rig.model_copy(update={"weather": one_weather})
            weather_sources[full_name] = rig_sources[name]
    return weather_rigs, weather_sources


def _limit_frames(frames: SimulatedFrames, settings: Settings) -> int | None:
    """Limit a run with a target error to the distinct frames of a scenario that moves and repeats."""
    num_distinct_frames = frames.simulator.num_distinct_frames
    has_target = settings.num_frames is None and settings.target_error is not None
    if not has_target or num_distinct_frames in (None, 1):
        return None
    return max(DEFAULT_NUM_FRAMES, num_distinct_frames)


def _build_recording_task(frames: FrameDataset, settings: Settings) -> Task[FrameDataset]:
    """Build the task of a recording or of another source of frames."""
    metadata = frames.metadata
    names = make_rig_names(settings.rigs or metadata.rigs)
    is_single = len(names) == len(metadata.rigs) == 1  # the only rig of a recording may have any name
    recorded_names = metadata.rigs if is_single else names
    subset = RigSubset(frames, dict(zip(names, recorded_names, strict=True)))
    given_rigs: dict[str, AnyRig] = dict(zip(names, settings.rigs, strict=True)) if settings.rigs else {}
    rig_sources: dict[str, str | None] = dict.fromkeys(names)
    sensors = dict(subset.metadata.sensors)
    for name, rig in given_rigs.items():
        rig_sources[name] = format_rig_source(rig)
        # A name of the recording need not be a rig; any other name must be.
        if is_rig_document(rig) or name not in metadata.rigs:
            sensors[name] = load_rig(rig).sensors
    band_frame = settings.band_frame or ("ground" if frames.has_heights() else "vehicle")
    regions = settings.regions or RegionsOfInterest()
    query_plan = regions.build_query_plan(metadata.ego_outline_m, settings.cell_m, band_frame)
    description = dict(metadata.description)
    if settings.config_record:
        description["config"] = settings.config_record
    metadata = replace(subset.metadata, sensors=sensors, description=description)
    return Task(subset, rig_sources, metadata, query_plan, settings.num_frames)


def _find_limits(scenario: Scenario, rigs: Mapping[str, Rig]) -> Region | None:
    """Find the rectangle outside of which no rig can observe anything.

    It is bounded by the largest range of the sensors and by the walls of a closed yard; None if neither is small.
    """
    ranges_m = []
    for rig in rigs.values():
        for sensor in rig.sensors:
            distance_m = float(np.linalg.norm(sensor.mount.to_matrix()[:2, 3]))
            ranges_m.append(scenario.compute_max_range_m(sensor, rig.weather) + distance_m)
    range_m = max(ranges_m)
    room = scenario.find_room_bounds_m()
    if range_m > ROOM_M:
        return Region("room", *room) if room else None
    (x_min_m, x_max_m), (y_min_m, y_max_m) = room or ((-range_m, range_m), (-range_m, range_m))
    limits = (max(x_min_m, -range_m), min(x_max_m, range_m)), (max(y_min_m, -range_m), min(y_max_m, range_m))
    return Region("room" if limits == room else "range", *limits)


def compute_frame_interval_s(
    scenario: Scenario, frame_interval_s: float | None, params: TaskParams = TaskParams()
) -> float:
    """Compute the time between two frames.

    Without a given value it is 10 s in traffic. Otherwise it is a multiple of the time step that is coprime to the
    number of time steps and close to the golden ratio. Any number of frames is then spread evenly over the scenario,
    and no time step is repeated before all have been used.

    Args:
        scenario: The scenario.
        frame_interval_s: Value that the user gave.
        params: Defaults.
    """
    if frame_interval_s is not None:
        return frame_interval_s
    num_time_steps = scenario.num_distinct_time_steps
    if num_time_steps is None:
        return params.traffic_frame_interval_s
    golden = (math.sqrt(5) - 1) / 2 * num_time_steps
    coprime = [stride for stride in range(1, num_time_steps + 1) if math.gcd(stride, num_time_steps) == 1]
    return min(coprime, key=lambda stride: abs(stride - golden)) * scenario.effective_time_step_s


def build_run_identity(
    task: Task[FrameDataset], settings: Settings, observers: Mapping[str, AnyObserver], num_ranks: int = 1
) -> dict[str, str]:
    """Describe everything that the sums of a run depend on; checkpoints of another identity are refused.

    The number of frames is not part of it, as a run may continue with more frames.

    Args:
        task: Frames, rigs and regions.
        settings: Settings of `evaluate`.
        observers: Name -> observer besides coverage.
        num_ranks: Number of ranks, each of which has its own share of the frames.

    Returns:
        Name -> JSON text; a hash replaces long texts.
    """
    kinds = {name: f"{type(value).__module__}.{type(value).__qualname__}" for name, value in observers.items()}
    grid = task.query_plan.grid
    identity = {
        "torchcover": __version__,
        **task.frames.collect_content(),
        "rigs": task.metadata.rigs,
        "cell_m": grid.cell_m,
        "grid": [grid.x_m, grid.y_m],
        "heights": list(grid.heights.items()),
        "band_frame": grid.band_frame,
        "regions": [[region.name, region.x_m, region.y_m, region.corners_m] for region in task.query_plan.regions],
        **{name: getattr(settings, name) for name in DESCRIPTIONS if name not in NOT_IN_IDENTITY},
        "observers": kinds,
        "ranks": num_ranks,
    }
    return {name: _encode(value) for name, value in identity.items()}


def _encode(value: object, max_length: int = 40) -> str:
    """Encode a value as JSON text; a hash replaces long texts."""
    text = json.dumps(value, sort_keys=True, default=repr)
    return text if len(text) <= max_length else f"#{hashlib.sha256(text.encode()).hexdigest()}"
