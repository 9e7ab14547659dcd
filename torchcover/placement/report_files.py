"""Files and page of a placement search or a sensor selection."""

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

RUN_KEYS = ("duration_s", "torchcover", "space_sha256")  # keys of the record that are no settings


@dataclass(frozen=True, eq=False)
class PlacementReport:
    """Content of the files, the page and the terminal output of a placement result.

    Args:
        title: Title of the page.
        summary: Summary in sentences.
        record: Content of `search.json`; unknown numbers are NaN.
        setting_names: Keys of `record` that the page shows as settings.
        rigs: File name -> rig.
        page_rigs: Role -> rig, as shown on the page.
        tables: Tables of the page; the first is also printed.
        csv_tables: File name -> rows, the first of them headings.
        render_plots: Function that yields file stem, description and figure of each plot.
        ego_outline_m: (K, 2) corners x, y of the vehicle in meters.
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
        """Write the files of the command line: first numbers and rigs, then plots and page.

        Files of an earlier run that its `summary.json` lists are deleted.

        Args:
            folder: Folder of the files; it is created if it does not exist.
            files: Kinds of files, as in `Result.save`; "maps" are the plots.

        Returns:
            Paths of the written files.
        """
        kinds = parse_file_kinds(files)
        summary = {"torchcover": __version__, "complete": True, "summary": self.summary}
        with AtomicOutput(Path(folder)) as output:
            with defer_signals():  # an interrupted program must not lose the numbers
                if "numbers" in kinds:
                    self._add_numbers(output)
                output.publish(summary)
            pictures = []
            for stem, description, figure in self.render_plots() if kinds & {"maps", "page"} else ():
                png = BytesIO()
                figure.savefig(png, dpi=figure.dpi)
                pictures.append(PagePicture(description, png.getvalue()))
                if "maps" in kinds:
                    output.add(f"{stem}.png", partial(Path.write_bytes, data=png.getvalue()))
            if "page" in kinds:
                output.add_text("report.html", render_page(self._build_page(pictures)))
            output.publish(summary)
        return output.paths

    def _add_numbers(self, output: AtomicOutput) -> None:
        """Add the rigs, the CSV tables and search.json."""
        for name, rig in self.rigs.items():
            output.add(name, rig.save)
        for name, rows in self.csv_tables.items():
            rounded_rows = []
            for row in rows:
                rounded_rows.append([_round_digits(value) for value in row])
            output.add_text(name, format_csv(rounded_rows))
        record = json.dumps(replace_nan({**self.record, "summary": self.summary}), indent=2, allow_nan=False)
        output.add_text("search.json", f"{record}\n")

    def _build_page(self, pictures: Sequence[PagePicture]) -> Page:
        """Build the page with all tables, rigs and plots."""
        record = replace_nan(self.record)
        rigs = []
        for role, rig in self.page_rigs.items():
            yaml_text = format_rig_yaml(rig.name, rig.sensors)
            rigs.append(PageRig(f"{role}: {rig.name}", build_sensor_views(rig.sensors), yaml_text))
        settings = {name: record[name] for name in self.setting_names}
        run = {name: record[name] for name in RUN_KEYS if name in record}
        return Page(
            title=self.title,
            lead="Measured by torchcover.",
            findings=re.split(r"(?<=[.]) (?=[A-Z])", self.summary),
            tables=self.tables,
            pictures=pictures,
            rigs=rigs,
            ego_outline_m=self.ego_outline_m,
            facts={"Settings": format_facts(settings), "Run": format_facts(run)},
        )


class ReportMixin:
    """Methods of results that have a `PlacementReport`: files, a plot, and a notebook view."""

    @property
    def report(self) -> PlacementReport:
        """Content of the files, the page and the terminal output."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        report = self.report
        return build_result_html([report.title, report.summary], self.plot())

    def plot(self) -> Figure:
        """Return the first plot, a new figure outside pyplot."""
        return next(self.report.render_plots())[2]

    def to_dataframe(self) -> "pandas.DataFrame":
        """Return `evaluations.csv` of a search or `candidates.csv` of a selection as a data frame.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        headings, *rows = next(iter(self.report.csv_tables.values()))
        names = [str(heading) for heading in headings]
        return build_dataframe(dict(zip(names, row, strict=True)) for row in rows)

    def save(self, folder: str | Path, *, files: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of the command line, see `PlacementReport.save`.

        They are `best.yaml` (of several objectives also `best_OBJECTIVE.yaml`), `search.json`, `report.html`, plots and
        `summary.json`; of a search also `evaluations.csv` and `pareto.csv`, of a selection `candidates.csv` and
        `sizes.csv`.

        Args:
            folder: Folder of the files.
            files: Kinds of files, as in `Result.save`.

        Returns:
            Paths of the written files.
        """
        return self.report.save(folder, files=files)


def _round_digits(value: object) -> object:
    """Round numbers of a CSV file to nine digits."""
    return f"{value:.9g}" if isinstance(value, float) and value == value else value
