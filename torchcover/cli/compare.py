"""`torchcover compare`: several rigs in the same frames; one table, maps side by side, differences."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from torchcover.cli.explain import explanation, left_out
from torchcover.cli.run import Progression, accumulate, check_out, device_called, new_metric, outline_m, sensor_views
from torchcover.cli.settings import Settings, reference_note, reference_record, run_record, simulated_frames
from torchcover.cli.stopping import TargetWatch, outcome
from torchcover.coverage import Coverage, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.report import RENDERERS, CoverageTable, map_figures, print_table, table_dict, write_figures
from torchcover.simulation import Rig


@dataclass(frozen=True)
class Request:
    """What the user asked for; the options of `torchcover compare`."""

    rigs: tuple[str, ...]
    scenario: str
    settings: Settings


def run(request: Request) -> None:
    """Compare, print the table, write the files. What was computed is written even if the run was cut short.

    Raises:
        ValueError: The request makes no sense.
        FileNotFoundError: A name or a file is unknown.
        KeyboardInterrupt: The user stopped the run.
    """
    if len(request.rigs) < 2:
        raise ValueError(f"compare needs at least two rigs; got {request.rigs[0]!r} only (for one: `evaluate`)")
    settings = request.settings
    check_out(settings.out)
    device = device_called(settings.device)
    rigs = {name: Rig.load(rig) for name, rig in zip(distinct_names(request.rigs), request.rigs, strict=True)}
    metrics = {name: new_metric(settings.cell, settings.thresholds, device) for name in rigs}
    frames = simulated_frames(settings, request.scenario, rigs=rigs)
    watch = TargetWatch(settings.target, metrics, forward_regions()) if settings.target else None
    progression = accumulate(frames, list(metrics.values()), device, workers=settings.workers, watch=watch)
    _write({name: metric.compute() for name, metric in metrics.items()}, request, progression, frames)
    progression.raise_failure()


def distinct_names(rigs: Sequence[str]) -> list[str]:
    """What the columns are called: the built-in name, or the stem of the file; numbered where two would be the same.

    Example:
        >>> distinct_names(["kitti", "old/my.yaml", "new/my.yaml"])
        ['kitti', 'my', 'my_2']
    """
    names: list[str] = []
    for rig in rigs:
        stem = Path(rig).stem if Path(rig).suffix in (".yaml", ".yml") else rig
        name, number = stem, 2
        while name.lower() in (other.lower() for other in names):
            name, number = f"{stem}_{number}", number + 1
        names.append(name)
    return names


def _write(
    coverages: Mapping[str, Coverage], request: Request, progression: Progression, frames: SimulatedFrames
) -> None:
    settings, regions, console = request.settings, forward_regions(), Console()
    (settings.out / "coverage").mkdir(parents=True, exist_ok=True)
    steps = next(iter(coverages.values())).counts["steps"]
    reference = reference_record(settings, progression, frames, steps)
    target_record, target_lines = outcome(settings.target, coverages, regions)
    table = CoverageTable.of(coverages, regions, [reference_note(reference)])
    print_table(table, console)
    omissions = left_out(progression.counts, list(coverages.values()))
    if settings.explain:
        console.print(explanation(omissions))
    for line in target_lines:
        console.print(line, markup=False, soft_wrap=True)
    for name, coverage in coverages.items():
        coverage.save(settings.out / "coverage" / f"{name}.npz")
    (settings.out / "summary.csv").write_text(RENDERERS["csv"](table), encoding="utf-8")
    content: dict[str, Any] = {
        "rigs": dict(zip(coverages, request.rigs, strict=True)),
        "scenario": request.scenario,
        "seed": settings.seed,
        "reference": reference,
        **run_record(settings, progression),
        "target_error": target_record,
        "left_out": omissions,
        **table_dict(table),
    }
    (settings.out / "summary.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    figures = map_figures(
        coverages,
        ego_outline_m=outline_m(frames.scene.ego_box),
        sensors={name: sensor_views(rig) for name, rig in frames.rigs.items()},
        errors=settings.error_maps,
    )
    maps = write_figures(figures, settings.out / "maps")
    console.print(
        f"Wrote summary.json, summary.csv, {len(coverages)} coverage files and {len(maps)} maps to {settings.out}",
        soft_wrap=True,
    )
