"""The command `study` and its options."""

from pathlib import Path
from typing import Annotated

import typer

from torchcover.cli import options


def study(
    rig: options.Rig,
    scenario: Annotated[str, typer.Option(help="Scenario: a built-in name or a YAML file.")] = "courtyard",
    rays: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Rays of the reference at each step; may be repeated (1024, 4096 and 16384)."),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Most steps of a run.")] = 128,
    runs: Annotated[int, typer.Option(min=1, help="Runs of so many steps that errors are averaged over.")] = 2,
    long_run: Annotated[
        Path | None,
        typer.Option(
            help="What runs are measured against: coverage.npz of `evaluate` with another seed, or long_run.npz of an "
            "earlier study. Not given: a run is made for it."
        ),
    ] = None,
    long_run_steps: Annotated[int, typer.Option(min=8, help="Steps of that run.")] = 512,
    every: options.Every = None,
    seed: options.Seed = 0,
    vehicle: options.Vehicle = None,
    out: options.Out = Path("out"),
    cell: Annotated[float, typer.Option(help="Side of a grid cell in metres.")] = 0.25,
    threshold: Annotated[float, typer.Option(help="Detection threshold in metres.")] = 0.4,
) -> None:
    """Measure error against run time for numbers of rays and of steps, and recommend a setting."""
    from torchcover.cli.printing import print_study
    from torchcover.evaluation import StudyPlan, claimed, error_against_time, rank_count

    if rank_count() > 1:
        raise ValueError(
            "study measures run times, which ranks beside each other would change: run it without torchrun"
        )
    plan = StudyPlan(
        rig=rig,
        scenario=scenario,
        rays=tuple(sorted(set(rays or StudyPlan.rays))),
        steps=steps,
        runs=runs,
        long_run=long_run,
        long_run_steps=long_run_steps,
        every_s=every,
        seed=seed,
        vehicle=vehicle,
        cell_m=cell,
        threshold_m=threshold,
    )
    with claimed(out):
        found = error_against_time(plan, progress=True)
        found.save(out)
        print_study(found, out)
