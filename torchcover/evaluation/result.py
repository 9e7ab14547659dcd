"""Result of an evaluation: numbers, maps, page and files of one or several rigs."""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchcover import __version__
from torchcover.coverage import Coverage, Region, TargetSums
from torchcover.coverage.quantities import make_area_quantity
from torchcover.evaluation.omissions import Omission, build_omissions_table
from torchcover.evaluation.pipeline import Run
from torchcover.evaluation.progress import defer_signals
from torchcover.evaluation.result_notes import (
    describe_failure,
    describe_perfect_depth,
    describe_reference,
    describe_scan_periods,
    describe_sensor_models,
    describe_test_targets,
    describe_weather,
)
from torchcover.evaluation.result_page import (
    build_region_outline,
    build_result_tables,
    build_sensor_views,
    collect_facts,
    estimate_rendering_cost,
    format_facts,
    format_rig_yaml,
)
from torchcover.evaluation.settings import FILES, parse_file_kinds
from torchcover.evaluation.target_error import TargetError, summarize_target_error
from torchcover.files import AtomicOutput
from torchcover.notebooks import build_dataframe, build_result_html
from torchcover.report import (
    RENDERERS,
    CoverageTable,
    Page,
    PageRig,
    PageTable,
    build_file_stems,
    build_page_maps,
    build_table_dict,
    plot_maps,
    render_page,
    summarize_findings,
)
from torchcover.report.records import build_records
from torchcover.report.sensor_failures import get_main_quantity
from torchcover.simulation import Sensor
from torchcover.simulation.memory import check_memory_fits

if TYPE_CHECKING:
    import pandas


class MetricReport(Protocol):
    """Published metrics of the rigs, as `torchcover.contrib` compares them."""

    def build_page_tables(self, *, include_parts: bool = True) -> list[PageTable]:
        """Return the tables of the page; without `include_parts` only the numbers of the whole run."""

    @property
    def record(self) -> dict[str, Any]:
        """Content of `summary.json`."""

    @property
    def files(self) -> dict[str, str]:
        """Name of each further file -> its text."""


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Result of `evaluate` and `compare`.

    Args:
        coverages: Name of each rig -> its coverage; rigs are compared with the first one.
        regions: Regions of the numbers.
        run: Outcome of the run; None for saved results, where it is unknown.
        rigs: Name of each rig -> name or file that the user gave; None for a rig of a recording.
        source: Source of the frames, with the keys `scenario`, `vehicle`, `frames`, `seed` and others.
        reference_record: Source of the reference points, see `FrameDataset.describe_reference`; None if unknown.
        device: Device of the measurement; None if unknown.
        target_sums: Name of each rig -> visibility of test targets in the near field; empty without them.
        target_error: Requested standard errors.
        target_regions: Regions to which `target_error` applies.
        sensors: Name of each rig -> its sensors, for maps; rigs with unknown sensors are missing.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in meters, for maps.
        observer_results: Name of each observer of the user -> its result.
        metrics: Published metrics of the rigs; None if not requested.
        omissions: Work that the run did not need to do.
        input_files: Coverage files from which the result was made.
        block_ends: Number of frames of the source at the end of each block of the block jackknife, as far as known.
    """

    coverages: Mapping[str, Coverage]
    regions: Sequence[Region]
    run: Run | None
    rigs: Mapping[str, str | None]
    source: Mapping[str, object]
    reference_record: Mapping[str, Any] | None
    device: str | None
    target_sums: Mapping[str, TargetSums] = field(default_factory=dict)
    target_error: TargetError | None = None
    target_regions: Sequence[Region] = ()
    sensors: Mapping[str, Sequence[Sensor]] = field(default_factory=dict)
    ego_outline_m: NDArray[Any] | None = None
    observer_results: Mapping[str, Any] = field(default_factory=dict)
    metrics: MetricReport | None = None
    omissions: Sequence[Omission] = ()
    input_files: Sequence[Path] = ()
    block_ends: Sequence[int] = ()

    @property
    def coverage(self) -> Coverage:
        """Coverage of the only rig.

        Raises:
            ValueError: The result has several rigs.
        """
        if len(self.coverages) != 1:
            raise ValueError(f"there are {len(self.coverages)} rigs ({', '.join(self.coverages)}): use coverages[name]")
        return self._first_coverage

    @property
    def vehicle(self) -> str | None:
        """Name of the ego vehicle of a simulation; None for recordings."""
        vehicle = self.source.get("vehicle")
        return None if vehicle is None else str(vehicle)

    @property
    def is_comparison(self) -> bool:
        """True if the result has several rigs."""
        return len(self.rigs) > 1

    @cached_property
    def table(self) -> CoverageTable:
        """Numbers with standard errors, differences and marks; `RENDERERS` format it."""
        return CoverageTable.from_coverages(
            self.coverages, self.regions, self.notes, self.source, self.block_ends, self.target_sums
        )

    @property
    def notes(self) -> list[str]:
        """Notes on the run, the rigs and the reference sensor, as sentences."""
        notes = [self.cut_short] if self.cut_short else []
        if self.vehicle:
            notes.append(f"Vehicle: {self.vehicle}.")
        notes += describe_sensor_models(self.source.get("sensor_model"))
        notes += describe_weather(self.source.get("weather"))
        notes += describe_perfect_depth(self.sensors)
        notes += describe_scan_periods(self.sensors)
        is_recording = bool(self.source.get("frames"))
        notes += describe_test_targets(self.target_sums, self.regions, is_recording=is_recording)
        if self.run is not None and self.used_reference is not None:
            notes += describe_reference(self.used_reference, self.run, self._first_coverage)
        return notes

    @property
    def verdict(self) -> tuple[str, ...]:
        """Findings as sentences, the most important first; differences that may be chance are not among them."""
        return (*summarize_findings(self.table), *self.sensor_model_notes, *describe_scan_periods(self.sensors))

    @property
    def sensor_model_notes(self) -> list[str]:
        """Warning that the rigs have different sensor models; empty if they have the same."""
        model_by_rig = self.source.get("sensor_model")
        if isinstance(model_by_rig, Mapping) and len(set(model_by_rig.values())) > 1:
            return describe_sensor_models(model_by_rig)
        return []

    @property
    def tables(self) -> list[PageTable]:
        """Tables of the page."""
        return [*build_result_tables(self.table), *(self.metrics.build_page_tables() if self.metrics else [])]

    @property
    def summary(self) -> list[dict[str, Any]]:
        """Rows of `summary.json`, one for each rig, region and height band; unknown is None, infinite "Infinity"."""
        rows: list[dict[str, Any]] = build_table_dict(self.table)["rows"]
        return rows

    @property
    def target_error_lines(self) -> list[str]:
        """Achieved standard errors compared with the target error, as lines of text."""
        return self._summarize_target_error()[1]

    @property
    def record(self) -> dict[str, Any]:
        """Content of `summary.json`: everything except the maps; unknown values are None."""
        record: dict[str, Any] = {"rigs": dict(self.rigs)}
        if not self.is_comparison:
            record = {"rig": next(iter(self.rigs.values()))}
        record |= self.source
        record |= {"reference": self.used_reference, "torchcover": __version__, "device": self.device}
        record |= self._build_run_record()
        record |= {
            "target_error": self._summarize_target_error()[0],
            "average": self.table.average,
            "verdict": list(self.verdict),
            "notes": list(self.table.notes),
        }
        record |= build_table_dict(self.table)
        if self.metrics is not None:
            record["metrics"] = self.metrics.record
        return record

    @property
    def used_reference(self) -> Mapping[str, Any] | None:
        """Source of the reference points, for simulated ones with the number of rays per frame; None if unknown."""
        record = self.reference_record
        if self.run is None or record is None:
            return None
        if "frame_interval_s" not in record:  # a recording
            return record
        return {**record, "rays_per_frame": self.run.counts["reference_rays"] // self.run.num_frames}

    @property
    def cut_short(self) -> str:
        """Sentence on the early end of the run, with the number of frames and the error; empty if it is complete."""
        failure = None if self.run is None else self.run.failure
        return "" if failure is None else describe_failure(failure, self._first_coverage.counts["num_frames"])

    @property
    def page(self) -> Page:
        """Page with tables, maps, rigs, settings and omissions."""
        source = self.source.get("frames") or self.source.get("scenario") or "saved results"
        location = ", on ".join(format_facts({"source": source, "vehicle": self.vehicle}).values())
        rigs = []
        for name in self.rigs:
            sensors = self.sensors.get(name, ())
            rigs.append(PageRig(name, build_sensor_views(sensors), format_rig_yaml(name, sensors)))
        return Page(
            title=(" vs. " if len(rigs) == 2 else ", ").join(self.rigs),
            lead=f"Blind spots and coverage in {location}, measured by torchcover.",
            findings=self.verdict,
            tables=self.tables,
            maps=list(build_page_maps(self.coverages, self.target_sums)) if self.coverages else [],
            rigs=rigs,
            ego_outline_m=self.ego_outline_m,
            outlines=[build_region_outline(region) for region in self.regions],
            facts=collect_facts(self.record, self.rigs, self.table.first_conditions.counts["num_frames"]),
            more_tables=[build_omissions_table(self.omissions)] if self.omissions else [],
        )

    def plot(self, layer: str | None = None) -> Figure:
        """Plot one map in the first height band, several rigs next to each other.

        Args:
            layer: Key of `Coverage.layers`; the detection rate at the first threshold by default.

        Returns:
            Figure that does not belong to pyplot.

        Raises:
            ValueError: No map has this key.
        """
        quantity = get_main_quantity(self.table)
        key = layer or (make_area_quantity(quantity) if self.table.average == "area" else quantity).key
        for _, figure in self.plot_maps(key):
            return figure
        raise ValueError(f"layer: no map shows {key!r}")

    def to_dataframe(self) -> "pandas.DataFrame":
        """Return the rows of `summary.csv`; NaN where a number is unknown.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        return build_dataframe(build_records(self.table))

    def plot_maps(self, layer: str | None = None) -> Iterator[tuple[str, Figure]]:
        """Plot the maps one after the other: several rigs next to each other, and their differences to the first rig.

        Args:
            layer: Key of the only quantity to plot; all quantities by default.

        Returns:
            Stem of the file name, and a figure that does not belong to pyplot.
        """
        views = {name: build_sensor_views(sensors) for name, sensors in self.sensors.items()}
        return plot_maps(
            self.coverages, ego_outline_m=self.ego_outline_m, sensors=views, vehicle=self.vehicle, quantity_key=layer
        )

    def save(self, folder: str | Path, *, file_kinds: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of the command line: first the numbers, then the page and the maps.

        At any time, `summary.json` lists the files of one run; files of an earlier run stay until the new numbers are
        complete, and those that the new run does not write are then deleted.

        Args:
            folder: Folder of the files, created if necessary: `coverage.npz` or `coverage/RIG.npz` for several rigs,
                `summary.csv`, `report.html`, `maps/STEM.png`, `summary.json`; with published metrics `metrics.csv` and
                `metrics_rank_correlation.csv`.
            file_kinds: Files besides `summary.json`: "numbers", "maps", "page", or a text such as "numbers,page".

        Returns:
            Paths of the files.

        Raises:
            ValueError: The folder has an input file of the comparison, a file kind is unknown, or there is not enough
                memory for the page and the maps.
        """
        kinds = parse_file_kinds(file_kinds)
        output_folders = (Path(folder).resolve(), Path(folder).resolve() / "coverage")
        for path in self.input_files:
            if path.resolve().parent in output_folders:
                raise ValueError(f"{folder}: would overwrite {path}, which is compared; choose another folder")
        with AtomicOutput(Path(folder)) as output:
            with defer_signals():  # a signal ends the process only after the numbers are complete
                self.add_numbers(output, kinds)
                record = self.record
                output.publish(record)
            self.add_page_and_maps(output, kinds)
            output.publish(record)  # again, now with the files of the page and the maps
        return output.paths

    def add_page_and_maps(self, output: AtomicOutput, file_kinds: Container[str], folder: str = "") -> None:
        """Write the page and the maps if they are requested.

        Args:
            output: Output folder.
            file_kinds: Requested files.
            folder: Prefix of the file names; it ends with a slash.

        Raises:
            ValueError: There is not enough memory.
        """
        advice = "the numbers are saved; omit page and maps with `--files numbers`, or compare fewer rigs"
        needed_bytes, _ = estimate_rendering_cost(self.coverages, file_kinds)
        check_memory_fits(f"page and maps of {len(self.coverages)} rigs", needed_bytes, advice)
        if "page" in file_kinds:
            output.add_text(f"{folder}report.html", render_page(self.page))
        if "maps" in file_kinds:
            for stem, figure in self.plot_maps():
                output.add_figure(f"{folder}maps/{stem}.png", figure)

    def add_numbers(self, output: AtomicOutput, file_kinds: Container[str], folder: str = "") -> None:
        """Write the coverages, `summary.csv` and the files of the published metrics if they are requested.

        Args:
            output: Output folder.
            file_kinds: Requested files.
            folder: Prefix of the file names; it ends with a slash.
        """
        if "numbers" not in file_kinds:
            return
        names = [f"{folder}coverage.npz"]
        if self.is_comparison:
            names = [f"{folder}coverage/{stem}.npz" for stem in build_file_stems(list(self.coverages))]
        for name, (rig, coverage) in zip(names, self.coverages.items(), strict=True):
            arrays = self.target_sums[rig].to_arrays() if rig in self.target_sums else None
            output.add(name, partial(coverage.save, further_arrays=arrays))
        output.add_text(f"{folder}summary.csv", RENDERERS["csv"](self.table))
        if self.metrics is not None:
            for name, text in self.metrics.files.items():
                output.add_text(f"{folder}{name}", text)

    def _summarize_target_error(self) -> tuple[dict[str, Any] | None, list[str]]:
        """Summarize the achieved errors as a record and as lines of text."""
        is_confirmed = self.run is not None and self.run.is_target_reached
        return summarize_target_error(self.target_error, self.coverages, self.target_regions, is_confirmed=is_confirmed)

    @property
    def _first_coverage(self) -> Coverage:
        """Coverage of the first rig, with which the others are compared."""
        return next(iter(self.coverages.values()))

    def _build_run_record(self) -> dict[str, Any]:
        """Build the part of the record that describes the run; None for saved results."""
        run = self.run
        if run is None:
            return dict.fromkeys(("duration_s", "complete", "frame_counts", "skipped_frames", "omissions"))
        return {
            "duration_s": round(run.duration_s, 3),
            "complete": run.is_complete,
            "frame_counts": dict(run.counts),
            "skipped_frames": run.skipped_frames,
            "omissions": [asdict(omission) for omission in self.omissions],
        }

    @property
    def _title(self) -> str:
        """First line of texts about the result."""
        cut_short = ", cut short" if self.run is not None and not self.run.is_complete else ""
        return f"Result of {', '.join(self.coverages)}: {self._first_coverage.counts['num_frames']} frames{cut_short}"

    def _repr_html_(self) -> str:
        """Show title, findings and one map in notebooks."""
        return build_result_html([self._title, *self.verdict], self.plot() if self.coverages else None)

    def __repr__(self) -> str:
        """Return title and findings."""
        return "\n".join([self._title, *self.verdict])

    def __str__(self) -> str:
        """Return title and coverage table."""
        return f"{self._title}\n{RENDERERS['text'](self.table)}"
