"""Common instants: fewer worlds by pairing, fewer instants by racing, and what a score costs."""

import time

import numpy as np

from benchmarks import table
from torchcover.placement import CommonInstants, Objective
from torchcover.placement.racing import MIN_WORLDS, TOGETHER, Prefix, gains, race
from torchcover.simulation import Rig

# What the random mounts of the roof LiDAR are drawn from.
X_M, Z_M, PITCH_DEG = (-0.6, 0.8), (1.68, 1.85), (-10.0, 15.0)
RIGS, WORLDS, RACED_WORLDS, PER_WORLD, SEEDS, ORDERS = 24, 16, 6, 3, 6, 25
MEASURES = "area", "known"
OBJECTIVE = {"near and far": Objective(region=["20m", "80m"])}


def mounted(number):
    start = Rig.load("front_roof_32")
    if number == 0:
        return start
    generator = np.random.default_rng(number)
    x_m, z_m, pitch_deg = (float(generator.uniform(*bounds)) for bounds in (X_M, Z_M, PITCH_DEG))
    (roof,) = start.sensors
    mount = roof.mount.model_copy(update={"x_m": x_m, "z_m": z_m, "pitch_deg": pitch_deg})
    return start.model_copy(update={"sensors": (roof.model_copy(update={"mount": mount}),)})


def prefixes(instants, rig):
    """What is known of a rig after more and more instants, by each measure."""
    numbers, found = instants.questions.numbers_of(rig), {measure: [] for measure in MEASURES}
    for done, frame in enumerate(instants.frames(rig, instants.order.tolist()), 1):
        numbers.update(frame)
        if done % TOGETHER == 0:
            for measure, own in found.items():
                own.append(Prefix(done, numbers.estimate(measure), 0.0))
    return {measure: tuple(own) for measure, own in found.items()}


def pairing(estimates):
    """Median over rigs of the spread over worlds of a difference to the first, unpaired and paired; then how many times
    fewer worlds give an error, for all rigs and for those that are no worse."""
    first, *others = estimates
    paired = np.array([float(one.minus(first).errors(MIN_WORLDS)[0]) for one in others])
    own = np.array([float(one.errors(MIN_WORLDS)[0]) for one in estimates])
    unpaired = np.hypot(own[1:], own[0])
    no_worse = np.array([float(one.value[0]) for one in others]) >= float(first.value[0])
    fewer = (unpaired / paired) ** 2
    spreads = (np.median(each) * np.sqrt(WORLDS) for each in (unpaired, paired))
    return *spreads, np.median(fewer), np.median(fewer[no_worse])


def racing(scores):
    """Share of the instants, loss, and share of races won by the best, over orders of the rigs."""
    rows, whole, every = [], [float(one[-1].estimate.value[0]) for one in scores], scores[0][-1].instants
    for number in range(ORDERS):
        best, spent = 0, every
        for candidate in (1 + np.random.default_rng(number).permutation(len(scores) - 1)).tolist():
            raced = race(iter(scores[candidate]), [scores[best]])
            spent += raced[-1].instants
            if raced[-1].instants == every and gains(raced[-1].estimate, scores[best][-1].estimate)[0][0] > 0:
                best = candidate
        rows.append((spent / every / len(scores), max(whole) - whole[best], whole[best] == max(whole)))
    return np.array(rows)


def main():
    start = time.process_time()
    instants = CommonInstants("urban", OBJECTIVE, worlds=WORLDS, per_world=PER_WORLD)
    building_s = (time.process_time() - start) / len(instants)
    rigs = [mounted(number) for number in range(RIGS + 1)]
    start = time.process_time()
    estimates = [instants.estimates(rig) for rig in rigs]
    scoring_s = (time.process_time() - start) / len(rigs) / len(instants)
    frames = list(instants.frames())
    held_mb = sum(frame.reference.nbytes + frame.reference_weights.nbytes for frame in frames) / len(frames) / 1e6
    points = np.mean([len(frame.reference) for frame in frames])
    rays = next(instants.frames(rigs[0])).counts["rays"]
    print(f"{RIGS} random mounts of front_roof_32 and its own in {WORLDS} worlds of urban with {PER_WORLD} instants")
    print(f"each ({rays:,} rays, {points:,.0f} reference points); races in {SEEDS} times {RACED_WORLDS} worlds\n")
    raced = {measure: [] for measure in MEASURES}
    for seed in range(SEEDS):
        with CommonInstants("urban", OBJECTIVE, worlds=RACED_WORLDS, per_world=PER_WORLD, seed=1 + seed) as few:
            scores = [prefixes(few, rig) for rig in rigs]
        for measure, rows in raced.items():
            rows.append(racing([one[measure] for one in scores]))
    rows = []
    for measure in MEASURES:
        share, loss, kept = np.concatenate(raced[measure]).mean(axis=0)
        numbers = map(float, pairing([one[measure] for one in estimates]))
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
