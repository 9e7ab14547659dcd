"""Placement scores equal the numbers of `evaluate`."""

import numpy as np
import pytest

from torchcover import Coverage, Region, evaluate
from torchcover.contrib import score_placements
from torchcover.contrib.placement_scores import build_circle_region
from torchcover.data import RegionsOfInterest

RIGS = {name: f"place3d2024_{name}" for name in ("center", "line", "pyramid")}


def test_coverage_scores_equal_those_of_evaluate():
    region = Region("front", (0.0, 20.0), (-10.0, 10.0))
    scores = score_placements(RIGS, "courtyard", region=region, metrics=[], num_frames=8, seed=3)
    request = {
        "regions": {"front": {"x_m": (0, 20), "y_m": (-10, 10)}},
        "grid": {"x_m": (0, 20), "y_m": (-10, 10), "cell_m": 1.0},
    }
    result = evaluate(
        list(RIGS.values()), "courtyard", regions=RegionsOfInterest.model_validate(request), num_frames=8, seed=3
    )
    actual = {one.name: one for one in scores.rankings}
    for estimate, words in ((Coverage.estimate, "visible surface"), (Coverage.paper_mean, "observed cells")):
        each = [
            [float(estimate(coverage, region, band).value[1]) for coverage in result.coverages.values()]
            for band in ("ground", "obstacle")
        ]
        for name, expected in zip(("ground", "obstacle", "both bands"), (*each, np.mean(each, axis=0)), strict=True):
            one = actual[f"detection 0.4 m, {name}, front, {words}"]
            np.testing.assert_array_equal(one.scores, expected)  # no ambiguous names
            # Bootstrap values lie around the number of all scenes.
            assert one.samples.shape[1] == 3
            np.testing.assert_allclose(
                one.samples.mean(axis=0), expected, atol=4 * one.samples.std(axis=0).max() + 1e-3
            )


def test_the_region_is_a_circle():
    area_m2 = sum(
        x * next_y - y * next_x
        for (x, y), (next_x, next_y) in zip(
            build_circle_region().corners_m,
            (*build_circle_region().corners_m[1:], build_circle_region().corners_m[0]),
            strict=True,
        )
    )
    assert area_m2 / 2 == pytest.approx(np.pi * 50**2, rel=1e-3)


def test_two_placements_and_unknown_metrics_are_refused():
    with pytest.raises(ValueError, match="three or more"):
        score_placements({"a": "kitti", "b": "waymo"})
    with pytest.raises(ValueError, match="s_mag"):
        score_placements(RIGS, metrics=["s_mag"])


def test_metrics_can_be_combined_with_aggregations():
    """Aggregated numbers have no bootstrap values, and no ranking."""
    settings = {"metrics": "point_density", "aggregations": "maximum", "num_frames": 8, "num_rays": 2000}
    comparison = evaluate(list(RIGS.values()), "courtyard", **settings).metrics
    names = [ranking.name for ranking in comparison.coverage_rankings]
    assert "detection_0.4m 20m ground" in names
    assert not any("maximum" in name for name in names)
    assert all(ranking.samples is not None for ranking in comparison.coverage_rankings)
