"""The command `torchcover record` and its options."""

from collections.abc import Iterator

import typer

from torchcover.cli import options


def record(
    rig: options.Rig,
    out: options.RecordingOut,
    scenario: options.ScenarioOrNone = None,
    steps: options.RecordedSteps = None,
    seed: options.Seed = 0,
    vehicle: options.Vehicle = None,
    every: options.Every = None,
    reference: options.RecordedReference = None,
    rays: options.Rays = None,
    layout: options.Layout = "folder",
) -> None:
    """Write what a simulated rig sees as a recording, for other tools and for `evaluate --frames`."""
    from torchcover.evaluation.settings import DEFAULT_SCENARIO, DEFAULT_STEPS, spread_s
    from torchcover.simulation import (
        RegionsOfInterest,
        Rig,
        Scenario,
        SimulatedFrames,
        reference_called,
        with_ego,
        write_recording,
    )

    carried = Rig.load(rig)
    world = with_ego(Scenario.load(scenario or DEFAULT_SCENARIO), {carried.name: carried}, vehicle)
    frames = SimulatedFrames(
        world,
        carried,
        steps=steps or DEFAULT_STEPS,
        seed=seed,
        every_s=spread_s(world, every),
        reference_sensor=reference_called(reference, rays, RegionsOfInterest().around(world.ego_box().outline_m)),
        boxes=True,
    )
    frames.simulator.check_run(frames.steps)
    write_recording(frames, out, layout, progress=_with_a_bar)
    typer.echo(f"Wrote {len(frames)} frames to {out}; read them with: torchcover evaluate --frames {out}")


def _with_a_bar(steps: range) -> Iterator[int]:
    from torchcover.evaluation.progress import progress_of

    with progress_of(len(steps), "record", shown=True) as bar:
        for step in steps:
            yield step
            bar.advance(len(steps))
