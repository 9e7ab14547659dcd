"""Rays spread evenly, with and without weights, beside the paper's: do they answer the same question?"""

from dataclasses import replace

import torch

from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric, Region
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import EvenReference, PaperReference

STEPS = 192
GRID = BevGrid(x=(-40.0, 80.0), y=(-20.0, 20.0), cell=1.0)
REGION = Region("all", GRID.x, GRID.y)
# Cells that both know well: those that hardly any step saw differ by chance.
MIN_FRAMES = 8


class Unweighted(CoverageObserver):
    """Coverage as if every reference point weighed the same."""

    def update(self, frame):
        super().update(replace(frame, reference_weights=None))


def measured(frames, observer):
    """Coverage of a run."""
    coverage = observer(CoverageMetric(GRID, max_radius=GRID.diagonal_m))
    observe(frames, [coverage])
    return coverage.compute()


def main():
    """Print the mean radius and detection over the cells that all three know."""
    paper = SimulatedFrames("courtyard", "front_roof_128", steps=STEPS, reference_sensor=PaperReference(512, 512))
    even = paper.with_reference_sensor(EvenReference((((0.0, 20.0), (-5.0, 5.0)), (GRID.x, GRID.y)), rays=65_536))
    runs = {
        "the paper's 512 x 512": measured(paper, CoverageObserver),
        "65,536 even, weighted": measured(even, CoverageObserver),
        "65,536 even, unweighted": measured(even, Unweighted),
    }
    known = torch.stack([run.probed_steps >= MIN_FRAMES for run in runs.values()]).all(dim=0)
    rows = []
    for name, run in runs.items():
        numbers = [mean for band, mask in enumerate(known) for mean in _means(run, band, mask)]
        rows.append((name, *(f"{number:.4f}" for number in numbers)))
    bands = [f"{height}: {what}" for height in GRID.heights for what in ("radius (m)", "detection")]
    table(("reference", *bands), rows)


def _means(run, band, mask):
    return run.radius[band][mask].mean().item(), run.detection[0, band][mask].mean().item()


if __name__ == "__main__":
    main()
