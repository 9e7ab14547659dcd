"""The files of a search."""

import csv
import json
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np

from torchcover.evaluation.progress import held_back
from torchcover.evaluation.result_files import ResultFiles
from torchcover.placement.evaluation import Evaluation
from torchcover.placement.result import SearchResult
from torchcover.placement.result_page import search_page
from torchcover.placement.result_pictures import search_pictures
from torchcover.placement.scores import Scores
from torchcover.report import PagePicture, file_stems, page_html
from torchcover.simulation import Rig


def save_search(result: SearchResult, folder: Path) -> list[Path]:
    """Write the files of the command line: first what was found, then the pictures and the page.

    Args:
        result: What was found.
        folder: Where to write `best.yaml` (of several objectives also `best_OBJECTIVE.yaml`), `evaluations.csv`,
            `pareto.csv`, `search.json`, `report.html`, the pictures, and, last, `summary.json`. Made if it does not
            exist; files of an earlier search that its `summary.json` lists are deleted.

    Returns:
        The files.
    """
    record = result.record
    summary = {"torchcover": record["torchcover"], "complete": True, "sentence": result.sentence}
    with ResultFiles(folder) as files:
        with held_back():  # what was found is safe before anything ends this
            for name, rig in _rigs(result).items():
                files.add(name, rig.save)
            files.add("evaluations.csv", partial(write_rows, list(evaluation_rows(result))))
            files.add("pareto.csv", partial(write_rows, list(pareto_rows(result))))
            files.add("search.json", partial(write_text, json.dumps(record, indent=2, allow_nan=False) + "\n"))
            files.publish(summary)
        pictures = {}
        for stem, title, figure in search_pictures(result):
            png = BytesIO()
            figure.savefig(png, dpi=figure.dpi)
            pictures[f"{stem}.png"] = PagePicture(title, png.getvalue())
        for name, picture in pictures.items():
            files.add(name, partial(write_bytes, picture.png))
        page = search_page(result, list(pictures.values()))
        files.add("report.html", partial(write_text, page_html(page)))
        files.publish(summary)
    return files.paths


def evaluation_rows(result: SearchResult) -> Iterator[Sequence[object]]:
    """A row for each candidate, with a heading: gains are in shares, over the start."""
    search = result.search
    names, variables = list(search.space.objectives), [variable.name for variable in search.space.variables]
    of_objectives = [f"{name}_{what}" for name in names for what in ("mean", "gain", "gain_error")]
    at_end = ("instants", "self_hit_share", "cost_eur", "seconds", "why")
    yield ["number", "arm", "state", *variables, *of_objectives, *at_end]
    places = {one.number: (arm, at) for arm in search.arms.values() for at, one in enumerate(arm.evaluations)}
    for one in search.evaluations:
        arm, at = places[one.number]
        means = [None] * len(names) if one.scores is None else _means(result, one.scores)
        pair = arm.against_start(at)
        errors = [None] * len(names) if pair is None else pair.error.tolist()
        each = [value for triple in zip(means, arm.gains[at].tolist(), errors, strict=True) for value in triple]
        state, why = _state(result, one)
        hits = None if one.scores is None else one.scores.self_hit_share
        values = [one.values.get(name) for name in variables]
        cells = map(cell, [*values, *each, one.instants, hits, _cost(result, one), round(one.seconds, 3)])
        yield [one.number, one.arm, state, *cells, why]


def pareto_rows(result: SearchResult) -> Iterator[Sequence[object]]:
    """Candidates of each arm that no other of it beats, with a heading."""
    search = result.search
    variables = [variable.name for variable in search.space.variables]
    yield ["arm", "number", *(f"{name}_gain" for name in search.space.objectives), "cost_eur", *variables]
    for name, arm in search.arms.items():
        for at in arm.front:
            one = arm.evaluations[at]
            values = [one.values.get(variable) for variable in variables]
            yield [name, one.number, *map(cell, [*arm.gains[at].tolist(), _cost(result, one), *values])]


def _means(result: SearchResult, scores: Scores) -> list[float]:
    """Over the worlds that it was scored in, for each objective; NaN where none knows it."""
    known = (column[~np.isnan(column)] for column in scores.by_world(result.search.plan.measure).T)
    return [float(column.mean()) if len(column) else np.nan for column in known]


def _state(result: SearchResult, one: Evaluation) -> tuple[str, str]:
    if one.infeasible:
        return "infeasible", one.infeasible
    if one.instants < len(result.search.instants):
        return "dropped", "two standard errors below the best so far"
    return "complete", ""


def _cost(result: SearchResult, one: Evaluation) -> float | None:
    space = result.search.space
    if not space.cost or one.infeasible:
        return None
    return space.cost_eur(space.start if one.number == 0 else space.rig(one.values, str(one.number)))


def _rigs(result: SearchResult) -> dict[str, Rig]:
    """By the names of their files."""
    picks = [pick for pick in result.picks if pick.arm == "optimiser"]
    if len(picks) < 2:
        return {"best.yaml": result.rig}
    ends = picks[1:]
    stems = file_stems([pick.role for pick in ends])
    return {"best.yaml": result.rig} | {f"best_{stem}.yaml": pick.rig for stem, pick in zip(stems, ends, strict=True)}


def cell(value: object) -> object:
    """What stands in a table; nothing for what nobody knows."""
    if value is None or value != value:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else value


def write_rows(rows: Sequence[Iterable[object]], path: Path) -> None:
    """Write a table as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def write_text(text: str, path: Path) -> None:
    """Write a text."""
    path.write_text(text, encoding="utf-8")


def write_bytes(data: bytes, path: Path) -> None:
    """Write what is encoded already."""
    path.write_bytes(data)
