"""Optimisers at equal time: points left below the top of made-up surfaces, or gains of real rigs with --scenario."""

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
import torch

from benchmarks import table
from torchcover.placement import OPTIMISERS, CommonInstants, Cube, SearchSpace
from torchcover.placement.racing import gains, race

# The roof, and the roof with all angles of the LiDAR: 3 and 5 numbers.
FREE = {"x_m": (-0.6, 0.8), "z_m": (1.68, 1.85), "pitch_deg": (-10.0, 15.0)}
SPACES = {3: FREE, 5: FREE | {"y_m": (-0.4, 0.4), "roll_deg": (-10.0, 10.0)}}


def surface(numbers, seed):
    """What a place in the unit cube is worth: smooth, bent in some direction, with ripples; its top is 0."""
    draws = np.random.default_rng([seed, numbers])
    top, steep = draws.uniform(0.1, 0.9, numbers), draws.uniform(0.2, 3.0, numbers)
    turn = np.linalg.qr(draws.normal(size=(numbers, numbers)))[0]
    waves = draws.uniform(2.0, 6.0, numbers)

    def worth(unit):
        off = (np.asarray(unit) - top) @ turn
        ripple = 0.02 * (1 - np.cos(waves * off)).sum()
        return -float((steep * off**2).sum() + ripple) / numbers

    return worth


def on_surface(name, numbers, seed, budget_s, candidate_s):
    """How far below the top the best is: a candidate costs so much, and a proposal what it takes this processor."""
    worth, middle = surface(numbers, seed), np.full(numbers, 0.5)
    optimiser, zero, best, spent_s, asked = (
        OPTIMISERS[name](Cube((0,) * numbers, middle), seed),
        worth(middle),
        0.0,
        0.0,
        0,
    )
    while spent_s < budget_s:
        began = time.process_time()
        unit = optimiser.ask()
        value = worth(unit) - zero
        optimiser.tell(unit, value, 0.0)
        spent_s += candidate_s + time.process_time() - began
        best, asked = max(best, value), asked + 1
    return -100 * (zero + best), asked


def on_rigs(name, numbers, seed, budget_s, scenario):
    """Gain on the instants of a search in processor time, with racing, and no control beside it."""
    space = SearchSpace(name="roof", start="front_roof_32", scenario=scenario, free={"roof": SPACES[numbers]},
                        objectives={"near and far": {"region": ("20m", "80m")}})  # fmt: skip
    with CommonInstants(space.scenarios, space.asked, seed=seed) as instants:
        began, asked = time.process_time(), 0
        best = start = tuple(instants.prefixes(space.start))
        middle = np.array([one.unit(space.start_values()[one.name]) for one in space.variables])
        optimiser, most = OPTIMISERS[name](Cube((0,) * numbers, middle), seed), 0.0
        while time.process_time() - began < budget_s:
            unit, asked = optimiser.ask(), asked + 1
            values = {one.name: one.at(share) for one, share in zip(space.variables, unit.tolist(), strict=True)}
            try:
                found = race(instants.prefixes(space.rig(values, "candidate")), [best])
            except ValueError:
                optimiser.tell(unit, np.nan, 0.0)
                continue
            gain, error = gains(found[-1].estimate, best[len(found) - 1].estimate)
            left = np.sqrt(1 - found[-1].instants / len(instants))
            value = float(gain[0]) + most
            optimiser.tell(unit, value, float(np.nan_to_num(error[0] * left)))
            if found[-1].instants == start[-1].instants and value > most:
                best, most = found, value
    return 100 * most, asked


def main(arguments=()):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budget-s", type=float, default=12.0)
    parser.add_argument("--candidate-s", type=float, default=0.2)
    parser.add_argument("--numbers", default="3,5")
    parser.add_argument("--optimisers", default="gp,random")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--scenario", help="real rigs in it, 90 s each, instead of surfaces")
    parser.add_argument("--processes", type=int, default=1, help="runs at the same time: budgets are processor time")
    options = parser.parse_args(arguments)
    if options.scenario:
        each = partial(on_rigs, budget_s=options.budget_s, scenario=options.scenario)
    else:
        each = partial(on_surface, budget_s=options.budget_s, candidate_s=options.candidate_s)
    names = options.optimisers.split(",")
    cases = [(name, numbers) for numbers in map(int, options.numbers.split(",")) for name in names]
    with ProcessPoolExecutor(options.processes, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        runs = {case: [pool.submit(each, *case, seed) for seed in range(options.seeds)] for case in cases}
    rows = []
    for numbers in map(int, options.numbers.split(",")):
        found, asked = {}, {}
        for name in names:
            found[name], asked[name] = np.array([run.result() for run in runs[name, numbers]]).T
        for name, each in found.items():
            against = each - found.get("random", np.nan)
            error = against.std(ddof=1) / np.sqrt(len(against))
            left = f"{np.median(each):.2f}", f"{each.mean():.2f}"
            rows.append((numbers, name, f"{asked[name].mean():.0f}", *left, f"{against.mean():+.2f} ± {error:.2f}"))
    told = "gain (median)" if options.scenario else "left below (median)"
    table(("numbers", "optimiser", "candidates", told, "mean", "more than random's ± error"), rows)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
