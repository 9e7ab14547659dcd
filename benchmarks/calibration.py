"""Do the standard errors tell the truth? Their size beside the spread of the numbers over independent seeds.

40 runs over other cities, traffic and reference rays: the spread of a number over the runs is its true error, which
the reported one should equal within a factor of 1.3. The same is asked of the differences between two rigs in the
same frames. Spread-out steps and steps that follow each other are compared.
"""

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path

import torch

from torchcover import BevGrid, CoverageMetric, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import EvenReference

RIG, OTHER = "front_roof_32", "front_roof_128"
GRID = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.5)
REGIONS = forward_regions()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--steps", type=int, default=128)
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--every", type=float, nargs="+", default=[10.0, 0.1], help="seconds between steps")
    parser.add_argument("--out", type=Path, default=Path("out/calibration.json"))
    options = parser.parse_args([] if __name__ != "__main__" else None)
    results = {}
    for every_s in options.every:
        jobs = [(seed, every_s, options.steps, options.rays) for seed in range(options.seeds)]
        with ProcessPoolExecutor(2) as pool:
            results[every_s] = list(pool.map(estimates, jobs))
        print(f"\n{options.seeds} runs of {options.steps} steps, one every {every_s:g} s, {options.rays:,} rays\n")
        for subject in results[every_s][0]:
            print(f"{subject}:\n")
            report([run[subject] for run in results[every_s]])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results) + "\n", encoding="utf-8")


def estimates(job):
    """One run: [value, error] of each region, band and quantity, for a rig and for the difference to it."""
    seed, every_s, steps, rays = job
    torch.set_num_threads(1)
    reference = EvenReference(areas=tuple((region.x, region.y) for region in REGIONS), rays=rays)
    rigs = {rig: rig for rig in (RIG, OTHER)}
    frames = SimulatedFrames("urban", rigs=rigs, steps=steps, seed=seed, every_s=every_s, reference_sensor=reference)
    observers = {
        rig: CoverageObserver(CoverageMetric(GRID, max_radius=GRID.diagonal_m, blocks=16), rig) for rig in rigs
    }
    observe(frames, observers.values())
    coverages = {rig: observer.compute() for rig, observer in observers.items()}
    subjects = {RIG: [], f"{OTHER} - {RIG}": []}
    for region, height in product(REGIONS, GRID.heights):
        own, other = (coverages[rig].estimate(region, height) for rig in (RIG, OTHER))
        for rows, estimate in zip(subjects.values(), (own, other.minus(own)), strict=True):
            rows.extend(zip(estimate.value.tolist(), estimate.error.tolist(), strict=True))
    return subjects


def report(runs):
    """The tables of docs/measured/error_bars.md: spread over the runs, root mean square of the errors, their ratio."""
    print("| region | height | quantity | mean | spread | reported error | spread / error |")
    print("|---|---|---|---|---|---|---|")
    names = product([region.name for region in REGIONS], GRID.heights, ["radius (m)", "detection"])
    ratios = []
    for at, name in enumerate(names):
        values, errors = torch.tensor([run[at] for run in runs], dtype=torch.float64).T
        spread, error = values.std().item(), errors.square().mean().sqrt().item()
        ratios.append(spread / error)
        print(f"| {' | '.join(name)} | {values.mean():.4f} | {spread:.4f} | {error:.4f} | {ratios[-1]:.2f} |")
    middle = math.exp(sum(map(math.log, ratios)) / len(ratios))
    print(f"\nspread over error: {min(ratios):.2f} to {max(ratios):.2f}, geometric mean {middle:.2f}\n")


if __name__ == "__main__":
    main()
