"""Rank correlations of metrics with the placements of Place3D, as a page in Markdown."""

import math

from examples.place3d.study import NOTES, READINGS, summarize_agreement


def format_page(study):
    """Format a table for each rating of the detectors, with both readings of the rolls, and the scores of all rigs.

    Args:
        study: `Study`.
    """
    scores = study.scores
    method = (
        f"Measured in {scores.num_frames} frames of {study.scenario}, seed {study.seed}. Spearman's correlation and "
        "Kendall's tau-b with the mean of the networks; 95 % intervals by resampling scenes and networks (where marked "
        "*, networks only); p is the probability of a correlation as strong, of either sign, by chance. More is "
        "better, as the authors of a metric define it."
    )
    text = "".join(f"{line}\n\n" for line in (*NOTES, method))
    for rating in dict.fromkeys(rating for rating, _ in study.agreements):
        agreements = {reading: study.agreements[rating, reading] for reading in READINGS}
        text += f"## {rating}\n\n{summarize_agreement(rating, agreements)}\n\n{format_correlations(agreements)}\n"
    heading = f"| metric | {' | '.join(scores.rigs)} |\n|---|{'---:|' * len(scores.rigs)}\n"
    text += f"## Scores of each rig\n\n{heading}"
    for ranking in scores.rankings:
        cells = [ranking.name, *(format_score(score) for score in ranking.scores)]
        text += f"| {' | '.join(cells)} |\n"
    return text


def format_correlations(agreements):
    """Format a row for each metric.

    Args:
        agreements: Reading of the rolls -> `MetricAgreement`.
    """
    columns = [f"{name}, {reading}" for reading in agreements for name in ("Spearman", "tau-b", "p")]
    text = f"| metric | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}\n"
    for rows in zip(*(agreement.correlations for agreement in agreements.values()), strict=True):
        cells = []
        for row in rows:
            cells += [row.spearman.text, row.kendall.text, format_score(row.p_value)]
        text += f"| {rows[0].metric}{'' if rows[0].resamples_scenes else ' *'} | {' | '.join(cells)} |\n"
    return text


def format_score(value):
    """Format a number with four digits."""
    return "-" if math.isnan(value) else f"{value:.4g}"
