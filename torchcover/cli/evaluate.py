"""`torchcover evaluate`: frames in; table, maps and files out."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from torch.utils.data import Dataset, Subset

from torchcover import __version__
from torchcover.cli.run import (
    DEFAULT_SCENARIO,
    DEFAULT_STEPS,
    Progression,
    accumulate,
    check_out,
    device_called,
    new_metric,
    outline_m,
    sensor_marks,
)
from torchcover.coverage import Coverage, Region, forward_regions
from torchcover.data import Frame, RecordedFrames, SimulatedFrames
from torchcover.report import coverage_table, draw_maps, summary_dict, write_csv
from torchcover.simulation import Rig


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


def run(request: Request) -> None:
    """Evaluate, print the table, write the files. What was computed is written even if the run was cut short.

    Raises:
        ValueError: The request makes no sense, or a frame was bad.
        FileNotFoundError: A name or a file is unknown.
        KeyboardInterrupt: The user stopped the run.
    """
    check_out(request.out)
    device = device_called(request.device)
    metric = new_metric(request.cell, request.thresholds, device)
    frames = _frames(request)
    progression = accumulate(frames, [metric], device, workers=request.workers, skip_bad_frames=request.skip_bad_frames)
    _write(metric.compute(), request, progression, frames)
    progression.raise_failure()


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
        coverage,
        request.out / "maps",
        ego_outline_m=_ego_outline(frames),
        sensors=[] if request.rig is None else sensor_marks(Rig.load(request.rig)),
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
        "complete": progression.complete,
        "skipped_frames": progression.skipped,
        "frame_counts": dict(progression.counts),
        **summary_dict(coverage, regions),
    }
    (request.out / "summary.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _ego_outline(frames: Dataset[Frame]) -> NDArray[np.float64] | None:
    return outline_m(frames.scene.ego_box) if isinstance(frames, SimulatedFrames) else None
