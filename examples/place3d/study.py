"""The placements of Place3D (NeurIPS 2024), ranked by metrics and by the published results of detectors."""

from typing import NamedTuple

from torchcover.contrib import PlacementRatings, correlate_rankings, read_results, score_placements
from torchcover.simulation import get_builtin_folder, list_builtin_names

PAPER = "place3d2024"
# Quantity and class in `datasets/published/place3d_2024.csv`, and what it is called here.
TRUTHS = {("map", "car"): "car mAP", ("map", "bicycle"): "bicycle mAP", ("map", "pedestrian"): "pedestrian mAP",
          ("miou", ""): "mIoU"}  # fmt: skip
# How the rolls of Table 7 are read, and what the rigs are called at their end.
READINGS = {"radians": "", "degrees": "_degrees"}
# What has to be known before any of it is believed.
NOTES = (
    "8 placements, 4 of which have the same mean height and which have 4 heights in all, cannot separate metrics: "
    "whatever grows with the height ranks them much as the detectors do.",
    "No metric is validated by this: for cars, Li et al. (ICRA 2024) and Place3D rank the same four placements "
    "(center, line, pyramid, trapezoid) with a Spearman correlation of -0.80, so that no metric can agree with both.",
    "The paper does not say whether rolls are radians or degrees; in degrees pyramid_roll is all but pyramid, as "
    "in the published car mAP (52.12 and 52.17).",
)


class Study(NamedTuple):
    """How metrics rank the placements by what detectors say and how the rolls are read, and what each scores."""

    found: dict
    scores: object
    scenario: str
    seed: int


def agree(scenario="urban", *, seed=0, **settings):
    """Measure the placements in a scenario; settings are those of `score_placements`."""
    rigs = {name: name for name in list_builtin_names("rigs") if name.startswith(f"{PAPER}_")}
    scores = score_placements(rigs, scenario, seed=seed, **settings)
    return Study(agreements(scores), scores, scenario, seed)


def agreements(scores):
    """What detectors say, and how the rolls are read -> how metrics rank the placements."""
    results = read_results(get_builtin_folder("published") / "place3d_2024.csv")
    found = {}
    for key, words in TRUTHS.items():
        judged = results[key]
        truth = PlacementRatings(words, judged.placements, judged.raters, judged.values)
        for reading, ending in READINGS.items():
            named = [rig_of(placement, ending, scores.rigs) for placement in judged.placements]
            found[words, reading] = correlate_rankings(scores.of(named), truth)
    return found


def rig_of(placement, ending, rigs):
    """The rig of a placement; most have no roll, and are the same in both readings."""
    name = f"{PAPER}_{placement}"
    return f"{name}{ending}" if f"{name}{ending}" in rigs else name


def verdict(truth, found):
    """What the detectors agree on, and what the best of so many metrics is worth."""
    judged = next(iter(found.values())).judged
    networks = f"{len(judged.judges)} networks ({', '.join(judged.judges)})"
    words = f"{networks} agree with each other by {judged.ceiling:.2f} on {truth}."
    for reading, one in found.items():
        words += (
            f" Rolls in {reading}: of {one.looked_at} metrics the best is `{one.best}`, p = {one.best_p:.3f} as the "
            f"best of so many; one of twenty times chance alone gives the best more than {one.by_chance:.2f}."
        )
    return words
