"""What the commands print."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from torchcover.evaluation import Omission, Result, Study, StudyPlan, WorkPoint, study_table
from torchcover.report import narrowest_width, print_table


def print_result(result: Result, files: Sequence[Path], out: Path, *, explain: bool) -> None:
    """The tables, what the run left out if that is asked for, and where the files are."""
    console = Console()
    print_table(result.table, console)
    if explain and result.left_out:
        console.print(_explanation(result.left_out))
    for line in result.run.skipped if result.run else ():
        console.print(f"skipped: {line}", style="yellow", markup=False)
    for line in result.target_lines:
        console.print(line, markup=False, soft_wrap=True)
    maps = sum(path.suffix == ".png" for path in files)
    coverages = f"{len(result.coverages)} coverage files" if result.is_comparison else "coverage.npz"
    console.print(f"Wrote summary.json, summary.csv, {coverages} and {maps} maps to {out}", soft_wrap=True)


def print_study(study: Study, out: Path) -> None:
    """The tables, and the settings that are recommended."""
    console, plan, floor = Console(), study.plan, study.floor
    tables = study_table(study.points), _stage_table(study.stages)
    # Rather lines that are too long than numbers that are cut off.
    wide = Console(width=max(console.width, narrowest_width(tables)))
    for table in tables:
        wide.print(table)
    console.print(
        f"The long run ({plan.long_run_steps:,} steps of {plan.long_run_rays:,} rays, other seed) has itself an error "
        f"of {100 * floor['detection_error']:.2f} percentage points and {floor['radius_error_m']:.3f} m."
    )
    for wanted, point in study.recommended.items():
        console.print(advice(wanted, point, plan), soft_wrap=True)
    console.print(f"Wrote study.json and work_precision.png to {out}", soft_wrap=True)


def advice(wanted: float, point: WorkPoint | None, plan: StudyPlan) -> str:
    """The options of `evaluate` that reach an error; the size of the cells, which decides about it, among them."""
    if point is None:
        return f"For {100 * wanted:g} percentage points of detection: not reached within {plan.steps:,} steps."
    every = "" if plan.every_s is None else f" --every {plan.every_s:g}"
    return (
        f"For {100 * wanted:g} percentage points of detection: --reference {point.reference} --rays {point.rays} "
        f"--steps {point.steps} --cell {plan.cell_m:g}{every} ({point.seconds:.0f} s)."
    )


def _explanation(omissions: Sequence[Omission]) -> Table:
    table = Table(title="Left out, for this run did not need it", title_justify="left")
    table.add_column("what")
    for column in ("count", "of", "share"):
        table.add_column(column, justify="right")
    for omission in omissions:
        count, of = omission.count, omission.of
        numbers = ("", "", "") if count is None or of is None else (f"{count:,}", f"{of:,}", f"{count / of:.1%}")
        table.add_row(Text(omission.what), *numbers)
    return table


def _stage_table(stages: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(title="One step: where the time goes", title_justify="left")
    table.add_column("reference")
    for column in ("rays", "step (ms)", "rays (%)", "search (%)", "binning (%)", "search by cdist (ms)"):
        table.add_column(column, justify="right")
    for stage in stages:
        parts = [stage["rays_s"], stage["search_s"], stage["binning_s"]]
        shares = [f"{100 * part / sum(parts):.0f}" for part in parts]
        brute_force = "" if math.isnan(stage["cdist_s"]) else f"{1000 * stage['cdist_s']:.0f}"
        table.add_row(stage["reference"], f"{stage['rays']:,}", f"{1000 * sum(parts):.0f}", *shares, brute_force)
    return table
