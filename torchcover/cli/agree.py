"""The command `torchcover agree` and its options."""

from pathlib import Path
from typing import Annotated

import typer

from torchcover.cli import options


def agree(
    paper: Annotated[str, typer.Argument(help="Published placements: place3d2024.")],
    scenario: Annotated[str, typer.Option(help="Scenario: a built-in name or a YAML file.")] = "urban",
    metrics: Annotated[
        str, typer.Option(help="Metrics of others, as in `k_cover,point_density`, or `all`; see `compare --metrics`.")
    ] = "all",
    steps: Annotated[int, typer.Option(min=1, help="Steps to simulate.")] = 64,
    seed: options.Seed = 0,
    every: options.Every = None,
    workers: options.Workers = 0,
    out: options.Out = Path("out/agree"),
) -> None:
    """Rank published placements by metrics, and by the detectors that were trained on them; say what that is worth."""
    from torchcover.cli.printing import print_agreement
    from torchcover.evaluation import agree, claimed, rank_count
    from torchcover.published import metric_names

    if rank_count() > 1:
        raise ValueError("agree: ranks do not share it; run it without torchrun, with --workers")
    with claimed(out):
        study = agree(
            paper,
            scenario,
            metrics=metric_names(metrics),
            steps=steps,
            seed=seed,
            every_s=every,
            workers=workers,
            progress=True,
        )
        files = study.save(out)
    print_agreement(study, files, out)
