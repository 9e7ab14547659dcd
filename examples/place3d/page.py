"""How metrics rank the placements of Place3D, as a page in Markdown."""

import math

from examples.place3d.study import NOTES, READINGS, verdict


def page(study):
    """A table for each truth, with both readings of the rolls side by side, and what each metric says of each rig."""
    scores = study.scores
    measured = (
        f"Measured in {scores.steps} steps of {study.scenario}, seed {study.seed}. "
        "Spearman's correlation and Kendall's tau-b with the mean of the networks, 95 % intervals from drawing worlds "
        "and networks anew (where marked *, networks only), p of a correlation as strong, of either sign, by chance. "
        "More is better, as a metric's authors say it."
    )
    text = "".join(f"{line}\n\n" for line in (*NOTES, measured))
    for truth in dict.fromkeys(truth for truth, _ in study.found):
        found = {reading: study.found[truth, reading] for reading in READINGS}
        text += f"## {truth}\n\n{verdict(truth, found)}\n\n{ranks(found)}\n"
    heading = f"| metric | {' | '.join(scores.rigs)} |\n|---|{'---:|' * len(scores.rigs)}\n"
    rows = "".join(f"| {' | '.join([one.name, *map(short, one.gains)])} |\n" for one in scores.rankings)
    return f"{text}## What each metric says of each rig\n\n{heading}{rows}"


def ranks(found):
    """A row for each metric."""
    columns = [f"{name}, {reading}" for reading in found for name in ("Spearman", "tau-b", "p")]
    text = f"| metric | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}\n"
    for rows in zip(*(one.ranked for one in found.values()), strict=True):
        cells = [cell for row in rows for cell in (row.spearman.words, row.kendall.words, short(row.p))]
        text += f"| {rows[0].metric}{'' if rows[0].over_worlds else ' *'} | {' | '.join(cells)} |\n"
    return text


def short(value):
    """A number in four digits."""
    return "-" if math.isnan(value) else f"{value:.4g}"
