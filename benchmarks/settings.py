"""What a user would not expect: how far does each setting move the numbers of regions, at the same instants?"""

from functools import partial

from benchmarks.instants import HEIGHTS, REGIONS, Way, estimates, frames_of, in_two_processes, measured
from benchmarks.timing import table

SCENARIO = "urban"
PLACES = [(region.name, height) for region in REGIONS for height in HEIGHTS]
USUAL, CROPPED, OTHER_EGO = "usual", "rig's points cropped to the region", "`sedan` instead of `suv`"
# What is set -> what differs from the usual way.
OTHERS = {
    "reference reaches 120 m instead of 250 m": {"max_range_m": 120.0},
    "shell of 0.25 m instead of 0.5 m": {"shell_m": 0.25},
    "shell of 1 m": {"shell_m": 1.0},
    "bands over z of the vehicle": {"band_frame": "vehicle"},
    "`max_radius` 5 m instead of the diagonal": {"max_radius": 5.0},
    "cells of 0.32 m instead of 1 m": {"cell_m": 0.32},
    "1 place a step instead of 4": {"places": 1},
    "16 places": {"places": 16},
    "4,096 rays instead of 16,384": {"rays": 4096},
    "65,536 rays": {"rays": 65_536},
}


def main():
    """Print how far detections and radii move, with 95 % intervals of the differences at the same instants."""
    cropped = {region.name: {"crop": partial(inside, region)} for region in REGIONS}
    names = list(OTHERS)
    jobs = [{name: OTHERS[name] for name in names[::2]} | cropped, {name: OTHERS[name] for name in names[1::2]}]
    found = {}
    for part in in_two_processes(of_job, [(None, {USUAL: {}} | jobs[0]), (None, jobs[1]), ("sedan", {OTHER_EGO: {}})]):
        found |= part
    found[CROPPED] = {place: found[place[0]][place] for place in PLACES}
    usual = found[USUAL]
    for at, heading in ((1, "detection (points)"), (0, "radius (%)")):
        rows = [(USUAL, *(whole(usual[place], at) for place in PLACES))]
        rows += [
            (name, *(moved(found[name][place], usual[place], at) for place in PLACES))
            for name in (*names, CROPPED, OTHER_EGO)
        ]
        table((heading, *(" ".join(place) for place in PLACES)), rows)
        print()


def of_job(job):
    """Name of each way -> (region, height) -> estimate."""
    vehicle, ways = job
    frames = frames_of(SCENARIO, vehicle=vehicle)
    coverages = measured(frames, {name: Way.of(**differs) for name, differs in ways.items()})
    return {name: estimates(coverage) for name, coverage in coverages.items()}


def inside(region, points):
    """What is left of a rig's points for who keeps no others."""
    x_m, y_m = points[:, 0], points[:, 1]
    return points[(x_m >= region.x[0]) & (x_m < region.x[1]) & (y_m >= region.y[0]) & (y_m < region.y[1])]


def whole(estimate, at):
    number = list(estimate.numbers().values())[at]
    return f"{100 * number.value:.1f} %" if at else f"{number.value:.2f} m"


def moved(estimate, usual, at):
    """How far, and its interval; of the radius in per cent of the usual."""
    scale = 100 if at else 100 / float(usual.value[at])
    difference = list(estimate.differences(usual).values())[at]
    if difference.error == 0:
        return f"{scale * difference.value:+.1f}"
    return f"{scale * difference.value:+.1f} [{scale * difference.low:+.1f}, {scale * difference.high:+.1f}]"


if __name__ == "__main__":
    main()
