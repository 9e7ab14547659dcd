"""What a run left out."""

import pytest
import torch

from torchcover.coverage import AGGREGATIONS, BevGrid, CoverageMetric, Maximum
from torchcover.evaluation import left_out


def test_points_outside_the_grid_are_counted_over_all_rigs():
    grid = BevGrid(x=(0.0, 2.0), y=(0.0, 2.0), cell=1.0)
    metric = CoverageMetric(grid)
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0], [9.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    records = {row.what: row for row in left_out({}, [metric.compute()] * 2)}
    outside = records["reference points outside every cell: not searched for"]
    assert (outside.count, outside.of) == (4, 6)
    others = ", ".join(aggregation.words for aggregation in AGGREGATIONS)
    assert f"{others}: not asked for, not kept" in records


def test_aggregations_that_were_asked_for_are_not_left_out():
    metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 2.0), cell=1.0), aggregations=[Maximum()])
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0]]))
    (listed,) = [row.what for row in left_out({}, [metric.compute()], [Maximum()]) if "not kept" in row.what]
    assert [kind.words in listed for kind in AGGREGATIONS] == [kind is not Maximum for kind in AGGREGATIONS]


@pytest.mark.parametrize("count", [0, 7])
def test_what_was_not_left_out_is_not_listed(count):
    metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 2.0), cell=1.0))
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0]]))
    counts = {"moving_bodies_out_of_range": count, "moving_bodies": 9}
    listed = [row.count for row in left_out(counts, [metric.compute()]) if row.of == 9]
    assert listed == ([7] if count else [])
