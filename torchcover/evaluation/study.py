"""Error against run time, and the setting to use for a wanted error."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from torchcover import __version__
from torchcover.evaluation.study_plan import StudyPlan
from torchcover.evaluation.study_runs import Sample, Trial, one_run, time_stages
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
        every_s: Time between two steps in seconds.
        truth: The long run.
        points: What each trial costs after some steps, and how far it is off; means over the runs.
        stages: Where the time of a step goes: records with `reference`, `rays`, `rays_s`, `search_s`, `binning_s` and
            `cdist_s`, NaN where that was not tried.
    """

    plan: StudyPlan
    every_s: float
    truth: Truth
    points: Sequence[WorkPoint]
    stages: Sequence[dict[str, Any]]

    @property
    def floor(self) -> dict[str, float]:
        """Standard errors of the long run itself: no smaller error can be told."""
        radius_m, detection = self.truth.errors.square().nanmean(dim=0).sqrt().tolist()
        return {"detection_error": detection, "radius_error_m": radius_m}

    @property
    def recommended(self) -> dict[float, WorkPoint | None]:
        """The cheapest point for each wanted error of the detection; None where none is good enough."""
        return {wanted: cheapest(self.points, "detection_error", wanted) for wanted in WANTED}

    @property
    def record(self) -> dict[str, Any]:
        """All of it: what stands in `study.json`."""
        plan = self.plan
        return {
            "torchcover": __version__,
            "rig": str(plan.rig),
            "scenario": str(plan.scenario),
            "seed": plan.seed,
            "runs": plan.runs,
            "every_s": self.every_s,
            "cell_m": plan.cell_m,
            "threshold_m": plan.threshold_m,
            "long_run": {
                "steps": plan.long_run_steps,
                "rays": plan.long_run_rays,
                "standard_errors": json_record(self.floor),
            },
            "points": study_records(self.points),
            "stages": [json_record(stage) for stage in self.stages],
            "recommended": [
                {"detection_error": wanted, **({} if point is None else study_records([point])[0])}
                for wanted, point in self.recommended.items()
            ],
        }

    def draw(self) -> Figure:
        """The diagram of error against run time."""
        about = f"{self.plan.runs} runs, a step every {self.every_s:g} s, cells of {self.plan.cell_m:g} m"
        title = f"{self.plan.rig} in {self.plan.scenario}: {about}"
        return draw_work_precision(work_panels(self.points, self.floor), title=title, legend_title="rays a step")

    def save(self, folder: str | Path) -> None:
        """Write `work_precision.png` and `study.json` into a folder, which is made if it does not exist."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self.draw().savefig(folder / "work_precision.png")
        text = json.dumps(self.record, indent=2, allow_nan=False) + "\n"
        (folder / "study.json").write_text(text, encoding="utf-8")


def error_against_time(plan: StudyPlan, *, progress: bool = False) -> Study:
    """Measure what each reference sensor costs and how far it is off after how many steps.

    Args:
        plan: What to try.
        progress: Whether to show bars.

    Raises:
        ValueError: A plan that makes no sense.
        FileNotFoundError: An unknown name or file.
    """
    truth = long_run(plan, progress=progress)
    samples: dict[tuple[Trial, int], list[Sample]] = {}
    for seed in range(plan.seed, plan.seed + plan.runs):
        for sample in one_run(plan, seed, truth, progress=progress):
            samples.setdefault((sample.trial, sample.steps), []).append(sample)
    points = [_point(of_runs) for _, of_runs in sorted(samples.items())]
    every_s = plan.frames(plan.seed, plan.steps).every_s
    return Study(plan, every_s, truth, points, time_stages(plan))


def _point(runs: Sequence[Sample]) -> WorkPoint:
    squares = torch.stack([run.squared_errors for run in runs]).mean(dim=0)
    radius, detection, cell_radius, cell_detection = squares.sqrt().tolist()
    return WorkPoint(
        reference=runs[0].trial.reference_sensor,
        rays=runs[0].trial.rays,
        steps=runs[0].steps,
        seconds=sum(run.seconds for run in runs) / len(runs),
        detection_error=detection,
        radius_error_m=radius,
        cell_detection_error=cell_detection,
        cell_radius_error_m=cell_radius,
    )
