"""Searches in which nothing can be better, and how often they say that something is; and what a requirement costs."""

import argparse
import time

import torch

from benchmarks import table
from benchmarks.placement import SPACE
from torchcover.placement import PlacementSearch, SearchSpace, run_search

# A full turn looks the same whichever way it begins, but for what its rays happen to hit.
TURNING = {"type": "lidar", "name": "top", "mount": {"x_m": 0.2, "z_m": 1.9}, "channels": 32, "columns": 1000,
           "vertical_fov_deg": [-30, 10], "horizontal_fov_deg": 360, "range_noise_m": 0.03,
           "max_range_m": 120}  # fmt: skip
NOTHING = {
    "name": "nothing",
    "start": {"name": "turning", "vehicle": "suv", "sensors": [TURNING]},
    "scenario": "urban",
    "free": {"top": {"yaw_deg": (-170.0, 170.0)}},
    "not_worse": ["80m"],
    "objectives": {"near": {"region": "20m"}},
}
CHILD = {"target": "child", "at": {"within_m": 3.0, "sides": ["front"]}, "points": 5}


def searched(space, **plan):
    """A result, and its seconds of processor time."""
    torch.set_num_threads(1)
    began = time.process_time()
    result = run_search(PlacementSearch(SearchSpace.model_validate(space), **plan))
    return result, time.process_time() - began


def main(arguments=()):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--searches", type=int, default=20)
    parser.add_argument("--evaluations", type=int, default=24)
    options = parser.parse_args(arguments)
    given = {"evaluations": 6, "worlds": 2, "fresh_worlds": 8, "rays": 4096}
    found = [searched(NOTHING, seed=2 * seed, **given)[0] for seed in range(options.searches)]
    tests = [one.test for one in found if one.test is not None]
    worse = sum(any(change.is_worse for change in one.changes) for one in tests)
    better = sum(any(change.p <= 0.05 and change.test.gain > 0 for change in one.changes) for one in tests)
    gained = sum(one.best.gains[0].test.significant for one in found if one.best.gains)
    numbers = max((len(one.changes) for one in tests), default=0)
    rows = [(len(found), len(tests), numbers, worse, better, gained)] * bool(found)
    table(("searches", "tested", "numbers each", "say worse", "say better", "say gained or lost"), rows)
    print()
    plan, rows = {"evaluations": options.evaluations}, []
    for what, more in (("none", {}), ("a child ahead", {"requirements": {"requirements": [CHILD]}})):
        result, seconds = searched(SPACE | more, **plan)
        gained = result.best.gains[0].words if result.best.gains else "-"
        rows.append((what, seconds, seconds / (rows[0][1] if rows else seconds), gained))
    table(("requirement", "seconds", "times", "gained (points)"), rows)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
