"""Omissions of a run."""

import sys

import pytest
import torch

from torchcover.coverage import AGGREGATIONS, BevGrid, CoverageMetric, Maximum
from torchcover.evaluation import list_omissions
from torchcover.simulation import CameraSensor


def test_outside_points_are_summed_over_rigs():
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 2.0), cell_m=1.0)
    metric = CoverageMetric(grid)
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0], [9.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    records = {row.description: row for row in list_omissions({}, [metric.compute()] * 2)}
    outside = records["reference points outside the grid: no search for sensor points"]
    assert (outside.count, outside.total) == (4, 6)
    others = ", ".join(aggregation.description for aggregation in AGGREGATIONS)
    assert f"{others}: not requested, not computed" in records


def test_requested_aggregations_are_no_omissions():
    metric = CoverageMetric(BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 2.0), cell_m=1.0), aggregations=[Maximum()])
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0]]))
    (listed,) = [
        row.description
        for row in list_omissions({}, [metric.compute()], [Maximum()])
        if "not computed" in row.description
    ]
    assert [kind.description in listed for kind in AGGREGATIONS] == [kind is not Maximum for kind in AGGREGATIONS]


@pytest.mark.parametrize("count", [0, 7])
def test_omissions_with_count_zero_are_not_listed(count):
    metric = CoverageMetric(BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 2.0), cell_m=1.0))
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0]]))
    counts = {"moving_bodies_out_of_range": count, "moving_bodies": 9}
    listed = [row.count for row in list_omissions(counts, [metric.compute()]) if row.total == 9]
    assert listed == ([7] if count else [])


@pytest.mark.parametrize(
    ("lens", "coefficients"), [("brown_conrady", (0.1, 0, 0, 0)), ("kannala_brandt", (0.1, 0, 0, 0))]
)
def test_lens_distortion_is_never_an_omission(lens, coefficients, monkeypatch):
    """Some lenses need no kornia, and frames may be made in another process."""
    monkeypatch.delitem(sys.modules, "kornia", raising=False)
    size = {"width": 8, "height": 6, "fx": 5, "fy": 5, "cx": 4, "cy": 3, "max_range_m": 50}
    pinhole = CameraSensor(name="a", **size)
    distorted = CameraSensor(name="b", lens=lens, coefficients=(0.1, 0.0, 0.0, 0.0), **size)

    def listed(*sensors, **options):
        return [
            row.description
            for row in list_omissions({}, [], (), sensors, **options)
            if "lenses with distortion" in row.description
        ]

    assert listed(pinhole) == ["kornia, for lenses with distortion: not imported"]
    assert listed(pinhole, distorted) == []
    assert listed(pinhole, num_workers=2) == []
