"""Common instants: fewer worlds by pairing, fewer instants by racing, and what a score costs."""

import time

import numpy as np

from benchmarks.timing import table
from torchcover.placement import CommonInstants, Objective, paired, race, racing_order
from torchcover.simulation import Rig

# What the random mounts of the roof LiDAR are drawn from.
X_M, Z_M, PITCH_DEG = (-0.6, 0.8), (1.68, 1.85), (-10.0, 15.0)
RIGS, GROUPS, GROUP, PER_WORLD, ORDERS = 24, 3, 6, 3, 25


def mounted(number):
    start = Rig.load("front_roof_32")
    if number == 0:
        return start
    generator = np.random.default_rng(number)
    x_m, z_m, pitch_deg = (float(generator.uniform(*bounds)) for bounds in (X_M, Z_M, PITCH_DEG))
    (roof,) = start.sensors
    mount = roof.mount.model_copy(update={"x_m": x_m, "z_m": z_m, "pitch_deg": pitch_deg})
    return start.model_copy(update={"sensors": (roof.model_copy(update={"mount": mount}),)})


def pairing(scores, measure):
    """Median variance over worlds of a difference to the first rig, unpaired and paired; then how many times fewer
    worlds give an error, for all rigs and for those that are no worse."""
    values = np.stack([each.by_world(measure)[:, 0] for each in scores])
    paired_variance = (values[1:] - values[0]).var(axis=1, ddof=1)
    unpaired_variance = values[1:].var(axis=1, ddof=1) + values[0].var(ddof=1)
    no_worse = values[1:].mean(axis=1) >= values[0].mean()
    fewer = unpaired_variance / paired_variance
    return np.median(unpaired_variance), np.median(paired_variance), np.median(fewer), np.median(fewer[no_worse])


def racing(scores, measure):
    """Share of the instants, loss, and share of races won by the best, over groups of worlds and orders."""
    rows = []
    for group in range(GROUPS):
        instants = np.flatnonzero(np.isin(scores[0].world, np.arange(GROUP) + GROUP * group))
        of_group = [each.at(instants) for each in scores]
        whole = [float(np.nanmean(each.by_world(measure)[:, 0])) for each in of_group]
        for number in range(ORDERS):
            order = instants[racing_order(of_group[0].world, number)]
            others = 1 + np.random.default_rng(number).permutation(len(scores) - 1)
            best, spent = 0, len(instants)
            for candidate in others.tolist():
                incumbents = [of_group[best]]
                (raced,) = race(
                    lambda k, at: scores[k].at(at), [candidate], order, incumbents=incumbents, measure=measure
                )
                spent += len(raced.scores.instants)
                if not raced.dropped and paired(raced.scores, of_group[best], measure).gain[0] > 0:
                    best = candidate
            rows.append((spent / len(instants) / len(scores), max(whole) - whole[best], whole[best] == max(whole)))
    return np.array(rows).mean(axis=0)


def main():
    objective = {"near and far": Objective(region=["20m", "80m"])}
    start = time.process_time()
    instants = CommonInstants("urban", objective, worlds=GROUPS * GROUP, per_world=PER_WORLD)
    building_s = (time.process_time() - start) / len(instants)
    rigs = [mounted(number) for number in range(RIGS + 1)]
    start = time.process_time()
    scores = [instants.score(rig) for rig in rigs]
    scoring_s = (time.process_time() - start) / len(rigs) / len(instants)
    held_mb = sum(reference.bytes for reference in instants.references) / len(instants) / 1e6
    points = np.mean([reference.points for reference in instants.references])
    print(f"{RIGS} random mounts of front_roof_32 and its own in {GROUPS * GROUP} worlds of urban, with {PER_WORLD}")
    print(f"instants each ({scores[0].rays:,} rays, {points:,.0f} reference points)\n")
    rows = []
    for measure in ("area", "known"):
        unpaired, of_pairs, *fewer = pairing(scores, measure)
        share, loss, kept = racing(scores, measure)
        numbers = [float(each) for each in (np.sqrt(unpaired), np.sqrt(of_pairs), *fewer)]
        rows.append((measure, *numbers, f"{100 * share:.0f} %", f"{loss:.5f}", f"{100 * kept:.0f} %"))
    headings = (
        "unpaired, a world",
        "paired",
        "fewer worlds by",
        "of those no worse",
        "instants of a race",
        "its loss",
        "best kept",
    )
    table(("measure", *headings), rows)
    print(f"\nProcessor time an instant: {1000 * building_s:.0f} ms to build, {1000 * scoring_s:.0f} ms for a score;")
    print(f"{held_mb:.2f} MB of reference beside the worlds.")


if __name__ == "__main__":
    main()
