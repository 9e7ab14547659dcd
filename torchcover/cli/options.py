"""The options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

Seed = Annotated[int, typer.Option(min=0, help="Seed of the simulation.")]
Out = Annotated[Path, typer.Option(help="Folder for the results.")]
Cell = Annotated[float, typer.Option(help="Side of a grid cell in metres.")]
Thresholds = Annotated[
    list[float] | None, typer.Option("--threshold", help="Detection threshold in metres (0.4); may be repeated.")
]
Reference = Annotated[
    str | None,
    typer.Option(help="Reference sensor: `even`, rays spread over the regions and the grid (default), or `paper`."),
]
Rays = Annotated[
    int | None,
    typer.Option(min=1, help="Rays of the reference sensor at each step (even: 262144; paper: 1048576, a square)."),
]
Every = Annotated[
    float | None,
    typer.Option(
        help="Seconds between one step and the next; steps that follow each other are alike. Not given: 10 in traffic, "
        "which starts anew in another city every minute, else the scenario's own time step."
    ),
]
TargetErrors = Annotated[
    list[str] | None,
    typer.Option(
        "--target-error",
        help="Stop once every number is this good: 0.1% (standard error of each detection, in percentage points) or "
        "0.02m (of each radius); both may be given. --steps is then the most steps (4096).",
    ),
]
ErrorMaps = Annotated[bool, typer.Option("--error-maps", help="Draw maps of the standard errors too.")]
Explain = Annotated[bool, typer.Option("--explain", help="Say what was left out because the scene did not need it.")]
Device = Annotated[str, typer.Option(help="Where the search and the sums run: cpu, cuda, cuda:1, ...")]
Workers = Annotated[int, typer.Option(min=0, help="Processes that make frames; 0 makes them in this one.")]
