"""What objectives ask: which points and cells, which numbers of a result, and in which direction."""

import numpy as np
import pytest
import torch

from tests.placement.worlds import create_frames, lidar, rig
from torchcover.coverage import CoverageMetric, Maximum, Quantiles
from torchcover.coverage.number import estimate_number
from torchcover.estimation import Estimate
from torchcover.evaluation import CoverageObserver
from torchcover.placement import Objective
from torchcover.placement.queries import Queries
from torchcover.placement.search import compute_improvements

OUTLINE_M = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])
LANE = {"lane": {"x_m": [-7.3, -2.0], "y_m": [-1.2, 1.6]}}
TWO = rig(lidar(), lidar("low", mount={"x_m": 2.2, "z_m": 0.6}), name="two")


def test_kept_points_lie_in_regions_or_their_cells():
    near = Objective(region="20m", band="obstacle"), Objective(region="20m")
    asked = Queries.from_objectives(
        {"a": near[0], "b": Objective(region=LANE, threshold_m=0.1), "c": near[1]}, OUTLINE_M
    )
    assert asked.thresholds_m == (0.1, 0.4)
    assert asked.max_radius_m == 0.4
    # Cells of half a metre that the lane touches.
    assert asked.areas == (((0.0, 20.0), (-5.0, 5.0)), ((-7.5, -2.0), (-1.5, 2.0)))
    assert (asked.grid.x_m, asked.grid.y_m) == ((-7.5, 20.0), (-5.0, 5.0))
    generator = np.random.default_rng(0)
    points = generator.uniform([-50, -45, -1], [30, 45, 3], (40_000, 3)).astype(np.float32)
    # Bands are over the ground, which is 5 m below the vehicle there.
    height = torch.from_numpy(points[:, 2].copy())
    kept = asked.mask_points(torch.from_numpy(points - np.float32([0, 0, 5])), height).numpy()
    # The lane, and the cells whose centres lie in it.
    lane = [((-7.3, -2.0), (-1.2, 1.6), (-0.5, 2)), ((-7.5, -2.0), (-1.0, 1.5), (-0.5, 2))]
    boxes = [((0, 20), (-5, 5), (-0.5, 2)), *lane]
    inside = [
        np.logical_and.reduce([(p >= low) & (p < high) for p, (low, high) in zip(points.T, box, strict=True)])
        for box in boxes
    ]
    np.testing.assert_array_equal(kept, np.logical_or.reduce(inside))
    assert 10 < inside[2].sum() < inside[0].sum() < len(points) / 10


NUMBERS = {
    "detection_0.4m": Objective(region="20m", band="ground"),
    "radius_m": Objective(number="radius_m", region="20m", band="ground"),
    "detected_by_two_0.4m": Objective(number="detected_by_two_0.4m", region="20m", band="ground"),
    "detection_0.4m_without_top": Objective(number="detection_0.4m_without_top", region="20m", band="ground"),
    "detection_0.4m_without_any": Objective(number="detection_0.4m_without_any", region="20m", band="ground"),
    "radius_maximum_m": Objective(number="radius_maximum_m", region="20m", band="ground"),
    "radius_q0.9_m": Objective(number="radius_q0.9_m", region="20m", band="ground"),
    "radius_q0.5_m": Objective(number="radius_q0.5_m", region="20m", band="ground"),
    "radius_m_without_any": Objective(number="radius_m_without_any", region="20m", band="ground"),
}


@pytest.fixture(scope="module")
def several():
    return create_frames(objectives=NUMBERS)


def test_objective_is_any_number_with_its_direction(several):
    one, two = (several.score(each).estimate for each in (rig(), TWO))
    value = dict(zip(NUMBERS, two.value.tolist(), strict=True))
    region = several.queries.regions["20m"]
    metric = CoverageMetric(
        several.queries.grid,
        max_radius_m=several.queries.max_radius_m,
        num_blocks=16,
        aggregations=[Maximum(), Quantiles((0.5, 0.9))],
        regions=[region],
        sensor_names=["top", "low"],
        has_area_weights=True,
    )
    observer = CoverageObserver(metric)
    for frame in several.iterate_frames(TWO):
        observer.update(frame)
    (row,) = (row for row in observer.compute().summary() if row.band == "ground")
    assert value["radius_m"] == row.numbers["radius_m"].value
    for key in ("radius_maximum_m", "radius_q0.5_m", "radius_q0.9_m"):
        assert value[key] == row.numbers[key].value
    assert value["detected_by_two_0.4m"] == row.redundancy.detecting_sensors["detected_by_two_0.4m"].value
    without = {sensor: numbers["detection_0.4m"].value for sensor, numbers in row.redundancy.failure_numbers.items()}
    assert value["detection_0.4m_without_top"] == without["top"]
    assert value["detection_0.4m_without_any"] == min(without.values()) < row.numbers["detection_0.4m"].value
    assert value["radius_m_without_any"] == max(
        numbers["radius_m"].value for numbers in row.redundancy.failure_numbers.values()
    )
    # Of a rig that has no such sensor, none is lost; of one with a single sensor, all.
    assert dict(zip(NUMBERS, one.value.tolist(), strict=True))["detection_0.4m_without_any"] == 0
    low = several.score(rig(lidar("low"))).estimate.value.tolist()
    assert low[3] == low[0]
    # Fewer metres and more detection are both a gain of the second sensor.
    gain, error = compute_improvements(two, one)
    assert (gain > 0).all()
    assert (error[[0, 1]] > 0).all()


def test_failure_numbers_use_the_same_cells_as_evaluate(several):
    both = several, create_frames(objectives=NUMBERS, average="cells")
    by_area, by_cells = (dict(zip(NUMBERS, of.score(TWO).estimate.value.tolist(), strict=True)) for of in both)
    region = several.queries.regions["20m"]
    metric = CoverageMetric(
        several.queries.grid, max_radius_m=several.queries.max_radius_m, regions=[region], sensor_names=["top", "low"]
    )
    observer = CoverageObserver(metric)
    for frame in several.iterate_frames(TWO):
        observer.update(frame)
    for key in ("detection_0.4m", "radius_m", "detected_by_two_0.4m", "detection_0.4m_without_top"):
        assert by_cells[key] == float(estimate_number(observer.compute(), key, region, "ground").value)
        assert by_cells[key] != by_area[key]
    # An aggregation is over all points of the region, whatever the means are over.
    assert by_cells["radius_q0.9_m"] == by_area["radius_q0.9_m"]


def test_a_number_without_any_sensor_says_so(several):
    titles = dict(zip(NUMBERS, (one.title for one in several.score(TWO).estimate.quantities), strict=True))
    assert titles["detection_0.4m_without_any"] == "detection within 0.4 m, without any one sensor"
    assert titles["detection_0.4m_without_top"] == "detection within 0.4 m, without top"


def test_numbers_without_average_are_equal_for_both_averages():
    alone = {"cells": Objective(number="cells_radius_m", region="20m")}
    for asked in (NUMBERS, alone):
        by_area, by_cells = (
            create_frames(objectives=asked, average=one).score(TWO).estimate.value for one in ("area", "cells")
        )
        for objective, area, cells in zip(asked.values(), by_area, by_cells, strict=True):
            assert (area == cells) == (objective.fixed_average != ""), objective.key
    assert alone["cells"].fixed_average == "cells"


def test_second_sensor_loss_has_jackknife_values(several):
    estimate = several.score(TWO).estimate
    assert estimate.jackknife_values.shape == (3, len(NUMBERS))
    unknown = ~torch.isfinite(estimate.jackknife_values).all(dim=0)
    # Of a largest value no error is known.
    assert [key for key, one in zip(NUMBERS, unknown.tolist(), strict=True) if one] == ["radius_maximum_m"]


@pytest.mark.parametrize(
    ("given", "near"),
    [
        ("detektion_0.4m", "detection_0.4m"),
        ("radius", "radius_m"),
        ("detection_0.4m_without_roof", "detection_0.4m_without_top"),
        ("seen_by_too_0.4m", "detected_by_two_0.4m"),
        ("detection_0.40m", "detection_0.4m"),
        ("radius_maximal_m", "radius_maximum_m"),
        ("detection_0.4.1m", "detection_0.4m"),
        ("radius_q0.9.1_m", "radius_q0.9_m"),
    ],
)
def test_unknown_number_is_refused_with_a_suggestion(given, near):
    asked = Queries.from_objectives({"odd": Objective(number=given, region="20m")}, OUTLINE_M)
    with pytest.raises(ValueError, match=f"objective 'odd': results have no number '{given}'; did you mean '{near}'"):
        asked.check(TWO)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"number": "radius_m", "threshold_m": 0.4, "region": "20m"},
            "number, threshold_m: got 'radius_m' and 0.4; give one of the two",
        ),
        ({"number": "radius_m"}, "region: 'radius_m' needs one; add it$"),
    ],
)
def test_an_objective_that_makes_no_sense_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Objective(**given)


def test_worst_sensor_is_chosen_without_each_block():
    from torchcover.coverage.quantities import RADIUS, make_detection_quantity
    from torchcover.placement.queries import _select_worst

    value, left_out = torch.tensor([0.4]), torch.tensor([[0.3], [0.6]])
    other = torch.tensor([0.5]), torch.tensor([[0.5], [0.5]])
    for quantity, expected in ((make_detection_quantity(0.4), [0.4, 0.3, 0.5]), (RADIUS, [0.5, 0.5, 0.6])):
        each = [Estimate((quantity,), *one, torch.ones(2)) for one in ((value, left_out), other)]
        worst = _select_worst(each)
        assert [*worst.value.tolist(), *worst.jackknife_values[:, 0].tolist()] == pytest.approx(expected)
