"""Rigs against the same instants: what all three experiments do."""

from rich.progress import track

from torchcover import CoverageMetric
from torchcover.data import SimulatedFrames
from torchcover.simulation import ReferenceSensor


def coverage_of(rigs, grid, options):
    """Coverage of each rig, by name, over the same steps of one scenario and against the same reference clouds."""
    side = options.rays
    frames = SimulatedFrames(
        options.scenario,
        rigs={name: name for name in rigs},
        steps=options.steps,
        seed=options.seed,
        reference=ReferenceSensor(rows=side, columns=side),
    )
    metrics = {name: CoverageMetric(grid, max_radius=grid.diagonal_m) for name in rigs}
    for index in track(range(len(frames)), description=" ".join(rigs)):
        frame = frames[index]
        for name, metric in metrics.items():
            metric.update(frame.sensors[name], frame.reference)
    return {name: metric.compute() for name, metric in metrics.items()}
