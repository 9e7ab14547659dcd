"""Do numbers depend on how many rays were spent? Each estimator beside its own value with a million.

The same instants for all. The distance is the root mean square over the paper's regions and bands: percentage points
of detection / per cent of the radius.
"""

import argparse
from dataclasses import replace

import torch

from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver
from torchcover.simulation import REFERENCE_SENSORS

RAYS = (1024, 4096, 16_384, 65_536, 262_144, 1_048_576)
REGIONS = forward_regions()
AREAS = tuple((region.x, region.y) for region in REGIONS)
GRID = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.25)
# What a row is called, its reference sensor, and its estimator.
ESTIMATORS = (
    ("paper's pattern, known cells", "paper", "known"),
    ("surface points, by area", "surface", "area"),
)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", default="front_roof_128")
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=float, default=10.0, help="seconds between steps")
    options = parser.parse_args([] if __name__ != "__main__" else None)
    coverages = measured(options)
    rows = []
    for name, kind, estimator in ESTIMATORS:
        values = [numbers(coverages[kind, rays], estimator) for rays in RAYS]
        rows.append((name, *(distance(value, values[-1]) for value in values[:-1])))
    table(("estimator", *(f"{rays:,}" for rays in RAYS[:-1])), rows)


def measured(options):
    """The coverage of each pattern and number of rays, all fed in the same order: a world is built once."""
    base = SimulatedFrames(options.scenario, options.rig, steps=options.steps, seed=options.seed, every_s=options.every)
    kinds = dict.fromkeys(kind for _, kind, _ in ESTIMATORS)
    runs = {}
    for kind in kinds:
        for rays in RAYS:
            reference = REFERENCE_SENSORS[kind].from_rays(AREAS, rays)
            frames = base.with_reference_sensor(reference)
            metric = CoverageMetric(
                replace(GRID, band_frame=reference.band_frame),
                max_radius=GRID.diagonal_m,
                square_metres=kind == "surface",
            )
            runs[kind, rays] = frames, CoverageObserver(metric)
    for index in range(options.steps):
        for frames, observer in runs.values():
            observer.update(frames[index])
    return {key: observer.compute() for key, (_, observer) in runs.items()}


def numbers(coverage, estimator):
    """(regions x bands, 2): radius and detection."""
    return torch.stack(
        [coverage.estimate(region, height, estimator).value for region in REGIONS for height in GRID.heights]
    )


def distance(value, truth):
    """How far from its own value with a million rays."""
    radius = (value[:, 0] / truth[:, 0] - 1).square().nanmean().sqrt().item()
    detection = (value[:, 1] - truth[:, 1]).square().nanmean().sqrt().item()
    return f"{100 * detection:.2f} / {100 * radius:.1f}"


if __name__ == "__main__":
    main()
