"""`torchcover evaluate`: frames in; table, maps and files out."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from torch.utils.data import Dataset, Subset

from torchcover.cli.explain import explanation, left_out
from torchcover.cli.run import (
    DEFAULT_SCENARIO,
    Progression,
    accumulate,
    check_out,
    device_called,
    new_metric,
    outline_m,
    sensor_views,
)
from torchcover.cli.settings import Settings, reference_note, reference_record, run_record, simulated_frames
from torchcover.cli.stopping import TargetWatch, outcome
from torchcover.coverage import Coverage, forward_regions
from torchcover.data import Frame, RecordedFrames, SimulatedFrames
from torchcover.report import RENDERERS, CoverageTable, map_figures, print_table, table_dict, write_figures
from torchcover.simulation import Rig


@dataclass(frozen=True)
class Request:
    """What the user asked for; the options of `torchcover evaluate`."""

    rig: str | None
    scenario: str | None
    recording: Path | None
    skip_bad_frames: bool
    settings: Settings


def run(request: Request) -> None:
    """Evaluate, print the table, write the files. What was computed is written even if the run was cut short.

    Raises:
        ValueError: The request makes no sense, or a frame was bad.
        FileNotFoundError: A name or a file is unknown.
        KeyboardInterrupt: The user stopped the run.
    """
    settings = request.settings
    check_out(settings.out)
    device = device_called(settings.device)
    metric = new_metric(settings.cell, settings.thresholds, device)
    frames = _frames(request)
    progression = accumulate(
        frames,
        [metric],
        device,
        workers=settings.workers,
        skip_bad_frames=request.skip_bad_frames,
        watch=TargetWatch(settings.target, {_name(request): metric}, forward_regions()) if settings.target else None,
    )
    _write(metric.compute(), request, progression, frames)
    progression.raise_failure()


def _frames(request: Request) -> Dataset[Frame]:
    settings = request.settings
    if request.recording is not None:
        if request.scenario is not None:
            raise ValueError("--scenario and --frames exclude each other: simulate a scenario or read a recording")
        if any(option is not None for option in (settings.reference, settings.rays, settings.every_s)):
            raise ValueError(
                "--reference, --rays and --every are for simulations; a recording has its reference points"
            )
        recorded = RecordedFrames(request.recording)
        return recorded if settings.steps is None else Subset(recorded, range(min(settings.steps, len(recorded))))
    if request.rig is None:
        raise ValueError("which rig? Give a built-in name (see `torchcover list`) or a YAML file, or use --frames")
    return simulated_frames(settings, request.scenario or DEFAULT_SCENARIO, rig=request.rig)


def _name(request: Request) -> str:
    return request.rig or str(request.recording)


def _write(coverage: Coverage, request: Request, progression: Progression, frames: Dataset[Frame]) -> None:
    out, regions, console = request.settings.out, forward_regions(), Console()
    out.mkdir(parents=True, exist_ok=True)
    target_record, target_lines = outcome(request.settings.target, {_name(request): coverage}, regions)
    record = {
        **_run_record(request, progression, frames, coverage.counts["steps"]),
        "target_error": target_record,
        "left_out": left_out(progression.counts, [coverage]),
    }
    notes = [reference_note(record["reference"])] if record["reference"] else []
    name = _name(request)
    table = CoverageTable.of({name: coverage}, regions, notes)
    print_table(table, console)
    if request.settings.explain:
        console.print(explanation(record["left_out"]))
    for line in progression.skipped:
        console.print(f"skipped: {line}", style="yellow", markup=False)
    for line in target_lines:
        console.print(line, markup=False, soft_wrap=True)
    coverage.save(out / "coverage.npz")
    (out / "summary.csv").write_text(RENDERERS["csv"](table), encoding="utf-8")
    record |= table_dict(table)
    (out / "summary.json").write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    figures = map_figures(
        {name: coverage},
        ego_outline_m=_ego_outline(frames),
        sensors={} if request.rig is None else {name: sensor_views(Rig.load(request.rig))},
        errors=request.settings.error_maps,
    )
    maps = write_figures(figures, out / "maps")
    console.print(f"Wrote summary.json, summary.csv, coverage.npz and {len(maps)} maps to {out}", soft_wrap=True)


def _run_record(request: Request, progression: Progression, frames: Dataset[Frame], steps: int) -> dict[str, Any]:
    settings, simulated = request.settings, request.recording is None
    return {
        "rig": request.rig,
        "scenario": request.scenario or DEFAULT_SCENARIO if simulated else None,
        "frames": None if simulated else str(request.recording),
        "seed": settings.seed if simulated else None,
        "reference": reference_record(settings, progression, frames, steps) if simulated else None,
        **run_record(settings, progression),
        "skipped_frames": progression.skipped,
    }


def _ego_outline(frames: Dataset[Frame]) -> NDArray[np.float64] | None:
    return outline_m(frames.scene.ego_box) if isinstance(frames, SimulatedFrames) else None
