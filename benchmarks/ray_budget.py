"""Do numbers depend on how many rays were spent? Few beside a million, and draws of few beside draws of many.

The same instants for all. Distances are root mean squares over the paper's regions and bands: percentage points of
detection / per cent of the radius.
"""

from dataclasses import replace

import numpy as np
import torch

from benchmarks.instants import AREAS, HEIGHTS, REGIONS, RIG, frames_of, in_two_processes, rig_clouds
from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric, nearest
from torchcover.evaluation import CoverageObserver
from torchcover.simulation import PaperReference, SurfaceReference

RAYS = (1024, 4096, 16_384, 65_536, 262_144, 1_048_576)
CITIES = 4
# What a row is called, its estimator and band frame.
ESTIMATORS = (("paper's pattern, known cells", "known", "vehicle"), ("surface points, by area", "area", "ground"))
SCENARIOS = ("urban", "highway", "parking", "sumo_random")
FEW, MANY, DRAWS, INSTANTS = 4096, 262_144, 20, 6
FAR_M = 180.0


def main():
    print(f"### {6 * CITIES} instants of `urban`\n")
    rows = in_two_processes(of_estimator, ESTIMATORS)
    table(("estimator", *(f"{rays:,}" for rays in RAYS[:-1])), rows)
    print(f"\n### {DRAWS} draws of {FEW:,} points beside as many of {MANY:,}, {INSTANTS} instants of as many cities\n")
    header = ("scenario", "bias", "its error", "largest bias", "rms of one draw")
    table(header, in_two_processes(of_draws, SCENARIOS))


def of_estimator(row):
    """The distances of an estimator with few rays to its own value with a million."""
    name, measure, band_frame = row
    frames = frames_of("urban", cities=CITIES)
    grid = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.25 if measure == "known" else 1.0, band_frame=band_frame)
    looks, observers = {}, {}
    for rays in RAYS:
        of_paper = PaperReference(rows=int(rays**0.5), columns=int(rays**0.5))
        of_surface = SurfaceReference(AREAS, rays=rays, band_frame=band_frame)
        looks[rays] = frames.with_reference_sensor(of_paper if measure == "known" else of_surface)
        metric = CoverageMetric(grid, max_radius=grid.diagonal_m, square_metres=measure == "area")
        observers[rays] = CoverageObserver(metric)
    for index, cloud in enumerate(rig_clouds(frames)):
        for rays, look in looks.items():
            observers[rays].update(replace(look[index], clouds={RIG: cloud}, sensor_points={}))
    coverages = {rays: observer.compute() for rays, observer in observers.items()}
    places = [(region, height) for region in REGIONS for height in HEIGHTS]
    values = {
        rays: np.stack([coverage.estimate(*place, measure).value.numpy() for place in places])
        for rays, coverage in coverages.items()
    }
    return name, *(shown(rms(moves(values[rays], values[RAYS[-1]]), axis=0)) for rays in RAYS[:-1])


def of_draws(scenario):
    """How far draws of few points are from those of many points that the same places see."""
    frames = frames_of(scenario, cities=1, every_s=60.0)
    sums = np.zeros((2, DRAWS, len(REGIONS) * len(HEIGHTS), 3))
    for index, cloud in enumerate(rig_clouds(frames)):
        for draw in range(DRAWS):
            for at, rays in enumerate((FEW, MANY)):
                look = frames.with_reference_sensor(SurfaceReference(AREAS, rays=rays, band_frame="ground"))
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
        inside = (x_m >= region.x[0]) & (x_m < region.x[1]) & (y_m >= region.y[0]) & (y_m < region.y[1])
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


if __name__ == "__main__":
    main()
