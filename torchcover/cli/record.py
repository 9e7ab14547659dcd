"""`torchcover record`."""

from pathlib import Path

import typer

from torchcover.data import SimulatedFrames, reference_called, write_recording
from torchcover.evaluation.settings import DEFAULT_SCENARIO, DEFAULT_STEPS, spread_s
from torchcover.simulation import Rig, Scenario


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
    world = Scenario.load(scenario or DEFAULT_SCENARIO)
    frames = SimulatedFrames(
        world,
        Rig.load(rig),
        steps=steps or DEFAULT_STEPS,
        seed=seed,
        vehicle=vehicle,
        every_s=spread_s(world, every_s),
        reference_sensor=reference_called(reference, rays),
        boxes=True,
    )
    frames.simulator.check_run(frames.steps)
    write_recording(frames, out, layout)
    typer.echo(f"Wrote {len(frames)} frames to {out}; read them with: torchcover evaluate --frames {out}")
