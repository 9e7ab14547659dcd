"""Placement: the optimizer against random candidates, pairing of rigs, selections of sensors, and false alarms.

The optimizer and random search get the same number of candidates and the same frames; gains are percentage points of
the objective over the start of the space, in the search itself.
"""

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import torch

from benchmarks import table
from torchcover.placement import (
    CommonFrames,
    Objective,
    OptimizerParams,
    PlacementSearch,
    SearchSpace,
    SelectionSpace,
    run_search,
)
from torchcover.placement.search import compute_improvements
from torchcover.placement.selection import compute_point_weights, observe_points
from torchcover.placement.selection_solver import CandidateCoverage, SelectionLimits, select_sensors
from torchcover.simulation import Rig

NEAR = ("front_3m", "rear_3m", "left_3m", "right_3m")
FRAMES = {"num_scenes": 4, "frames_per_scene": 1, "frame_interval_s": 5.0, "num_rays": 4096}


def roof_lidar(name, vehicle, model, **mounts):
    sensors = [{"type": "lidar", "name": key, "model": model, "mount": mount} for key, mount in mounts.items()]
    return {"name": name, "vehicle": vehicle, "sensors": sensors}


PAIR = roof_lidar("pair", "suv", "velodyne_vlp16", left={"x_m": -0.8, "y_m": 0.5, "z_m": 1.75},
                  right={"x_m": -0.8, "y_m": -0.5, "z_m": 1.75})  # fmt: skip
MODELS = ("velodyne_vlp16", "velodyne_vlp32c", "hesai_pandar64", "hesai_at128", "velodyne_hdl32e")
SIDE = {"x_m": (-1.6, 0.3), "z_above_body_m": (0.05, 0.4), "pitch_deg": (-10.0, 40.0)}
SPACES = {
    "x, z, pitch on a van; near ground": {
        "start": roof_lidar("van", "van", "velodyne_vlp32c", roof={"x_m": 0.5, "z_m": 2.8}),
        "free": {"roof": {"x_m": (-2.4, 2.6), "z_m": (1.2, 3.2), "pitch_deg": (-15.0, 45.0)}},
        "objectives": {"near": {"region": NEAR, "band": "ground"}},
    },
    "one of 5 models, x, z, pitch": {
        "start": "front_roof_32",
        "free": {
            "roof": {"model": MODELS, "x_m": (-0.6, 0.8), "z_above_body_m": (0.05, 0.5), "pitch_deg": (-10.0, 25.0)}
        },
        "objectives": {"around": {"region": (*NEAR, "20m")}},
    },
    "two LiDARs, 10 numbers": {
        "start": PAIR,
        "free": {
            "left": {**SIDE, "y_m": (0.1, 0.7), "yaw_deg": (-45.0, 120.0)},
            "right": {**SIDE, "y_m": (-0.7, -0.1), "yaw_deg": (-120.0, 45.0)},
        },
        "constraints": {"min_distance_m": 0.4, "max_self_hit_share": 0.35},
        "objectives": {"sides": {"region": NEAR}},
    },
    "one of 3 mount regions, pose on it": {
        "start": PAIR,
        "free": {
            "left": {"region": ("fender_left", "mirror_left", "roof"), "height_m": (0.05, 0.3),
                     "yaw_deg": (-90.0, 90.0), "pitch_deg": (-10.0, 40.0)}
        },
        "constraints": {"max_self_hit_share": 0.6},
        "objectives": {"sides": {"region": ("left_3m", "front_3m")}},
    },
}  # fmt: skip
STRATEGIES = {"optimizer": OptimizerParams(), "random": OptimizerParams(num_startup_candidates=0, random_interval=1)}


def search_gains(name, seeds, evaluations):
    """Best gain of each strategy for each seed, (strategies, seeds), on the same frames."""
    torch.set_num_threads(1)
    space = SearchSpace.model_validate({"name": "space", "scenario": "parking", **SPACES[name]})
    frames = CommonFrames(space.scenarios, space.scored_objectives, **FRAMES)
    gains = np.zeros((len(STRATEGIES), seeds))
    for row, params in zip(gains, STRATEGIES.values(), strict=True):
        for seed in range(seeds):
            search = PlacementSearch(
                space, num_evaluations=evaluations, seed=seed, optimizer_params=params, make_frames=lambda *_: frames
            )
            while (candidate := search.ask()) is not None:
                search.evaluate(candidate)
            row[seed] = 100 * np.nanmax(search.improvements)
    return gains


def compare_strategies(seeds, evaluations, processes):
    rows = []
    with ProcessPoolExecutor(processes) as pool:
        runs = {name: pool.submit(search_gains, name, seeds, evaluations) for name in SPACES}
        for name, run in runs.items():
            optimizer, random = run.result()
            difference = optimizer - random
            error = difference.std(ddof=1) / np.sqrt(seeds) if seeds > 1 else np.nan
            medians = f"{np.median(optimizer):.1f}", f"{np.median(random):.1f}"
            better = f"{(difference > 0).sum()} of {seeds}"
            rows.append((name, *medians, f"{difference.mean():+.1f} ± {error:.1f}", better))
    table(("free", "optimizer", "random", "difference", "better in"), rows)


def compare_pairs(rigs=24, num_scenes=16):
    """Standard error of the difference of two rigs on the same and on other frames."""
    objective = {"near and far": Objective(region=["20m", "80m"])}
    start, (roof,) = Rig.load("front_roof_32"), Rig.load("front_roof_32").sensors
    each = [start]
    for number in range(1, rigs):
        x_m, z_m, pitch_deg = np.random.default_rng(number).uniform((-0.6, 1.68, -10.0), (0.8, 1.85, 15.0)).tolist()
        mount = roof.mount.model_copy(update={"x_m": x_m, "z_m": z_m, "pitch_deg": pitch_deg})
        each.append(start.model_copy(update={"sensors": (roof.model_copy(update={"mount": mount}),)}))
    rows = []
    for measure in ("area", "cells"):
        with CommonFrames("urban", objective, num_scenes=num_scenes, average=measure) as frames:
            began_s = time.process_time()
            first, *others = [frames.score(rig).estimate for rig in each]
            score_s = (time.process_time() - began_s) / len(each) / len(frames)
        paired = np.median([compute_improvements(other, first)[1][0] for other in others])
        alone = np.median([float(torch.hypot(other.error, first.error)[0]) for other in others])
        rows.append((measure, f"{100 * alone:.2f}", f"{100 * paired:.2f}", f"{(alone / paired) ** 2:.0f}"))
    table(("average", "unpaired (points)", "paired (points)", "fewer worlds by"), rows)
    print(f"\nScoring a rig takes {score_s:.3f} s of processor time a frame.")


WIDE = {"type": "lidar", "channels": 32, "vertical_fov_deg": [-45, 15], "horizontal_fov_deg": 360, "columns": 600,
        "min_range_m": 0.3, "max_range_m": 60}  # fmt: skip
NARROW = WIDE | {"channels": 16, "vertical_fov_deg": [-30, 10], "horizontal_fov_deg": 120, "columns": 300}
GRID = {"region": ["roof", "fender_left", "fender_right", "mirror_left", "mirror_right", "grille", "rear_bumper"],
        "spacing_m": 0.45}  # fmt: skip
CHOICE = {
    "name": "around",
    "scenario": "urban",
    "vehicle": "suv",
    "candidates": {"wide": {"sensor": WIDE, "grid": GRID},
                   "narrow": {"sensor": NARROW, "grid": GRID | {"yaw_deg": [-20.0, 20.0]}}},
    "constraints": {"max_sensors": 8, "max_cost_eur": 9000, "min_distance_m": 0.2},
    "prices_eur": {"wide": 2500, "narrow": 900, "mount": 100},
    "objectives": {"around": {"region": [*NEAR, "20m"]}},
}  # fmt: skip


def time_selections():
    space = SelectionSpace.model_validate(CHOICE)
    with CommonFrames(
        space.scenarios, space.scored_objectives, num_scenes=4, frames_per_scene=2, num_rays=8192
    ) as frames:
        rigs = [Rig(name=one.name, vehicle="suv", sensors=(one,)) for one in space.sensors]
        observed, weights = [observe_points(rig, frames)[0] for rig in rigs], compute_point_weights(frames)
    rows = []
    for count in (40, len(observed)):
        some = np.random.default_rng(0).permutation(len(observed))[:count].tolist()
        base = np.zeros(weights.shape[1], dtype=bool)
        coverage = CandidateCoverage.from_points(weights, [observed[one] for one in some], base)
        limits = space.build_limits(some)
        free = [SelectionLimits(size, compatible=limits.compatible) for size in (8, 4)]
        for what, each in zip(("8 for 9,000 EUR", "8", "4"), (limits, *free), strict=True):
            began_s = time.process_time()
            selection = select_sensors(coverage, each)
            gap = "proven" if selection.is_proven else f"at most {100 * selection.gap:.2f} points below"
            seconds = f"{time.process_time() - began_s:.2f}"
            rows.append((count, len(coverage.observes), what, f"{100 * selection.values[0]:.2f}", seconds, gap))
    table(("candidates", "groups of points", "at most", "objective (%)", "HiGHS (s)", ""), rows)


TURNING = {"type": "lidar", "name": "top", "mount": {"x_m": 0.2, "z_m": 1.9}, "channels": 32, "columns": 1000,
           "vertical_fov_deg": [-30, 10], "horizontal_fov_deg": 360, "range_noise_m": 0.03,
           "max_range_m": 120}  # fmt: skip
# A full turn covers the same whichever way it begins: no candidate is better.
NOTHING = {
    "name": "nothing",
    "start": {"name": "turning", "vehicle": "suv", "sensors": [TURNING]},
    "scenario": "urban",
    "free": {"top": {"yaw_deg": (-170.0, 170.0)}},
    "not_worse": ["80m"],
    "objectives": {"near": {"region": "20m"}},
}


def count_false_alarms(searches):
    space = SearchSpace.model_validate(json.loads(json.dumps(NOTHING)))
    given = {"num_evaluations": 6, "num_scenes": 2, "num_held_out_scenes": 8, "num_rays": 4096}
    results = [run_search(PlacementSearch(space, seed=2 * seed, **given)) for seed in range(searches)]
    tests = [result.test for result in results if result.test is not None]
    worse = sum(any(change.is_worse for change in test.side_effects) for test in tests)
    gained = sum(
        result.best.improvements[0].difference.is_significant for result in results if result.best.improvements
    )
    numbers = max((len(test.side_effects) for test in tests), default=0)
    table(("searches", "tested", "numbers each", "report worse", "report a gain or loss"),
          [(len(results), len(tests), numbers, worse, gained)])  # fmt: skip


def main(arguments=()):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("optimizer", "pairs", "selections", "nothing"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--num-evaluations", type=int, default=25)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args(arguments)
    if options.part == "optimizer":
        compare_strategies(options.seeds, options.num_evaluations, options.processes)
    elif options.part == "pairs":
        compare_pairs()
    elif options.part == "selections":
        time_selections()
    else:
        count_false_alarms(options.seeds)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
