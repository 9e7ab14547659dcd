"""Error against run time, and the setting to use for a wanted error."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchcover import __version__
from torchcover.estimation import Quantity
from torchcover.evaluation.study_plan import StudyPlan
from torchcover.evaluation.study_runs import command_s, tried
from torchcover.evaluation.study_truth import Truth, long_run
from torchcover.evaluation.work_points import WorkPoint, cheapest, study_records, work_panels
from torchcover.report import draw_work_precision, json_record

# Detection errors that a setting is recommended for.
WANTED = (0.05, 0.02, 0.01, 0.005)


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
            "rig": str(plan.rig),
            "scenario": str(plan.scenario),
            "vehicle": self.vehicle,
            "seed": plan.seed,
            "every_s": self.every_s,
            "cell_m": plan.cell_m,
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
    frames, _ = plan.frames(plan.seed, 1), plan.metric(1)  # which fail at once if anything is wrong
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
