"""Error against run time: run time and bias of several settings, and the frames that each needs for a target error."""

import math
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchcover import __version__
from torchcover.coverage import Coverage, Region, list_region_bands
from torchcover.estimation import MIN_BLOCKS, ROUND_OFF, Difference, ErrorModel, Estimate, estimate_blocks_needed
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.study_plan import StudiedNumber, StudyParams, StudyPlan, Trial
from torchcover.evaluation.target_error import MIN_FRAMES, round_up_frames
from torchcover.evaluation.task import build_simulation_task
from torchcover.files import AtomicOutput, end_with_parent, report_stopped_processes, start_program
from torchcover.report import (
    PageTable,
    build_text_cells,
    format_difference,
    format_difference_heading,
    format_error,
    get_display_unit,
    plot_work_precision,
    to_json_record,
)

# Name of the settings of the user in tables and in the diagram.
BASELINE = "as given"


@dataclass(frozen=True)
class Study:
    """Result of a study.

    Args:
        plan: Its plan.
        trials: Its trials; the first is the baseline.
        startup_s: Run time of a command without frames: Python, imports, maps and files. Part of all reported times.
    """

    plan: StudyPlan
    trials: Sequence[Trial]
    startup_s: float

    def find_recommended(self, error: float) -> tuple[Trial, int] | None:
        """Find the fastest setting that reaches an error of all detection rates.

        Args:
            error: Standard error as a share.

        Returns:
            The trial and its number of frames; None if no trial reaches the error.
        """
        candidates = []
        for trial in self.trials:
            num_frames = trial.estimate_num_frames(error)
            if num_frames is not None:
                candidates.append((trial, num_frames))
        if not candidates:
            return None
        times_s = [trial.estimate_duration_s(num_frames, self.startup_s) for trial, num_frames in candidates]
        # A small saving does not justify settings other than the user's.
        is_baseline_first = candidates[0][0] is self.trials[0]
        if is_baseline_first and (1 - self.plan.params.min_saving) * times_s[0] <= min(times_s):
            return candidates[0]
        return candidates[times_s.index(min(times_s))]

    @property
    def tables(self) -> list[PageTable]:
        """Table of the settings, and table of the numbers of the baseline."""
        return [self._build_settings_table(), self._build_numbers_table()]

    def _list_frames_headings(self) -> list[str]:
        """List the headings of the columns with numbers of frames."""
        return [f"frames for {_format_points(error)}" for error in self.plan.params.target_errors]

    def _build_settings_table(self) -> PageTable:
        """Build the table with run time, bias and needed frames of each setting."""
        rows = []
        for trial in self.trials:
            frame_ms = f"{1000 * trial.duration_s / trial.num_frames:.0f}"
            frame_cpu_ms = f"{1000 * trial.cpu_s / trial.num_frames:.0f}"
            texts = [trial.options or BASELINE, frame_ms, frame_cpu_ms, _format_largest_bias(trial)]
            for error in self.plan.params.target_errors:
                texts.append(_format_frames(trial, trial.estimate_num_frames(error), self.startup_s))
            rows.append(build_text_cells(*texts))
        return PageTable(
            "Standard error of all detection rates in front of the vehicle, in percentage points",
            ("setting", "frame (ms)", "CPU time (ms)", "bias (points)", *self._list_frames_headings()),
            rows,
            notes=["bias: largest difference to the first setting in the same frames; * significant"],
        )

    def _build_numbers_table(self) -> PageTable:
        """Build the table with the error and the needed frames of each number of the baseline."""
        baseline = self.trials[0]
        rows = []
        for number in baseline.numbers:
            error_text = format_error(number.error.estimate_error(baseline.num_frames), number.quantity.unit)
            place = f"{number.region} {number.band}"
            texts = [place, format_difference_heading(number.quantity), error_text]
            for error in self.plan.params.target_errors:
                num_frames = number.error.estimate_num_frames(error) if number.quantity.unit == "share" else None
                if num_frames is not None:
                    num_frames = round_up_frames(max(num_frames, baseline.min_frames))
                texts.append(_format_frames(baseline, num_frames, self.startup_s))
            rows.append(build_text_cells(*texts))
        headings = ("region", "number", f"error after {baseline.num_frames:,}", *self._list_frames_headings())
        return PageTable(f"Numbers, {BASELINE}", headings, rows)

    def format_recommendation(self, error: float) -> str:
        """Format the options of `evaluate` that reach an error of all detection rates.

        Args:
            error: Standard error as a share.
        """
        goal = f"Standard error of {_format_points(error)} for every detection rate"
        recommended = self.find_recommended(error)
        if recommended is None:
            baseline = self.trials[0]
            unknown = []
            for number in baseline.select_numbers("share"):
                if math.isnan(number.error.error_coefficient):
                    unknown.append(f"{number.region} {number.band}")
            return (
                f"{goal}: unknown; {baseline.num_frames:,} frames give no standard error of "
                f"{', '.join(unknown) or 'any number'}."
            )
        trial, num_frames = recommended
        options = [trial.options] if trial.options else []
        command = " ".join([*self.plan.command[1:], *options, f"--num-frames={num_frames}"])
        return f"{goal}: {command} ({trial.estimate_duration_s(num_frames, self.startup_s):.0f} s)."

    @property
    def record(self) -> dict[str, Any]:
        """Content of `summary.json`."""
        rig, scenario = self.plan.input_names
        recommendations = []
        for error in self.plan.params.target_errors:
            trial, num_frames = self.find_recommended(error) or (None, None)
            options = None if trial is None else trial.options
            recommendations.append({"error": error, "options": options, "num_frames": num_frames})
        return {
            "torchcover": __version__,
            "rig": str(rig),
            "scenario": str(scenario),
            "seed": self.plan.settings.seed,
            "startup_s": self.startup_s,
            "trials": [_build_trial_record(trial) for trial in self.trials],
            "recommended": recommendations,
        }

    def plot(self) -> Figure:
        """Plot the largest error of each unit against the run time."""
        panels = {}
        quantities = dict.fromkeys(number.quantity for number in self.trials[0].numbers)
        # In general the radius and the first detection rate.
        for quantity in list(quantities)[:2]:
            factor = get_display_unit(quantity.unit).factor
            lines = {}
            for trial in self.trials:
                points = []
                for doubling in range(self.plan.params.num_doublings + 1):
                    num_frames = trial.min_frames << doubling
                    error = factor * trial.estimate_error(num_frames, quantity.unit)
                    points.append((trial.estimate_duration_s(num_frames, self.startup_s), error))
                lines[trial.options or BASELINE] = points
            panels[f"largest error of the {format_difference_heading(quantity)}"] = lines
        return plot_work_precision(panels, title=" in ".join(map(str, self.plan.input_names)), legend_title="setting")

    def save(self, folder: str | Path) -> list[Path]:
        """Write `work_precision.png` and `summary.json`.

        Args:
            folder: Folder for the files; created if it does not exist.

        Returns:
            The files.
        """
        figure = self.plot()
        with AtomicOutput(Path(folder)) as files:
            files.add("work_precision.png", figure.savefig)
            files.publish(self.record)
        return files.paths


def _format_points(error: float) -> str:
    """Format an error of a share in percentage points."""
    return f"{100 * error:g} percentage point{'' if error == 0.01 else 's'}"


def _format_frames(trial: Trial, num_frames: int | None, startup_s: float) -> str:
    """Format a number of frames with its run time."""
    return "-" if num_frames is None else f"{num_frames:,} ({trial.estimate_duration_s(num_frames, startup_s):.0f} s)"


def _format_largest_bias(trial: Trial) -> str:
    """Format the largest difference to the baseline; a significant one is larger than any other."""
    largest, largest_key = None, (False, -1.0)
    for number in trial.select_numbers("share"):
        if number.difference is not None and not math.isnan(number.difference.value):
            key = (number.is_biased, abs(number.difference.value))
            if key > largest_key:
                largest, largest_key = number.difference, key
    if largest is None:
        return "-" if trial.options else ""
    return f"{format_difference(largest)}{' *' if largest_key[0] else ''}"


def _build_trial_record(trial: Trial) -> dict[str, Any]:
    """Build the record of a trial for `summary.json`."""
    numbers = []
    for number in trial.numbers:
        values = {"region": number.region, "band": number.band, "quantity": number.quantity.key, "value": number.value}
        difference = number.difference._asdict() if number.difference else {}
        difference_values = {key: difference.get(key, math.nan) for key in ("value", "error", "p_value")}
        errors = {**number.error._asdict(), "difference": to_json_record(difference_values)}
        numbers.append(to_json_record({**values, **errors}))
    names = ("options", "num_frames", "min_frames", "duration_s", "cpu_s", "band_frame")
    return {**{name: getattr(trial, name) for name in names}, "numbers": numbers}


def measure_error_against_time(plan: StudyPlan, *, show_progress: bool = False) -> Study:
    """Measure run time and bias of all settings of a plan, on the same frames.

    Args:
        plan: The settings.
        show_progress: Show progress bars.

    Returns:
        The trials and the startup time.

    Raises:
        ValueError: Invalid settings, or the timed command fails.
        FileNotFoundError: Unknown name or file.
    """
    for settings in plan.trial_settings.values():
        build_simulation_task(settings)  # invalid settings fail before anything runs
    trials: list[Trial] = []
    baseline: Coverage | None = None
    for options, settings in plan.trial_settings.items():
        num_frames = settings.num_frames if baseline is None else _count_variant_frames(baseline, plan.params)
        run_settings = replace(settings, num_frames=num_frames, test_targets="none", progress=show_progress)
        trial, coverage = _run_trial(options, run_settings, baseline, plan.params)
        trials.append(trial)
        baseline = baseline or coverage
    # The timed command evaluates one frame.
    frame_s = trials[0].duration_s / trials[0].num_frames
    return Study(plan, trials, max(0.0, measure_command_s(plan) - frame_s))


def _count_variant_frames(baseline: Coverage, params: StudyParams) -> int:
    """Count the frames of the blocks of the baseline on which variants are evaluated."""
    frame_counts = baseline.estimate(baseline.regions[0], next(iter(baseline.grid.heights))).frame_counts
    num_blocks = max(MIN_BLOCKS, int(len(frame_counts) * params.variant_share))
    return int(frame_counts[:num_blocks].sum())


def _run_trial(
    options: str, settings: Settings, baseline: Coverage | None, params: StudyParams
) -> tuple[Trial, Coverage]:
    """Evaluate one setting and compare it with the baseline; None if it is the baseline."""
    task = build_simulation_task(settings)
    # User and system time of this process and of its children, the workers.
    cpu_before_s = sum(os.times()[:4])
    result = measure_coverage(task, settings)
    cpu_s = sum(os.times()[:4]) - cpu_before_s
    assert result.run is not None  # the result was measured, not loaded
    result.run.raise_failure()
    coverage = result.coverage
    num_frames = coverage.counts["num_frames"]
    effective_blocks = math.inf
    region_bands = list_region_bands(result.regions, coverage.grid)
    num_comparisons = len(region_bands) * len(coverage.quantities)
    numbers = []
    for region, band in region_bands:
        estimate = coverage.estimate(region, band)
        paired = None if baseline is None else _select_paired(baseline, coverage, region, band)
        differences = estimate.compute_differences(paired) if paired else {}
        has_target = region in task.query_plan.target_regions
        if has_target and not estimate.value.isnan().all():
            effective_blocks = min(effective_blocks, float(estimate.effective_blocks.min()))
        coefficients = _mask_zero_errors(estimate.error).square() * num_frames
        if paired and baseline:
            # The baseline has more frames and therefore the better error; its ratio to the error of the variant is
            # accurate because both come from the same frames.
            baseline_error = _mask_zero_errors(baseline.estimate(region, band).error)
            baseline_coefficients = baseline_error.square() * baseline.counts["num_frames"]
            ratios = (estimate.error / _mask_zero_errors(paired.error)).square()
            coefficients = torch.where(baseline_coefficients.isnan(), coefficients, baseline_coefficients * ratios)
        values = zip(estimate.quantities, estimate.value.tolist(), coefficients.tolist(), strict=True)
        for quantity, value, coefficient in values:
            difference, is_biased, bias = None, False, 0.0
            if baseline is not None:
                difference = differences.get(quantity.key, Difference(quantity, math.nan))
                is_biased = difference.p_value * num_comparisons < params.significance_level
                if is_biased or math.isnan(difference.value):
                    bias = abs(difference.value)
            error = ErrorModel(coefficient, bias)
            numbers.append(StudiedNumber(region.name, band, has_target, quantity, value, error, difference, is_biased))
    min_frames = estimate_blocks_needed(num_frames, effective_blocks) if effective_blocks > 0 else num_frames
    times_s = result.run.duration_s, cpu_s
    trial = Trial(options, num_frames, max(MIN_FRAMES, min_frames), *times_s, coverage.band_frame, numbers)
    return trial, coverage


def _mask_zero_errors(errors: Tensor) -> Tensor:
    """Replace errors of 0 with NaN: identical blocks do not prove that a number is exact."""
    return errors.where(errors > ROUND_OFF, math.nan)


def _select_paired(baseline: Coverage, coverage: Coverage, region: Region, band: str) -> Estimate | None:
    """Select the estimate of the baseline on the frames of another trial.

    Returns:
        The estimate; None if the averages or the frames of both trials differ.
    """
    estimate = coverage.estimate(region, band)
    paired = baseline.estimate(region, band)
    num_blocks = len(estimate.frame_counts)
    if baseline.average != coverage.average or num_blocks > len(paired.frame_counts):
        return None
    paired = paired.truncate_blocks(num_blocks)
    return paired if paired.frame_counts.tolist() == estimate.frame_counts.tolist() else None


def measure_command_s(plan: StudyPlan) -> float:
    """Measure the run time of `torchcover evaluate` for one frame, from its start to its end.

    Args:
        plan: The settings.

    Returns:
        Seconds.

    Raises:
        ValueError: The command fails.
    """
    arguments = [*plan.command, "--num-frames=1"]
    start_s = time.perf_counter()
    with TemporaryDirectory() as folder:
        # With `-m`, modules in the working directory would be imported instead of packages.
        program = f"import sys; sys.path[:] = {sys.path!r}; from torchcover.cli.app import main; main()"
        command = [sys.executable, "-c", program, *arguments, f"--out={folder}"]
        process = start_program(
            command,
            "the timed command",
            text=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            preexec_fn=end_with_parent(),
        )
        with process, report_stopped_processes([process.pid], "the timed command"):
            messages = process.communicate()[1]
    if process.returncode:
        raise ValueError(f"torchcover {' '.join(arguments)} ended with {process.returncode}: {messages.strip()}")
    return time.perf_counter() - start_s
