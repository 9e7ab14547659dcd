"""Do 95 % intervals cover, and are they no wider than needed? Runs are put together from simulated cities.

Each run draws cities at random, with replacement, and goes through the six steps of each, 10 s apart, as an evaluation
does. The truth is the number over all the cities; what is counted is how often the interval of a run holds it, and how
wide it is next to the range that holds the numbers of 95 % of the runs. Then how near to the steps that are needed runs
with a target error end, and studies say that they would.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from benchmarks import table
from torchcover import BevGrid, CoverageMetric, forward_regions, nearest
from torchcover.coverage.quantities import (
    RADIUS,
    make_detection_quantity,
    make_redundancy_quantity,
    make_sensor_count_quantity,
)
from torchcover.data import SimulatedFrames
from torchcover.estimation import ErrorModel, Estimate
from torchcover.evaluation import CoverageObserver, Settings, TargetError, TargetErrorRule
from torchcover.evaluation.task import build_simulation_task
from torchcover.simulation import PaperReference, Rig, SurfaceReference

SCENARIOS = {"urban": 50, "highway": 35}
RIGS = ("front_roof_128", "front_grille_128")
THRESHOLD_M, STEPS_OF_A_CITY, LENGTHS = 0.4, 6, (64, 256)
# Values that are summed for each point: those of each rig, and of both rigs as one.
VALUES = [
    *product(("roof", "grille", "both"), (RADIUS, make_detection_quantity(THRESHOLD_M))),
    ("both", make_sensor_count_quantity(THRESHOLD_M)),
    ("both", make_redundancy_quantity(THRESHOLD_M)),
]
# A rig against another: roof and grille as a comparison has them, each against both as a sensor that fails.
DIFFERENCES = {"difference": [("grille", "roof")], "loss": [("roof", "both"), ("grille", "both")]}
# Where one city has more than this of the variance, it alone decides about the truth.
ONE_CITY = 1 / 3
TARGET = 0.01


RIG = "front_roof_128"
REGIONS = forward_regions()
AREAS = tuple((region.x_m, region.y_m) for region in REGIONS)
HEIGHTS = ("ground", "obstacle")
EVERY_S = 10.0
RAYS = (1024, 4096, 16_384, 65_536, 262_144, 1_048_576)
BUDGET_CITIES = 3
# Name of a row, estimator and band frame.
ESTIMATORS = (("paper's pattern, mean over cells", "cells", "vehicle"), ("surface points, by area", "area", "ground"))
BUDGET_SCENARIOS = ("urban", "highway")
FEW, MANY, DRAWS, INSTANTS = 4096, 262_144, 10, 6
FAR_M = 180.0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=77, help="of the cities")
    parser.add_argument("--draw", type=int, default=5, help="seed of the runs")
    parser.add_argument("--runs", type=int, default=400)
    options = parser.parse_args()
    pools = {name: Cities.of(name, cities, options.seed) for name, cities in SCENARIOS.items()}
    apart = []
    for steps in LENGTHS:
        found = [
            (name, *row)
            for name, pool in pools.items()
            for row in pool.judged(np.random.default_rng(options.draw), steps, options.runs)
        ]
        apart += [(steps, *row) for row in found if row[3] > ONE_CITY]
        judged = [row for row in found if row[3] <= ONE_CITY]
        print(f"\nRuns of {steps} steps:\n")
        table(
            ("scenario", "what", "rows", "with intervals", "covered, mean", "worst", "which", "width, mean", "widest"),
            [
                _summary(name, kind, judged)
                for name in (*pools, "all")
                for kind in dict.fromkeys(row[1] for row in judged)
            ],
        )
    print("\nRows of which one city has more than a third of the variance:\n")
    table(
        ("steps", "scenario", "row", "its share", "covered", "width"),
        [(steps, name, what, round(top, 2), *_told(rest)) for steps, name, _, what, top, *rest in apart if rest[0]],
    )
    print(f"\nEvery detection in front to {100 * TARGET:g} point:\n")
    table(
        ("scenario", "steps needed", "by", "stopped at, 5 / 50 / 95 %", "within 0.8 to 1.3", "studied, 5 / 50 / 95 %",
         "within 1.3 of their median"),
        [(name, *pool.stopped(np.random.default_rng(options.draw))) for name, pool in pools.items()],
    )  # fmt: skip
    show_ray_budget()


def _summary(name, kind, judged):
    rows = [row for row in judged if name in ("all", row[0]) and row[1] == kind]
    known = [row for row in rows if row[4]]
    covered, widths = np.array([row[4:6] for row in known]).T
    worst = known[int(covered.argmin())]
    where = worst[2] if name != "all" else f"{worst[0]}: {worst[2]}"
    each = (f"{number:.3f}" for number in (covered.mean(), covered.min()))
    return name, kind, len(rows), len(known), *each, where, f"{widths.mean():.2f}", f"{widths.max():.2f}"


def _told(rest):
    return f"{rest[0]:.3f}", f"{rest[1]:.2f}"


def simulated(scenario, cities, seed):
    """(n,) city and (n, P, 1 + V) square metres of each place, and those times each value, of each step."""
    torch.set_num_threads(1)
    steps = STEPS_OF_A_CITY * cities + 1
    task = build_simulation_task(Settings(RIGS, scenario, num_frames=steps, seed=seed, band_frame="ground"))
    places = [(region, band) for region in task.query_plan.regions for band in task.query_plan.grid.heights.values()]
    city, sums = [], []
    for index in range(steps):
        frame = task.frames[index]
        points, m2, height = frame.reference.double(), frame.reference_weights.double(), frame.reference_heights_m
        clouds, most = (frame.clouds[rig] for rig in RIGS), task.query_plan.grid.diagonal_m
        radii = torch.stack([nearest(frame.reference, cloud, max_distance=most).distance for cloud in clouds])
        radii = radii.double().clamp(max=most)
        seen = radii <= THRESHOLD_M
        both = radii.amin(dim=0)
        rows = [torch.ones_like(m2), radii[0], seen[0], radii[1], seen[1], both, both <= THRESHOLD_M]
        values = m2 * torch.stack([row.double() for row in (*rows, seen.sum(dim=0), seen.sum(dim=0) >= 2)])
        city.append(frame.block_index)
        sums.append([_within(points, height, values, *place) for place in places])
    names = [f"{region.name} {height}" for region in task.query_plan.regions for height in task.query_plan.grid.heights]
    return {"city": np.array(city), "S": np.array(sums), "places": np.array(names)}


def _within(points, height, values, region, band):
    inside = torch.ones(len(points), dtype=torch.bool)
    for along, (low, high) in ((points[:, 0], region.x_m), (points[:, 1], region.y_m), (height, band)):
        inside &= (along >= low) & (along < high)
    return values[:, inside].sum(dim=1).tolist()


class Cities:
    """The sums of simulated steps, city by city, (C, 6, P, 1 + V)."""

    def __init__(self, sums, places):
        self.sums, self.places = torch.from_numpy(sums), places
        self.names = [f"{place} {rig} {what.key}" for rig, what in VALUES for place in places]
        self.whole = self.over_all()

    @classmethod
    def of(cls, scenario, cities, seed):
        """Those of a file in `out/`, which is simulated if missing."""
        path = Path("out") / f"calibration_{scenario}_{seed}_{cities}.npz"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, **simulated(scenario, cities, seed))
        with np.load(path) as file:
            steps = [np.flatnonzero(file["city"] == one)[:STEPS_OF_A_CITY] for one in np.unique(file["city"])]
            whole = np.array([one for one in steps if len(one) == STEPS_OF_A_CITY])
            return cls(file["S"][whole], [str(name) for name in file["places"]])

    def over_all(self, every=1):
        """What all cities say, by so many of their steps."""
        of_city = self.sums[:, ::every]
        return self.estimate(of_city.sum(dim=1)[None], torch.full((len(of_city),), of_city.shape[1]))

    def drawn(self, random, steps, runs=1, every=1):
        """What runs say, as one estimate: whole cities, the last one as far as the steps go."""
        of_city = self.sums[:, ::every]
        cities, rest = divmod(steps, of_city.shape[1])
        chosen = random.integers(len(of_city), size=(runs, cities + (rest > 0)))
        sums, lengths = of_city.sum(dim=1)[chosen], torch.full((chosen.shape[1],), of_city.shape[1])
        if rest:
            sums[:, -1], lengths[-1] = of_city[:, :rest].sum(dim=1)[chosen[:, -1]], rest
        return self.estimate(sums, lengths)

    def estimate(self, sums, lengths):
        """Of (R, g, P, 1 + V) sums all R runs, V values and P places, in this order."""
        each = sums[..., 1:].movedim(-1, 2).movedim(1, 0)
        base = sums[..., 0].movedim(1, 0)[:, :, None].expand_as(each)
        quantities = [
            what._replace(key=f"{run} {rig} {place} {what.key}")
            for run in range(len(sums))
            for rig, what in VALUES
            for place in self.places
        ]
        return Estimate.from_ratios(quantities, base.flatten(1), each.flatten(1), lengths)

    def judged(self, random, steps, runs):
        """Kind, name, share of one city, share of intervals that cover (0: most runs have none), relative width."""
        # As a search tests its winner: in 16 fresh worlds, three instants in each.
        for gain, many, every in (("", steps, 1), ("gain", 48, 2))[: 1 + (steps == LENGTHS[0])]:
            whole, found = self.over_all(every), self._rows(self.drawn(random, many, runs, every))
            truths = self._rows(whole)
            tops = self._rows(replace(whole, jackknife_values=whole.jackknife_values - whole.value), _share_of_one_city)
            for (kind, name), each in found.items():
                if not gain or kind == "difference":
                    yield gain or kind, name, float(tops[kind, name][0]), *_covered(each, truths[kind, name][0, 0])

    def _rows(self, estimate, told=None):
        """(Kind, name) -> (R, 3) value, low, high; or what is told of an estimate, (R,)."""
        told = told or _ends_of
        found = {}
        each = told(estimate, None)
        each = each.reshape(-1, len(self.names), *each.shape[1:])
        found |= {("number", name): each[:, at] for at, name in enumerate(self.names)}
        for kind, pairs in DIFFERENCES.items():
            for first, second in pairs:
                for what in (0, 1):
                    one, other = (self.part(estimate, rig, what) for rig in (first, second))
                    each = told(one, other)
                    each = each.reshape(-1, len(self.places), *each.shape[1:])
                    names = (f"{place} {first} {VALUES[what][1].key}, less {second}" for place in self.places)
                    found |= {(kind, name): each[:, at] for at, name in enumerate(names)}
        return found

    def part(self, estimate, rig, what):
        """The radius (0) or the detection (1) of a rig, of all runs and places."""
        places = len(self.places)
        start = (2 * ("roof", "grille", "both").index(rig) + what) * places
        runs = np.arange(len(estimate.value) // len(self.names)) * len(self.names)
        at = (runs[:, None] + start + np.arange(places)).ravel()
        quantities = [estimate.quantities[one]._replace(key=str(one - start)) for one in at]
        return Estimate(
            tuple(quantities),
            estimate.value[at],
            estimate.jackknife_values[:, at],
            estimate.frame_counts,
            None,
            estimate.effective_blocks[at],
        )

    def stopped(self, random, runs=100, studies=50, studied=512):
        """Steps that the target needs, by which number; where runs stopped, and what studies named."""
        six = range(2 * len(forward_regions()))
        whole = self.part(self.whole, "roof", 1)
        models = [ErrorModel.from_error(float(whole.error[at]), STEPS_OF_A_CITY * len(self.sums)) for at in six]
        needed = [model.estimate_num_frames(TARGET) for model in models]
        most = max(needed)
        ends = np.array([Replay(self, random, 4 * most).stops() for _ in range(runs)])
        named = []
        for _ in range(studies):
            run = self.part(self.drawn(random, studied), "roof", 1)
            named.append(
                max(ErrorModel.from_error(float(run.error[at]), studied).estimate_num_frames(TARGET) for at in six)
            )
        ratio = np.array(named) / np.median(named)
        near = np.mean((ratio < 1.3) & (ratio > 1 / 1.3))
        good = np.mean((ends >= 0.8 * most) & (ends <= 1.3 * most))
        return most, self.places[int(np.argmax(needed))], _ends(ends), f"{good:.2f}", _ends(named), f"{near:.2f}"


class Replay:
    """A run that grows, as `TargetErrorRule` looks at it: its coverage of the regions in front."""

    def __init__(self, pool, random, most):
        self.pool, self.grid = pool, SimpleNamespace(heights=("ground", "obstacle"))
        self.order = random.integers(len(pool.sums), size=-(-most // STEPS_OF_A_CITY))
        self.most, self.counts, self.quantities = (
            most,
            {"num_frames": 0},
            (RADIUS, make_detection_quantity(THRESHOLD_M)),
        )

    def stops(self):
        """After how many steps."""
        watch = TargetErrorRule(TargetError(detection=TARGET), {"roof": self}, forward_regions())
        while self.counts["num_frames"] < self.most:
            self.counts["num_frames"] = watch.next_check_frame
            if watch.is_reached(watch.next_check_frame):
                break
        return self.counts["num_frames"]

    def compute(self):
        """Itself, with what the steps so far say."""
        cities, rest = divmod(min(self.counts["num_frames"], self.most), STEPS_OF_A_CITY)
        parts = self.pool.sums[self.order[: cities + (rest > 0)]].clone()
        lengths = torch.full((len(parts),), STEPS_OF_A_CITY)
        if rest:
            parts[-1, rest:] = 0.0
            lengths[-1] = rest
        blocks, block = parts.sum(dim=1), torch.arange(len(parts)) // (1 + len(parts) // 256)
        whole = blocks.new_zeros((int(block[-1]) + 1, *blocks.shape[1:])).index_add_(0, block, blocks)
        steps = lengths.new_zeros(len(whole)).index_add_(0, block, lengths)
        self.found = self.pool.estimate(whole[None], steps)
        return self

    def estimate(self, region, height):
        """As `Coverage.estimate`."""
        at = self.pool.places.index(f"{region.name} {height}")
        return Estimate(
            self.quantities,
            *(one[..., [at, len(self.pool.places) + at]] for one in (self.found.value, self.found.jackknife_values)),
            self.found.frame_counts,
        )


def _ends_of(estimate, other):
    """(N, 3) values and ends of numbers, or of differences to others."""
    found = estimate.to_numbers() if other is None else estimate.compute_differences(other)
    return np.array([(one.value, one.low, one.high) for one in found.values()])


def _share_of_one_city(estimate, other):
    """(N,) the largest share that a city has of the variance."""
    parts = (estimate.jackknife_values - (0.0 if other is None else other.jackknife_values)).numpy()
    squares = np.square(parts - parts.mean(axis=0))
    return squares.max(axis=0) / np.maximum(squares.sum(axis=0), np.finfo(float).tiny)


def _covered(each, truth):
    """Of (R, 3) values and ends: how many intervals hold the truth, and their mean width by what is needed."""
    known = np.isfinite(each[:, 1])
    if known.mean() < 0.5:
        return 0.0, 0.0
    low, high = each[known, 1], each[known, 2]
    needed = np.subtract(*np.quantile(each[:, 0], (0.975, 0.025)))
    return float(np.mean((low <= truth) & (truth <= high))), float(np.mean(high - low) / needed)


def _ends(numbers):
    return " / ".join(f"{number:.0f}" for number in np.quantile(numbers, (0.05, 0.5, 0.95)))


def show_ray_budget():
    """Print how numbers depend on the number of rays."""
    print(f"\n### {STEPS_OF_A_CITY * BUDGET_CITIES} frames of `urban`\n")
    rows = in_two_processes(of_estimator, ESTIMATORS)
    table(("estimator", *(f"{rays:,}" for rays in RAYS[:-1])), rows)
    print(f"\n### {DRAWS} samples of {FEW:,} points against as many of {MANY:,}, {INSTANTS} frames of as many cities\n")
    header = ("scenario", "bias", "standard error", "largest bias", "rms of one sample")
    table(header, in_two_processes(of_draws, BUDGET_SCENARIOS))


def of_estimator(row):
    """The distances of an estimator with few rays to its own value with a million."""
    name, measure, band_frame = row
    frames = frames_of("urban", cities=BUDGET_CITIES)
    grid = BevGrid(
        x_m=(0.0, 160.0), y_m=(-40.0, 40.0), cell_m=0.25 if measure == "cells" else 1.0, band_frame=band_frame
    )
    looks, observers = {}, {}
    for rays in RAYS:
        of_paper = PaperReference(rows=int(rays**0.5), columns=int(rays**0.5))
        of_surface = SurfaceReference(AREAS, num_rays=rays, band_frame=band_frame)
        looks[rays] = frames.replace_reference_sensor(of_paper if measure == "cells" else of_surface)
        metric = CoverageMetric(grid, max_radius_m=grid.diagonal_m, has_area_weights=measure == "area")
        observers[rays] = CoverageObserver(metric)
    for index, cloud in enumerate(rig_clouds(frames)):
        for rays, look in looks.items():
            observers[rays].update(replace(look[index], clouds={RIG: cloud}, sensor_point_counts={}))
    coverages = {rays: observer.compute() for rays, observer in observers.items()}
    places = [(region, height) for region in REGIONS for height in HEIGHTS]
    # A metric without area weights estimates the mean of the paper over observed cells.
    values = {
        rays: np.stack([coverage.estimate(*place).value.numpy() for place in places])
        for rays, coverage in coverages.items()
    }
    return name, *(shown(rms(moves(values[rays], values[RAYS[-1]]), axis=0)) for rays in RAYS[:-1])


def of_draws(scenario):
    """How far draws of few points are from those of many points that the same places see."""
    frames = frames_of(scenario, cities=1, frame_interval_s=60.0)
    sums = np.zeros((2, DRAWS, len(REGIONS) * len(HEIGHTS), 3))
    for index, cloud in enumerate(rig_clouds(frames)):
        for draw in range(DRAWS):
            for at, rays in enumerate((FEW, MANY)):
                look = frames.replace_reference_sensor(SurfaceReference(AREAS, num_rays=rays, band_frame="ground"))
                look.simulator.seed = draw  # of places and points; what stands there is drawn already
                sums[at, draw] += sums_of(look[index], cloud)
    few, many = sums[..., 1:] / sums[..., :1]
    apart = moves(few, many)
    bias, error = apart.mean(axis=0), apart.std(axis=0, ddof=1) / DRAWS**0.5
    return (
        f"`{scenario}`",
        shown(rms(bias, 0)),
        shown(rms(error, 0)),
        shown(np.abs(bias).max(0)),
        shown(rms(apart, (0, 1))),
    )


def sums_of(frame, cloud):
    """(places, 3) square metres, and those times radius and detection."""
    radius_m = nearest(frame.reference, cloud, max_distance=FAR_M).distance.clamp(max=FAR_M).double()
    each = torch.stack([torch.ones_like(radius_m), radius_m, (radius_m <= 0.4).double()], dim=1)
    each *= frame.reference_weights.double()[:, None]
    x_m, y_m = frame.reference[:, 0], frame.reference[:, 1]
    found = []
    for region in REGIONS:
        inside = (x_m >= region.x_m[0]) & (x_m < region.x_m[1]) & (y_m >= region.y_m[0]) & (y_m < region.y_m[1])
        for low_m, high_m in ((-0.5, 0.5), (0.5, 2.0)):
            height_m = frame.reference_heights_m
            found.append(each[inside & (height_m >= low_m) & (height_m < high_m)].sum(dim=0))
    return torch.stack(found).numpy()


def moves(values, others):
    """(..., 2) radius, detection -> points of detection, per cent of the radius."""
    return np.stack([100 * (values[..., 1] - others[..., 1]), 100 * (values[..., 0] / others[..., 0] - 1)], axis=-1)


def rms(values, axis):
    return np.sqrt(np.nanmean(values**2, axis=axis))


def shown(pair):
    return "{:.2f} / {:.1f}".format(*pair)


def frames_of(scenario, *, cities=BUDGET_CITIES, seed=0, vehicle=None, frame_interval_s=EVERY_S):
    """All instants of whole cities, or of a scenario that repeats itself; no rig is in them."""
    few = SimulatedFrames(
        scenario, rigs={}, num_frames=1, seed=seed, frame_interval_s=frame_interval_s, vehicle=vehicle
    )
    steps = few.simulator.num_distinct_frames or STEPS_OF_A_CITY * cities
    return SimulatedFrames(
        scenario, rigs={}, num_frames=steps, seed=seed, frame_interval_s=frame_interval_s, vehicle=vehicle
    )


def rig_clouds(frames, rig=RIG):
    """The points of a rig, instant by instant."""
    torch.set_num_threads(1)
    simulator = frames.simulator.replace_rigs({rig: Rig.load(rig)})
    for index in range(len(frames)):
        yield torch.cat([torch.from_numpy(scan.points) for scan in simulator.simulate_scans(index)[rig]])


def in_two_processes(function, rows):
    """[function(row) for row in rows], two at a time."""
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(function, rows))


if __name__ == "__main__":
    main()
