"""Error against run time: what settings cost, how far each is off, and the steps that reach a wanted error."""

import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchcover import __version__
from torchcover.coverage import Coverage, Region, list_region_bands
from torchcover.coverage.grid import BandFrame
from torchcover.estimation import (
    MIN_BLOCKS,
    ROUND_OFF,
    Difference,
    ErrorModel,
    Estimate,
    Quantity,
    estimate_blocks_needed,
)
from torchcover.evaluation.config import STUDY_SETTINGS
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.target_error import MIN_FRAMES, round_up_frames
from torchcover.evaluation.task import build_simulation_task
from torchcover.files import AtomicOutput, end_with_parent, report_stopped_processes
from torchcover.report import (
    PageTable,
    TextCell,
    format_difference,
    format_difference_heading,
    format_error,
    get_display_unit,
    plot_work_precision,
    to_json_record,
)

DEFAULT_STEPS = 512
# Of the blocks of the first setting, which alone says how errors fall, the others see so many.
SHARE_OF_OTHERS = 4
FEWER_RAYS: tuple[Mapping[str, Any], ...] = (
    {"num_rays": 4096},
    {"only_detection": True},
    {"only_detection": True, "num_rays": 512},
)
# Errors of the detection that settings are recommended for.
WANTED = (0.02, 0.01, 0.005)


def _points(error: float) -> str:
    return f"{100 * error:g} percentage point{'s' * (error != 0.01)}"


STEPS_HEADINGS = tuple(f"steps for {_points(error)}" for error in WANTED)
# Another setting than the first is recommended only where it saves a fifth of the time.
WORTH = 0.8
# A bias is one if chance gives the largest of all numbers less than this often.
LEVEL = 0.05
DOUBLINGS = 6


@dataclass(frozen=True)
class StudyPlan:
    """What is tried, on the same instants.

    Args:
        settings: Of `evaluate`: one rig and a scenario, by names or paths; 512 steps if not given. The others are held
            against it on the first quarter of them.
        variants: What each other setting has different, by the name of the argument of `evaluate`.

    Raises:
        ValueError: Not one rig by its name.
    """

    settings: Settings
    variants: tuple[Mapping[str, Any], ...] = FEWER_RAYS

    def __post_init__(self) -> None:
        if not all(isinstance(one, str | Path) for one in self.input_names) or len(self.settings.rigs) != 1:
            raise ValueError(
                "study: one rig and a scenario are needed, by names or paths: a command is timed with them"
            )

    @property
    def input_names(self) -> tuple[Any, ...]:
        """What the rig and the scenario were called."""
        return (*self.settings.rigs, self.settings.single_scenario)

    @property
    def trial_settings(self) -> dict[str, Settings]:
        """Options -> settings of every trial, that without any first."""
        # What it takes to build worlds counts: who uses what is found has others.
        first = replace(self.settings, num_frames=self.settings.num_frames or DEFAULT_STEPS, no_cache=True)
        return {"": first} | {" ".join(_options(other)): replace(first, **other) for other in self.variants}

    @property
    def command(self) -> list[str]:
        """What `torchcover` is told to do the same: the command, the rig, and the options that are not as usual."""
        defaults = Settings()
        given = {name: getattr(self.settings, name) for name in STUDY_SETTINGS}
        others = {name: value for name, value in given.items() if value != getattr(defaults, name)}
        return ["evaluate", str(self.input_names[0]), *_options(others)]


def _options(settings: Mapping[str, Any]) -> Iterator[str]:
    for name, value in settings.items():
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        yield from ("--set", f"{name}={text.lower() if isinstance(value, bool) else text}")


class StudiedNumber(NamedTuple):
    """A number as one setting has it: value, what its error becomes, and difference to the first on the same instants.

    `has_target` says whether `--target-error` waits for it, `is_biased` whether the difference is beyond chance.
    """

    region: str
    band: str
    has_target: bool
    quantity: Quantity
    value: float
    error: ErrorModel
    difference: Difference | None
    is_biased: bool


@dataclass(frozen=True)
class Trial:
    """A setting at work.

    Args:
        options: What is different from the first, as on the command line; empty for the first.
        num_frames: How many were measured.
        min_frames: The fewest that print an error of every number that is awaited.
        duration_s: What they took.
        cpu_s: What it took of all processors, those of workers too.
        band_frame: What the bands are over.
        numbers: Of all regions and bands.
    """

    options: str
    num_frames: int
    min_frames: int
    duration_s: float
    cpu_s: float
    band_frame: BandFrame
    numbers: Sequence[StudiedNumber]

    def select_numbers(self, unit: str) -> list[StudiedNumber]:
        """The awaited numbers of a unit, but for those that are unknown."""
        return [
            one for one in self.numbers if one.has_target and one.quantity.unit == unit and not math.isnan(one.value)
        ]

    def estimate_error(self, num_frames: int, unit: str) -> float:
        """The largest error of a unit after so many steps; NaN if one is unknown."""
        errors = [one.error.estimate_error(num_frames) for one in self.select_numbers(unit)]
        return math.nan if any(map(math.isnan, errors)) else max(errors, default=math.nan)

    def estimate_num_frames(self, error: float) -> int | None:
        """Steps after which every detection is this good, in two digits; None if there are none, or that is unknown."""
        needed = [one.error.estimate_num_frames(error) for one in self.select_numbers("share")]
        known = [steps for steps in needed if steps is not None]
        return round_up_frames(max(self.min_frames, *known)) if known and len(known) == len(needed) else None

    def estimate_duration_s(self, num_frames: int, startup_s: float) -> float:
        """What a command of so many steps takes."""
        return startup_s + self.duration_s * num_frames / self.num_frames


@dataclass(frozen=True)
class Study:
    """What a study has found.

    Args:
        plan: What it was about.
        trials: What was tried, the first first.
        startup_s: What a command takes whatever its steps: Python, imports, maps and files. It is in all times.
    """

    plan: StudyPlan
    trials: Sequence[Trial]
    startup_s: float

    def find_recommended(self, error: float) -> tuple[Trial, int] | None:
        """The setting to use for an error of every detection, and its steps; None if none is good enough."""
        reached = [(trial, steps) for trial in self.trials if (steps := trial.estimate_num_frames(error)) is not None]
        times = [trial.estimate_duration_s(steps, self.startup_s) for trial, steps in reached]
        if not reached:
            return None
        first = reached[0][0] is self.trials[0] and WORTH * times[0] <= min(times)
        return reached[0 if first else times.index(min(times))]

    @property
    def tables(self) -> list[PageTable]:
        """The settings; the numbers of the first."""
        return [self._settings(), self._numbers()]

    def _settings(self) -> PageTable:
        rows = []
        for trial in self.trials:
            needed = [_steps_words(trial, trial.estimate_num_frames(error), self.startup_s) for error in WANTED]
            times = [f"{1000 * s / trial.num_frames:.0f}" for s in (trial.duration_s, trial.cpu_s)]
            rows.append(list(map(TextCell, [trial.options or "as given", *times, _bias(trial), *needed])))
        return PageTable(
            "Every detection in front to so many percentage points",
            ("setting", "step (ms)", "of processors (ms)", "bias (points)", *STEPS_HEADINGS),
            rows,
            notes=["bias: the largest to the first setting on the same instants, * if it is beyond chance"],
        )

    def _numbers(self) -> PageTable:
        first, rows = self.trials[0], []
        for one in first.numbers:
            steps = (
                [one.error.estimate_num_frames(error) for error in WANTED]
                if one.quantity.unit == "share"
                else [None] * 3
            )
            words = [
                _steps_words(first, each and round_up_frames(max(each, first.min_frames)), self.startup_s)
                for each in steps
            ]
            error = format_error(one.error.estimate_error(first.num_frames), one.quantity.unit)
            place = f"{one.region} {one.band}"
            rows.append(list(map(TextCell, [place, format_difference_heading(one.quantity), error, *words])))
        headings = ("place", "number", f"error after {first.num_frames:,}", *STEPS_HEADINGS)
        return PageTable("Each number, as given", headings, rows)

    def format_recommendation(self, error: float) -> str:
        """The options of `evaluate` that reach an error."""
        found = self.find_recommended(error)
        if found is None:
            first = self.trials[0]
            unknown = [
                f"{one.region} {one.band}"
                for one in first.select_numbers("share")
                if math.isnan(one.error.error_coefficient)
            ]
            why = f"not known, for {first.num_frames:,} steps say no error of {', '.join(unknown) or 'any'}"
            return f"For {_points(error)} of every detection: {why}."
        trial, steps = found
        options = " ".join(
            [*self.plan.command[1:], *([trial.options] if trial.options else []), f"--num-frames={steps}"]
        )
        return f"For {_points(error)} of every detection: {options} ({trial.estimate_duration_s(steps, self.startup_s):.0f} s)."

    @property
    def record(self) -> dict[str, Any]:
        """All of it: what stands in `summary.json`."""
        rig, scenario = map(str, self.plan.input_names)
        found = {error: self.find_recommended(error) for error in WANTED}
        return {
            "torchcover": __version__,
            "rig": rig,
            "scenario": scenario,
            "seed": self.plan.settings.seed,
            "startup_s": self.startup_s,
            "trials": [_record(trial) for trial in self.trials],
            "recommended": [
                {"error": error, "options": one and one[0].options, "num_frames": one and one[1]}
                for error, one in found.items()
            ],
        }

    def plot(self) -> Figure:
        """The diagram of error against run time: the largest error of each unit."""
        panels = {}
        for quantity in list(dict.fromkeys(one.quantity for one in self.trials[0].numbers))[:2]:
            lines = {}
            for trial in self.trials:
                steps = [trial.min_frames << doubling for doubling in range(DOUBLINGS + 1)]
                factor = get_display_unit(quantity.unit).factor
                errors = [factor * trial.estimate_error(each, quantity.unit) for each in steps]
                times = [trial.estimate_duration_s(each, self.startup_s) for each in steps]
                lines[trial.options or "as given"] = list(zip(times, errors, strict=True))
            panels[f"largest error of the {format_difference_heading(quantity)}"] = lines
        return plot_work_precision(panels, title=" in ".join(map(str, self.plan.input_names)), legend_title="setting")

    def save(self, folder: str | Path) -> list[Path]:
        """Write `work_precision.png` and `summary.json` into a folder, which is made if need be."""
        figure = self.plot()
        with AtomicOutput(Path(folder)) as files:
            files.add("work_precision.png", figure.savefig)
            files.publish(self.record)
        return files.paths


def _steps_words(trial: Trial, steps: int | None, start_s: float) -> str:
    return "-" if steps is None else f"{steps:,} ({trial.estimate_duration_s(steps, start_s):.0f} s)"


def _bias(trial: Trial) -> str:
    known = [one for one in trial.select_numbers("share") if one.difference and not math.isnan(one.difference.value)]
    if not known:
        return "-" if trial.options else ""
    most = max(known, key=lambda one: (one.is_biased, abs(one.difference.value if one.difference else 0.0)))
    assert most.difference is not None
    return f"{format_difference(most.difference)}{' *' * most.is_biased}"


def _record(trial: Trial) -> dict[str, Any]:
    numbers = []
    for one in trial.numbers:
        difference = one.difference._asdict() if one.difference else {}
        told = {name: difference.get(name, math.nan) for name in ("value", "error", "p_value")}
        own = {"region": one.region, "band": one.band, "quantity": one.quantity.key, "value": one.value}
        numbers.append(
            to_json_record(
                {
                    **own,
                    "error_coefficient": one.error.error_coefficient,
                    "bias": one.error.bias,
                    "difference": to_json_record(told),
                }
            )
        )
    names = ("options", "num_frames", "min_frames", "duration_s", "cpu_s", "band_frame")
    return {**{name: getattr(trial, name) for name in names}, "numbers": numbers}


def measure_error_against_time(plan: StudyPlan, *, show_progress: bool = False) -> Study:
    """Measure what each setting costs and how far it is off, all of them on the same instants.

    Args:
        plan: What to try.
        show_progress: Whether to show bars.

    Raises:
        ValueError: A plan that makes no sense.
        FileNotFoundError: An unknown name or file.
    """
    for settings in plan.trial_settings.values():
        build_simulation_task(settings)  # fails before anything runs
    trials: list[Trial] = []
    first: Coverage | None = None
    for options, settings in plan.trial_settings.items():
        steps = settings.num_frames if first is None else _first_steps(first)
        trial, coverage = _tried(
            options, replace(settings, num_frames=steps, test_targets="none", progress=show_progress), first
        )
        trials.append(trial)
        first = first or coverage
    return Study(plan, trials, max(0.0, measure_command_s(plan) - trials[0].duration_s / trials[0].num_frames))


def _first_steps(coverage: Coverage) -> int:
    """Steps of the first quarter of its blocks, and of 8 at least."""
    blocks = coverage.estimate(coverage.regions[0], next(iter(coverage.grid.heights))).frame_counts
    return int(blocks[: max(MIN_BLOCKS, len(blocks) // SHARE_OF_OTHERS)].sum())


def _tried(options: str, settings: Settings, first: Coverage | None) -> tuple[Trial, Coverage]:
    task, before_s = build_simulation_task(settings), sum(os.times()[:4])
    result = measure_coverage(task, settings)
    processor_s = sum(os.times()[:4]) - before_s
    assert result.run is not None  # it was not loaded
    result.run.raise_failure()
    coverage, awaited = result.coverage, task.query_plan.target_regions
    places = list_region_bands(result.regions, coverage.grid)
    count, steps, worlds = len(places) * len(coverage.quantities), coverage.counts["num_frames"], math.inf
    numbers = []
    for region, height in places:
        estimate = coverage.estimate(region, height)
        against = None if first is None else _paired(first, coverage, region, height)
        differences = estimate.compute_differences(against) if against else {}
        if region in awaited and not estimate.value.isnan().all():
            worlds = min(worlds, float(estimate.effective_blocks.min()))
        a = _known(estimate.error).square() * steps
        if against and first:  # who has more steps knows it better; on the same instants the ratio is known well
            more = _known(first.estimate(region, height).error).square() * first.counts["num_frames"]
            a = torch.where(more.isnan(), a, more * (estimate.error / _known(against.error)).square())
        for quantity, value, own in zip(estimate.quantities, estimate.value.tolist(), a.tolist(), strict=True):
            difference = None if first is None else differences.get(quantity.key, Difference(quantity, math.nan))
            is_biased = difference is not None and difference.p_value * count < LEVEL
            bias = abs(difference.value) if difference and (is_biased or math.isnan(difference.value)) else 0.0
            place = region.name, height, region in awaited
            numbers.append(StudiedNumber(*place, quantity, value, ErrorModel(own, bias), difference, is_biased))
    least = max(MIN_FRAMES, estimate_blocks_needed(steps, worlds) if worlds > 0 else steps)
    times = result.run.duration_s, processor_s
    return Trial(options, steps, least, *times, coverage.band_frame, numbers), coverage


def _known(errors: Tensor) -> Tensor:
    """Errors, NaN where all blocks say the same: that proves nothing."""
    return errors.where(errors > ROUND_OFF, math.nan)


def _paired(first: Coverage, coverage: Coverage, region: Region, height: str) -> Estimate | None:
    """The first setting over the instants of another; None of numbers of another definition, or of other instants."""
    own, against = (each.estimate(region, height) for each in (coverage, first))
    if first.average != coverage.average or len(own.frame_counts) > len(against.frame_counts):
        return None
    against = against.truncate_blocks(len(own.frame_counts))
    return against if against.frame_counts.tolist() == own.frame_counts.tolist() else None


def measure_command_s(plan: StudyPlan) -> float:
    """How long `torchcover evaluate` takes for one step, from its start to its end. ValueError: it fails."""
    words = [*plan.command, "--num-frames=1"]
    start = time.perf_counter()
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "torchcover", *words, f"--out={folder}"]
        process = subprocess.Popen(
            command,
            text=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            preexec_fn=end_with_parent(),  # noqa: PLW1509  (one call of the system, no lock)
        )
        with process, report_stopped_processes([process.pid], "the command that is measured"):
            complaints = process.communicate()[1]
    if process.returncode:
        raise ValueError(f"torchcover {' '.join(words)} ended with {process.returncode}: {complaints.strip()}")
    return time.perf_counter() - start
