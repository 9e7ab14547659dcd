"""Scores of several sensor placements by all metrics in the same frames, with bootstrap values over scenes."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchcover.contrib.comparison import MetricComparison
from torchcover.contrib.ranks import BASELINE, LEAST, OWN, Ranking, build_rankings
from torchcover.contrib.registry import PUBLISHED
from torchcover.coverage import Coverage, Region
from torchcover.estimation import Quantity
from torchcover.evaluation.evaluating import evaluate
from torchcover.evaluation.rig_names import AnyRig, load_rig
from torchcover.simulation import RegionsOfInterest, Scenario

DETECTION_THRESHOLD_M = 0.4


def build_circle_region(radius_m: float = 50.0) -> Region:
    """Build a circle around the vehicle as a polygon with one corner per degree.

    Args:
        radius_m: Radius in meters.
    """
    corners_m = []
    for degree in range(360):
        angle_rad = math.radians(degree)
        corners_m.append((radius_m * math.cos(angle_rad), radius_m * math.sin(angle_rad)))
    return Region.from_corners(f"{radius_m:g}m_around", corners_m)


@dataclass(frozen=True, eq=False)
class PlacementScores:
    """Scores of placements by several metrics.

    Args:
        rigs: Names of the placements.
        rankings: One ranking per number, with values in the order of `rigs`.
        num_frames: Number of frames.
        sensor_models: Sensor model of each placement, `ideal` or `real`.
    """

    rigs: tuple[str, ...]
    rankings: tuple[Ranking, ...]
    num_frames: int
    sensor_models: Mapping[str, str]

    def select(self, rigs: Sequence[str]) -> tuple[Ranking, ...]:
        """Select the rankings of some placements.

        Args:
            rigs: Names of placements in the desired order.
        """
        rig_indices = [self.rigs.index(rig) for rig in rigs]
        return tuple(ranking.select(rig_indices) for ranking in self.rankings)


def score_placements(
    rigs: Mapping[str, AnyRig],
    scenario: Scenario | str | Path = "urban",
    *,
    region: Region | None = None,
    metrics: Sequence[str] | None = None,
    num_frames: int = 64,
    seed: int = 0,
    sensor_model: Literal["ideal", "real"] | None = None,
    **settings: Any,  # noqa: ANN401  (settings of `evaluate`)
) -> PlacementScores:
    """Score placements by all metrics in the same frames.

    The numbers of torchcover are the detection rate at 0.4 m on the ground, on obstacles and the mean of both, over the
    visible surface and over the observed cells of 1 m.

    Args:
        rigs: Three or more rigs by name.
        scenario: Scenario.
        region: Region; by default a circle of 50 m around the vehicle.
        metrics: Names of published metrics in `torchcover.contrib.PUBLISHED`; by default all. The number of points is
            always included as a baseline.
        num_frames: Number of frames.
        seed: Seed of the traffic.
        sensor_model: Sensor model as in `evaluate`.
        settings: Further settings of `evaluate`: `frame_interval_s`, `workers`, `progress`.

    Raises:
        ValueError: There are fewer rigs, a metric does not exist, or as in `evaluate`.
        FileNotFoundError: A rig or the scenario does not exist.

    Example:
        >>> rigs = {name: f"place3d2024_{name}" for name in ("center", "line", "pyramid")}
        >>> scores = score_placements(rigs, "courtyard", metrics=["point_density"], num_frames=1)
        >>> [ranking.scores.tolist() for ranking in scores.rankings if ranking.metric == "baseline"][1:]
        [[2.5, 2.2, 2.35], [16000.0, 16000.0, 16000.0]]
    """
    if len(rigs) < LEAST:
        raise ValueError(f"rigs: three or more are needed to speak of ranks; got {', '.join(rigs) or 'none'}")
    named_rigs = {}
    for name, rig in rigs.items():
        named_rigs[name] = load_rig(rig).apply_sensor_model(sensor_model).model_copy(update={"name": name})
    region = build_circle_region() if region is None else region
    requested_metrics = PUBLISHED if metrics is None else metrics
    result = evaluate(
        list(named_rigs.values()),
        scenario,
        regions=_build_regions_of_interest(region),
        thresholds_m=DETECTION_THRESHOLD_M,
        metrics=tuple(dict.fromkeys([*requested_metrics, "point_density"])),
        num_frames=num_frames,
        seed=seed,
        **settings,
    )
    if result.run is not None:
        result.run.raise_failure()  # ranks of an incomplete run would look complete
    assert isinstance(result.metrics, MetricComparison)  # metrics were requested
    heights_m, ray_counts = [], []
    for rig in named_rigs.values():
        heights_m.append(round(sum(sensor.mount.z_m for sensor in rig.sensors) / len(rig.sensors), 6))
        ray_counts.append(float(sum(sensor.num_rays for sensor in rig.sensors)))
    height = Quantity("mean mounting height", "mean mounting height", "m", lower_is_better=False)
    num_rays = Quantity("rays", "rays", "rays", lower_is_better=False)
    return PlacementScores(
        rigs=tuple(rigs),
        rankings=(
            *_rank_by_coverage([result.coverages[rig] for rig in rigs], region, seed),
            *_select_published(result.metrics.rankings),
            Ranking.from_values(height, heights_m),
            Ranking.from_values(num_rays, ray_counts),
        ),
        num_frames=num_frames,
        sensor_models={name: rig.sensor_model for name, rig in named_rigs.items()},
    )


def _build_regions_of_interest(region: Region) -> RegionsOfInterest:
    """Build regions of interest with one region and the smallest grid that contains it."""
    bounds: dict[str, object] = {"x_m": region.x_m, "y_m": region.y_m}
    if region.corners_m:
        bounds = {"polygon_m": region.corners_m}
    grid = {
        "x_m": (math.floor(region.x_m[0]), math.ceil(region.x_m[1])),
        "y_m": (math.floor(region.y_m[0]), math.ceil(region.y_m[1])),
        "cell_m": 1.0,
    }
    return RegionsOfInterest.model_validate({"regions": {region.name: bounds}, "grid": grid})


def _rank_by_coverage(coverages: Sequence[Coverage], region: Region, seed: int) -> Iterator[Ranking]:
    """Rank by the detection rate over visible surface and observed cells, in each band and as mean of both bands."""
    for estimate, description in ((Coverage.estimate, "visible surface"), (Coverage.paper_mean, "observed cells")):
        name = f"detection {DETECTION_THRESHOLD_M:g} m, {{}}, {region.name}, {description}"
        band_rankings = []
        for band in coverages[0].grid.heights:
            estimates = [estimate(coverage, region, band)[1:] for coverage in coverages]
            numbers = [list(estimate.to_numbers().values()) for estimate in estimates]
            (ranking,) = build_rankings(OWN, numbers, estimates, seed)
            band_rankings.append(ranking._replace(name=name.format(band)))
        yield from band_rankings
        mean_scores = np.mean([ranking.scores for ranking in band_rankings], axis=0)
        samples = [ranking.samples for ranking in band_rankings if ranking.samples is not None]
        mean_samples = np.asarray(np.mean(samples, axis=0)) if len(samples) == len(band_rankings) else None
        mean_ranking = Ranking.from_values(band_rankings[0].quantity, mean_scores, OWN, mean_samples)
        yield mean_ranking._replace(name=name.format("both bands"))


def _select_published(rankings: Sequence[Ranking]) -> Iterator[Ranking]:
    """Select rankings by published metrics; the number of points is the baseline that any metric has to beat."""
    # Categories on which detectors are evaluated; numbers of other parts are excluded.
    categories = ("car", "pedestrian", "cyclist")
    for ranking in rankings:
        if ranking.is_part and ranking.name.split(":")[1] not in categories:
            continue
        name = f"{ranking.name} (less is better)" if ranking.quantity.lower_is_better else ranking.name
        yield ranking._replace(name=name, metric=BASELINE if ranking.name == "points" else ranking.metric)
