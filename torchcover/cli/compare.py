"""`torchcover compare`: several rigs in the same frames; one table, maps side by side, differences."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from torchcover.cli.explain import explanation, left_out
from torchcover.cli.run import Progression, accumulate, check_out, device_called, new_metric, sensor_marks
from torchcover.cli.settings import Settings, reference_note, reference_record, run_record, simulated_frames
from torchcover.cli.stopping import TargetWatch, outcome
from torchcover.coverage import Coverage, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.report import comparison_dict, comparison_tables, draw_comparison, narrowest_width, write_comparison
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
    _print(comparison_tables(coverages, regions, [reference_note(reference)]), list(coverages))
    omissions = left_out(progression.counts, list(coverages.values()))
    if settings.explain:
        console.print(explanation(omissions))
    for line in target_lines:
        console.print(line, markup=False, soft_wrap=True)
    for name, coverage in coverages.items():
        coverage.save(settings.out / "coverage" / f"{name}.npz")
    write_comparison(coverages, regions, settings.out / "summary.csv")
    content: dict[str, Any] = {
        "rigs": dict(zip(coverages, request.rigs, strict=True)),
        "scenario": request.scenario,
        "seed": settings.seed,
        "reference": reference,
        **run_record(settings, progression),
        "target_error": target_record,
        "left_out": omissions,
        **comparison_dict(coverages, regions),
    }
    (settings.out / "summary.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    maps = draw_comparison(
        coverages,
        settings.out / "maps",
        ego_outline_m=frames.scenario.ego_box().outline_m,
        sensors={name: sensor_marks(rig) for name, rig in frames.rigs.items()},
        errors=settings.error_maps,
    )
    console.print(
        f"Wrote summary.json, summary.csv, {len(coverages)} coverage files and {len(maps)} maps to {settings.out}",
        soft_wrap=True,
    )


def _print(tables: Sequence[Table], rigs: Sequence[str]) -> None:
    console = Console()
    # Rather lines that are too long than numbers that are cut off; in a file the names are whole too.
    console.width = max(console.width, narrowest_width(tables, rigs if console.is_terminal else ()))
    for table in tables:
        console.print(table)
