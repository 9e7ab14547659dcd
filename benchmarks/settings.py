"""What a user would not expect: how far does each setting move the numbers of regions, at the same instants?"""

from functools import partial

from benchmarks.instants import HEIGHTS, REGIONS, Way, estimates, frames_of, in_two_processes, measured
from benchmarks.timing import table

SCENARIO = "urban"
PLACES = [(region.name, height) for region in REGIONS for height in HEIGHTS]
USUAL, CROPPED, OTHER_EGO = "usual", "rig's points cropped to the region", "`sedan` (`suv`)"
# What is set -> what differs from the usual way.
OTHERS = {
    "reference to 120 m (250 m)": {"max_range_m": 120.0},
    "shell of 0.25 m (0.5 m)": {"shell_m": 0.25},
    "shell of 1 m": {"shell_m": 1.0},
    "bands over z of the vehicle": {"band_frame": "vehicle"},
    "`max_radius` 5 m (diagonal)": {"max_radius": 5.0},
    "cells of 0.32 m (1 m)": {"cell_m": 0.32},
    "1 place (4)": {"places": 1},
    "16 places": {"places": 16},
    "4,096 rays (16,384)": {"rays": 4096},
    "65,536 rays": {"rays": 65_536},
}
DETECTION, RADIUS = 1, 0
NONE = "none"


def main():
    """Print the largest move of each setting, then all, with 95 % intervals of the differences at the same instants."""
    cropped = {region.name: {"crop": partial(inside, region)} for region in REGIONS}
    halves = [dict(list(OTHERS.items())[start::2]) for start in (0, 1)]
    found = {}
    for part in in_two_processes(
        of_job, [(None, {USUAL: {}} | halves[0] | cropped), (None, halves[1]), ("sedan", {OTHER_EGO: {}})]
    ):
        found |= part
    found[CROPPED] = {place: found[place[0]][place] for place in PLACES}
    usual, names = found.pop(USUAL), (*OTHERS, CROPPED, OTHER_EGO)
    most = {name: tuple(largest(found[name], usual, at) for at in (DETECTION, RADIUS)) for name in names}
    still = [name for name in names if most[name] == (NONE, NONE)]
    rows = [(name, *most[name]) for name in names if name not in still]
    table(("setting", "detection (points)", "radius (%)"), [*rows, ("; ".join(still), NONE, NONE)])
    for at, heading in ((DETECTION, "detection (points)"), (RADIUS, "radius (%)")):
        rows = [(USUAL, *(whole(usual[place], at) for place in PLACES))]
        rows += [(name, *(words(*moved(found[name][place], usual[place], at)) for place in PLACES)) for name in names]
        print()
        table((heading, *(" ".join(place) for place in PLACES)), rows)


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
    return f"{100 * number.value:.1f} %" if at == DETECTION else f"{number.value:.2f} m"


def moved(estimate, usual, at):
    """How far, in points or in per cent of the usual radius, its interval, and how likely chance does as much."""
    scale = 100 if at == DETECTION else 100 / float(usual.value[at])
    difference = list(estimate.differences(usual).values())[at]
    return scale * difference.value, scale * difference.low, scale * difference.high, difference.p


def words(value, low, high, _):
    return f"{value:+.1f} [{low:+.1f}, {high:+.1f}]" if high - low > 1e-9 else f"{value:+.1f}"


def largest(of_places, usual, at):
    """The largest move that is beyond chance, for which one of so many places has to be farther off, and where."""
    moves = {place: moved(of_places[place], usual[place], at) for place in PLACES}
    beyond = {place: value for place, (value, *_, p) in moves.items() if p < 0.05 / len(PLACES) and abs(value) >= 0.05}
    if not beyond:
        return NONE
    place = max(beyond, key=lambda one: abs(beyond[one]))
    return f"{beyond[place]:+.1f}, {' '.join(place)}"


if __name__ == "__main__":
    main()
