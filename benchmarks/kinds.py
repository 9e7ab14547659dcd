"""How far kinds of world move numbers, and the order of rigs: each kind apart, and their mixture."""

import math
from itertools import combinations

from benchmarks.timing import table
from torchcover import evaluate

RIGS = ("front_roof_128", "front_roof_64", "front_roof_32", "front_grille_128")
WORLDS = ("urban", "sumo_random", "highway", "parking")
SHOWN = (("20m", "ground"), ("80m", "ground"), ("80m", "obstacle"), ("160m", "obstacle"))
STEPS, EVERY_S, RAYS = 96, 10.0, 8192
KEY = "detection_0.4m"


def main(steps=STEPS):
    """Print the detections of some rigs in each kind of world, and which orders of two rigs a kind turns round."""
    result = evaluate(RIGS, list(WORLDS), steps=steps, every_s=EVERY_S, rays=RAYS, cell_m=0.5, seed=5)
    worlds = list(result.worlds.values())
    each = {**{name: world.table for name, world in result.worlds.items()}, "mixture": result.table}
    print(f"Detection within 0.4 m in %, 95 % intervals; {steps} instants of each kind, a world a minute.\n")
    rows = []
    for region, height in SHOWN:
        for rig in RIGS:
            numbers = [_row(of, rig, region, height).summary.numbers[KEY] for of in each.values()]
            cells = (f"{100 * n.value:.1f} [{100 * n.low:.1f}, {100 * n.high:.1f}]" for n in numbers)
            rows.append((f"{region} {height}", rig, *cells))
    table(("place", "rig", *each), rows)
    places = [(row.region.name, row.summary.height) for row in result.table.rows[RIGS[0]]]
    print(
        "\nThe most that a detection of one rig differs between two kinds of world, with its standard error; and pairs"
    )
    print("of rigs of which one is the better in some kind and the other in the mixture, both by more than chance.\n")
    rows = []
    for place in places:
        spans = [_span([_row(world.table, rig, *place).summary.numbers[KEY] for world in worlds]) for rig in RIGS]
        pairs = list(combinations(RIGS, 2))
        turned = sum(any(_turns(world, result, place, pair) for world in worlds) for pair in pairs)
        most, error = max(spans)
        known = "" if math.isnan(error) else f" +- {100 * error:.1f}"
        rows.append((" ".join(place), f"{100 * most:.1f}{known}", f"{turned} of {len(pairs)}"))
    table(("place", "points", "pairs of rigs"), rows)


def _span(numbers):
    """Of numbers of kinds of world, how far the largest is from the smallest, and the standard error of that."""
    known = [number for number in numbers if number.known] or numbers
    low, high = min(known, key=lambda number: number.value), max(known, key=lambda number: number.value)
    return high.value - low.value, math.hypot(low.error, high.error)


def _row(of, rig, region, height):
    return next(row for row in of.rows[rig] if (row.region.name, row.summary.height) == (region, height))


def _turns(world, result, place, pair):
    """Whether one rig of a pair is the better one in the mixture, and the other one in a kind of world."""
    region = next(region for region in result.regions if region.name == place[0])
    signs = []
    for measured in (world.coverages, result.mixtures):
        one, other = (measured[rig].estimate(region, place[1]) for rig in pair)
        difference = one.differences(other)[KEY]
        signs.append((difference.value > 0) - (difference.value < 0) if difference.significant else 0)
    return signs[0] * signs[1] < 0


if __name__ == "__main__":
    main()
