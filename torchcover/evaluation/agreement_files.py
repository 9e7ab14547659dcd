"""The files of `torchcover agree`: a page, and every number in CSV and JSON."""

import csv
import io
import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import IO

from torchcover.evaluation.agreeing import READINGS, AgreementStudy
from torchcover.files import write_durably
from torchcover.published import Agreement, Ranked, Relation

COLUMNS = ("truth", "rolls", "metric", "kind", "spearman", "spearman_low", "spearman_high", "kendall", "kendall_low",
           "kendall_high", "p", "interval_over")  # fmt: skip


def save_agreement(study: AgreementStudy, folder: Path) -> list[Path]:
    """Write the files of a study.

    Returns:
        `agreement.csv`, a row for each metric, truth and reading of the rolls; `scores.csv`, what each metric says of
        each rig; `agreement.json`, everything; `agreement.md`, the page.
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "agreement.csv": _csv([COLUMNS, *_rows(study)]),
        "scores.csv": _csv([("metric", "kind", *study.scores.rigs), *_scores(study)]),
        "agreement.json": json.dumps(record(study), indent=1, allow_nan=False),
        "agreement.md": page(study),
    }
    for name, text in texts.items():
        write_durably(folder / name, partial(_write, text))
    return [folder / name for name in texts]


def _write(text: str, file: IO[bytes]) -> None:
    file.write(text.encode())


def record(study: AgreementStudy) -> dict[str, object]:
    """Everything, as JSON takes it; what is unknown is None."""
    return {
        "scenario": study.scenario,
        "steps": study.scores.steps,
        "seed": study.seed,
        "notes": list(study.notes),
        "truths": [
            {
                "truth": truth,
                "rolls": reading,
                "judges": list(found.judged.judges),
                "placements": dict(zip(found.judged.placements, found.judged.mean.tolist(), strict=True)),
                "noise_ceiling": _known(found.judged.ceiling),
                "metrics_looked_at": found.looked_at,
                "best": found.best,
                "p_of_the_best": _known(found.best_p),
                "best_by_chance_95": _known(found.by_chance),
            }
            for (truth, reading), found in study.found.items()
        ],
        "rows": [dict(zip(COLUMNS, row, strict=True)) for row in _rows(study)],
    }


def page(study: AgreementStudy) -> str:
    """The page in Markdown: a table for each truth, with both readings of the rolls side by side."""
    scores = study.scores
    lines = [*study.notes, _measured(study)]
    text = "".join(f"{line}\n\n" for line in lines)
    for truth in dict.fromkeys(truth for truth, _ in study.found):
        found = {reading: study.found[truth, reading] for reading in READINGS}
        text += f"## {truth}\n\n{verdict(truth, found)}\n\n{_table(found)}\n"
    heading = f"| metric | {' | '.join(scores.rigs)} |\n|---|{'---:|' * len(scores.rigs)}\n"
    rows = "".join(f"| {' | '.join([str(name), *map(_short, values)])} |\n" for name, _, *values in _scores(study))
    return f"{text}## What each metric says of each rig\n\n{heading}{rows}"


def verdict(truth: str, found: dict[str, Agreement]) -> str:
    """What the detectors agree on, and what the best of so many metrics is worth."""
    first = next(iter(found.values()))
    judges = first.judged.judges
    words = (
        f"{len(judges)} networks ({', '.join(judges)}) agree with each other by {first.judged.ceiling:.2f} on {truth}."
    )
    for reading, one in found.items():
        words += (
            f" Rolls in {reading}: of {one.looked_at} metrics the best is `{one.best}`, p = {one.best_p:.3f} as the "
            f"best of so many; one of twenty times chance alone gives the best more than {one.by_chance:.2f}."
        )
    return words


def relation(one: Relation) -> str:
    """A number and its interval.

    Example:
        >>> relation(Relation(0.857, 0.5, 0.95))
        '+0.86 [+0.50, +0.95]'
    """
    if math.isnan(one.value):
        return "-"
    return f"{one.value:+.2f} [{one.low:+.2f}, {one.high:+.2f}]"


def _measured(study: AgreementStudy) -> str:
    scores = study.scores
    return (
        f"Measured in {scores.steps} steps of {study.scenario}, seed {study.seed}. "
        "Spearman's correlation and Kendall's tau-b with the mean of the networks, 95 % intervals from drawing worlds "
        "and networks anew (where marked *, networks only), p of a correlation as strong, of either sign, by chance. "
        "More is better, as a metric's authors say it."
    )


def _table(found: dict[str, Agreement]) -> str:
    columns = [f"{name}, {reading}" for reading in found for name in ("Spearman", "tau-b", "p")]
    text = f"| metric | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}\n"
    for rows in zip(*(one.ranked for one in found.values()), strict=True):
        cells = [cell for row in rows for cell in (relation(row.spearman), relation(row.kendall), _short(row.p))]
        text += f"| {rows[0].metric}{'' if rows[0].over_worlds else ' *'} | {' | '.join(cells)} |\n"
    return text


def _rows(study: AgreementStudy) -> list[tuple[object, ...]]:
    return [
        (truth, reading, row.metric, row.kind, *map(_known, (*row.spearman, *row.kendall, row.p)), _over(row))
        for (truth, reading), one in study.found.items()
        for row in one.ranked
    ]


def _scores(study: AgreementStudy) -> list[tuple[object, ...]]:
    return [(one.name, one.kind, *map(_known, one.values.tolist())) for one in study.scores.candidates]


def _over(row: Ranked) -> str:
    return "worlds and networks" if row.over_worlds else "networks"


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) and not math.isnan(value) else "-"


def _csv(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
