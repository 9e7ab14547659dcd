"""`torchcover record`."""

from collections.abc import Iterator
from pathlib import Path

import typer

from torchcover.data import RegionsOfInterest, SimulatedFrames, reference_called, write_recording
from torchcover.evaluation.progress import progress_of
from torchcover.evaluation.settings import DEFAULT_SCENARIO, DEFAULT_STEPS, spread_s
from torchcover.simulation import Rig, Scenario, with_ego


def run(
    rig: str,
    out: Path,
    layout: str,
    *,
    scenario: str | None,
    steps: int | None,
    seed: int,
    vehicle: str | None,
    every_s: float | None,
    reference: str | None,
    rays: int | None,
) -> None:
    """Simulate as `evaluate` does, and write what is seen.

    Raises:
        ValueError: A folder that is not empty, a layout that cannot hold the rig, or as `SimulatedFrames`.
        FileNotFoundError: An unknown name or file.
    """
    carried = Rig.load(rig)
    world = with_ego(Scenario.load(scenario or DEFAULT_SCENARIO), {carried.name: carried}, vehicle)
    frames = SimulatedFrames(
        world,
        carried,
        steps=steps or DEFAULT_STEPS,
        seed=seed,
        every_s=spread_s(world, every_s),
        reference_sensor=reference_called(reference, rays, RegionsOfInterest().around(world.ego_box().outline_m)),
        boxes=True,
    )
    frames.simulator.check_run(frames.steps)
    write_recording(frames, out, layout, progress=_with_a_bar)
    typer.echo(f"Wrote {len(frames)} frames to {out}; read them with: torchcover evaluate --frames {out}")


def _with_a_bar(steps: range) -> Iterator[int]:
    with progress_of(len(steps), "record", shown=True) as bar:
        for step in steps:
            yield step
            bar.advance(len(steps))
