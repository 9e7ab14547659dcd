"""What the metric leaves out: off and on, for one frame of `urban`."""

import torch

from benchmarks.timing import compare, table
from torchcover import BevGrid, CoverageMetric
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference

GRID = BevGrid(x=(0.0, 80.0), y=(-20.0, 20.0), cell=0.25)
# As large as everything that the reference can hit.
EVERYWHERE = BevGrid(x=(-260.0, 260.0), y=(-260.0, 260.0), cell=0.25, heights={"all": (-50.0, 100.0)})


def main():
    """Print the time of an update with more and with less to do."""
    torch.manual_seed(0)
    frame = SimulatedFrames("urban", "front_roof_128", steps=1, reference_sensor=PaperReference(512, 512))[0]

    def update(grid=GRID, **options):
        metric = CoverageMetric(grid, (0.4,), **options)
        return lambda: metric.update(frame.sensor, frame.reference, place_in_time=0)

    everything = {"maximum": True, "pooled": True, "quantiles": (0.5,), "blocks": 16}
    pairs = {
        "search beyond the largest threshold (`max_radius=0.4`)": (update(), update(max_radius=0.4)),
        "reference points outside the grid": (update(EVERYWHERE), update()),
        "maxima, pooled means, quantiles, blocks": (update(max_radius=GRID.diagonal_m, **everything), update()),
    }
    rows = []
    for name, (off, on) in pairs.items():
        (off_s, on_s), _ = compare(off, on, rounds=5)
        rows.append((name, 1000 * off_s, 1000 * on_s, off_s / on_s))
    table(("left out", "off (ms)", "on (ms)", "off / on"), rows)


if __name__ == "__main__":
    main()
