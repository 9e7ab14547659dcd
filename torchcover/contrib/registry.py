"""Registry of the published metrics: names for `--set metrics=NAME`, required data and construction."""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias

from torchcover.contrib.comparison import MetricComparison
from torchcover.contrib.frame_metric import FrameMetric
from torchcover.contrib.frame_queries import FrameQueryCache
from torchcover.contrib.ranks import OWN, Ranking, build_rankings
from torchcover.contrib.ratio_metrics import KCover, ObjectCoverage, PerceptionEntropy, PointDensity
from torchcover.contrib.ray_metrics import FalseVisible, MSog, build_coarse_grid
from torchcover.contrib.s_mig import SMig
from torchcover.coverage import BevGrid, Coverage, Region, forward_regions
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import Task
from torchcover.frames import FrameDataset, FrameMetadata
from torchcover.simulation import Sensor
from torchcover.simulation.shapes import Mesh

# boxes: `Frame.boxes`; sensors: the sensors of the rig with mounts and rays; sensor_point_counts: number of points of
# each sensor.
Need: TypeAlias = Literal["boxes", "sensors", "sensor_point_counts"]

GRID = BevGrid(x_m=(-40.0, 160.0), y_m=(-40.0, 40.0))
# Most of the smaller cells are empty for every rig, which hides differences in uniformity.
UNIFORMITY_CELL_M = 1.0


@dataclass(frozen=True)
class MetricSetup:
    """Inputs from which the metrics of one rig are built.

    Args:
        rig_name: Name of the rig in `Frame.clouds`; may be None if there is only one.
        sensors: Sensors of the rig; empty if unknown.
        ego_mesh: Mesh of the ego vehicle in the vehicle frame; None if unknown.
        grid: Cells and band bands of the run.
        regions: Regions with separate numbers.
        has_area_weights: True if frames have area weights of their reference points.
        threshold_m: Detection threshold.
        query_cache: Cache that the metrics of a run share, so that each frame is searched once.
    """

    rig_name: str | None = None
    sensors: Sequence[Sensor] = ()
    ego_mesh: Mesh | None = None
    grid: BevGrid = GRID
    regions: Sequence[Region] = field(default_factory=forward_regions)
    has_area_weights: bool = True
    threshold_m: float = 0.4
    query_cache: FrameQueryCache = field(default_factory=FrameQueryCache)


@dataclass(frozen=True)
class PublishedMetric:
    """Entry of the registry.

    Args:
        create: Class of the metric, or function that creates it.
        arguments: Fields of `MetricSetup` that it takes, besides `rig_name` and `query_cache`.
        needs: Data that the metric requires.
        description: Description of its numbers in one line.
    """

    create: Callable[..., FrameMetric]
    arguments: tuple[str, ...]
    needs: Set[Need]
    description: str

    def build(self, setup: MetricSetup) -> FrameMetric:
        """Build the metric of one rig.

        Args:
            setup: Inputs of the metrics.
        """
        names = (*self.arguments, "rig_name", "query_cache")
        return self.create(**{name: getattr(setup, name) for name in names})


def _create_point_density(
    grid: BevGrid,
    regions: Sequence[Region],
    **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
) -> PointDensity:
    """Create the metric on cells of 1 m, or on the cells of the run for smaller regions."""
    # Regions smaller than a cell of 1 m need the cells of the run.
    coarse = build_coarse_grid(grid, UNIFORMITY_CELL_M)
    covers_regions = all(region.mask_cells(coarse).any() for region in regions)
    return PointDensity(coarse if covers_regions else grid, regions, **kwargs)


PUBLISHED: Mapping[str, PublishedMetric] = {
    "object_coverage": PublishedMetric(
        ObjectCoverage,
        ("threshold_m",),
        {"boxes"},
        "share of an object within the threshold; objects with 1, 5, 10 points",
    ),
    "perception_entropy": PublishedMetric(
        PerceptionEntropy, ("sensors",), {"boxes"}, "nats of a detector's error, from points on objects (Ma 2021)"
    ),
    "k_cover": PublishedMetric(
        KCover,
        ("grid", "regions", "threshold_m", "has_area_weights"),
        {"sensor_point_counts"},
        "share of the surface detected by 1, 2, 3 sensors",
    ),
    "point_density": PublishedMetric(
        _create_point_density, ("grid", "regions"), set(), "points, points per square meter, and their uniformity"
    ),
    "false_visible": PublishedMetric(
        FalseVisible,
        ("sensors", "ego_mesh", "grid", "threshold_m"),
        {"sensors"},
        "blind cells within the field of view (Börger 2022)",
    ),
    "s_mig": PublishedMetric(
        SMig, ("sensors",), {"boxes", "sensors"}, "minus the entropy of objects along the rays, in nats (Hu 2022)"
    ),
    "s_mig_occluded": PublishedMetric(
        partial(SMig, ends_at_hits=True),
        ("sensors",),
        {"boxes", "sensors", "sensor_point_counts"},
        "s_mig with rays that end at their hits",
    ),
    "m_sog": PublishedMetric(
        MSog, ("sensors",), {"boxes", "sensors"}, "minus the mean entropy of labels along the rays (Place3D 2024)"
    ),
}


def parse_metric_names(names_or_text: str | Iterable[str]) -> tuple[str, ...]:
    """Parse the names of requested metrics.

    Args:
        names_or_text: Names, or text with names separated by commas; "all" selects all metrics.

    Returns:
        Names without repetitions.

    Raises:
        ValueError: An unknown metric.
    """
    names = []
    for name in names_or_text.split(",") if isinstance(names_or_text, str) else names_or_text:
        names.append(name.strip() if isinstance(names_or_text, str) else name)
    if names == ["all"]:
        return tuple(PUBLISHED)
    for name in names:
        if name not in PUBLISHED:
            raise ValueError(f"metrics: all, or some of {', '.join(PUBLISHED)}, separated by commas; got {name!r}")
    return tuple(dict.fromkeys(names))


REASONS: Mapping[Need, str] = {
    "boxes": "it needs boxes of objects, which simulations and labeled recordings have",
    "sensors": "it needs the rig's sensors, with mounts and rays: give the rig's YAML file or a built-in name",
    "sensor_point_counts": "the sensor of each point is unknown",
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
        """Metrics of all rigs by unique names, as the observers of a run."""
        observers = {}
        for name, metrics in self.by_rig.items():
            for rig, metric in metrics.items():
                observers[f"{name} of {rig}"] = metric
        return observers

    def update_from(self, observers: Mapping[str, Any]) -> "RunMetrics":
        """Return the metrics in the state after a run.

        Args:
            observers: Metrics after the run, under the names of `observers`.

        Returns:
            The metrics by rig.
        """
        by_rig: dict[str, dict[str, FrameMetric]] = {}
        for name, rigs in self.by_rig.items():
            by_rig[name] = {rig: observers[f"{name} of {rig}"] for rig in rigs}
        return RunMetrics(by_rig, self.omissions)


def build_metrics(task: Task[FrameDataset], settings: Settings) -> RunMetrics:
    """Build the requested metrics for all rigs; those whose needs are not met are omitted.

    Args:
        task: Frames and rigs of the run.
        settings: Settings with the names of the metrics and the thresholds.

    Returns:
        The metrics and the omissions.

    Raises:
        ValueError: No metric can be built; the message says why.
    """
    query_cache = FrameQueryCache()
    threshold_m = settings.thresholds_m[0] if settings.thresholds_m else 0.4
    missing, ego_mesh = _find_missing_needs(task.metadata), task.metadata.ego_mesh
    omissions: dict[str, str] = {}
    by_rig: dict[str, dict[str, FrameMetric]] = {}
    for name in settings.metrics:
        unmet = PUBLISHED[name].needs & missing
        if unmet:
            omissions[name] = REASONS[min(unmet)]
        else:
            by_rig[name] = {}
    if not by_rig:
        raise ValueError("; ".join(f"metric {name}: {reason}" for name, reason in omissions.items()))
    for rig in task.metadata.rigs:
        setup = MetricSetup(
            rig_name=rig,
            sensors=tuple(task.metadata.sensors.get(rig, ())),
            ego_mesh=ego_mesh,
            grid=task.query_plan.grid,
            regions=task.query_plan.regions,
            has_area_weights=task.metadata.has_area_weights,
            threshold_m=threshold_m,
            query_cache=query_cache,
        )
        for name, metrics in by_rig.items():
            metrics[rig] = PUBLISHED[name].build(setup).to(settings.device)
    return RunMetrics(by_rig, omissions)


def _find_missing_needs(metadata: FrameMetadata) -> frozenset[Need]:
    """Find the data that a source of frames does not provide for all of its rigs."""
    missing: set[Need] = set() if metadata.has_boxes else {"boxes"}
    for rig in metadata.rigs:
        if not metadata.sensors.get(rig):
            missing.add("sensors")
        if rig not in metadata.sensor_names:
            missing.add("sensor_point_counts")
    return frozenset(missing)


def compare_metrics(
    metrics: RunMetrics, coverages: Mapping[str, Coverage], regions: Sequence[Region], seed: int
) -> MetricComparison:
    """Compare the metrics after a run with the coverage numbers of the regions.

    Args:
        metrics: Metrics after the run.
        coverages: Coverage of each rig.
        regions: Regions of the coverage numbers.
        seed: Seed of the bootstrap.

    Returns:
        Rankings of all numbers.
    """
    published: list[Ranking] = []
    for name, by_rig in metrics.by_rig.items():
        numbers = [metric.compute() for metric in by_rig.values()]
        estimates = [metric.estimate() for metric in by_rig.values()]
        published += build_rankings(name, numbers, estimates, seed)
    heights = next(iter(coverages.values())).grid.heights
    coverage_rankings: list[Ranking] = []
    for region in regions:
        for band in heights:
            coverage_rankings += _rank_by_coverage(list(coverages.values()), region, band, seed)
    return MetricComparison(tuple(coverages), published, coverage_rankings, metrics.omissions)


def _rank_by_coverage(coverages: Sequence[Coverage], region: Region, band: str, seed: int) -> list[Ranking]:
    """Rank rigs by the coverage numbers of a region and band."""
    numbers, estimates = [], []
    for coverage in coverages:
        (row,) = (row for row in coverage.summary([region]) if row.band == band)
        parameters = {"measure": row.average, "cell_m": coverage.grid.cell_m}
        # The row also has the numbers of other aggregations, which the estimate does not resample.
        numbers.append([row.numbers[name.key]._replace(parameters=parameters) for name in coverage.quantities])
        estimates.append(coverage.estimate(region, band))
    ranked = build_rankings(OWN, numbers, estimates, seed)
    return [ranking._replace(name=f"{ranking.name} {region.name} {band}") for ranking in ranked]
