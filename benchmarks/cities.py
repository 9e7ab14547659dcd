"""Cities that bend, cities that do not, and towns of SUMO: code, time to build, variety, distance to the paper.

A city is a run of a minute with a seed of its own. `sumo_random` stands for the other way to have streets, networks and
tracks that SUMO made once: its time is that of this process, without SUMO's own, and reading its tracks is part of it.
"""

import argparse
import csv
import statistics
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import torchcover
from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric, Scenario, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import REFERENCE_SENSORS

STRAIGHT = {"bend_deg": 0.0, "turn_share": 0.0, "hills_m": 0.0, "built_share": 1.0, "lanes": 4}
SCENARIOS = {
    "straight": Scenario.model_validate({"name": "straight", "traffic": {"type": "urban", **STRAIGHT}}),
    "urban": Scenario.load("urban"),
    "sumo_random": Scenario.load("sumo_random"),
}
# The files that only the one or the other needs.
FILES = {
    "urban": ("urban", "city", "site", "streets", "course", "alignment", "territory", "hills", "gates", "signals"),
    "sumo_random": ("",),
}
REGIONS = forward_regions()
GRID = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.5)
EVERY_S, STEPS_OF_A_CITY = 15.0, 3
PAPER_RIGS = ("roof_128", "roof_32")
TABLES = Path(__file__).parents[1] / "examples" / "paper" / "tables.csv"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cities", type=int, default=12)
    parser.add_argument("--rays", type=int, default=8192, help="points on surfaces, for the variety")
    parser.add_argument("--paper-steps", type=int, default=12)
    options = parser.parse_args([] if __name__ != "__main__" else None)
    table(("code", "files", "lines"), [lines(name) for name in FILES])
    print(flush=True)
    table(("scenario", "processor time of a world (s)"), building(options.cities))
    print(flush=True)
    head = [
        f"{region.name} {height} {what}"
        for region in REGIONS
        for height in ("ground", "obstacle")
        for what in ("%", "m")
    ]
    table(("spread between cities", *head), [variety(name, options) for name in SCENARIOS])
    print(flush=True)
    head = [f"{rig} {region}" for rig in PAPER_RIGS for region in ("80m", "160m")]
    table(
        ("obstacle radius / paper's", *head, "detection, 12 numbers (points)"),
        [paper(name, options) for name in SCENARIOS],
    )


def lines(name):
    """Of all files in a room, or of those named."""
    room = Path(torchcover.__file__).parent / "simulation" / ("traffic" if name == "urban" else "sumo")
    files = [path for path in room.glob("*.py") if path.stem in FILES[name] or FILES[name] == ("",)]
    return name, len(files), sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


def building(cities):
    """Median processor time of this process for a world, in turns."""
    ego = SCENARIOS["urban"].ego_mesh()
    seconds = {name: [] for name in SCENARIOS}
    for seed in range(cities + 1):
        for name, scenario in SCENARIOS.items():
            start = time.process_time()
            scenario.world(seed, 0, ego)
            seconds[name].append(time.process_time() - start)
    return [(name, statistics.median(of_all[1:])) for name, of_all in seconds.items()]


def variety(name, options):
    """Standard deviation between cities of what `front_roof_32` gets."""
    areas = tuple((region.x, region.y) for region in REGIONS)
    reference = REFERENCE_SENSORS["surface"].from_rays(areas, options.rays)
    found = []
    for seed in range(options.cities):
        of_city = measured(SCENARIOS[name], ["front_roof_32"], reference, STEPS_OF_A_CITY, seed, area=True)
        found.append([value for pair in of_city["front_roof_32"].values() for value in pair])
    spread = np.nanstd(np.array(found), axis=0, ddof=1) * np.tile([100.0, 1.0], 2 * len(REGIONS))
    return name, *(round(float(value), 2) for value in spread)


def paper(name, options):
    """How far the fitted LiDARs are from the paper's tables, with its pattern and over known cells."""
    rigs = [f"paper_fit_{rig}" for rig in PAPER_RIGS]
    reference = REFERENCE_SENSORS["paper"].from_rays(tuple((r.x, r.y) for r in REGIONS), 262_144)
    found = measured(SCENARIOS[name], rigs, reference, options.paper_steps, 2024, area=False)
    with TABLES.open(encoding="utf-8") as file:
        published = {
            tuple(row[key] for key in ("lidar", "quantity", "region", "height")): float(row["value"])
            for row in csv.DictReader(file)
        }
    radius = next(quantity for _, quantity, _, _ in published if "radius" in quantity)
    ratios = [
        found[f"paper_fit_{rig}"][region, "obstacle"][1] / published[rig, radius, region, "obstacle"]
        for rig in PAPER_RIGS
        for region in ("80m", "160m")
    ]
    away = [
        100 * numbers[0] - published[rig, "detection_percent", *key]
        for rig in PAPER_RIGS
        for key, numbers in found[f"paper_fit_{rig}"].items()
    ]
    return name, *(round(ratio, 2) for ratio in ratios), round(float(np.sqrt(np.mean(np.square(away)))), 1)


def measured(scenario, rigs, reference, steps, seed, *, area):
    """For each rig {(region, height): (detection, radius)}."""
    frames = SimulatedFrames(
        scenario, rigs={rig: rig for rig in rigs}, steps=steps, seed=seed, every_s=EVERY_S, reference_sensor=reference
    )
    grid = replace(GRID, band_frame=reference.band_frame)
    metrics = {rig: CoverageMetric(grid, max_radius=GRID.diagonal_m, square_metres=area) for rig in rigs}
    observers = {rig: CoverageObserver(metric, rig) for rig, metric in metrics.items()}
    observe(frames, observers.values())
    found = {}
    for rig, observer in observers.items():
        coverage = observer.compute()
        for region in REGIONS:
            for height in GRID.heights:
                radius_m, detection = coverage.estimate(region, height).value.tolist()[:2]
                found.setdefault(rig, {})[region.name, height] = detection, radius_m
    return found


if __name__ == "__main__":
    main()
