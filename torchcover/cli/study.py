"""`torchcover study`: error against run time, and the setting to use for a wanted error."""

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from torchcover import __version__
from torchcover.cli.run import BLOCKS, check_out, new_metric
from torchcover.cli.settings import every_s_of, reference_called
from torchcover.coverage import Coverage, CoverageMetric, Region, forward_regions
from torchcover.coverage.estimate import Estimator
from torchcover.data import SimulatedFrames
from torchcover.neighbors import nearest
from torchcover.report import (
    WorkPoint,
    cheapest,
    draw_work_precision,
    json_record,
    narrowest_width,
    study_records,
    study_table,
)
from torchcover.simulation import Scenario

# Rays in a step of the long run: no fewer than any setting has, for fewer never see some cells of some steps.
LONG_RUN_RAYS = 1_048_576
# The other backend of the search is tried up to here; beyond, it takes minutes.
MAX_RAYS_BY_BRUTE_FORCE = 4096
# Seeds of the runs are next to each other; the long run's is far away.
LONG_RUN_SEED = 1_000_003
# Detection errors that a setting is recommended for.
WANTED = (0.05, 0.02, 0.01, 0.005)
DEFAULT_RAYS = (1024, 4096, 16_384, 65_536, 262_144, 1_048_576)
ESTIMATORS: tuple[Estimator, ...] = ("known", "completed")


@dataclass(frozen=True)
class Request:
    """What the user asked for; the options of `torchcover study`."""

    rig: str
    scenario: str
    rays: tuple[int, ...]
    steps: int
    runs: int
    long_run_steps: int
    every_s: float | None
    seed: int
    cell: float
    threshold: float
    out: Path


@dataclass(frozen=True)
class Truth:
    """The long run: its maps, and what it says about each region and band."""

    coverage: Coverage
    values: torch.Tensor  # (regions x bands, 2): radius, detection
    errors: torch.Tensor  # their standard errors


@dataclass
class Setting:
    """A pattern of the reference sensor with a number of rays, and what one run with it has cost so far."""

    name: str
    rays: int
    frames: SimulatedFrames
    metric: CoverageMetric
    seconds: float = 0.0

    def add(self, index: int) -> None:
        """Do a step, and note the time."""
        start = time.perf_counter()
        frame = self.frames[index]
        self.metric.update(frame.sensor, frame.reference, weights=frame.reference_weights, index=index)
        self.seconds += time.perf_counter() - start


def run(request: Request) -> None:
    """Measure, print the tables, write `study.json` and the diagram.

    Raises:
        ValueError: The request makes no sense.
        FileNotFoundError: A name or a file is unknown.
    """
    check_out(request.out)
    with Progress(console=Console(stderr=True)) as bar:
        truth = _long_run(request, bar)
        samples: dict[tuple[str, int, int], list[tuple[float, torch.Tensor]]] = {}
        for seed in range(request.seed, request.seed + request.runs):
            for key, sample in _one_run(request, seed, truth, bar):
                samples.setdefault(key, []).append(sample)
    points = [_point(key, of_runs) for key, of_runs in sorted(samples.items())]
    stages = _stages(request)
    _write(request, truth, points, stages)


def _long_run(request: Request, bar: Progress) -> Truth:
    metric = _metric(request, blocks=BLOCKS)
    base = _frames(request, LONG_RUN_SEED + request.seed, request.long_run_steps)
    frames = base.with_reference_sensor(reference_called("even", LONG_RUN_RAYS))
    for index in bar.track(range(request.long_run_steps), description="long run"):
        frame = frames[index]
        metric.update(frame.sensor, frame.reference, weights=frame.reference_weights, index=index)
    coverage = metric.compute()
    estimates = [
        coverage.estimate(region, height, "completed")
        for region in forward_regions()
        for height in coverage.grid.heights
    ]
    values = torch.stack([estimate.value for estimate in estimates])
    return Truth(coverage, values, torch.stack([estimate.error for estimate in estimates]))


def _one_run(
    request: Request, seed: int, truth: Truth, bar: Progress
) -> Iterator[tuple[tuple[str, int, int], tuple[float, torch.Tensor]]]:
    """Every setting over the same instants; yields what it has reached whenever the steps have doubled."""
    settings = _settings(request, seed)
    stops = {max(1, request.steps >> halvings) for halvings in range(6)}
    for index in bar.track(range(request.steps), description=f"seed {seed}"):
        start = time.perf_counter()
        settings[0].frames.scene_of(index)  # each of them would have built it alone
        world_seconds = time.perf_counter() - start
        for setting in settings:
            setting.seconds += world_seconds
            setting.add(index)
            if index + 1 in stops:
                reached = _errors(setting.metric.compute(), truth)
                yield (setting.name, setting.rays, index + 1), (setting.seconds, reached)


def _settings(request: Request, seed: int) -> list[Setting]:
    base = _frames(request, seed, request.steps)
    return [
        Setting(name, rays, base.with_reference_sensor(reference_called(name, rays)), _metric(request, blocks=1))
        for rays in request.rays
        for name in ("even", "paper")
    ]


def _frames(request: Request, seed: int, steps: int) -> SimulatedFrames:
    scenario = Scenario.load(request.scenario)
    return SimulatedFrames(scenario, request.rig, steps=steps, seed=seed, every_s=every_s_of(scenario, request.every_s))


def _metric(request: Request, blocks: int) -> CoverageMetric:
    return new_metric(request.cell, (request.threshold,), torch.device("cpu"), blocks=blocks)


def _errors(coverage: Coverage, truth: Truth) -> torch.Tensor:
    """Mean squares of the distances to the long run: (radius, detection) of known, completed, cells; known share."""
    squares = []
    regions = [(region, height) for region in forward_regions() for height in coverage.grid.heights]
    for estimator in ESTIMATORS:
        values = torch.stack([coverage.estimate(region, height, estimator).value for region, height in regions])
        # A region of which nothing is known yet has no distance.
        squares.append((values - truth.values).square().nanmean(dim=0))
    squares.append(_cell_errors(coverage, truth.coverage, forward_regions()[-1]))
    known = torch.tensor([row.known_share for row in coverage.summary(forward_regions())], dtype=torch.float64)
    return torch.cat([*squares, known.mean()[None]])


def _cell_errors(coverage: Coverage, truth: Coverage, region: Region) -> torch.Tensor:
    cells = region.mask(coverage.grid)
    radius = (coverage.radius - truth.radius)[:, cells].square().nanmean()
    detection = (coverage.detection[0] - truth.detection[0])[:, cells].square().nanmean()
    return torch.stack([radius, detection])


def _point(key: tuple[str, int, int], runs: Sequence[tuple[float, torch.Tensor]]) -> WorkPoint:
    name, rays, steps = key
    *squares, known = torch.stack([reached for _, reached in runs]).mean(dim=0).tolist()
    radius, detection, completed_radius, completed_detection, cell_radius, cell_detection = (x**0.5 for x in squares)
    return WorkPoint(
        reference=name,
        rays=rays,
        steps=steps,
        seconds=sum(seconds for seconds, _ in runs) / len(runs),
        detection_error=detection,
        radius_error_m=radius,
        completed_detection_error=completed_detection,
        completed_radius_error_m=completed_radius,
        cell_detection_error=cell_detection,
        cell_radius_error_m=cell_radius,
        known_share=known,
    )


def _stages(request: Request) -> list[dict[str, Any]]:
    """How a step of each setting divides into the rays, the search and the binning, in seconds; medians of five."""
    stages = []
    for setting in _settings(request, request.seed):
        times = zip(*(_one_step(setting, index % request.steps) for index in range(5)), strict=True)
        names = ("rays_s", "search_s", "binning_s", "cdist_s")
        medians = {name: median(seconds) for name, seconds in zip(names, times, strict=True)}
        stages.append({"reference": setting.name, "rays": setting.rays, **medians})
    return stages


def _one_step(setting: Setting, index: int) -> tuple[float, float, float, float]:
    setting.frames.scene_of(index)  # not counted: it comes once for many steps
    start = time.perf_counter()
    frame = setting.frames[index]
    cast = time.perf_counter()
    setting.metric.update(frame.sensor, frame.reference, weights=frame.reference_weights)
    updated = time.perf_counter()
    inside = setting.metric.grid.cell_of(frame.reference) >= 0
    searching = time.perf_counter()
    nearest(frame.reference[inside], frame.sensor, max_distance=setting.metric.max_radius)
    searched = time.perf_counter()
    search_s, brute_force_s = searched - searching, math.nan
    if setting.rays <= MAX_RAYS_BY_BRUTE_FORCE:
        nearest(frame.reference[inside], frame.sensor, max_distance=setting.metric.max_radius, backend="cdist")
        brute_force_s = time.perf_counter() - searched
    return cast - start, search_s, max(0.0, updated - cast - search_s), brute_force_s


def _write(request: Request, truth: Truth, points: Sequence[WorkPoint], stages: Sequence[Mapping[str, Any]]) -> None:
    request.out.mkdir(parents=True, exist_ok=True)
    radius_floor_m, detection_floor = truth.errors.square().nanmean(dim=0).sqrt().tolist()
    floor = {"detection_error": detection_floor, "radius_error_m": radius_floor_m}
    every_s = _frames(request, request.seed, request.steps).every_s
    about = f"{request.runs} runs, a step every {every_s:g} s, cells of {request.cell:g} m"
    title = f"{request.rig} in {request.scenario}: {about}"
    figure = draw_work_precision(points, floor, title)
    figure.savefig(request.out / "work_precision.png")
    recommended = {wanted: cheapest(points, "detection_error", wanted) for wanted in WANTED}
    content = {
        "torchcover": __version__,
        "rig": request.rig,
        "scenario": request.scenario,
        "seed": request.seed,
        "runs": request.runs,
        "every_s": every_s,
        "cell_m": request.cell,
        "threshold_m": request.threshold,
        "long_run": {"steps": request.long_run_steps, "rays": LONG_RUN_RAYS, "standard_errors": json_record(floor)},
        "points": study_records(points),
        "stages": [json_record(stage) for stage in stages],
        "recommended": [
            {"detection_error": wanted, **({} if point is None else study_records([point])[0])}
            for wanted, point in recommended.items()
        ],
    }
    (request.out / "study.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    console, tables = Console(), (study_table(points), _stage_table(stages))
    # Rather lines that are too long than numbers that are cut off.
    console.width = max(console.width, narrowest_width(tables))
    for table in tables:
        console.print(table)
    console.print(
        f"The long run ({request.long_run_steps:,} steps of {LONG_RUN_RAYS:,} rays, other seed) has itself an error of "
        f"{100 * detection_floor:.2f} percentage points and {radius_floor_m:.3f} m."
    )
    for wanted, point in recommended.items():
        console.print(_advice(wanted, point, request), soft_wrap=True)
    console.print(f"Wrote study.json and work_precision.png to {request.out}", soft_wrap=True)


def _advice(wanted: float, point: WorkPoint | None, request: Request) -> str:
    """The options of `evaluate` that reach an error; the size of the cells, which decides about it, among them."""
    if point is None:
        return f"For {100 * wanted:g} percentage points of detection: not reached within {request.steps:,} steps."
    every = "" if request.every_s is None else f" --every {request.every_s:g}"
    return (
        f"For {100 * wanted:g} percentage points of detection: --reference {point.reference} --rays {point.rays} "
        f"--steps {point.steps} --cell {request.cell:g}{every} ({point.seconds:.0f} s)."
    )


def _stage_table(stages: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(title="One step: where the time goes", title_justify="left")
    table.add_column("reference")
    for column in ("rays", "step (ms)", "rays (%)", "search (%)", "binning (%)", "search by cdist (ms)"):
        table.add_column(column, justify="right")
    for stage in stages:
        parts = [stage["rays_s"], stage["search_s"], stage["binning_s"]]
        shares = [f"{100 * part / sum(parts):.0f}" for part in parts]
        brute_force = "" if math.isnan(stage["cdist_s"]) else f"{1000 * stage['cdist_s']:.0f}"
        table.add_row(stage["reference"], f"{stage['rays']:,}", f"{1000 * sum(parts):.0f}", *shares, brute_force)
    return table
