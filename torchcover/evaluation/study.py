"""Error against run time, and the setting to use for a wanted error."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table

from torchcover import __version__
from torchcover.estimation import Quantity
from torchcover.evaluation.study_runs import StudyPlan, Truth, command_s, long_run, tried
from torchcover.report import (
    WorkPanel,
    difference_heading,
    draw_work_precision,
    error_words,
    json_record,
    shown_unit,
    text_table,
)

# Detection errors that a setting is recommended for.
WANTED = (0.05, 0.02, 0.01, 0.005)


@dataclass(frozen=True)
class WorkPoint:
    """What a setting reached in a time.

    Args:
        rays: Rays of the reference sensor at each step.
        steps: Steps.
        runs: How many runs of so many steps there were.
        seconds: Time that a command with this setting takes, from its start to its end.
        errors: By the key of the quantity, the root mean square of the distance to a long run, over regions, bands and
            runs.
    """

    rays: int
    steps: int
    runs: int
    seconds: float
    errors: Mapping[str, float]


def pareto_front(points: Sequence[WorkPoint], key: str) -> list[WorkPoint]:
    """The points that no other beats in both time and error, fastest first; none whose error is unknown.

    Args:
        points: Measured points.
        key: Of the quantity whose error counts.

    Example:
        >>> points = [WorkPoint(1, 1, 1, seconds, {"radius_m": error}) for seconds, error in ((1, 3), (2, 4), (3, 1))]
        >>> [one.seconds for one in pareto_front(points, "radius_m")]
        [1, 3]
    """
    front: list[WorkPoint] = []
    known = [point for point in points if not math.isnan(point.errors[key])]
    for point in sorted(known, key=lambda point: (point.seconds, point.errors[key])):
        if not front or point.errors[key] < front[-1].errors[key]:
            front.append(point)
    return front


def cheapest(points: Sequence[WorkPoint], key: str, at_most: float) -> WorkPoint | None:
    """The fastest point with an error of at most this; None if there is none.

    Example:
        >>> cheapest([], "detection_0.4m", 0.01) is None
        True
    """
    good = [point for point in points if point.errors[key] <= at_most]
    return min(good, key=lambda point: point.seconds, default=None)


def study_table(points: Sequence[WorkPoint], quantities: Sequence[Quantity]) -> Table:
    """A row for each point, the Pareto front of the last quantity marked `*`."""
    front = pareto_front(points, quantities[-1].key)
    by_rays = (list(of_rays) for _, of_rays in groupby(points, lambda point: point.rays))
    return text_table(
        ("rays", "steps", "runs", "time (s)", *(f"error of {difference_heading(one)}" for one in quantities)),
        [[_row(point, quantities, is_best=point in front) for point in section] for section in by_rays],
        caption=f"* no other setting is both faster and more accurate ({quantities[-1].title})",
    )


def _row(point: WorkPoint, quantities: Sequence[Quantity], *, is_best: bool) -> list[str]:
    errors = [error_words(point.errors[one.key], one.unit) for one in quantities]
    rays = f"{point.rays:,}{' *' * is_best}"
    return [rays, f"{point.steps:,}", f"{point.runs:,}", f"{point.seconds:.1f}", *errors]


def stage_table(stages: Sequence[Mapping[str, Any]]) -> Table:
    """How a step of each setting divides into its parts; `Study.stages`."""
    rows = []
    for stage in stages:
        parts = [stage["worlds"], stage["casting"], stage["measuring"]]
        shares = [f"{100 * part / sum(parts):.0f}" for part in parts]
        rows.append((f"{stage['rays']:,}", f"{1000 * sum(parts):.0f}", *shares))
    headings = ("rays", "step (ms)", "worlds (%)", "casting (%)", "search and sums (%)")
    return text_table(headings, [rows], title="One step: where the time goes")


def work_panels(
    points: Sequence[WorkPoint], quantities: Sequence[Quantity], floor: Mapping[str, float]
) -> Iterator[WorkPanel]:
    """What the work-precision diagram shows of them.

    Args:
        points: Measured points.
        quantities: What errors are of: a panel each.
        floor: Standard errors of the long run, likewise by key: errors below them say nothing.
    """
    for quantity in quantities:
        key, factor = quantity.key, shown_unit(quantity.unit).factor

        def line(of: Sequence[WorkPoint], key: str = key, factor: float = factor) -> list[tuple[float, float]]:
            return [(point.seconds, factor * point.errors[key]) for point in of]

        lines = {f"{rays:,}": line(list(of)) for rays, of in groupby(points, lambda point: point.rays)}
        label = f"error of the {difference_heading(quantity)}"
        yield WorkPanel(label, lines, line(pareto_front(points, key)), factor * floor[key])


def study_records(points: Sequence[WorkPoint], quantities: Sequence[Quantity]) -> list[dict[str, object]]:
    """The points for `study.json`."""
    fronts = {quantity.key: pareto_front(points, quantity.key) for quantity in quantities}
    return [
        {
            **{name: getattr(point, name) for name in ("rays", "steps", "runs", "seconds")},
            "errors": json_record(point.errors),
            "best": [key for key, front in fronts.items() if point in front],
        }
        for point in points
    ]


@dataclass(frozen=True)
class Study:
    """What a study has found.

    Args:
        plan: What it was about.
        vehicle: What carried the rig.
        every_s: Time between two steps in seconds.
        truth: The long run.
        points: What each number of rays and of steps costs, and how far it is off.
        start_s: What a command takes whatever its steps: Python, imports, maps and files. It is in all times.
        stages: Where the time of a step goes: records with `rays`, and in seconds `worlds`, `casting` and `measuring`.
    """

    plan: StudyPlan
    vehicle: str
    every_s: float
    truth: Truth
    points: Sequence[WorkPoint]
    start_s: float
    stages: Sequence[dict[str, Any]]

    @property
    def quantities(self) -> Sequence[Quantity]:
        """What errors are of: the radius and the detection."""
        return self.truth.coverage.quantities

    @property
    def recommended(self) -> dict[float, WorkPoint | None]:
        """The cheapest point for each wanted error of the detection; None where none is good enough."""
        return {wanted: cheapest(self.points, self.quantities[1].key, wanted) for wanted in WANTED}

    @property
    def record(self) -> dict[str, Any]:
        """All of it: what stands in `study.json`."""
        plan = self.plan
        return {
            "torchcover": __version__,
            "rig": plan.rig,
            "scenario": plan.scenario,
            "vehicle": self.vehicle,
            "seed": plan.settings.seed,
            "every_s": self.every_s,
            "cell_m": plan.task.asked.grid.cell,
            "long_run": {
                "steps": self.truth.coverage.counts["steps"],
                "standard_errors": json_record(self.truth.errors),
            },
            "start_s": self.start_s,
            "points": study_records(self.points, self.quantities),
            "seconds_a_step": list(self.stages),
            "recommended": [
                {"error": wanted, "rays": point and point.rays, "steps": point and point.steps}
                for wanted, point in self.recommended.items()
            ],
        }

    def draw(self) -> Figure:
        """The diagram of error against run time."""
        title = f"{self.plan.rig} on {self.vehicle} in {self.plan.scenario}: a step every {self.every_s:g} s"
        panels = work_panels(self.points, self.quantities, self.truth.errors)
        return draw_work_precision(panels, title=title, legend_title="rays a step")

    def save(self, folder: str | Path) -> None:
        """Write `work_precision.png`, `long_run.npz` and `study.json` into a folder, which is made if need be."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self.draw().savefig(folder / "work_precision.png")
        self.truth.coverage.save(folder / "long_run.npz")
        text = json.dumps(self.record, indent=2, allow_nan=False) + "\n"
        (folder / "study.json").write_text(text, encoding="utf-8")


def error_against_time(plan: StudyPlan, *, progress: bool = False) -> Study:
    """Measure what each number of rays costs and how far it is off after how many steps.

    Args:
        plan: What to try.
        progress: Whether to show bars.

    Raises:
        ValueError: A plan that makes no sense.
        FileNotFoundError: An unknown name or file.
    """
    frames, _ = plan.frames(plan.settings.seed, 1), plan.metric(1)  # which fail at once if anything is wrong
    truth = long_run(plan, progress=progress)
    one_step_s = command_s(plan)
    done = tried(plan, one_step_s, progress=progress)
    points = [
        WorkPoint(
            rays=trial.rays,
            steps=steps,
            runs=done.steps // steps,
            seconds=done.seconds(trial, steps),
            errors=truth.distances(trial.sums(steps // plan.lengths[0])),
        )
        for trial in done.trials
        for steps in plan.lengths
    ]
    stages = [
        {
            "rays": trial.rays,
            "worlds": done.worlds_s / done.steps,
            "casting": trial.casting.seconds / done.steps,
            "measuring": trial.measuring.seconds / done.steps,
        }
        for trial in done.trials
    ]
    return Study(plan, frames.scenario.ego_name, frames.every_s, truth, points, done.start_s, stages)
