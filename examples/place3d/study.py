"""The placements of Place3D (NeurIPS 2024), ranked by metrics and by the published results of detectors."""

from typing import NamedTuple

from torchcover.contrib import PlacementRatings, correlate_rankings, read_results, score_placements
from torchcover.simulation import get_builtin_folder, list_builtin_names

# Quantity and class in `datasets/published/place3d_2024.csv` -> name of the rating on the page.
RATINGS = {
    ("map", "car"): "car mAP",
    ("map", "bicycle"): "bicycle mAP",
    ("map", "pedestrian"): "pedestrian mAP",
    ("miou", ""): "mIoU",
}
# Unit of the rolls in Table 7 -> ending of the names of the rigs.
READINGS = {"radians": "", "degrees": "_degrees"}
NOTES = (
    "8 placements, 4 of which have the same mean height and which have 4 heights in all, cannot separate metrics: "
    "any number that grows with the height ranks them much as the detectors do.",
    "No metric is validated by this: for cars, Li et al. (ICRA 2024) and Place3D rank the same four placements "
    "(center, line, pyramid, trapezoid) with a Spearman correlation of -0.80, so that no metric can agree with both.",
    "The paper does not say whether rolls are radians or degrees; in degrees pyramid_roll is nearly pyramid, as "
    "in the published car mAP (52.12 and 52.17).",
)


class Study(NamedTuple):
    """Scores of the placements by all metrics, and their agreement with the detectors.

    Args:
        agreements: (rating, reading of the rolls) -> `MetricAgreement`.
        scores: `PlacementScores`.
        scenario: Name of the scenario.
        seed: Seed of the traffic.
    """

    agreements: dict
    scores: object
    scenario: str
    seed: int


def run_study(scenario="urban", *, seed=0, **settings):
    """Measure the placements in a scenario and rank them.

    Args:
        scenario: Name of a scenario.
        seed: Seed of the traffic.
        settings: Settings of `score_placements`.

    Returns:
        `Study`.
    """
    rigs = {name: name for name in list_builtin_names("rigs") if name.startswith("place3d2024_")}
    scores = score_placements(rigs, scenario, seed=seed, **settings)
    return Study(compute_agreements(scores), scores, scenario, seed)


def compute_agreements(scores):
    """Correlate the rankings of metrics with the results of the detectors.

    Args:
        scores: `PlacementScores` of all rigs.

    Returns:
        (rating, reading of the rolls) -> `MetricAgreement`.
    """
    results = read_results(get_builtin_folder("published") / "place3d_2024.csv")
    agreements = {}
    for key, rating in RATINGS.items():
        published = results[key]
        ratings = PlacementRatings(rating, published.placements, published.raters, published.values)
        for reading, ending in READINGS.items():
            rigs = [get_rig_name(placement, ending, scores.rigs) for placement in published.placements]
            agreements[rating, reading] = correlate_rankings(scores.select(rigs), ratings)
    return agreements


def get_rig_name(placement, ending, rigs):
    """Return the name of the rig of a placement; most placements have no roll, and one rig for both readings."""
    name = f"place3d2024_{placement}"
    return f"{name}{ending}" if f"{name}{ending}" in rigs else name


def summarize_agreement(rating, agreements):
    """Summarize the agreement of the detectors and the significance of the best metric.

    Args:
        rating: Name of the rating.
        agreements: Reading of the rolls -> `MetricAgreement`.
    """
    ratings = next(iter(agreements.values())).ratings
    networks = f"{len(ratings.raters)} networks ({', '.join(ratings.raters)})"
    text = f"{networks} agree with each other by {ratings.inter_rater_correlation:.2f} on {rating}."
    for reading, agreement in agreements.items():
        text += (
            f" Rolls in {reading}: the best of {agreement.metric_count} metrics is `{agreement.best_metric}`, "
            f"p = {agreement.best_p_value:.3f} corrected for the choice of the best; in one of twenty cases, chance "
            f"alone gives the best metric more than {agreement.chance_threshold:.2f}."
        )
    return text
