"""The metrics of others by the names that `--set metrics=NAME` takes: their needs, and how a run builds them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from torchcover.contrib.comparison import MetricComparison
from torchcover.contrib.frame_metric import FrameMetric, FrameQueryCache
from torchcover.contrib.ranks import OWN, Ranking, build_rankings
from torchcover.contrib.ratio_metrics import KCover, ObjectCoverage, PerceptionEntropy, PointDensity
from torchcover.contrib.ray_metrics import FalseVisible, MSog, build_coarse_grid
from torchcover.contrib.s_mig import SMig
from torchcover.coverage import BevGrid, Coverage, Region, forward_regions
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import Task
from torchcover.frames import FrameSource
from torchcover.simulation import Sensor
from torchcover.simulation.shapes import Mesh

# boxes: `Frame.boxes`. sensors: the rig's sensors, with mounts and rays. sensor_points: which points are of which
# sensor.
Need: TypeAlias = Literal["boxes", "sensors", "sensor_point_counts"]

GRID = BevGrid(x_m=(-40.0, 160.0), y_m=(-40.0, 40.0))
# Of smaller cells most are empty whatever the rig.
UNIFORMITY_CELL_M = 1.0


@dataclass(frozen=True)
class MetricSetup:
    """What metrics of one rig are made from.

    Args:
        rig_name: Its name in `Frame.clouds`; the only one if not given.
        sensors: Its sensors; empty if they are unknown.
        ego_mesh: The body that carries it, in the vehicle frame; None if it is unknown.
        grid: Cells and height bands of the run.
        regions: Those that numbers are given for.
        has_area_weights: Whether frames have the square metres of their reference points.
        threshold_m: Distance within which a point counts as seen.
        query_cache: What metrics of the same run share, so that each frame is searched once.
    """

    rig_name: str | None = None
    sensors: Sequence[Sensor] = ()
    ego_mesh: Mesh | None = None
    grid: BevGrid = GRID
    regions: Sequence[Region] = field(default_factory=forward_regions)
    has_area_weights: bool = True
    threshold_m: float = 0.4
    query_cache: FrameQueryCache = field(default_factory=FrameQueryCache)

    @property
    def common_arguments(self) -> dict[str, Any]:
        """The arguments that metrics of what frames show have in common."""
        return {"rig_name": self.rig_name, "query_cache": self.query_cache}


@dataclass(frozen=True)
class PublishedMetric:
    """A metric by its name in `--set metrics=NAME`.

    Args:
        build: Makes it.
        needs: What it cannot do without.
        description: What it says, in a line.
    """

    build: Callable[[MetricSetup], FrameMetric]
    needs: frozenset[Need]
    description: str


def _point_density(setup: MetricSetup) -> PointDensity:
    # A region that is smaller than a cell of 1 m needs the cells of the run.
    coarse = build_coarse_grid(setup.grid, UNIFORMITY_CELL_M)
    fits = all(region.mask_cells(coarse).any() for region in setup.regions)
    return PointDensity(coarse if fits else setup.grid, setup.regions, **setup.common_arguments)


PUBLISHED: Mapping[str, PublishedMetric] = {
    "object_coverage": PublishedMetric(
        lambda setup: ObjectCoverage(setup.threshold_m, **setup.common_arguments),
        frozenset({"boxes"}),
        "share of an object within the threshold; objects with 1, 5, 10 points",
    ),
    "perception_entropy": PublishedMetric(
        lambda setup: PerceptionEntropy(setup.sensors, **setup.common_arguments),
        frozenset({"boxes"}),
        "nats of a detector's error, from points on objects (Ma 2021)",
    ),
    "k_cover": PublishedMetric(
        lambda setup: KCover(
            setup.grid,
            setup.regions,
            setup.threshold_m,
            has_area_weights=setup.has_area_weights,
            **setup.common_arguments,
        ),
        frozenset({"sensor_point_counts"}),
        "share of the surface seen by 1, 2, 3 sensors",
    ),
    "point_density": PublishedMetric(_point_density, frozenset(), "points, for each square metre, and how evenly"),
    "false_visible": PublishedMetric(
        lambda setup: FalseVisible(
            setup.sensors, setup.ego_mesh, setup.grid, setup.threshold_m, **setup.common_arguments
        ),
        frozenset({"sensors"}),
        "blind cells that the field of view promised (Börger 2022)",
    ),
    "s_mig": PublishedMetric(
        lambda setup: SMig(setup.sensors, **setup.common_arguments),
        frozenset({"boxes", "sensors"}),
        "minus the entropy of objects along the rays, in nats (Hu 2022)",
    ),
    "s_mig_occluded": PublishedMetric(
        lambda setup: SMig(setup.sensors, ends_at_hits=True, **setup.common_arguments),
        frozenset({"boxes", "sensors", "sensor_point_counts"}),
        "the same, up to what the rays hit",
    ),
    "m_sog": PublishedMetric(
        lambda setup: MSog(setup.sensors, **setup.common_arguments),
        frozenset({"boxes", "sensors"}),
        "minus the mean entropy of labels along the rays (Place3D 2024)",
    ),
}


def parse_metric_names(names_or_text: str | Iterable[str]) -> tuple[str, ...]:
    """The metrics that a user asks for; "all" is all of them.

    Raises:
        ValueError: No such metric.
    """
    names = (
        [name.strip() for name in names_or_text.split(",")] if isinstance(names_or_text, str) else list(names_or_text)
    )
    if names == ["all"]:
        return tuple(PUBLISHED)
    for name in names:
        if name not in PUBLISHED:
            raise ValueError(f"metrics: all, or some of {', '.join(PUBLISHED)}, separated by commas; got {name!r}")
    return tuple(dict.fromkeys(names))


REASONS: Mapping[Need, str] = {
    "boxes": "it needs boxes of objects, which simulations and labelled recordings have",
    "sensors": "it needs the rig's sensors, with mounts and rays: give the rig's YAML file or a built-in name",
    "sensor_point_counts": "which points are of which sensor is unknown",
}


class RunMetrics(NamedTuple):
    """The metrics of a run.

    Args:
        by_rig: Name of a metric -> name of a rig -> the metric.
        omissions: Name of a metric that cannot be built -> the reason.
    """

    by_rig: Mapping[str, Mapping[str, FrameMetric]]
    omissions: Mapping[str, str]

    @property
    def observers(self) -> dict[str, FrameMetric]:
        """All metrics by unique names, as the observers of a run."""
        return {f"{name} of {rig}": metric for name, metrics in self.by_rig.items() for rig, metric in metrics.items()}

    def update_from(self, observers: Mapping[str, Any]) -> "RunMetrics":
        """Return the metrics as a run left them, by the names of `observers`."""
        by_rig = {name: {rig: observers[f"{name} of {rig}"] for rig in rigs} for name, rigs in self.by_rig.items()}
        return RunMetrics(by_rig, self.omissions)


def build_metrics(task: Task[FrameSource], settings: Settings) -> RunMetrics:
    """Build the requested metrics for all rigs; those whose needs are not met are left out.

    Raises:
        ValueError: No metric can be built; the message says why.
    """
    sights = FrameQueryCache()
    threshold_m = settings.thresholds_m[0] if settings.thresholds_m else 0.4
    missing, ego = _find_missing_needs(task), task.frames.get_ego_mesh()
    unmet = {name: PUBLISHED[name].needs & missing for name in settings.metrics}
    left_out = {name: REASONS[min(needs)] for name, needs in unmet.items() if needs}
    if len(left_out) == len(settings.metrics):
        raise ValueError("; ".join(f"metric {name}: {reason}" for name, reason in left_out.items()))
    by_rig: dict[str, dict[str, FrameMetric]] = {name: {} for name in settings.metrics if name not in left_out}
    for rig in task.rigs:
        setup = MetricSetup(
            rig_name=rig,
            sensors=tuple(task.sensors.get(rig, ())),
            ego_mesh=ego,
            grid=task.query_plan.grid,
            regions=task.query_plan.regions,
            has_area_weights=task.frames.has_area_weights,
            threshold_m=threshold_m,
            query_cache=sights,
        )
        for name, metrics in by_rig.items():
            metrics[rig] = PUBLISHED[name].build(setup).to(settings.device)
    return RunMetrics(by_rig, left_out)


def _find_missing_needs(task: Task[FrameSource]) -> frozenset[Need]:
    available: dict[Need, bool] = {
        "sensors": all(task.sensors.get(rig) for rig in task.rigs),
        "boxes": task.frames.has_boxes(),
        "sensor_point_counts": all(rig in task.frames.sensor_names for rig in task.rigs),
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
        published += build_rankings(name, numbers, estimates, seed)
    heights = next(iter(coverages.values())).grid.heights
    own: list[Ranking] = []
    for region in regions:
        for height in heights:
            own += _rank_by_coverage(list(coverages.values()), region, height, seed)
    return MetricComparison(tuple(coverages), published, own, metrics.omissions)


def _rank_by_coverage(coverages: Sequence[Coverage], region: Region, height: str, seed: int) -> list[Ranking]:
    numbers = []
    for coverage in coverages:
        (row,) = (row for row in coverage.summary([region]) if row.band == height)
        parameters = {"measure": row.average, "cell_m": coverage.grid.cell_m}
        numbers.append([number._replace(parameters=parameters) for number in row.numbers.values()])
    estimates = [coverage.estimate(region, height) for coverage in coverages]
    ranked = build_rankings(OWN, numbers, estimates, seed)
    return [ranking._replace(name=f"{ranking.name} {region.name} {height}") for ranking in ranked]
