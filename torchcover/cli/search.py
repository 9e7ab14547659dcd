"""The command `search` and its options."""

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from torchcover.cli import options

UNITS_S = {"s": 1.0, "min": 60.0, "h": 3600.0}


def search(
    space: Annotated[Path, typer.Argument(help="YAML file of what is free, and of what a good rig is.")],
    budget: Annotated[
        str | None, typer.Option(help="Time for all of it: 30min (if nothing is given), 90s, 2h; or --evaluations.")
    ] = None,
    evaluations: Annotated[
        int | None, typer.Option(min=1, help="Candidates instead of a time: the same ones whatever the machine.")
    ] = None,
    optimiser: Annotated[
        str, typer.Option(help="auto, gp (Gaussian process), cmaes (extra `search`), enumerate (choices) or random.")
    ] = "auto",
    measure: Annotated[
        Literal["area", "known"],
        typer.Option(help="What a score is: `area`, the share of the visible surface, or `known`, of the known cells."),
    ] = "area",
    worlds: Annotated[int | None, typer.Option(min=1, help="Worlds of each scenario to search in (6).")] = None,
    fresh_worlds: Annotated[int | None, typer.Option(min=1, help="Fresh worlds of each to test in (16).")] = None,
    per_world: Annotated[int | None, typer.Option(min=1, help="Instants of each world (3).")] = None,
    every: Annotated[float | None, typer.Option(help="Seconds between two of them (20).")] = None,
    rays: Annotated[int | None, typer.Option(min=1, help="Rays of the reference at each instant (16384).")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search and of its worlds.")] = 0,
    test_seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the fresh worlds, another one (the next).")
    ] = None,
    workers: Annotated[int, typer.Option(min=0, help="Processes that score; 0 scores in this one.")] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the evaluations in --out, whatever ended that search.")
    ] = False,
    out: options.Out = Path("out/search"),
) -> None:
    """Look for better places for sensors, beside a random search, and test what was found in fresh worlds."""
    from torchcover.cli.search_run import run

    if budget is not None and evaluations is not None:
        raise ValueError("--budget, --evaluations: one of them; both are given")
    given = {"worlds": worlds, "fresh_worlds": fresh_worlds, "per_world": per_world, "every_s": every,
             "rays": rays}  # fmt: skip
    run(
        space,
        out,
        resume=resume,
        evaluations=evaluations,
        budget_s=None if budget is None else parsed_budget(budget),
        optimiser=optimiser,
        measure=measure,
        seed=seed,
        test_seed=test_seed,
        workers=workers,
        **{name: value for name, value in given.items() if value is not None},
    )


def parsed_budget(text: str) -> float:
    """Seconds.

    Raises:
        ValueError: No number with a unit.

    Example:
        >>> parsed_budget("30min"), parsed_budget("1.5h"), parsed_budget("90 s")
        (1800.0, 5400.0, 90.0)
    """
    match = re.fullmatch(r"\s*(\d{1,9}(?:\.\d{1,9})?)\s*(s|min|h)\s*", text)
    if match is None:
        raise ValueError(f"--budget: a time is needed, as in 90s, 30min or 2h; got {text!r}")
    return float(match[1]) * UNITS_S[match[2]]
