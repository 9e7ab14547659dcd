"""`torchcover evaluate`: frames in; table, maps and files out."""

import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from torch.utils.data import DataLoader, Dataset, Subset

from torchcover import __version__
from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region, forward_regions
from torchcover.data import BadFrameError, Frame, FrameBatch, RecordedFrames, SimulatedFrames, collate_frames
from torchcover.report import SensorMark, coverage_table, draw_maps, summary_dict, write_csv
from torchcover.simulation import Rig

DEFAULT_SCENARIO = "courtyard"
DEFAULT_STEPS = 64
# Holds the paper's regions, and the space beside and behind the vehicle.
GRID_X_M = (-40.0, 160.0)
GRID_Y_M = (-40.0, 40.0)


@dataclass(frozen=True)
class Request:
    """What the user asked for; the options of `torchcover evaluate`."""

    rig: str | None
    scenario: str | None
    recording: Path | None
    steps: int | None
    seed: int
    out: Path
    cell: float
    thresholds: tuple[float, ...]
    device: str
    workers: int
    skip_bad_frames: bool


@dataclass
class Progression:
    """How a run went: sums of the frames' counts, what was skipped, and the error that ended it, if one did."""

    counts: Counter[str] = field(default_factory=Counter)
    skipped: list[str] = field(default_factory=list)
    failure: BadFrameError | None = None
    interrupted: bool = False
    seconds: float = 0.0


def run(request: Request) -> None:
    """Evaluate, print the table, write the files. What was computed is written even if the run was cut short.

    Raises:
        ValueError: The request makes no sense, or a frame was bad.
        FileNotFoundError: A name or a file is unknown.
        KeyboardInterrupt: The user stopped the run.
    """
    device = _device(request.device)
    grid = BevGrid(x=GRID_X_M, y=GRID_Y_M, cell=request.cell)
    metric = CoverageMetric(grid, request.thresholds, max_radius=grid.diagonal_m).to(device)
    frames = _frames(request)
    progression = _accumulate(frames, metric, device, request)
    if int(metric.steps) == 0:
        raise progression.failure or ValueError("no frame could be used; nothing is written")
    _write(metric.compute(), request, progression, frames)
    if progression.failure is not None:
        raise progression.failure
    if progression.interrupted:
        raise KeyboardInterrupt


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device {name}: cannot be used here ({str(error).splitlines()[0]}); try cpu") from error
    return device


def _frames(request: Request) -> Dataset[Frame]:
    if request.recording is not None:
        if request.scenario is not None:
            raise ValueError("--scenario and --frames exclude each other: simulate a scenario or read a recording")
        recorded = RecordedFrames(request.recording)
        return recorded if request.steps is None else Subset(recorded, range(min(request.steps, len(recorded))))
    if request.rig is None:
        raise ValueError("which rig? Give a built-in name (see `torchcover list`) or a YAML file, or use --frames")
    return SimulatedFrames(
        request.scenario or DEFAULT_SCENARIO, request.rig, steps=request.steps or DEFAULT_STEPS, seed=request.seed
    )


def _accumulate(frames: Dataset[Frame], metric: CoverageMetric, device: torch.device, request: Request) -> Progression:
    progression = Progression()
    start = time.perf_counter()
    with _progress_bar() as bar:
        task = bar.add_task("steps", total=len(frames), rate="")  # type: ignore[arg-type]  # map-style: has a length
        try:
            for batch in _batches(frames, request, progression):
                metric.update(batch.to(device).sensor, batch.to(device).reference)
                progression.counts.update(batch.frames[0].counts)
                _advance(bar, task)
        except KeyboardInterrupt:
            progression.interrupted = True
    progression.seconds = time.perf_counter() - start
    return progression


def _batches(frames: Dataset[Frame], request: Request, progression: Progression) -> Iterator[FrameBatch]:
    """One frame at a time; notes bad ones in `progression`, and ends at the first unless they are to be skipped."""
    loader = DataLoader(frames, batch_size=1, collate_fn=collate_frames, num_workers=request.workers)
    iterator = iter(loader)
    while True:
        try:
            yield next(iterator)
        except StopIteration:
            return
        except BadFrameError as error:
            if not request.skip_bad_frames:
                progression.failure = error
                return
            progression.skipped.append(str(error))


def _progress_bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=Console(stderr=True),
    )


def _advance(bar: Progress, task: TaskID) -> None:
    bar.advance(task)
    speed = bar.tasks[0].speed
    bar.update(task, rate=f"{speed:.2f} steps/s" if speed else "")


def _write(coverage: Coverage, request: Request, progression: Progression, frames: Dataset[Frame]) -> None:
    request.out.mkdir(parents=True, exist_ok=True)
    regions = forward_regions()
    console = Console()
    console.print(coverage_table(coverage, regions))
    for line in progression.skipped:
        console.print(f"skipped: {line}", style="yellow", markup=False)
    coverage.save(request.out / "coverage.npz")
    write_csv(coverage, regions, request.out / "summary.csv")
    _write_summary(coverage, regions, request, progression)
    maps = draw_maps(
        coverage, request.out / "maps", ego_outline_m=_ego_outline(frames), sensors=_sensor_marks(request.rig)
    )
    console.print(
        f"Wrote summary.json, summary.csv, coverage.npz and {len(maps)} maps to {request.out}", soft_wrap=True
    )


def _write_summary(coverage: Coverage, regions: tuple[Region, ...], request: Request, progression: Progression) -> None:
    content: dict[str, Any] = {
        "torchcover": __version__,
        "rig": request.rig,
        "scenario": None if request.recording else request.scenario or DEFAULT_SCENARIO,
        "frames": str(request.recording) if request.recording else None,
        "seed": None if request.recording else request.seed,
        "device": request.device,
        "seconds": round(progression.seconds, 3),
        "complete": progression.failure is None and not progression.interrupted,
        "skipped_frames": progression.skipped,
        "frame_counts": dict(progression.counts),
        **summary_dict(coverage, regions),
    }
    (request.out / "summary.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _ego_outline(frames: Dataset[Frame]) -> Any:  # noqa: ANN401
    if not isinstance(frames, SimulatedFrames):
        return None
    (x0, y0, _), (x1, y1, _) = frames.scene.ego_box.lower_m, frames.scene.ego_box.upper_m
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def _sensor_marks(rig: str | None) -> list[SensorMark]:
    return (
        []
        if rig is None
        else [
            SensorMark(
                name=sensor.name,
                x_m=sensor.mount.x_m,
                y_m=sensor.mount.y_m,
                yaw_deg=sensor.mount.yaw_deg,
                horizontal_fov_deg=sensor.horizontal_fov_deg,
                range_m=sensor.max_range_m,
            )
            for sensor in Rig.load(rig).sensors
        ]
    )
