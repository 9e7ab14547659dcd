"""Do 95 % intervals cover? Runs are put together from simulated cities, again and again, and asked for the mean of all.

Each run draws cities at random, with replacement, and goes through the six steps of each, 10 s apart, as an evaluation
does. The truth is the number over all the cities; what is counted is how often the interval of a run holds it:
of the twelve numbers of the regions at several lengths, of cells, and of runs that a target error has ended.
"""

import argparse
import math
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch

from benchmarks.timing import table
from torchcover import forward_regions, nearest
from torchcover.coverage import BevGrid, MeanOfMeans
from torchcover.coverage.binning import mean_per_cell
from torchcover.data import SimulatedFrames
from torchcover.estimation import Estimate, ratio_errors, student
from torchcover.evaluation.measuring import BLOCKS
from torchcover.evaluation.target_error import LOOKS_IN_A_ROW, MAX_GROWTH, MIN_GROWTH, MIN_STEPS
from torchcover.simulation.regions_of_interest import GRID_X_M, GRID_Y_M

RIG, EVERY_S = "front_roof_128", 10.0
GRID = BevGrid(x=GRID_X_M, y=GRID_Y_M, cell=0.25, band_frame="ground")
REGIONS = forward_regions()
PLACES = [(region, height) for region in REGIONS for height in GRID.heights]
ALL = range(len(PLACES))
QUANTITIES = MeanOfMeans((0.4,)).quantities
NAMES = [f"{region.name} {height} {what}" for region, height in PLACES for what in ("radius", "detection")]
# A cell has a truth if so many cities have probed it.
CITIES_OF_A_CELL = 20


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--steps", type=int, default=720, help="steps to simulate, six a city")
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--sums", type=Path, help="simulated if missing (out/calibration_SCENARIO_SEED_STEPS.npz)")
    parser.add_argument("--blind-side", type=float, default=student.BLIND_SIDE, help="to try another factor")
    options = parser.parse_args([] if __name__ != "__main__" else None)
    student.BLIND_SIDE = options.blind_side
    name = f"calibration_{options.scenario}_{options.seed}_{options.steps}.npz"
    path = options.sums or Path("out") / name
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        halves = [range(options.steps // 2), range(options.steps // 2, options.steps)]
        with ProcessPoolExecutor(2) as pool:
            parts = list(pool.map(simulated, halves, [options.scenario] * 2, [options.seed] * 2))
        np.savez(path, **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    with np.load(path) as sums:
        cities = Cities(**sums)
    random = np.random.default_rng(0)
    print(
        f"{len(cities.steps)} cities of {options.scenario}, {RIG}; of {options.runs} runs, how many intervals cover\n"
    )
    lengths = {f"{steps} steps": cities.covered(random, steps, options.runs) for steps in (64, 256, 1024)}
    stopped = {
        f"stopped, target as at {steps}": cities.stopped(random, steps, options.runs // 4) for steps in (96, 192)
    }
    columns = lengths | stopped
    rows = [(name, *(f"{share[at]:.3f}" for share in columns.values())) for at, name in enumerate(NAMES)]
    rows += [(f"**{f.__name__}**", *(f"{f(share):.3f}" for share in columns.values())) for f in (np.mean, np.min)]
    table(("number", *columns), rows)
    print("\nCells of 0.25 m, number +- two errors:\n")
    kinds = [(measure, steps) for measure in ("area", "known") for steps in (64, 256)]
    rows = [(*kind, *cities.covered_cells(random, *kind, runs=10)) for kind in kinds]
    table(("measure", "steps", "cells with an error", "radius", "detection", "errors of 0"), rows)


def simulated(steps, scenario, seed):
    """The sums of some steps: over each region and band, and the means of each cell."""
    torch.set_num_threads(1)
    frames = SimulatedFrames(scenario, RIG, steps=steps.stop, seed=seed, every_s=EVERY_S)
    city, over_regions, cells = [], [], []
    for index in steps:
        frame = frames[index]
        height, m2 = frame.reference_heights_m, frame.reference_weights.double()
        points = torch.cat([frame.reference[:, :2], height[:, None]], dim=1).double()
        radius = nearest(frame.reference, frame.sensor, max_distance=GRID.diagonal_m).distance.double()
        each = torch.stack([radius.clamp(max=GRID.diagonal_m), (radius <= 0.4).double()])
        city.append(frame.place_in_time)
        over_regions.append([_sums(points, m2, each, *place) for place in PLACES])
        cell = GRID.cell_of(frame.reference, height)
        inside = cell >= 0
        means = mean_per_cell(cell[inside], each[:, inside], GRID.cells, m2[inside])
        seen_m2 = torch.bincount(cell[inside], m2[inside], minlength=GRID.cells)[means.cell]
        cells.append(np.column_stack([np.full(len(means.cell), index), means.cell, seen_m2, *means.mean]))
    return {"city": np.array(city), "over_regions": np.array(over_regions), "cells": np.concatenate(cells)}


def _sums(points, m2, each, region, height):
    """Square metres, and the sums of radius and detection over them."""
    x, y, z = points.T
    inside = torch.ones_like(x, dtype=torch.bool)
    for along, (low, high) in ((x, region.x), (y, region.y), (z, GRID.heights[height])):
        inside &= (along >= low) & (along < high)
    return [float(m2[inside].sum()), *(each[:, inside] * m2[inside]).sum(dim=1).tolist()]


class Cities:
    """The sums of simulated steps, city by city.

    Args:
        city: (n,) city of each step.
        over_regions: (n, 6, 3) square metres, and the sums of radius and detection.
        cells: (k, 5) step, cell, square metres, mean radius and mean detection of what was probed.
    """

    def __init__(self, city, over_regions, cells):
        self.over_regions = torch.from_numpy(over_regions)
        steps = [np.flatnonzero(city == one) for one in np.unique(city)]
        self.steps = [one for one in steps if len(one) >= 6]
        all_of_them = self.over_regions[np.concatenate(self.steps)].sum(dim=0)
        self.truth = (all_of_them[:, 1:] / all_of_them[:, :1]).flatten().tolist()
        self._index_cells(city, cells)

    def _index_cells(self, city, cells):
        """Keep the cells that enough cities have probed, and number them."""
        pairs = np.unique(np.column_stack([city[cells[:, 0].astype(int)], cells[:, 1]]), axis=0)
        known, probed_by = np.unique(pairs[:, 1], return_counts=True)
        known = known[probed_by >= CITIES_OF_A_CELL]
        cells = cells[np.isin(cells[:, 1], known) & np.isin(cells[:, 0], np.concatenate(self.steps))]
        at = cells[:, 0].astype(int), slice(None), np.searchsorted(known, cells[:, 1])
        # By measure: what the ratio is over, radius and detection.
        self.cell_sums = {name: np.zeros((len(city), 3, len(known)), dtype=np.float32) for name in ("area", "known")}
        self.cell_sums["area"][at] = cells[:, 2:3] * np.column_stack([np.ones(len(cells)), cells[:, 3:]])
        self.cell_sums["known"][at] = np.column_stack([np.ones(len(cells)), cells[:, 3:]])

    def drawn(self, random, steps):
        """The blocks of a run: steps of whole cities, as a metric with 16 blocks has them."""
        cities = [self.steps[one] for one in random.integers(len(self.steps), size=steps // 6 + 1)]
        cities = np.split(np.concatenate(cities)[:steps], np.cumsum([len(city) for city in cities])[:-1])
        cities = [city for city in cities if len(city)]
        length = 2 ** max(0, math.ceil(math.log2(len(cities) / BLOCKS)))
        return [np.concatenate(cities[at : at + length]) for at in range(0, len(cities), length)]

    def numbers(self, blocks, places=ALL):
        """Value, error and degrees of freedom of the radius and detection of each place."""
        sums = torch.stack([self.over_regions[block].sum(dim=0) for block in blocks])
        lengths = torch.tensor([len(block) for block in blocks])
        found = []
        for at in places:
            estimate = Estimate.of_ratios(QUANTITIES, sums[:, at, 0], sums[:, at, 1:], lengths)
            found += zip(estimate.value.tolist(), estimate.error.tolist(), strict=True)
        return [(value, error, len(blocks) - 1) for value, error in found]

    def covers(self, number, at):
        """Whether the interval around a number holds the truth."""
        low, high = student.interval95(*number, QUANTITIES[at % 2])
        return low <= self.truth[at] <= high

    def covered(self, random, steps, runs):
        """(12,) shares of the intervals that cover."""
        found = [self.numbers(self.drawn(random, steps)) for _ in range(runs)]
        return np.mean([[self.covers(number, at) for at, number in enumerate(run)] for run in found], axis=0)

    def stopped(self, random, steps, runs):
        """(12,) as `covered`, of runs that ended when this number alone had the error of so many steps."""
        errors = [[error for _, error, _ in self.numbers(self.drawn(random, steps))] for _ in range(runs)]
        targets = np.sqrt(np.square(errors).mean(axis=0))
        return np.array([np.mean([self._stops(random, *one) for _ in range(runs)]) for one in enumerate(targets)])

    def _stops(self, random, at, target, most=1536):
        """Whether the interval of a number covers when its error has made the run end, as `TargetWatch` does."""
        order = random.integers(len(self.steps), size=most // 6)
        steps, good = MIN_STEPS, 0
        while True:
            number = self.numbers(self.drawn(_Replay(order), steps), [at // 2])[at % 2]
            error = number[1]
            good = good + 1 if error <= target else 0
            if good == LOOKS_IN_A_ROW or steps == most:
                return self.covers(number, at)
            needed = steps * max(1.0, error / target) ** 2
            steps = min(most, math.ceil(min(max(needed, MIN_GROWTH * steps), MAX_GROWTH * steps)))

    def covered_cells(self, random, measure, steps, runs):
        """How many cells had an error, and how many of their radii and detections two errors cover; errors of 0."""
        cells, covered, zero = 0, np.zeros(2), 0
        of_steps = self.cell_sums[measure]
        total = torch.from_numpy(of_steps.sum(axis=0, dtype=np.float64))
        for _ in range(runs):
            drawn = self.drawn(random, steps)
            sums = torch.from_numpy(np.stack([of_steps[block].sum(axis=0, dtype=np.float64) for block in drawn]))
            for at, quantity in enumerate(QUANTITIES, 1):
                error = ratio_errors(sums[:, 0], sums[:, at], quantity.unit)
                ratio = sums[:, at].sum(dim=0) / sums[:, 0].sum(dim=0)
                known = error.isfinite()
                holds = (ratio - total[at] / total[0]).abs()[known] <= 2 * error[known]
                covered[at - 1] += int(holds.sum())
                zero += int((error == 0).sum())
            cells += int(known.sum())
        return cells, *(f"{share:.3f}" for share in covered / cells), zero


class _Replay:
    """Draws what was drawn before, for a run that grows."""

    def __init__(self, order):
        self.order = order

    def integers(self, _, size):
        return self.order[:size]


if __name__ == "__main__":
    main()
