"""What an evaluation gives: numbers, maps and files of one rig or several. All that `report` is asked for is here."""

import math
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchcover import __version__
from torchcover.coverage import Coverage, Region
from torchcover.coverage.quantities import make_area_quantity
from torchcover.estimation import MIN_BLOCKS
from torchcover.evaluation.pipeline import Run
from torchcover.evaluation.progress import defer_signals
from torchcover.evaluation.result_page import (
    Omission,
    build_omissions_table,
    build_region_outline,
    build_result_tables,
    build_sensor_views,
    collect_facts,
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
from torchcover.report.map_layers import list_map_quantities
from torchcover.report.records import build_records
from torchcover.report.table_notes import get_main_quantity
from torchcover.simulation import CameraSensor, Sensor
from torchcover.simulation.memory import check_memory_fits
from torchcover.simulation.sensor import ScanTimes

if TYPE_CHECKING:
    import pandas

# Where more places of the reference sensor are refused, something is wrong with the scene.
REFUSED_SHARE = 0.2
# What `summary.json` says of how the run went.
RUN_KEYS = ("duration_s", "complete", "frame_counts", "skipped_frames", "omissions")


@dataclass(frozen=True)
class PictureCosts:
    """What the page and the maps of a result take; measured with 1 to 16 rigs on the usual grid.

    Args:
        bytes_per_cell: Memory of a cell of a rig, whatever is drawn.
        bytes_per_value: Memory of a cell of a rig for each quantity: its value and its error.
        seconds_per_panel: Time to draw one map; a rig has three in each height band for each quantity.
        min_announced_s: Shorter times are not announced.
        min_announced_bytes: Less memory is not announced.
    """

    bytes_per_cell: int = 40
    bytes_per_value: int = 20
    seconds_per_panel: float = 0.1
    min_announced_s: float = 60.0
    min_announced_bytes: float = 2e9


class MetricReport(Protocol):
    """Numbers of metrics of others, as `torchcover.contrib` compares them."""

    def build_page_tables(self, *, include_parts: bool = True) -> list[PageTable]:
        """Return the tables of the page; without `include_parts` only numbers about everything."""

    @property
    def record(self) -> dict[str, Any]:
        """Content of `summary.json`."""

    @property
    def files(self) -> dict[str, str]:
        """Name and text of further files."""


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What `evaluate` and `compare` return.

    Args:
        coverages: By the name of the rig; the others are compared with the first.
        regions: Those that numbers are given for.
        run: How the run went; None if unknown, for they were saved.
        rigs: What the user called each rig, by its name; None for the rig of a recording that was not named.
        source: Where the frames came from: `scenario`, `vehicle`, `frames`, `seed`.
        reference_record: Where the reference comes from, as `FrameSource.reference_record` says; None if unknown.
        device: Where it ran; None if unknown.
        target_error: What was aimed at.
        target_regions: The regions that it was about.
        sensors: The sensors of the rigs that they are known of, for the maps.
        ego_outline_m: (K, 2) corners x, y of the ego in metres, for the maps.
        observer_results: What the user's own observers computed, by their names.
        metrics: What metrics of others say of the rigs; None if none was asked for.
        omissions: What the run left out because the scene did not need it.
        input_files: Coverage files that it was made from.
        block_ends: Frames of the source after which one block of time after the other is complete, as far as is known.
    """

    coverages: Mapping[str, Coverage]
    regions: Sequence[Region]
    run: Run | None
    rigs: Mapping[str, str | None]
    source: Mapping[str, object]
    reference_record: Mapping[str, Any] | None
    device: str | None
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
        """The coverage of the only rig.

        Raises:
            ValueError: There are several.
        """
        if len(self.coverages) != 1:
            raise ValueError(f"there are {len(self.coverages)} rigs ({', '.join(self.coverages)}): use coverages[name]")
        return next(iter(self.coverages.values()))

    @property
    def vehicle(self) -> str | None:
        """What carried the rigs in a simulation."""
        vehicle = self.source.get("vehicle")
        return None if vehicle is None else str(vehicle)

    @property
    def is_comparison(self) -> bool:
        """Whether it is about several rigs."""
        return len(self.rigs) > 1

    @cached_property
    def table(self) -> CoverageTable:
        """The numbers, with errors, differences and marks; `RENDERERS` write it down."""
        return CoverageTable.from_coverages(self.coverages, self.regions, self.notes, self.source, self.block_ends)

    @property
    def verdict(self) -> tuple[str, ...]:
        """The answer in sentences, the first of which says most; none tells what may be chance."""
        return (*summarize_findings(self.table), *self.sensor_model_notes, *describe_scan_periods(self.sensors))

    @property
    def sensor_model_notes(self) -> list[str]:
        """That rigs were measured with different sensor models, in words; none where all had the same."""
        of_rigs = self.source.get("sensor_model")
        differ = isinstance(of_rigs, Mapping) and len(set(of_rigs.values())) > 1
        return describe_sensor_models(of_rigs) if differ else []

    @property
    def tables(self) -> list[PageTable]:
        """The tables of the page."""
        return [*build_result_tables(self.table), *(self.metrics.build_page_tables() if self.metrics else [])]

    @property
    def summary(self) -> list[dict[str, Any]]:
        """A row for each rig, region and height band, as in `summary.json`: unknown is None, infinite "Infinity"."""
        rows: list[dict[str, Any]] = build_table_dict(self.table)["rows"]
        return rows

    @property
    def target_error_lines(self) -> list[str]:
        """What was reached of the target error, in words."""
        return self._outcome[1]

    @property
    def record(self) -> dict[str, Any]:
        """Everything but the maps: what stands in `summary.json`; what is unknown is None."""
        rigs = {"rigs": dict(self.rigs)} if self.is_comparison else {"rig": next(iter(self.rigs.values()))}
        return {
            **rigs,
            **self.source,
            "reference": self._reference_used,
            "torchcover": __version__,
            "device": self.device,
            **self._run_record,
            "target_error": self._outcome[0],
            "average": self.table.average,
            "verdict": list(self.verdict),
            "notes": list(self.table.notes),
            **build_table_dict(self.table),
            **({} if self.metrics is None else {"metrics": self.metrics.record}),
        }

    @property
    def page(self) -> Page:
        """All that it knows, on one page: tables, maps and rigs, under which settings, and where they come from."""
        rigs = {name: self.sensors.get(name, ()) for name in self.rigs}
        place = self.source.get("frames") or self.source.get("scenario") or "runs that were saved"
        where = ", on ".join(format_facts({"place": place, "vehicle": self.vehicle}).values())
        return Page(
            title=" against ".join(rigs) if len(rigs) == 2 else ", ".join(rigs),
            lead=f"Blind spots and coverage in {where}, measured by torchcover.",
            findings=self.verdict,
            tables=self.tables,
            maps=list(build_page_maps(self.coverages)) if self.coverages else [],
            rigs=[PageRig(name, build_sensor_views(of), format_rig_yaml(name, of)) for name, of in rigs.items()],
            ego_outline_m=self.ego_outline_m,
            outlines=[build_region_outline(region) for region in self.regions],
            facts=collect_facts(self.record, self.rigs, self.table.first_conditions.counts["num_frames"]),
            more_tables=[build_omissions_table(self.omissions)] if self.omissions else [],
        )

    def _repr_html_(self) -> str:
        return build_result_html([self._about, *self.verdict], self.plot() if self.coverages else None)

    def plot(self, layer: str | None = None) -> Figure:
        """Draw one map, several rigs side by side, in the first height band.

        Args:
            layer: A key of `Coverage.layers`; what sensors are judged by, the detection at the first threshold, if not
                given.

        Returns:
            A figure of its own, outside pyplot.

        Raises:
            ValueError: No map shows that.
        """
        first = get_main_quantity(self.table)
        key = layer or (make_area_quantity(first) if self.table.average == "area" else first).key
        for _, figure in self.plot_maps(key):
            return figure
        raise ValueError(f"layer: no map shows {key!r}")

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows of `summary.csv`; NaN where nothing is known.

        Raises:
            ModuleNotFoundError: pandas is not there.
        """
        return build_dataframe(build_records(self.table))

    def plot_maps(self, layer: str | None = None) -> Iterator[tuple[str, Figure]]:
        """Draw the maps, one by one; several rigs side by side, and their differences to the first.

        Args:
            layer: Key of the only quantity to draw; all if not given.

        Returns:
            The stem of the file name, and a figure of its own, outside pyplot.
        """
        views = {name: build_sensor_views(sensors) for name, sensors in self.sensors.items()}
        return plot_maps(
            self.coverages, ego_outline_m=self.ego_outline_m, sensors=views, vehicle=self.vehicle, quantity_key=layer
        )

    def save(self, folder: str | Path, *, file_kinds: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of the command line: first the numbers, then the maps.

        At any time `summary.json` lists files of one run; those of an earlier one stay until the new numbers are there.

        Args:
            folder: Where to write: `coverage.npz`, or `coverage/RIG.npz` for several; `summary.csv`, `report.html`,
                `maps/STEM.png`, `summary.json`; with metrics of others `metrics.csv` and `metrics_rank_correlation.csv`. Made if it
                does not exist. Files of an earlier run that this one does not write are deleted: those that its
                `summary.json` lists.
            file_kinds: What to write beside `summary.json`: "numbers", "maps", "page", or a text as in "numbers,page".

        Raises:
            ValueError: The folder is that of a file which is compared, or files that there are not.
        """
        wanted = parse_file_kinds(file_kinds)
        for path in self.input_files:
            if path.resolve().parent in (Path(folder).resolve(), Path(folder).resolve() / "coverage"):
                raise ValueError(f"{folder}: holds {path}, which is compared, and would lose it; choose another folder")
        with AtomicOutput(Path(folder)) as written:
            with defer_signals():  # the numbers are safe before anything ends this, and before the maps are drawn
                if "numbers" in wanted:
                    self.add_numbers(written)
                summary = self.record
                written.publish(summary)
            self.add_pictures(written, wanted)
            written.publish(summary)
        return written.paths

    def estimate_pictures(
        self, file_kinds: Container[str], costs: PictureCosts = PictureCosts()
    ) -> tuple[float, float]:
        """Estimate the memory in bytes and the time in seconds that the page and the maps take, if they are wanted."""
        first, rigs = self._first, len(self.coverages)
        quantities, cells = len(list_map_quantities(first)), first.grid.num_cells
        needed_bytes = float(rigs * cells * (costs.bytes_per_cell + costs.bytes_per_value * quantities))
        seconds = 3 * costs.seconds_per_panel * rigs * quantities * len(first.grid.heights) * ("maps" in file_kinds)
        return needed_bytes * ("maps" in file_kinds or "page" in file_kinds), seconds

    def announce_pictures(self, file_kinds: str | Iterable[str], costs: PictureCosts = PictureCosts()) -> str:
        """Say what the page and the maps of many rigs will take; no words where that is little."""
        needed_bytes, seconds = self.estimate_pictures(parse_file_kinds(file_kinds), costs)
        if needed_bytes < costs.min_announced_bytes and seconds < costs.min_announced_s:
            return ""
        return (
            f"page and maps of {len(self.coverages)} rigs take about {needed_bytes / 1e9:.2g} GB of memory and "
            f"{math.ceil(seconds / 60)} min, after the numbers are saved; `--files numbers` leaves them out"
        )

    def add_pictures(self, output: AtomicOutput, file_kinds: Container[str], folder: str = "") -> None:
        """Write the page and the maps, if they are wanted; `folder` is a prefix that ends with a slash.

        ValueError: there is not enough memory for them.
        """
        advice = "the numbers are saved; leave the others out by `--files numbers`, or compare fewer rigs"
        needed_bytes, _ = self.estimate_pictures(file_kinds)
        check_memory_fits(f"page and maps of {len(self.coverages)} rigs", needed_bytes, advice)
        if "page" in file_kinds:
            output.add_text(f"{folder}report.html", render_page(self.page))
        for stem, figure in self.plot_maps() if "maps" in file_kinds else ():
            output.add_figure(f"{folder}maps/{stem}.png", figure)

    def add_numbers(self, output: AtomicOutput, folder: str = "") -> None:
        """Write the files of numbers; `folder` is a prefix that ends with a slash. Names of rigs become file names."""
        stems = build_file_stems(list(self.coverages)) if self.is_comparison else ["coverage"]
        for stem, coverage in zip(stems, self.coverages.values(), strict=True):
            output.add(f"{folder}coverage/{stem}.npz" if self.is_comparison else f"{folder}coverage.npz", coverage.save)
        output.add_text(f"{folder}summary.csv", RENDERERS["csv"](self.table))
        if self.metrics is not None:
            for name, text in self.metrics.files.items():
                output.add_text(f"{folder}{name}", text)

    @property
    def _outcome(self) -> tuple[dict[str, Any] | None, list[str]]:
        confirmed = self.run is not None and self.run.is_target_reached
        return summarize_target_error(self.target_error, self.coverages, self.target_regions, is_confirmed=confirmed)

    @property
    def _first(self) -> Coverage:
        return next(iter(self.coverages.values()))

    @property
    def _run_record(self) -> dict[str, Any]:
        run = self.run
        if run is None:
            return dict.fromkeys(RUN_KEYS)
        known = (
            round(run.duration_s, 3),
            run.is_complete,
            dict(run.counts),
            run.skipped_frames,
            list(map(asdict, self.omissions)),
        )
        return dict(zip(RUN_KEYS, known, strict=True))

    @property
    def _reference_used(self) -> Mapping[str, Any] | None:
        """Where the reference comes from, with the rays that it cast where it was simulated."""
        record = self.reference_record
        if self.run is None or record is None:
            return None
        rays = self.run.counts["reference_rays"] // self.run.num_frames
        return {**record, "rays_per_frame": rays} if "frame_interval_s" in record else record

    @property
    def notes(self) -> list[str]:
        """What ended the run before its time, what was measured, and the reference sensor in words, for a caption."""
        record, told = self._reference_used, [self.cut_short] if self.cut_short else []
        told += [f"Vehicle: {self.vehicle}."] if self.vehicle else []
        told += describe_sensor_models(self.source.get("sensor_model")) + describe_weather(self.source.get("weather"))
        told += describe_perfect_depth(self.sensors) + describe_scan_periods(self.sensors) + self._on_bodies
        if record is None:
            return told
        if "frame_interval_s" not in record:
            return [*told, *record["notes"]]
        rays, frame_interval_s = record["rays_per_frame"], record["frame_interval_s"]
        sensor = f"Reference sensor: {record['sensor']}, {rays:,} rays a step; a step every {frame_interval_s:g} s."
        return [*told, sensor, *record["notes"], *self._on_refused, *self._on_repetitions]

    @property
    def _on_bodies(self) -> list[str]:
        """Where bodies were put, or that a recording has none."""
        bodies = self._first.target_sums
        if bodies is not None:
            put = f"at {int(bodies.frame_counts.sum()):,} steps, in random places whose middle is in the region"
            return [f"Bodies: {put}, one at a time and seen by nothing else."]
        near = any(region.bands for region in self.regions) and self.source.get("frames")
        return ["Bodies beside the vehicle: not for recordings, which have no scene to put them into."] if near else []

    @property
    def _on_refused(self) -> list[str]:
        """That many places of the reference sensor were refused: then it looked from few of those that it should."""
        assert self.run is not None  # asked of a reference that was used
        refused, drawn = self.run.counts["reference_poses_resampled"], self.run.counts["reference_poses"]
        if refused < REFUSED_SHARE * drawn:
            return []
        return [
            f"{refused:,} of {drawn:,} places of the reference sensor ({refused / drawn:.0%}) were refused: they lay "
            "inside bodies or below the ground. Does the ego stand on the ground, and do faces point outwards?"
        ]

    @property
    def cut_short(self) -> str:
        """That the run was cut short, after how many steps, and why; no words where it was not."""
        failure = None if self.run is None else self.run.failure
        if failure is None:
            return ""
        steps = self._first.counts["num_frames"]
        after = f"The run was cut short after {steps:,} step{'s' * (steps != 1)}"
        if isinstance(failure, KeyboardInterrupt):
            return f"{after}: interrupted."
        reason = ": ".join([type(failure).__name__, *str(failure).strip().splitlines()[:1]])
        return f"{after}: {reason.rstrip('.')}."

    @property
    def _on_repetitions(self) -> list[str]:
        """That a scenario was seen again, which is no news; nothing where every step showed an instant of its own."""
        steps, again = (self.run.num_frames, self.run.counts["repeated_frames"]) if self.run else (0, 0)
        if not again:
            return []
        if steps - again == 1:
            about = ": intervals are about the reference sensor's places only" if self._has_errors else ""
            return [f"All {steps:,} steps show the same instant{about}."]
        known = ", which intervals know" if self._has_errors else ""
        return [f"{steps - again:,} different instants in {steps:,} steps: the scenario was seen again{known}."]

    @property
    def _has_errors(self) -> bool:
        blocks = self._first.block_sums
        return blocks is not None and int((blocks.frame_counts > 0).sum()) >= MIN_BLOCKS

    @property
    def _about(self) -> str:
        cut_short = ", cut short" if self.run is not None and not self.run.is_complete else ""
        return f"Result of {', '.join(self.coverages)}: {self._first.counts['num_frames']} steps{cut_short}"

    def __repr__(self) -> str:
        return "\n".join([self._about, *self.verdict])

    def __str__(self) -> str:
        return f"{self._about}\n{RENDERERS['text'](self.table)}"


def describe_sensor_models(model_by_rig: object) -> list[str]:
    """What sensors make of their hits, in words; none where that is unknown.

    Example:
        >>> describe_sensor_models({"kitti": "real"})
        ['Sensor model: real, what returns too little light is no point.']
    """
    if not isinstance(model_by_rig, Mapping) or not model_by_rig:
        return []
    means = {"real": "what returns too little light is no point", "ideal": "every hit is a point"}
    if len(set(model_by_rig.values())) == 1:
        (model,) = set(model_by_rig.values())
        return [f"Sensor model: {model}, {means[model]}."]
    return [
        f"Sensor models: {', '.join(f'{rig} {model}' for rig, model in model_by_rig.items())}: differences are of both."
    ]


def describe_perfect_depth(sensors: Mapping[str, Sequence[Sensor]]) -> list[str]:
    """Name the cameras whose depth counts as exact, since no error of it is given.

    Args:
        sensors: Sensors by the name of the rig.

    Returns:
        One sentence, or none.

    Example:
        >>> from torchcover.simulation import CameraSensor
        >>> front = CameraSensor(name="front", width=64, height=48, fov_deg=90, max_range_m=100)
        >>> describe_perfect_depth({"van": [front]})[0][:54]
        'Perfect depth is assumed for cameras of van (front): a'
        >>> describe_perfect_depth({"van": [front.model_copy(update={"range_noise_share": 0.02})]})
        []
    """
    cameras = {
        rig: [
            one.name
            for one in of_rig
            if isinstance(one, CameraSensor) and not np.any(one.compute_noise_std_m(np.ones(1)))
        ]
        for rig, of_rig in sensors.items()
    }
    exact = [f"{rig} ({', '.join(names)})" for rig, names in cameras.items() if names]
    if not exact:
        return []
    advice = "add `stereo` or `range_noise_share`"
    return [
        f"Perfect depth is assumed for cameras of {'; '.join(exact)}: a pixel measures its range exactly; {advice}."
    ]


def describe_scan_periods(sensors: Mapping[str, Sequence[Sensor]]) -> list[str]:
    """Warn of a comparison of rigs whose sensors take different times for a scan.

    Args:
        sensors: Sensors by the name of the rig.

    Returns:
        One sentence, or none where all rigs scan alike.

    Example:
        >>> from torchcover.simulation import CameraSensor
        >>> camera = CameraSensor(name="front", width=64, height=48, fov_deg=90, max_range_m=100)
        >>> rolling = CameraSensor(**camera.model_dump() | {"scan": {"period_s": 0.05}})
        >>> describe_scan_periods({"global": [camera], "rolling": [rolling]})[0][:58]
        'Scan periods differ: global at once, rolling 0.05 s. Motio'
    """
    known = {rig: of_rig for rig, of_rig in sensors.items() if of_rig}
    periods_s = {rig: sorted({_scan_period_s(sensor) for sensor in of_rig}) for rig, of_rig in known.items()}
    if len({tuple(of_rig) for of_rig in periods_s.values()}) < 2:
        return []
    words = {
        rig: " and ".join(f"{period_s:g} s" if period_s else "at once" for period_s in of_rig)
        for rig, of_rig in periods_s.items()
    }
    listed = ", ".join(f"{rig} {period}" for rig, period in words.items())
    return [f"Scan periods differ: {listed}. Motion during the scan changes numbers of the near field."]


def _scan_period_s(sensor: Sensor) -> float:
    """Time from the first to the last ray; 0 where all are cast at once."""
    timing: ScanTimes | None = getattr(sensor, "scan", None)
    return timing.period_s if timing else 0.0


def describe_weather(weather_by_rig: object) -> list[str]:
    """What the rigs were measured in, in words; none where that is clear air or unknown.

    Example:
        >>> describe_weather({"kitti, clear": "clear", "kitti, fog_100m": "fog_100m"}), describe_weather({"kitti": "clear"})
        (['Weather: clear, fog_100m.'], [])
    """
    names = dict.fromkeys(weather_by_rig.values()) if isinstance(weather_by_rig, Mapping) else {}
    return [f"Weather: {', '.join(names)}."] if names and list(names) != ["clear"] else []
