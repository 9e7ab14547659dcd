"""What a search, and a choice, write: the same kinds of files and one page."""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from torchcover import __version__
from torchcover.evaluation import build_sensor_views
from torchcover.evaluation.progress import defer_signals
from torchcover.evaluation.result_page import format_facts, format_rig_yaml
from torchcover.evaluation.settings import FILES, parse_file_kinds
from torchcover.files import AtomicOutput, format_csv
from torchcover.geometry.arrays import Float64
from torchcover.notebooks import build_dataframe, build_result_html
from torchcover.placement.validation import replace_nan
from torchcover.report import Page, PagePicture, PageRig, PageTable, render_page
from torchcover.simulation import Rig

if TYPE_CHECKING:
    import pandas

OF_THE_RUN = ("seconds", "torchcover", "space_sha256")


@dataclass(frozen=True, eq=False)
class PlacementReport:
    """What was found, for its files, its page, and the terminal.

    `record` stands in `search.json`, where what is unknown may be NaN; the page shows those `setting_names` of it, and the
    rigs that are `page_rigs`, by what they are. `rigs` and `csv_tables`, tables with their headings, are by the names of their
    files. The first table is printed, too. `render_plots` makes the stem of a file, what it shows, and a figure of its own.
    """

    title: str
    summary: str
    record: Mapping[str, Any]
    setting_names: Sequence[str]
    rigs: Mapping[str, Rig]
    page_rigs: Mapping[str, Rig]
    tables: Sequence[PageTable]
    csv_tables: Mapping[str, Iterable[Iterable[object]]]
    render_plots: Callable[[], Iterator[tuple[str, str, Figure]]]
    ego_outline_m: Float64

    def save(self, folder: str | Path, *, files: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of the command line: first what was found, then the pictures and the page.

        A folder is made if it does not exist; files of an earlier run that its `summary.json` lists are deleted.
        `files` is as in `Result.save`; "maps" are the pictures.
        """
        wanted = parse_file_kinds(files)
        summary = {"torchcover": __version__, "complete": True, "sentence": self.summary}
        with AtomicOutput(Path(folder)) as written:
            with defer_signals():  # what was found is safe before anything ends this
                if "numbers" in wanted:
                    self._add_numbers(written)
                written.publish(summary)
            pictures = []
            for stem, words, figure in self.render_plots() if wanted & {"maps", "page"} else ():
                png = BytesIO()
                figure.savefig(png, dpi=figure.dpi)
                pictures.append(PagePicture(words, png.getvalue()))
                if "maps" in wanted:
                    written.add(f"{stem}.png", partial(Path.write_bytes, data=png.getvalue()))
            if "page" in wanted:
                written.add_text("report.html", render_page(self._page(pictures)))
            written.publish(summary)
        return written.paths

    def _add_numbers(self, files: AtomicOutput) -> None:
        for name, rig in self.rigs.items():
            files.add(name, rig.save)
        for name, rows in self.csv_tables.items():
            files.add_text(name, format_csv([*map(_digits, row)] for row in rows))
        record = json.dumps(replace_nan({**self.record, "sentence": self.summary}), indent=2, allow_nan=False)
        files.add_text("search.json", f"{record}\n")

    def _page(self, pictures: Sequence[PagePicture]) -> Page:
        record = replace_nan(self.record)
        facts = {"Settings": self.setting_names, "Run": [name for name in OF_THE_RUN if name in record]}
        return Page(
            title=self.title,
            lead="Measured by torchcover.",
            findings=re.split(r"(?<=[.]) (?=[A-Z])", self.summary),
            tables=self.tables,
            pictures=pictures,
            rigs=[
                PageRig(f"{what}: {rig.name}", build_sensor_views(rig.sensors), format_rig_yaml(rig.name, rig.sensors))
                for what, rig in self.page_rigs.items()
            ],
            ego_outline_m=self.ego_outline_m,
            facts={title: format_facts({name: record[name] for name in names}) for title, names in facts.items()},
        )


class ReportMixin:
    """What has a report: files, a page, and what a notebook shows of it."""

    @property
    def report(self) -> PlacementReport:
        """For its files, its page, and the terminal."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        report = self.report
        return build_result_html([report.title, report.summary], self.plot())

    def plot(self) -> Figure:
        """The first of its pictures: a figure of its own, outside pyplot."""
        return next(self.report.render_plots())[2]

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows of its first table: `candidates.csv` of a choice, `evaluations.csv` of a search.

        Raises:
            ModuleNotFoundError: pandas is not there.
        """
        headings, *rows = next(iter(self.report.csv_tables.values()))
        return build_dataframe(dict(zip(map(str, headings), row, strict=True)) for row in rows)

    def save(self, folder: str | Path, *, files: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of the command line; see `PlacementReport.save`.

        They are `best.yaml` (of several objectives also `best_OBJECTIVE.yaml`), `search.json`, `report.html`, the
        pictures and `summary.json`; of a choice `candidates.csv` and `sizes.csv`, of a search `evaluations.csv` and
        `pareto.csv`.
        """
        return self.report.save(folder, files=files)


def _digits(value: object) -> object:
    """As many as anybody can use."""
    return f"{value:.9g}" if isinstance(value, float) and value == value else value
