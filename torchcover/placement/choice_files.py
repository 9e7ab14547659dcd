"""The files of a choice: the rig, the numbers, a picture and a page."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path

from torchcover.evaluation import sensor_views
from torchcover.evaluation.progress import held_back
from torchcover.evaluation.result_files import ResultFiles
from torchcover.evaluation.result_page import rig_document, words_of
from torchcover.placement.choosing import SensorChoice
from torchcover.placement.result_files import cell, write_bytes, write_rows, write_text
from torchcover.placement.subsets import greedy
from torchcover.report import ChoiceSize, Page, PagePicture, PageRig, PageTable, Words, draw_choice, page_html

HEADINGS = ("sensor", "alone (%)", "lost without it\n(points)", "cost (EUR)")
# Sizes of choices that are looked at, for the picture.
MOST_SIZES = 12


def save_choice(found: SensorChoice, folder: Path) -> list[Path]:
    """Write the files of the command line.

    Args:
        found: What was chosen.
        folder: Where to write `best.yaml`, `candidates.csv`, `sizes.csv`, `search.json`, `sizes.png`, `report.html`,
            and, last, `summary.json`. Made if it does not exist.

    Returns:
        The files.
    """
    record = found.record
    sizes = list(_sizes(found))
    with ResultFiles(folder) as files:
        with held_back():
            files.add("best.yaml", found.rig.save)
            files.add("candidates.csv", partial(write_rows, list(candidate_rows(found))))
            files.add("sizes.csv", partial(write_rows, [ChoiceSize._fields, *(map(cell, one) for one in sizes)]))
            files.add("search.json", partial(write_text, json.dumps(record, indent=2, allow_nan=False) + "\n"))
            files.publish({key: record[key] for key in ("torchcover", "sentence")} | {"complete": True})
        png = BytesIO()
        drawn = [one.value for one in found.drawn]
        figure = draw_choice(sizes, drawn, len(found.best.chosen), found.best.value, title=found.space.name)
        figure.savefig(png, dpi=figure.dpi)
        files.add("sizes.png", partial(write_bytes, png.getvalue()))
        picture = PagePicture("What more sensors bring, and what random choices are worth", png.getvalue())
        files.add("report.html", partial(write_text, page_html(_page(found, picture))))
        files.publish({key: record[key] for key in ("torchcover", "sentence")} | {"complete": True})
    return files.paths


def candidate_rows(found: SensorChoice) -> Iterator[Sequence[object]]:
    """A row for each candidate, with a heading: values are shares, with what is always there."""
    lost = dict(zip(found.best.chosen, found.marginal_values, strict=True))
    yield ["name", "value_alone", "cost_eur", "chosen", "lost_without", "why_not"]
    for at, sensor in enumerate(found.sensors):
        alone = found.candidates.value([at])
        yield [sensor.name, *map(cell, (alone, _price(found, at), at in lost, lost.get(at))), ""]
    for name, why in found.refused.items():
        yield [name, "", "", False, "", why]


def chosen_rows(found: SensorChoice) -> list[tuple[str, ...]]:
    """Cells below `HEADINGS`, in the order in which the sensors were chosen."""
    rows: list[tuple[str, ...]] = []
    for at, lost in zip(found.best.chosen, found.marginal_values, strict=True):
        price = _price(found, at)
        alone = f"{100 * found.candidates.value([at]):.2f}"
        rows.append((found.sensors[at].name, alone, f"{100 * lost:.2f}", "-" if price is None else f"{price:g}"))
    return rows


def _price(found: SensorChoice, at: int) -> float | None:
    return found.limits.price([at]) if found.space.cost else None


def _sizes(found: SensorChoice) -> Iterator[ChoiceSize]:
    for size in range(1, min(found.limits.most, MOST_SIZES) + 1):
        best = found.best
        if size != len(best.chosen):
            best = greedy(found.candidates, replace(found.limits, most=size))
        if len(best.chosen) == size:
            yield ChoiceSize(size, best.value, best.upper_bound)


def _page(found: SensorChoice, picture: PagePicture) -> Page:
    rigs = {"best": found.rig, "now": found.rig_of(found.now, f"{found.space.name}_now")}
    return Page(
        title=f"{found.space.name}: which sensors, and how many?",
        lead=found.sentence,
        tables=[PageTable("Chosen", HEADINGS, [tuple(map(Words, row)) for row in chosen_rows(found)], 1)],
        pictures=[picture],
        rigs=[
            PageRig(f"{name}: {rig.name}", sensor_views(rig.sensors), rig_document(rig.name, rig.sensors))
            for name, rig in rigs.items()
        ],
        ego_outline_m=found.space.scenarios[0].ego_box().outline_m,
        facts={"Result": words_of({key: value for key, value in found.record.items() if key != "sentence"})},
    )
