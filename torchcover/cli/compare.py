"""`torchcover compare`: several rigs in the same frames; one table, maps side by side, differences."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from torchcover import __version__
from torchcover.cli.run import Progression, accumulate, check_out, device_called, new_metric, outline_m, sensor_marks
from torchcover.coverage import Coverage, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.report import comparison_dict, comparison_tables, draw_comparison, narrowest_width, write_comparison
from torchcover.simulation import Rig


@dataclass(frozen=True)
class Request:
    """What the user asked for; the options of `torchcover compare`."""

    rigs: tuple[str, ...]
    scenario: str
    steps: int
    seed: int
    out: Path
    cell: float
    thresholds: tuple[float, ...]
    device: str
    workers: int


def run(request: Request) -> None:
    """Compare, print the table, write the files. What was computed is written even if the run was cut short.

    Raises:
        ValueError: The request makes no sense.
        FileNotFoundError: A name or a file is unknown.
        KeyboardInterrupt: The user stopped the run.
    """
    if len(request.rigs) < 2:
        raise ValueError(f"compare needs at least two rigs; got {request.rigs[0]!r} only (for one: `evaluate`)")
    check_out(request.out)
    device = device_called(request.device)
    rigs = {name: Rig.load(rig) for name, rig in zip(distinct_names(request.rigs), request.rigs, strict=True)}
    metrics = [new_metric(request.cell, request.thresholds, device) for _ in rigs]
    frames = SimulatedFrames(request.scenario, rigs=rigs, steps=request.steps, seed=request.seed)
    progression = accumulate(frames, metrics, device, workers=request.workers)
    coverages = {name: metric.compute() for name, metric in zip(rigs, metrics, strict=True)}
    _write(coverages, request, progression, frames)
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
    (request.out / "coverage").mkdir(parents=True, exist_ok=True)
    regions = forward_regions()
    _print(comparison_tables(coverages, regions), list(coverages))
    for name, coverage in coverages.items():
        coverage.save(request.out / "coverage" / f"{name}.npz")
    write_comparison(coverages, regions, request.out / "summary.csv")
    content: dict[str, Any] = {
        "torchcover": __version__,
        "rigs": dict(zip(coverages, request.rigs, strict=True)),
        "scenario": request.scenario,
        "seed": request.seed,
        "device": request.device,
        "seconds": round(progression.seconds, 3),
        "complete": progression.complete,
        "frame_counts": dict(progression.counts),
        **comparison_dict(coverages, regions),
    }
    (request.out / "summary.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    maps = draw_comparison(
        coverages,
        request.out / "maps",
        ego_outline_m=outline_m(frames.scene.ego_box),
        sensors={name: sensor_marks(rig) for name, rig in frames.rigs.items()},
    )
    Console().print(
        f"Wrote summary.json, summary.csv, {len(coverages)} coverage files and {len(maps)} maps to {request.out}",
        soft_wrap=True,
    )


def _print(tables: Sequence[Table], rigs: Sequence[str]) -> None:
    console = Console()
    # Rather lines that are too long than numbers that are cut off; in a file the names are whole too.
    console.width = max(console.width, narrowest_width(tables, rigs if console.is_terminal else ()))
    for table in tables:
        console.print(table)
