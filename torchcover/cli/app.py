"""The commands and their options."""

import sys
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="torchcover",
    help="Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

# What is raised for any mistake in options and arguments. Typer names only descendants of it.
USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]


def main() -> None:
    """Run the command line; a user's mistake ends in one line on stderr and exit code 2."""
    try:
        code = typer.main.get_command(app).main(standalone_mode=False)
    except USAGE_ERROR as error:
        _fail(error.format_message())  # type: ignore[attr-defined]  # the typed name is private
    except (ValueError, TypeError, OSError) as error:
        _fail(str(error))
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)


@app.callback(invoke_without_command=True)
def version(show: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False) -> None:
    """Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor."""
    if show:
        from torchcover import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.command()
def evaluate(
    rig: Annotated[
        str | None, typer.Argument(help="Rig: a built-in name (see `list`) or a YAML file. Optional with --frames.")
    ] = None,
    scenario: Annotated[str | None, typer.Option(help="Scenario: a built-in name or a YAML file.")] = None,
    frames: Annotated[
        Path | None, typer.Option(help="A recording instead: a folder with sensor/NAME.* beside reference/NAME.*")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps to simulate (64), or most frames of a recording to use (all).")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out"),
    cell: Annotated[float, typer.Option(help="Side of a grid cell in metres.")] = 0.25,
    threshold: Annotated[
        list[float] | None, typer.Option(help="Detection threshold in metres (0.4); may be repeated.")
    ] = None,
    device: Annotated[str, typer.Option(help="Where the search and the sums run: cpu, cuda, cuda:1, ...")] = "cpu",
    workers: Annotated[int, typer.Option(min=0, help="Processes that make frames; 0 makes them in this one.")] = 0,
    skip_bad_frames: Annotated[
        bool, typer.Option("--skip-bad-frames", help="Skip and count frames that cannot be read, instead of stopping.")
    ] = False,
) -> None:
    """Measure the coverage of a rig: a table, maps, and files to compare and to log."""
    from torchcover.cli.evaluate import Request, run

    run(
        Request(
            rig=rig,
            scenario=scenario,
            recording=frames,
            steps=steps,
            seed=seed,
            out=out,
            cell=cell,
            thresholds=tuple(threshold or (0.4,)),
            device=device,
            workers=workers,
            skip_bad_frames=skip_bad_frames,
        )
    )


@app.command()
def compare(
    rigs: Annotated[list[str], typer.Argument(help="Rigs: built-in names (see `list`) or YAML files; two or more.")],
    scenario: Annotated[str, typer.Option(help="Scenario: a built-in name or a YAML file.")] = "courtyard",
    steps: Annotated[int, typer.Option(min=1, help="Steps to simulate.")] = 64,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out"),
    cell: Annotated[float, typer.Option(help="Side of a grid cell in metres.")] = 0.25,
    threshold: Annotated[
        list[float] | None, typer.Option(help="Detection threshold in metres (0.4); may be repeated.")
    ] = None,
    device: Annotated[str, typer.Option(help="Where the search and the sums run: cpu, cuda, cuda:1, ...")] = "cpu",
    workers: Annotated[int, typer.Option(min=0, help="Processes that make frames; 0 makes them in this one.")] = 0,
) -> None:
    """Compare rigs in the same frames: a table with the better values marked, maps side by side, differences."""
    from torchcover.cli.compare import Request, run

    run(
        Request(
            rigs=tuple(rigs),
            scenario=scenario,
            steps=steps,
            seed=seed,
            out=out,
            cell=cell,
            thresholds=tuple(threshold or (0.4,)),
            device=device,
            workers=workers,
        )
    )


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="Rig or scenario: a built-in name (see `list`) or a YAML file.")],
    scenario: Annotated[
        str | None, typer.Option(help="For a rig: the scenario whose ego carries it (courtyard).")
    ] = None,
    rig: Annotated[str | None, typer.Option(help="For a scenario: whose points to draw (front_roof_128).")] = None,
    step: Annotated[int | None, typer.Option(min=0, help="For a scenario: which time step (0).")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="For a scenario: seed of the simulation (0).")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the picture.")] = Path("out"),
) -> None:
    """Draw a rig on its vehicle, or a frame of a scenario from above."""
    from torchcover.cli.show import run

    run(name, scenario=scenario, rig=rig, step=step, seed=seed, out=out)


@app.command("list")
def list_builtin() -> None:
    """List the built-in rigs and scenarios."""
    from torchcover.cli.listing import run

    run()


def _fail(message: str) -> None:
    typer.echo(f"torchcover: {' '.join(message.split())}", err=True)
    sys.exit(2)
