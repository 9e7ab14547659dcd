"""Report on rigs for a meeting: one page with findings first, from several evaluations within a time budget."""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from torchcover.encounters import EncounterResults, EncounterSet
from torchcover.estimation import MIN_BLOCKS
from torchcover.evaluation.check_result import CheckResult
from torchcover.evaluation.encounter_evaluation import build_encounters_page, evaluate_encounters
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.progress import Progress, defer_signals
from torchcover.evaluation.requirements import Requirements
from torchcover.evaluation.requirements_check import check
from torchcover.evaluation.result import Result
from torchcover.evaluation.rig_names import AnyRig, load_rig, make_rig_names
from torchcover.evaluation.settings import DEFAULT_NUM_FRAMES, FILES, Settings, parse_file_kinds
from torchcover.evaluation.target_page import (
    build_sides_table,
    build_target_page,
    build_target_record,
    summarize_target_maps,
)
from torchcover.evaluation.target_visibility import build_flat_ground, map_target_visibility
from torchcover.evaluation.task import AnyScenario, build_simulation_task
from torchcover.files import AtomicOutput
from torchcover.notebooks import build_result_html
from torchcover.report import (
    Page,
    TargetVisibilityMap,
    build_detection_shares,
    build_file_stems,
    describe_range,
    escape_markdown,
    explain_missing_intervals,
    render_page,
)
from torchcover.simulation import Rig
from torchcover.simulation.scenario import ActorDescription
from torchcover.targets import Target, TargetMap, write_arrays, write_csv

# Maximum number of rigs that can be compared on one page.
MAX_RIGS = 8


@dataclass(frozen=True, eq=False)
class Report:
    """Result of `report`.

    Args:
        result: Coverage in traffic, with test targets and the loss if a sensor fails.
        targets: Name of the rig -> map of the positions on flat ground at which it detects the test target.
        num_frames: Requested frames of traffic; fewer are evaluated if the budget is used up.
        encounters: Times to collision at first detection; None if not requested.
        check_result: Verdicts of the requirements; None if not requested.
    """

    result: Result
    targets: Mapping[str, TargetMap]
    num_frames: int
    encounters: EncounterResults | None = None
    check_result: CheckResult | None = None

    @property
    def verdict(self) -> tuple[str, ...]:
        """Findings in sentences, the most important first; each states only significant differences."""
        main_finding, *losses = summarize_target_maps(self.targets)
        ranges = describe_range(self.result.table) or explain_missing_intervals(self.result.table, "ranges")
        sentences = [main_finding, ranges, *self.result.sensor_model_notes, *losses, *self._encounters_page.findings]
        if self.check_result:
            sentences += self.check_result.verdict
        sentences.append(self.cut_short)
        return tuple(sentence for sentence in sentences if sentence)

    @property
    def cut_short(self) -> str:
        """Sentence about missing frames; empty if all requested frames were evaluated."""
        num_evaluated = self.result.table.first_conditions.counts["num_frames"]
        if self.result.cut_short or num_evaluated >= self.num_frames:
            return self.result.cut_short
        return f"The time budget ended after {num_evaluated:,} of {self.num_frames:,} frames of traffic."

    @property
    def _encounters_page(self) -> Page:
        """Page of the encounters; an empty one without encounters."""
        return build_encounters_page(self.encounters) if self.encounters else Page("", "")

    @property
    def page(self) -> Page:
        """Page with the findings, their pictures, and the tables and maps from which they follow."""
        first_map = next(iter(self.targets.values()))
        num_evaluated = self.result.table.first_conditions.counts["num_frames"]
        lead = (
            f"{first_map.target}, {first_map.detection_points} points or more, on flat ground with nothing else; "
            f"{num_evaluated:,} frames of {self.result.source['scenario']}."
        )
        encounters_page = self._encounters_page
        tables = list(encounters_page.tables)
        if self.check_result:
            tables += self.check_result.build_tables()
        maps: list[TargetVisibilityMap] = []
        for rig, target_map in self.targets.items():
            sides = build_sides_table(target_map)
            tables.append(replace(sides, title=f"{rig}: {sides.title}"))
            maps += build_target_page(target_map).target_maps
        tables += self.result.tables
        return replace(
            self.result.page,
            lead=lead,
            findings=self.verdict,
            target_maps=maps,
            detection_shares=build_detection_shares(self.result.table),
            pictures=encounters_page.pictures,
            tables=tables,
        )

    def _repr_html_(self) -> str:
        """Return the findings as HTML for notebooks."""
        return build_result_html(self.verdict)

    @property
    def markdown(self) -> str:
        """Findings as Markdown, for a merge request."""
        first, *further = [escape_markdown(sentence) for sentence in self.verdict]
        return "\n".join([f"**{first}**", "", *(f"- {sentence}" for sentence in further), ""])

    @property
    def record(self) -> dict[str, Any]:
        """Content of `summary.json`."""
        return {
            "verdict": list(self.verdict),
            "complete": not self.cut_short,
            "traffic": self.result.record,
            "targets": {rig: build_target_record(target_map) for rig, target_map in self.targets.items()},
            "encounters": self.encounters.to_record() if self.encounters else None,
            "requirements": self.check_result.record if self.check_result else None,
        }

    def save(self, folder: str | Path, *, file_kinds: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of `torchcover report`: first the numbers, then the page.

        Args:
            folder: Folder for `report.html`, `report.md` with the findings, `summary.json`, and the files that
                `evaluate`, `targets`, `encounter` and `check` write. Created if it does not exist; files of an earlier
                run that its `summary.json` lists are deleted.
            file_kinds: Files in addition to `summary.json` and `report.md`, as in `Result.save`.

        Returns:
            The files.
        """
        kinds = parse_file_kinds(file_kinds)
        record = self.record
        with AtomicOutput(Path(folder)) as files:
            with defer_signals():  # a signal does not interrupt the numbers
                if "numbers" in kinds:
                    self._add_numbers(files)
                files.add_text("report.md", self.markdown)
                files.publish(record)
            if "page" in kinds:
                files.add_text("report.html", render_page(self.page))
            if "maps" in kinds:
                for stem, figure in self.result.plot_maps():
                    files.add_figure(f"maps/{stem}.png", figure)
            files.publish(record)
        return files.paths

    def _add_numbers(self, files: AtomicOutput) -> None:
        """Add the files of numbers: coverage, target maps, encounters and verdicts."""
        self.result.add_numbers(files, ["numbers"])
        for stem, target_map in zip(build_file_stems(list(self.targets)), self.targets.values(), strict=True):
            files.add(f"targets/{stem}.csv", partial(write_csv, target_map))
            files.add(f"targets/{stem}.npz", partial(write_arrays, target_map))
        if self.encounters:
            files.add("encounters.csv", self.encounters.write_csv)
        if self.check_result:
            files.add_text("junit.xml", self.check_result.junit)


def report(
    rigs: AnyRig | Sequence[AnyRig],
    scenario: AnyScenario = "urban",
    target: Target | str | Path = "child",
    *,
    encounters: EncounterSet | str | Path | None = None,
    requirements: Requirements | str | Path | None = None,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    num_frames: int = DEFAULT_NUM_FRAMES,
    seed: int = 0,
    num_workers: int | None = None,
    budget_s: float = math.inf,
    show_progress: bool = False,
) -> Report:
    """Report on rigs: detection of a test target, loss if a sensor fails, range, and time to collision at detection.

    Args:
        rigs: A rig or several, at most 8: objects, built-in names, or YAML files.
        scenario: Traffic: a single scenario, as for `evaluate`.
        target: Test target on flat ground, as for `map_target_visibility`.
        encounters: Set of encounters, as for `encounter`; None: no encounters.
        requirements: Requirements, as for `check`; None: no requirements.
        vehicle: Host vehicle, as for `evaluate`.
        sensor_model: As for `evaluate`.
        num_frames: Frames of the traffic.
        seed: Seed of the simulation.
        num_workers: As for `evaluate`.
        budget_s: Time in seconds after which the traffic ends, which comes last; not before it has confidence
            intervals.
        show_progress: Show a progress bar.

    Returns:
        Report with the findings in `verdict`; `save` writes the page.

    Raises:
        FileNotFoundError: Unknown name or file.
        ValueError: Invalid file or number, no rig, too many rigs, or several scenarios.

    Example:
        >>> result = report("front_roof_128", "courtyard", num_frames=8)
        >>> print(result.verdict[0])
        A child of 1.10 m is detected (5 points or more) at 35 % of the positions within 2 m by front_roof_128.
    """
    start_s = time.monotonic()
    inputs = [rigs] if isinstance(rigs, str | Path | Rig) else list(rigs)
    if not 1 <= len(inputs) <= MAX_RIGS:
        raise ValueError(f"report: 1 to {MAX_RIGS} rigs fit on a page; got {len(inputs)}: omit some, or use `compare`")
    if not budget_s > 0:
        raise ValueError(f"budget: seconds above 0 are needed; got {budget_s}")
    named_rigs = []
    for rig, name in zip(inputs, make_rig_names(inputs), strict=True):
        named_rigs.append(load_rig(rig).model_copy(update={"name": name}))
    vehicle_and_model: dict[str, Any] = {"vehicle": vehicle, "sensor_model": sensor_model}
    settings = Settings(
        named_rigs,
        scenario,
        num_frames=num_frames,
        seed=seed,
        redundancy=True,
        num_workers=num_workers,
        **vehicle_and_model,
    )
    if settings.mixture is not None:
        raise ValueError("report: a single scenario is needed; use `compare` for several")
    task = build_simulation_task(settings)
    loaded_target = target if isinstance(target, Target) else Target.load(target)
    ego = task.frames.scenario.ego
    assert ego is not None  # every simulation task has an ego vehicle
    # Test targets stand around the same vehicle as in the traffic.
    ground = build_flat_ground().model_copy(update={"ego": ActorDescription(shape=ego.shape)})
    bar_total = len(named_rigs) + (encounters is not None) + (requirements is not None) + num_frames
    with Progress(bar_total, "report", is_shown=show_progress) as bar:
        target_maps = {}
        for rig in named_rigs:
            target_maps[rig.name] = map_target_visibility(
                rig, loaded_target, ground, sensor_model=sensor_model, seed=seed
            )
            bar.advance(bar_total)
        encounter_results = check_result = None
        if encounters is not None:
            encounter_results = evaluate_encounters(named_rigs, encounters, seed=seed, **vehicle_and_model)
            bar.advance(bar_total)
        if requirements is not None:
            check_result = check(named_rigs, requirements, seed=seed, num_workers=num_workers, **vehicle_and_model)
            bar.advance(bar_total)
        # The traffic comes last because its number of frames follows the budget.
        result = measure_coverage(task, settings, _BudgetRule(bar, bar_total, start_s + budget_s))
    return Report(result, target_maps, num_frames, encounter_results, check_result)


@dataclass(frozen=True)
class _BudgetRule:
    """Stopping rule that advances the bar at every frame and ends the traffic when the time is over.

    Args:
        bar: Progress bar.
        bar_total: Its total: frames and other evaluations.
        end_s: End of the budget on the monotonic clock.
        progress_text: Text of the rule for other progress bars.
    """

    bar: Progress
    bar_total: int
    end_s: float
    progress_text: str = ""

    def is_reached(self, num_frames: int) -> bool:
        """Return True if the budget is used up and the numbers have confidence intervals."""
        self.bar.advance(self.bar_total)
        return num_frames >= MIN_BLOCKS and time.monotonic() >= self.end_s

    def estimate_num_frames(self, max_frames: int) -> int:
        """Return the maximum: the budget does not predict a number of frames."""
        return max_frames
