"""Placement search: the roof LiDAR's gain in fresh cities, and its optimiser against random search on an emulator."""

import argparse
import time

import numpy as np
import torch

from benchmarks import table
from torchcover.placement import OPTIMISERS, Cube, PlacementSearch, SearchSpace, run_search
from torchcover.placement.optimisers.gp_model import GaussianProcess

SPACE = {
    "name": "roof",
    "start": "front_roof_32",
    "scenario": "urban",
    "free": {"roof": {"x_m": (-0.6, 0.8), "z_m": (1.68, 1.85), "pitch_deg": (-10.0, 15.0)}},
    "objectives": {"near and far": {"region": ("20m", "80m")}},
}
REPEATS, TURNS = 10, (10, 20, 30)
NAMES = ("gp", "random")


def gains(result):
    """A row for what each arm found, by each estimate."""
    for pick in result.picks:
        if pick.is_start:
            yield pick.arm, "-", "nothing better than the start", "", "", "", ""
        for gain in pick.gains:
            places = ", ".join(f"{value:.2f}" for value in pick.evaluation.values.values())
            test = gain.test
            searched, better = f"{100 * gain.search_gain:+.2f}", f"{test.better} of {test.blocks}"
            yield pick.arm, gain.estimate, places, searched, gain.words, f"{gain.t:.1f}", better


def emulator(search):
    """The gain that a Gaussian process of all evaluations expects: (n, 3) places -> (n,)."""
    arms = search.arms.values()
    told = [(arm, at) for arm in arms for at in range(len(arm.evaluations)) if np.isfinite(arm.gains[at, 0])]
    values = [torch.tensor([getattr(arm, name)[at, 0] for arm, at in told]) for name in ("gains", "left")]
    places = torch.from_numpy(np.array([arm.evaluations[at].unit for arm, at in told]))
    model = GaussianProcess.fitted((0, 0, 0), places, *values)
    return lambda units: model.predict(torch.from_numpy(np.atleast_2d(units)))[0].numpy()


def regrets(name, worth, start, seed):
    """How far below the top the best is, after so many turns."""
    top = max(worth(np.random.default_rng(0).random((100_000, 3))).max(), 0.0)
    optimiser, zero, best, found = OPTIMISERS[name](Cube((0, 0, 0), start), seed), worth(start)[0], 0.0, []
    for turn in range(1, max(TURNS) + 1):
        unit = optimiser.ask()
        gain = float(worth(unit)[0] - zero)
        optimiser.tell(unit, gain, 0.0)
        best = max(best, gain)
        if turn in TURNS:
            found.append(top - zero - best)
    return found


def main(arguments=()):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budget-s", type=float, default=600.0)
    parser.add_argument("--evaluations", type=int)
    parser.add_argument("--worlds", type=int, default=6)
    parser.add_argument("--fresh-worlds", type=int, default=16)
    parser.add_argument("--rays", type=int, default=16_384)
    parser.add_argument("--estimate", default="known")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    options = parser.parse_args(arguments)
    budget = {"evaluations": options.evaluations} if options.evaluations else {"budget_s": options.budget_s}
    given = {"worlds": options.worlds, "fresh_worlds": options.fresh_worlds, "rays": options.rays}
    torch.set_num_threads(1)
    search = PlacementSearch(SearchSpace.model_validate(SPACE), estimate=options.estimate, **budget, **given)
    start = time.process_time()
    result = run_search(search)
    seconds = time.process_time() - start
    spent = [f"{name} {len(arm.evaluations) - 1}" for name, arm in search.arms.items()]
    print(f"{search.plan.optimiser_name}, {len(search.instants)} instants; candidates: {', '.join(spent)}; "
          f"{seconds:.0f} s of processor time in this process; racing saved {search.share_saved:.0%}.\n")  # fmt: skip
    table(
        ("found by", "estimate", "x, z (m), pitch (°)", "search", "fresh (points)", "t", "better"), list(gains(result))
    )
    worth, where = emulator(search), search.evaluations[0].unit
    runs = {name: np.array([regrets(name, worth, where, seed) for seed in range(options.repeats)]) for name in NAMES}
    print(f"\nOn an emulator of these evaluations, {options.repeats} repeats, points below its top (median):\n")
    rows = [
        (name, *(f"{100 * regret:.2f}" for regret in np.median(run, axis=0)),
         f"{(run[:, -1] <= runs['random'][:, -1]).sum()} of {options.repeats}")
        for name, run in runs.items()
    ]  # fmt: skip
    table(("optimiser", *(f"after {turns}" for turns in TURNS), "at least as good as random"), rows)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
