"""How far apart a run should look at a city, how long a city should be, and what may be a block of its errors.

The variance of a number is that of independent steps times the design effect, which is above 1 where steps of a city
are alike. Runs of 64 steps are put together from simulated cities, drawn with replacement, that are looked at every 5,
10, 15 or 20 s for a minute: how often do 95 % intervals hold the number over all cities, with cities and with instants
as blocks?
"""

import time

import numpy as np
import torch

from benchmarks.calibration import _within
from benchmarks.timing import table
from torchcover import Scenario, forward_regions, nearest
from torchcover.coverage.quantity import RADIUS, detection
from torchcover.estimation import Estimate
from torchcover.evaluation import Settings
from torchcover.evaluation.task import simulation
from torchcover.simulation.moving import Solids
from torchcover.simulation.scene import Scene

RIG, THRESHOLD_M = "front_roof_128", 0.4
CITIES, SEED, EVERY_S, DURATION_S = 60, 4321, 5.0, 60.0
RUNS, STEPS = 400, 64
DURATIONS_S, BUILT = (30.0, 60.0, 90.0, 120.0, 180.0), 4


def main():
    """Print what cities cost, and what they say."""
    costs = [building(duration_s) for duration_s in DURATIONS_S]
    print("Processor time of a city with its geometry:\n")
    rows = [
        (f"{of_s:g} s", f"{cost:.3f}", f"{10 * cost / of_s:.3f}") for of_s, cost in zip(DURATIONS_S, costs, strict=True)
    ]
    table(("length", "s", "s for each look, 10 s apart"), rows)
    sums, city_s, step_s = simulated()
    print(f"\nThe first step of a city of a minute takes {city_s:.2f} s, each other one {step_s:.3f} s. Detections and")
    print("radii in front; time is what a run takes for the same error, that of looks every 10 s being 1:\n")
    each = [judged(sums[:, ::every], city_s - step_s, step_s) for every in (1, 2, 3, 4)]
    table(
        ("looks every", "cities of 64 steps", "design effect, mean", "largest", "time", "cities cover, mean", "least",
         "instants cover, mean", "least"),
        [(f"{EVERY_S * every:g} s", one[0], *(f"{number:.2f}" for number in (*one[1:3], one[3] / each[1][3])),
          *("none" if np.isnan(number) else f"{number:.3f}" for number in one[4:]))
         for every, one in enumerate(each, 1)],
    )  # fmt: skip


def building(duration_s):
    """Mean of some worlds and their scenes; the first, which makes the bodies of all, is left out."""
    scenario = Scenario.load("urban")
    traffic = scenario.traffic.model_copy(update={"duration_s": duration_s})
    scenario, solids = scenario.model_copy(update={"traffic": traffic}), Solids()
    ego, taken = scenario.ego_mesh(), []
    for run in range(BUILT + 1):
        start = time.process_time()
        Scene(scenario.world(SEED, run, ego), solids).at(0)
        taken.append(time.process_time() - start)
    return float(np.mean(taken[1:]))


def simulated():
    """(C, looks, places, 3) square metres, those times radius and detection; seconds of first steps, and of others."""
    torch.set_num_threads(1)
    looks = round(DURATION_S / EVERY_S)
    settings = Settings(RIG, "urban", steps=CITIES * looks + looks, seed=SEED, every_s=EVERY_S, no_cache=True)
    task, sums, taken, city = simulation(settings), [], [], []
    bands, most = task.asked.grid.heights.values(), task.asked.grid.diagonal_m
    while not city or city[-1] < CITIES:
        index, start = len(city), time.process_time()
        frame = task.frames[index]
        radius = nearest(frame.reference, frame.clouds[RIG], max_distance=most).distance.double().clamp(max=most)
        taken.append(time.process_time() - start)
        city.append(frame.place_in_time)
        m2, points = frame.reference_weights.double(), frame.reference.double()
        values = m2 * torch.stack([torch.ones_like(m2), radius, (radius <= THRESHOLD_M).double()])
        of_places = [(region, band) for region in forward_regions() for band in bands]
        sums.append([_within(points, frame.reference_heights_m, values, *place) for place in of_places])
    # A minute holds one more look now and then.
    of_city = np.array([np.flatnonzero(np.array(city) == one)[:looks] for one in range(CITIES)])
    taken = np.array(taken)[of_city]
    return np.array(sums)[of_city].reshape(CITIES, looks, -1, 3), np.median(taken[1:, 0]), np.median(taken[:, 1:])


def judged(sums, city_s, step_s):
    """How many cities 64 steps are of, design effects, time at equal error, and shares of intervals that cover."""
    cities, looks = sums.shape[:2]
    each, base = np.moveaxis(sums[..., 1:], 3, 2).reshape(cities, looks, -1), np.tile(sums[..., 0], 2)
    truth = each.sum(axis=(0, 1)) / base.sum(axis=(0, 1))
    away = each - truth * base
    effect = looks * away.mean(axis=1).var(axis=0, ddof=1) / away.var(axis=(0, 1), ddof=1)
    random, of_run = np.random.default_rng(SEED), -(-STEPS // looks)
    covered = np.zeros((2, RUNS, len(truth)))
    for run in range(RUNS):
        chosen = random.integers(cities, size=of_run)
        for by, together in enumerate((looks, 1)):
            parts = [
                torch.from_numpy(of[chosen].reshape(-1, len(truth))[:STEPS]).split(together) for of in (each, base)
            ]
            some, m2 = (torch.stack([part.sum(dim=0) for part in of]) for of in parts)
            lengths = torch.tensor([len(part) for part in parts[0]])
            covered[by, run] = holds(Estimate.of_ratios(QUANTITIES, m2, some, lengths), truth)
    shares = covered.mean(axis=1)  # NaN of those that have none in a run
    at_equal_error = effect.mean() * (city_s / looks + step_s)
    return of_run, effect.mean(), effect.max(), at_equal_error, *(f(of) for of in shares for f in (np.mean, np.min))


QUANTITIES = tuple(
    what._replace(key=f"{place} {what.key}")
    for what in (RADIUS, detection(THRESHOLD_M))
    for place in range(2 * len(forward_regions()))
)


def holds(estimate, truth):
    """(Q,) whether each interval holds it, NaN where there is none."""
    ends = np.array([(number.low, number.high) for number in estimate.numbers().values()])
    return np.where(np.isnan(ends[:, 0]), np.nan, (ends[:, 0] <= truth) & (truth <= ends[:, 1]))


if __name__ == "__main__":
    main()
