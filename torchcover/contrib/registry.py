"""The metrics of others by the names that `--set metrics=NAME` takes: their needs, and how a run builds them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from torchcover.contrib.comparison import MetricComparison
from torchcover.contrib.frame_metric import FrameMetric, Sights
from torchcover.contrib.ranks import OWN, Ranking, rankings
from torchcover.contrib.ratio_metrics import KCover, ObjectCoverage, PerceptionEntropy, PointDensity
from torchcover.contrib.ray_metrics import FalseVisible, MSog, coarse_grid
from torchcover.contrib.s_mig import SMig
from torchcover.coverage import BevGrid, Coverage, Region, forward_regions
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import Task
from torchcover.frames import FrameSource
from torchcover.simulation import Sensor
from torchcover.simulation.shapes import Mesh

# boxes: `Frame.boxes`. sensors: the rig's sensors, with mounts and rays. sensor_points: which points are of which
# sensor.
Need: TypeAlias = Literal["boxes", "sensors", "sensor_points"]

GRID = BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0))
# Of smaller cells most are empty whatever the rig.
UNIFORMITY_CELL_M = 1.0


@dataclass(frozen=True)
class Setup:
    """What metrics of one rig are made from.

    Args:
        rig: Its name in `Frame.clouds`; the only one if not given.
        sensors: Its sensors; empty if they are unknown.
        ego: The body that carries it, in the vehicle frame; None if it is unknown.
        grid: Cells and height bands of the run.
        regions: Those that numbers are given for.
        square_metres: Whether frames have the square metres of their reference points.
        threshold_m: Distance within which a point counts as seen.
        sights: What metrics of the same run share, so that each frame is searched once.
    """

    rig: str | None = None
    sensors: Sequence[Sensor] = ()
    ego: Mesh | None = None
    grid: BevGrid = GRID
    regions: Sequence[Region] = field(default_factory=forward_regions)
    square_metres: bool = True
    threshold_m: float = 0.4
    sights: Sights = field(default_factory=Sights)

    @property
    def of_frames(self) -> dict[str, Any]:
        """The arguments that metrics of what frames show have in common."""
        return {"rig": self.rig, "sights": self.sights}


@dataclass(frozen=True)
class Published:
    """A metric by its name in `--set metrics=NAME`.

    Args:
        make: Makes it.
        needs: What it cannot do without.
        words: What it says, in a line.
    """

    make: Callable[[Setup], FrameMetric]
    needs: frozenset[Need]
    words: str


def _point_density(setup: Setup) -> PointDensity:
    # A region that is smaller than a cell of 1 m needs the cells of the run.
    coarse = coarse_grid(setup.grid, UNIFORMITY_CELL_M)
    fits = all(region.mask(coarse).any() for region in setup.regions)
    return PointDensity(coarse if fits else setup.grid, setup.regions, **setup.of_frames)


PUBLISHED: Mapping[str, Published] = {
    "object_coverage": Published(
        lambda setup: ObjectCoverage(setup.threshold_m, **setup.of_frames),
        frozenset({"boxes"}),
        "share of an object within the threshold; objects with 1, 5, 10 points",
    ),
    "perception_entropy": Published(
        lambda setup: PerceptionEntropy(setup.sensors, **setup.of_frames),
        frozenset({"boxes"}),
        "nats of a detector's error, from points on objects (Ma 2021)",
    ),
    "k_cover": Published(
        lambda setup: KCover(
            setup.grid, setup.regions, setup.threshold_m, square_metres=setup.square_metres, **setup.of_frames
        ),
        frozenset({"sensor_points"}),
        "share of the surface seen by 1, 2, 3 sensors",
    ),
    "point_density": Published(_point_density, frozenset(), "points, for each square metre, and how evenly"),
    "false_visible": Published(
        lambda setup: FalseVisible(setup.sensors, setup.ego, setup.grid, setup.threshold_m, **setup.of_frames),
        frozenset({"sensors"}),
        "blind cells that the field of view promised (Börger 2022)",
    ),
    "s_mig": Published(
        lambda setup: SMig(setup.sensors, **setup.of_frames),
        frozenset({"boxes", "sensors"}),
        "minus the entropy of objects along the rays, in nats (Hu 2022)",
    ),
    "s_mig_occluded": Published(
        lambda setup: SMig(setup.sensors, occlusion=True, **setup.of_frames),
        frozenset({"boxes", "sensors", "sensor_points"}),
        "the same, up to what the rays hit",
    ),
    "m_sog": Published(
        lambda setup: MSog(setup.sensors, **setup.of_frames),
        frozenset({"boxes", "sensors"}),
        "minus the mean entropy of labels along the rays (Place3D 2024)",
    ),
}


def metric_names(given: str | Iterable[str]) -> tuple[str, ...]:
    """The metrics that a user asks for; "all" is all of them.

    Raises:
        ValueError: No such metric.
    """
    names = [name.strip() for name in given.split(",")] if isinstance(given, str) else list(given)
    if names == ["all"]:
        return tuple(PUBLISHED)
    for name in names:
        if name not in PUBLISHED:
            raise ValueError(f"metrics: all, or some of {', '.join(PUBLISHED)}, separated by commas; got {name!r}")
    return tuple(dict.fromkeys(names))


REASONS: Mapping[Need, str] = {
    "boxes": "it needs boxes of objects, which simulations and labelled recordings have",
    "sensors": "it needs the rig's sensors, with mounts and rays: give the rig's YAML file or a built-in name",
    "sensor_points": "which points are of which sensor is unknown",
}


class RunMetrics(NamedTuple):
    """The metrics of a run.

    Args:
        by_rig: Name of a metric -> name of a rig -> the metric.
        left_out: Name of a metric that cannot be built -> the reason.
    """

    by_rig: Mapping[str, Mapping[str, FrameMetric]]
    left_out: Mapping[str, str]

    @property
    def observers(self) -> dict[str, FrameMetric]:
        """All metrics by unique names, as the observers of a run."""
        return {f"{name} of {rig}": metric for name, metrics in self.by_rig.items() for rig, metric in metrics.items()}

    def update_from(self, observers: Mapping[str, Any]) -> "RunMetrics":
        """Return the metrics as a run left them, by the names of `observers`."""
        by_rig = {name: {rig: observers[f"{name} of {rig}"] for rig in rigs} for name, rigs in self.by_rig.items()}
        return RunMetrics(by_rig, self.left_out)


def build_metrics(task: Task[FrameSource], settings: Settings) -> RunMetrics:
    """Build the requested metrics for all rigs; those whose needs are not met are left out.

    Raises:
        ValueError: No metric can be built; the message says why.
    """
    sights = Sights()
    threshold_m = settings.thresholds_m[0] if settings.thresholds_m else 0.4
    missing, ego = _find_missing_needs(task), task.frames.ego_mesh()
    unmet = {name: PUBLISHED[name].needs & missing for name in settings.metrics}
    left_out = {name: REASONS[min(needs)] for name, needs in unmet.items() if needs}
    if len(left_out) == len(settings.metrics):
        raise ValueError("; ".join(f"metric {name}: {reason}" for name, reason in left_out.items()))
    by_rig: dict[str, dict[str, FrameMetric]] = {name: {} for name in settings.metrics if name not in left_out}
    for rig in task.rigs:
        setup = Setup(
            rig=rig,
            sensors=tuple(task.sensors.get(rig, ())),
            ego=ego,
            grid=task.query_plan.grid,
            regions=task.query_plan.regions,
            square_metres=task.frames.square_metres,
            threshold_m=threshold_m,
            sights=sights,
        )
        for name, metrics in by_rig.items():
            metrics[rig] = PUBLISHED[name].make(setup).to(settings.device)
    return RunMetrics(by_rig, left_out)


def _find_missing_needs(task: Task[FrameSource]) -> frozenset[Need]:
    available: dict[Need, bool] = {
        "sensors": all(task.sensors.get(rig) for rig in task.rigs),
        "boxes": task.frames.has_boxes(),
        "sensor_points": all(rig in task.frames.sensor_names for rig in task.rigs),
    }
    return frozenset(need for need, is_available in available.items() if not is_available)


def compare_metrics(
    metrics: RunMetrics, coverages: Mapping[str, Coverage], regions: Sequence[Region], seed: int
) -> MetricComparison:
    """Compare the metrics after a run with torchcover's numbers of the regions."""
    published: list[Ranking] = []
    for name, by_rig in metrics.by_rig.items():
        numbers = [metric.compute() for metric in by_rig.values()]
        estimates = [metric.estimate() for metric in by_rig.values()]
        published += rankings(name, numbers, estimates, seed)
    heights = next(iter(coverages.values())).grid.heights
    own: list[Ranking] = []
    for region in regions:
        for height in heights:
            own += _rank_by_coverage(list(coverages.values()), region, height, seed)
    return MetricComparison(tuple(coverages), published, own, metrics.left_out)


def _rank_by_coverage(coverages: Sequence[Coverage], region: Region, height: str, seed: int) -> list[Ranking]:
    numbers = []
    for coverage in coverages:
        (row,) = (row for row in coverage.summary([region]) if row.height == height)
        parameters = {"measure": row.measure, "cell_m": coverage.grid.cell}
        numbers.append([number._replace(parameters=parameters) for number in row.numbers.values()])
    estimates = [coverage.estimate(region, height) for coverage in coverages]
    ranked = rankings(OWN, numbers, estimates, seed)
    return [ranking._replace(name=f"{ranking.name} {region.name} {height}") for ranking in ranked]
