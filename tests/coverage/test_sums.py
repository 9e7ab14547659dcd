"""Sums of `CoverageMetric`, in addition to the contract of all metrics in `tests/metrics`."""

import copy

import pytest
import torch

from torchcover import BevGrid, CoverageMetric
from torchcover.coverage import Maximum, PooledMean
from torchcover.metrics import sum_rows
from torchcover.metrics.blocked_sums import merge_tables

ONE_CELL = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
STEP = (torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1, 3))


def test_sums_over_very_many_steps_do_not_drift():
    """In float32, 2**25 + 1 is 2**25, so that no further frame would count."""
    metric = CoverageMetric(ONE_CELL, (2.0,))
    metric.update(*STEP)
    metric.persistent(True)
    many = {name: value if name == "fingerprint" else value * 2**25 for name, value in metric.state_dict().items()}
    metric.load_state_dict(many)
    metric.update([STEP[0]] * 3, [STEP[1]] * 3)
    assert metric.cell_sums.tolist() == [[0.0, 2**25 + 3, 2**25 + 3, 2**25 + 3, 2**25 + 3]]


def clouds(seed: int, points: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(20, 3, generator=generator), torch.rand(points, 3, generator=generator)


@pytest.mark.parametrize("cell", [0.1, 0.001])
def test_state_size_depends_on_touched_cells_only(cell):
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=cell, heights={"all": (-1.0, 1.0)})
    metric = CoverageMetric(grid, num_blocks=8)
    for at in range(16):
        metric.update(*clouds(at), block_index=at)
    assert len(metric.cell_sums) <= min(8 * grid.num_cells, 16 * 300)
    assert sum(value.numel() for value in metric.metric_state.values()) < 5 * len(metric.cell_sums) + 250


def test_time_of_summation_changes_no_bit():
    """Reading the state adds pending rows: after every frame, or once."""
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=0.1, heights={"all": (-1.0, 1.0)})
    every = [CoverageMetric(grid, num_blocks=8, aggregations=[Maximum(), PooledMean()]) for _ in range(3)]
    for at in range(40):
        for number, metric in enumerate(every):
            metric.update(*clouds(at, points=60), block_index=at)
            if number == 1 or (number == 2 and at % 7 == 0):
                assert (metric.cell_sums[:, 0].diff() > 0).all()
    for metric in every[1:]:
        assert all(torch.equal(value, metric.metric_state[name]) for name, value in every[0].metric_state.items())


@pytest.mark.parametrize(
    "spoil", [lambda key: key + 0.5, lambda key: key.flip(0), lambda key: key - 1.0, lambda key: key * 1e6]
)
def test_a_table_whose_keys_are_none_is_refused(spoil):
    metric = CoverageMetric(BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=0.1, heights={"all": (-1.0, 1.0)}))
    metric.update(*clouds(0))
    metric.persistent(True)
    state = metric.state_dict()
    state["cell_sums"][:, 0] = spoil(state["cell_sums"][:, 0])
    with pytest.raises(RuntimeError, match="state 'cell_sums': keys in ascending order, whole numbers below 100"):
        metric.load_state_dict(state)


def test_no_step_holds_on_to_its_graph():
    sensor, reference = (cloud.clone().requires_grad_() for cloud in STEP)
    metric = CoverageMetric(ONE_CELL)
    metric.update(sensor, reference)
    result = metric(sensor, reference)
    assert not any(value.requires_grad for value in metric.metric_state.values())
    assert not result.radius.requires_grad
    assert copy.deepcopy(metric).compute().counts["num_frames"] == 2


@pytest.mark.parametrize("maxima", [0, 2])
@pytest.mark.parametrize("sizes", [(40, 60), (60, 1), (0, 9), (9, 0), (1, 1)])
def test_merged_tables_equal_sums_of_their_rows(sizes, maxima):
    generator = torch.Generator().manual_seed(3)
    keys = [torch.randint(0, 90, (size, 1), generator=generator) for size in sizes]
    values = [torch.randn(size, 4, generator=generator) for size in sizes]
    one, other = (sum_rows(torch.cat(each, dim=1).double(), maxima) for each in zip(keys, values, strict=True))
    given = one.clone(), other.clone()
    assert torch.equal(merge_tables(one, other, maxima), sum_rows(torch.cat([one, other]), maxima))
    assert torch.equal(one, given[0])
    assert torch.equal(other, given[1])
