"""One page that answers first: all that is asked of some rigs, measured one after the other within a budget."""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from torchcover.encounters import EncounterResults, EncounterSet
from torchcover.estimation import MIN_BLOCKS
from torchcover.evaluation.encounter_evaluation import build_encounters_page, evaluate_encounters
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.progress import Progress, defer_signals
from torchcover.evaluation.requirements import Requirements
from torchcover.evaluation.requirements_check import CheckResult, check
from torchcover.evaluation.result import Result
from torchcover.evaluation.settings import DEFAULT_STEPS, FILES, Settings, parse_file_kinds
from torchcover.evaluation.target_visibility import (
    build_flat_ground,
    build_sides_table,
    build_target_page,
    build_target_record,
    map_target_visibility,
    summarize_target_maps,
)
from torchcover.evaluation.task import AnyRig, AnyScenario, build_simulation_task, load_rig, make_rig_names
from torchcover.files import AtomicOutput
from torchcover.notebooks import build_result_html
from torchcover.report import (
    Page,
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

# As many as anybody compares on a page.
MOST_RIGS = 8


@dataclass(frozen=True, eq=False)
class Report:
    """What `report` returns.

    Args:
        result: What the rigs see in traffic, with bodies beside them, and what is lost with each sensor.
        targets: By the name of the rig, where it sees the body in free space.
        num_frames: How many steps of traffic were asked for; fewer are measured if the budget was over.
        encounters: When they see whom they are about to collide with; None if that was not asked.
        check_result: Whether they see what they must; likewise.
    """

    result: Result
    targets: Mapping[str, TargetMap]
    num_frames: int
    encounters: EncounterResults | None = None
    check_result: CheckResult | None = None

    @property
    def verdict(self) -> tuple[str, ...]:
        """The answer in sentences, the first of which says most; each has its rule, and none tells what is chance."""
        first, *losses = summarize_target_maps(self.targets)
        range_words = describe_range(self.result.table) or explain_missing_intervals(self.result.table, "ranges")
        asked = [*self._met.findings, *(self.check_result.verdict if self.check_result else ())]
        told = [first, range_words, *self.result.sensor_model_notes, *losses, *asked, self.cut_short]
        return tuple(filter(None, told))

    @property
    def cut_short(self) -> str:
        """That fewer steps were measured than asked for; no words where all were."""
        done = self.result.table.first_conditions.counts["num_frames"]
        over = f"The budget was over after {done:,} of {self.num_frames:,} steps of traffic." * (done < self.num_frames)
        return self.result.cut_short or over

    @property
    def _met(self) -> Page:
        return build_encounters_page(self.encounters) if self.encounters else Page("", "")

    @property
    def page(self) -> Page:
        """The answer and what shows it; below it the tables and maps that it comes from."""
        target, *_ = self.targets.values()
        steps = f"{self.result.table.first_conditions.counts['num_frames']:,} steps of {self.result.source['scenario']}"
        lead = f"{target.target}, {target.detection_points} points or more, on flat ground with nothing else; {steps}."
        of_targets = [build_target_page(one) for one in self.targets.values()]
        sides = [
            replace(build_sides_table(one), title=f"{rig}: {build_sides_table(one).title}")
            for rig, one in self.targets.items()
        ]
        tables = [
            *self._met.tables,
            *(self.check_result.build_tables() if self.check_result else ()),
            *sides,
            *self.result.tables,
        ]
        return replace(
            self.result.page,
            lead=lead,
            findings=self.verdict,
            target_maps=[plan for page in of_targets for plan in page.target_maps],
            detection_shares=build_detection_shares(self.result.table),
            pictures=self._met.pictures,
            tables=tables,
        )

    def _repr_html_(self) -> str:
        return build_result_html(self.verdict)

    @property
    def markdown(self) -> str:
        """The verdict, for a merge request."""
        first, *others = map(escape_markdown, self.verdict)
        return "\n".join([f"**{first}**", "", *(f"- {words}" for words in others), ""])

    @property
    def record(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {
            "verdict": list(self.verdict),
            "complete": not self.cut_short,
            "traffic": self.result.record,
            "targets": {rig: build_target_record(one) for rig, one in self.targets.items()},
            "encounters": self.encounters.to_record() if self.encounters else None,
            "requirements": self.check_result.record if self.check_result else None,
        }

    def save(self, folder: str | Path, *, file_kinds: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of the command line: the numbers first, then the page.

        Args:
            folder: Where to write `report.html`, `report.md` with the verdict, `summary.json`, and the files that
                `evaluate`, `targets`, `encounter` and `check` write. Made if it does not exist; files of an earlier run
                that its `summary.json` lists are deleted.
            file_kinds: What to write beside `summary.json` and `report.md`, as in `Result.save`.

        Returns:
            The files.
        """
        wanted, record = parse_file_kinds(file_kinds), self.record
        with AtomicOutput(Path(folder)) as written:
            with defer_signals():  # the numbers are safe before anything ends this
                if "numbers" in wanted:
                    self._add_numbers(written)
                written.add_text("report.md", self.markdown)
                written.publish(record)
            if "page" in wanted:
                written.add_text("report.html", render_page(self.page))
            for stem, figure in self.result.plot_maps() if "maps" in wanted else ():
                written.add_figure(f"maps/{stem}.png", figure)
            written.publish(record)
        return written.paths

    def _add_numbers(self, files: AtomicOutput) -> None:
        self.result.add_numbers(files)
        for stem, one in zip(build_file_stems(list(self.targets)), self.targets.values(), strict=True):
            files.add(f"targets/{stem}.csv", partial(write_csv, one))
            files.add(f"targets/{stem}.npz", partial(write_arrays, one))
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
    num_frames: int = DEFAULT_STEPS,
    seed: int = 0,
    num_workers: int | None = None,
    budget_s: float = math.inf,
    show_progress: bool = False,
) -> Report:
    """Measure what a meeting asks about rigs: where a body beside them is seen, what fails, how far, how soon.

    Args:
        rigs: A rig or several, at most 8: each one itself, its built-in name, or its YAML file.
        scenario: The traffic: one kind of world, as for `evaluate`.
        target: What is put beside the vehicle, in free space, as for `map_target_visibility`.
        encounters: A set of encounters, as for `encounter`; none if not given.
        requirements: What the rigs must see, as for `check`; likewise.
        vehicle: What carries the rigs, as for `evaluate`.
        sensor_model: As for `evaluate`.
        num_frames: Of the traffic.
        seed: Of the simulation.
        num_workers: As for `evaluate`.
        budget_s: Seconds: traffic, which comes last, ends when they are over, but not before it has intervals.
        show_progress: Whether to show a bar.

    Returns:
        Its answer in `verdict`; `save` writes the page.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A file that cannot be used, a number out of its bounds, no rig or too many, several kinds of world.

    Example:
        >>> result = report("front_roof_128", "courtyard", num_frames=8)
        >>> print(result.verdict[0])
        A child of 1.10 m is seen (5 points or more) at 35 % of the places within 2 m by front_roof_128.
    """
    start_s = time.monotonic()
    given = [rigs] if isinstance(rigs, str | Path | Rig) else list(rigs)
    if not 1 <= len(given) <= MOST_RIGS:
        raise ValueError(f"report: 1 to {MOST_RIGS} rigs fit on a page; got {len(given)}: choose, or use `compare`")
    if not budget_s > 0:
        raise ValueError(f"budget: seconds above 0 are needed; got {budget_s}")
    called = [load_rig(rig).model_copy(update={"name": n}) for rig, n in zip(given, make_rig_names(given), strict=True)]
    own: dict[str, Any] = {"vehicle": vehicle, "sensor_model": sensor_model}
    settings = Settings(
        called, scenario, num_frames=num_frames, seed=seed, redundancy=True, num_workers=num_workers, **own
    )
    if settings.mixture is not None:
        raise ValueError("report: one kind of world is needed; for several use `compare`")
    task = build_simulation_task(settings)
    body = target if isinstance(target, Target) else Target.load(target)
    carrier = task.frames.scenario.ego
    assert carrier is not None  # simulated
    ground = build_flat_ground().model_copy(update={"ego": ActorDescription(shape=carrier.shape)})
    whole = len(called) + (encounters is not None) + (requirements is not None) + num_frames
    with Progress(whole, "report", is_shown=show_progress) as bar:
        seen = {}
        for rig in called:
            seen[rig.name] = map_target_visibility(rig, body, ground, sensor_model=sensor_model, seed=seed)
            bar.advance(whole)
        met = checked = None
        if encounters is not None:
            met = evaluate_encounters(called, encounters, seed=seed, **own)
            bar.advance(whole)
        if requirements is not None:
            checked = check(called, requirements, seed=seed, num_workers=num_workers, **own)
            bar.advance(whole)
        result = measure_coverage(task, settings, _Pace(bar, whole, start_s + budget_s))
    return Report(result, seen, num_frames, met, checked)


@dataclass(frozen=True)
class _Pace:
    """Tells the bar of every step of the traffic, and ends it when the time is over: a `StoppingRule`."""

    bar: Progress
    whole: int
    until_s: float
    progress_text: str = ""

    def is_reached(self, num_frames: int) -> bool:
        self.bar.advance(self.whole)
        return num_frames >= MIN_BLOCKS and time.monotonic() >= self.until_s

    def estimate_num_frames(self, max_frames: int) -> int:
        return max_frames
