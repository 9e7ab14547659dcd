"""The sums of `CoverageMetric`, beyond what the contract of all metrics says (`tests/metrics`)."""

import copy

import pytest
import torch

from torchcover import BevGrid, CoverageMetric

ONE_CELL = BevGrid(x=(0.0, 1.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)})
STEP = (torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1, 3))


def test_sums_over_very_many_steps_do_not_drift():
    """Trap 8: in float32, 2**25 + 1 is 2**25, and from there on no step would count."""
    metric = CoverageMetric(ONE_CELL, (2.0,))
    metric.update(*STEP)
    many = {name: value if name == "fingerprint" else value * 2**25 for name, value in metric.state_dict().items()}
    metric.load_state_dict(many)
    metric.update([STEP[0]] * 3, [STEP[1]] * 3)
    for name in ("probed_steps", "points", "steps", "mean_sums"):
        assert metric.metric_state[name].amax().item() == 2**25 + 3, name


@pytest.mark.parametrize("cells", [10, 1000])
def test_the_state_is_a_few_numbers_for_each_cell(cells):
    metric = CoverageMetric(BevGrid(x=(0.0, cells), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)}))
    assert sum(value.numel() for value in metric.metric_state.values()) < 4 * cells + 50


def test_no_step_holds_on_to_its_graph():
    sensor, reference = (cloud.clone().requires_grad_() for cloud in STEP)
    metric = CoverageMetric(ONE_CELL)
    metric.update(sensor, reference)
    result = metric(sensor, reference)
    assert not any(value.requires_grad for value in metric.metric_state.values())
    assert not result.radius.requires_grad
    assert copy.deepcopy(metric).compute().counts["steps"] == 2
