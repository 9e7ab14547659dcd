"""The command `torchcover targets` and its options."""

from pathlib import Path
from typing import Annotated

import typer

from torchcover.cli import options


def targets(
    rig: options.Rig,
    target: Annotated[
        str,
        typer.Option(
            help="What is put around the vehicle: child (1.10 m), adult, dog, cyclist, pole, a built-in vehicle, the "
            "YAML file of one, or a mesh file."
        ),
    ] = "child",
    scenario: Annotated[
        str | None, typer.Option(help="Scenario: a built-in name or a YAML file. Not given: flat ground, nothing else.")
    ] = None,
    vehicle: options.Vehicle = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps to average (16, or 1 where nothing moves and no sensor is noisy).")
    ] = None,
    every: options.Every = None,
    raster: Annotated[
        str | None, typer.Option(help="Cells x0,x1,y0,y1,step in metres (within 5 m of the vehicle, step 0.2).")
    ] = None,
    heading: Annotated[
        str, typer.Option(help="Side that it turns to the vehicle: narrow, wide, or its yaw in degrees.")
    ] = "narrow",
    hits: Annotated[int, typer.Option(min=1, help="Points that are enough to see it.")] = 5,
    threshold: Annotated[
        float, typer.Option(help="Detection threshold in metres, for the share of its surface.")
    ] = 0.4,
    require: Annotated[
        Path | None, typer.Option(help="YAML file of requirements: exit code 1 if one is not met.")
    ] = None,
    seed: options.Seed = 0,
    rerun: Annotated[
        Path | None, typer.Option(help="Write the map to this .rrd file, for the Rerun viewer (extra `rerun`).")
    ] = None,
    out: options.Out = Path("out/targets"),
) -> None:
    """Put a body at every place around the vehicle: how much of it is seen, where not, and whether that is enough."""
    from torchcover.cli.target_run import run

    code = run(
        rig,
        target,
        scenario,
        vehicle=vehicle,
        raster=raster,
        steps=steps,
        every_s=every,
        seed=seed,
        hits=hits,
        threshold_m=threshold,
        heading=heading,
        require=require,
        rerun=rerun,
        out=out,
    )
    raise typer.Exit(code)
