"""How long it takes to prove the best of many candidates, by the search alone and with HiGHS."""

import time

import numpy as np

from benchmarks import table
from torchcover.placement import ChoiceSpace, CommonInstants, subsets
from torchcover.placement.choosing import seen_by, worth_of
from torchcover.placement.subsets import Candidates, Limits, best
from torchcover.simulation import Rig

REGIONS = ["roof", "fender_left", "fender_right", "mirror_left", "mirror_right", "grille", "rear_bumper"]
WIDE = {"type": "lidar", "channels": 32, "vertical_fov_deg": [-45, 15], "horizontal_fov_deg": 360, "columns": 600,
        "min_range_m": 0.3, "max_range_m": 60}  # fmt: skip
NARROW = WIDE | {"channels": 16, "vertical_fov_deg": [-30, 10], "horizontal_fov_deg": 120, "columns": 300}
GRID = {"region": REGIONS, "spacing_m": 0.45}
SPACE = {
    "name": "around",
    "scenario": "urban",
    "vehicle": "suv",
    "candidates": {"wide": {"sensor": WIDE, "grid": GRID},
                   "narrow": {"sensor": NARROW, "grid": GRID | {"yaw_deg": [-20.0, 20.0]}}},
    "choose": {"at_most": 8, "max_cost_eur": 9000, "min_distance_m": 0.2},
    "cost": {"wide": 2500, "narrow": 900, "mount": 100},
    "objectives": {"around": {"region": ["left_3m", "right_3m", "front_3m", "rear_3m", "20m"]}},
}  # fmt: skip


def main():
    space = ChoiceSpace.model_validate(SPACE)
    with CommonInstants(space.scenarios, space.asked, worlds=4, per_world=2, rays=8192) as instants:
        each = [Rig(name=one.name, vehicle="suv", sensors=(one,)) for one in space.sensors]
        seen, worth = [seen_by(rig, instants)[0] for rig in each], worth_of(instants)
    rows = []
    for count in (40, len(seen)):
        some = np.random.default_rng(0).permutation(len(seen))[:count].tolist()
        limits = space.limits(some)
        found = Candidates.grouped(worth, [seen[one] for one in some], np.zeros(worth.shape[1], dtype=bool))
        asked = {"8 for 9,000 EUR": limits, "8": Limits(8, apart=limits.apart), "4": Limits(4, apart=limits.apart)}
        for what, each in asked.items():
            began = time.process_time()
            _, gap = subsets._searched(subsets._Goal.of(found, each, (1.0,)))
            searched, choice = time.process_time(), best(found, each)
            seconds = f"{searched - began:.2f}", f"{time.process_time() - searched:.2f}"
            proven = f"at most {100 * choice.gap:.2f} points below" if not choice.proven else "proven"
            groups = f"{int(worth.any(axis=0).sum()):,} in {len(found.sees):,}"
            rows.append(
                (count, groups, what, seconds[0], "proven" if gap <= subsets.SAME else "gives up", seconds[1], proven)
            )
    table(("candidates", "points in groups", "at most", "search (s)", "", "with HiGHS (s)", ""), rows)


if __name__ == "__main__":
    main()
