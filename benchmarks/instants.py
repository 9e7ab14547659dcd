"""One rig in the same instants, measured in several ways: all is cast once for all of them."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import torch

from torchcover import BevGrid, CoverageMetric, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver
from torchcover.simulation import Rig, SurfaceReference

RIG = "front_roof_128"
EVERY_S, STEPS_OF_A_CITY = 10.0, 6
REGIONS = forward_regions()
AREAS = tuple((region.x, region.y) for region in REGIONS)
HEIGHTS = ("ground", "obstacle")
# Of regions of 5, 20 and 40 m to either side: what is asked about is a sum over whole cells.
CELL_M = 1.0
# Each is a block of its own.
CITIES = BLOCKS = 24


def uncropped(points):
    return points


class Way(NamedTuple):
    """A way to measure: what the reference draws, what the metric makes of it, and which points of the rig it gets."""

    reference: SurfaceReference
    metric: CoverageMetric
    crop: object = uncropped

    @classmethod
    def of(cls, band_frame="ground", *, cell_m=CELL_M, max_radius=None, crop=uncropped, **reference):
        """The usual way, or one that differs in something."""
        grid = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=cell_m, band_frame=band_frame)
        metric = CoverageMetric(
            grid, max_radius=max_radius or grid.diagonal_m, blocks=BLOCKS, square_metres=True, regions=REGIONS
        )
        return cls(SurfaceReference(AREAS, band_frame=band_frame, **reference), metric, crop)


def frames_of(scenario, *, cities=CITIES, seed=0, vehicle=None, every_s=EVERY_S):
    """All instants of whole cities, or of a scenario that repeats itself; no rig is in them."""
    few = SimulatedFrames(scenario, rigs={}, steps=1, seed=seed, every_s=every_s, vehicle=vehicle)
    steps = few.simulator.distinct_steps or STEPS_OF_A_CITY * cities
    return SimulatedFrames(scenario, rigs={}, steps=steps, seed=seed, every_s=every_s, vehicle=vehicle)


def rig_clouds(frames, rig=RIG):
    """The points of a rig, instant by instant."""
    torch.set_num_threads(1)
    simulator = frames.simulator.with_rigs({rig: Rig.load(rig)})
    for index in range(len(frames)):
        yield torch.cat([torch.from_numpy(scan.points) for scan in simulator.scans(index)[rig]])


def measured(frames, ways, rig=RIG):
    """Name of each way -> its `Coverage`."""
    looks = {way.reference: frames.with_reference_sensor(way.reference) for way in ways.values()}
    observers = {name: CoverageObserver(way.metric, rig) for name, way in ways.items()}
    for index, cloud in enumerate(rig_clouds(frames, rig)):
        seen = {reference: look[index] for reference, look in looks.items()}
        for name, way in ways.items():
            observers[name].update(replace(seen[way.reference], clouds={rig: way.crop(cloud)}, sensor_points={}))
    return {name: observer.compute() for name, observer in observers.items()}


def in_two_processes(function, rows):
    """[function(row) for row in rows], two at a time."""
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(function, rows))


def estimates(coverage):
    """(region, height) -> `Estimate` by area."""
    return {
        (region.name, height): coverage.estimate(region, height, "area") for region in REGIONS for height in HEIGHTS
    }
