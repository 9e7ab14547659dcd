"""`CoverageMetric` as a torchmetrics `Metric`: state, copies, merging, devices, ranks."""

import copy
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchmetrics import MetricCollection
from torchmetrics.aggregation import SumMetric

from torchcover import BevGrid, CoverageMetric
from torchcover.coverage import Coverage

SHAPE = {"x": (-2.0, 2.0), "y": (-1.0, 1.0), "cell": 0.5, "heights": {"all": (-2.0, 2.0)}}
GRID = BevGrid(**SHAPE)
OPTIONS = {"thresholds": (0.4, 0.8), "max_radius": 3.0, "maximum": True, "pooled": True, "quantiles": (0.5,)}
MAPS = ("probed_steps", "points", "radius", "detection", "maximum", "pooled", "quantiles")


def make_step(seed, points=60):
    generator = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(count, 3, generator=generator) for count in (points // 3, points))


def metric_over(steps, **options):
    metric = CoverageMetric(GRID, **{**OPTIONS, **options})
    for step in steps:
        metric.update(*step)
    return metric


def snapshot(metric):
    return {name: value.clone() for name, value in metric.metric_state.items()}


def assert_state(metric, expected):
    """Bit for bit."""
    assert metric.metric_state.keys() == expected.keys()
    for name, value in metric.metric_state.items():
        assert torch.equal(value, expected[name]), name


def assert_same(one, other):
    assert one.grid == other.grid
    assert one.counts == other.counts
    for name in MAPS:
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-12, atol=0, equal_nan=True)


def test_before_any_step_everything_is_unknown():
    metric = CoverageMetric(GRID, **OPTIONS)
    with pytest.warns(UserWarning, match="was called before the ``update`` method"):
        result = metric.compute()
    for name in ("radius", "detection", "maximum", "pooled", "quantiles"):
        assert getattr(result, name).isnan().all()
    assert not result.probed_steps.any()
    assert set(result.counts.values()) == {0}


def test_reset_forgets_every_step():
    metric = metric_over([make_step(0), make_step(1)])
    metric.compute()
    metric.reset()
    assert_state(metric, snapshot(CoverageMetric(GRID, **OPTIONS)))
    metric.update(*make_step(2))
    assert_same(metric.compute(), metric_over([make_step(2)]).compute())
    assert_state(CoverageMetric(GRID, **OPTIONS), snapshot(metric_over([])))


def test_compute_changes_nothing_and_sees_later_steps():
    metric = metric_over([make_step(0)])
    before = snapshot(metric)
    first = metric.compute()
    kept = first.radius.clone()
    assert_state(metric, before)
    metric.update(*make_step(1))
    assert_same(metric.compute(), metric_over([make_step(0), make_step(1)]).compute())
    assert torch.equal(first.radius.nan_to_num(-1), kept.nan_to_num(-1))
    assert int(first.probed_steps.sum()) == int(before["probed_steps"].sum())


def test_the_inputs_are_bit_equal_afterwards():
    step = make_step(0)
    before = [cloud.clone() for cloud in step]
    metric_over([step]).compute()
    assert all(torch.equal(a, b) for a, b in zip(step, before, strict=True))


# Memory and types


def test_the_state_has_a_fixed_size():
    metric = CoverageMetric(GRID, **OPTIONS)

    def sizes():
        return {name: value.untyped_storage().nbytes() for name, value in metric.metric_state.items()}

    def tensors():
        return sorted(name for name, value in vars(metric).items() if isinstance(value, torch.Tensor))

    before = sizes(), tensors()
    for seed in range(20):
        metric.update(*make_step(seed, points=30 * (seed + 1)))
    assert (sizes(), tensors()) == before
    assert sum(before[0].values()) < 110 * GRID.cells * 8


def test_sums_are_float64_and_counts_are_int64():
    for name, value in metric_over([make_step(0)]).metric_state.items():
        is_sum = name.endswith("_sum") or name in ("radius_max", "histogram")
        assert value.dtype == (torch.float64 if is_sum else torch.int64), name


def test_sums_over_very_many_steps_do_not_drift():
    """Trap 8: in float32, 2**25 + 1 is 2**25, and from there on no step would count."""
    grid = BevGrid(x=(0.0, 1.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)})
    metric = CoverageMetric(grid, (2.0,), pooled=True, quantiles=(0.5,))
    step = torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1, 3)
    metric.update(*step)
    after_many = {
        name: value if name == "fingerprint" else value * 2**25 for name, value in metric.state_dict().items()
    }
    metric.load_state_dict(after_many)
    for _ in range(3):
        metric.update(*step)
    for name in ("probed_steps", "points", "radius_sum", "detection_sum", "pooled_sum", "steps"):
        assert metric.metric_state[name].sum().item() == 2**25 + 3, name
    assert metric.histogram.sum().item() == 2**25 + 3


@pytest.mark.parametrize(
    "cast",
    [
        lambda m: m.half(),
        lambda m: m.float(),
        lambda m: m.double(),
        lambda m: m.to(torch.float16),
        lambda m: m.to(torch.bfloat16),
        lambda m: m.set_dtype(torch.float16),
        lambda m: torch.nn.ModuleList([m]).half()[0],
        lambda m: torch.nn.ModuleList([m]).to(torch.float16)[0],
        lambda m: torch.nn.ModuleList([m]).bfloat16()[0],
    ],
    ids=["half", "float", "double", "to half", "to bfloat16", "set_dtype", "child half", "child to", "child bfloat16"],
)
def test_a_cast_leaves_the_sums_alone(cast):
    metric = metric_over([make_step(0)])
    before = snapshot(metric)
    assert cast(metric) is metric
    assert_state(metric, before)
    metric.update(*make_step(1))
    metric.reset()
    assert_state(metric, snapshot(CoverageMetric(GRID, **OPTIONS)))


def test_a_move_takes_every_state_and_its_default_along():
    metric = metric_over([make_step(0)])
    metric.compute()
    assert metric.to("meta") is metric
    assert metric.device == torch.device("meta")
    for state in (metric.metric_state, metric._defaults):
        assert {value.device.type for value in state.values()} == {"meta"}
    assert {name: v.dtype for name, v in metric.metric_state.items()} == {
        name: v.dtype for name, v in CoverageMetric(GRID, **OPTIONS).metric_state.items()
    }


def test_a_move_to_the_device_it_is_on_changes_nothing():
    metric = metric_over([make_step(0)])
    before = snapshot(metric)
    assert_state(metric.to("cpu"), before)
    assert_same(metric.compute(), metric_over([make_step(0)]).compute())


# Copies and files


@pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)), lambda m: m.clone()],
    ids=["deepcopy", "pickle", "clone"],
)
def test_a_copy_goes_its_own_way(copied):
    metric = metric_over([make_step(0)])
    other = copied(metric)
    before = snapshot(metric)
    other.update(*make_step(1))
    assert_state(metric, before)
    assert_same(other.compute(), metric_over([make_step(0), make_step(1)]).compute())
    assert_same(metric.compute(), metric_over([make_step(0)]).compute())


@pytest.mark.parametrize("inside", [False, True], ids=["alone", "in a module"])
def test_a_state_dict_goes_round_without_aliases(inside):
    def wrap(metric):
        return torch.nn.ModuleDict({"coverage": metric}) if inside else metric

    metric, other = metric_over([make_step(0)]), metric_over([make_step(5)])
    other.compute()
    saved = wrap(metric).state_dict()
    kept = copy.deepcopy(saved)
    wrap(other).load_state_dict(saved)
    assert_same(other.compute(), metric.compute())
    before = snapshot(metric)
    other.update(*make_step(1))
    assert_state(metric, before)
    assert all(torch.equal(saved[name], kept[name]) for name in kept)
    assert_same(other.compute(), metric_over([make_step(0), make_step(1)]).compute())


def test_a_fresh_metric_that_loads_steps_computes_without_a_warning():
    fresh = CoverageMetric(GRID, **OPTIONS)
    fresh.load_state_dict(metric_over([make_step(0)]).state_dict())
    assert fresh.update_called
    assert fresh.compute().counts["steps"] == 1


def test_a_state_rounded_on_the_way_does_not_make_the_sums_short():
    short = {name: v.float() if v.is_floating_point() else v for name, v in metric_over([]).state_dict().items()}
    metric = CoverageMetric(GRID, **OPTIONS)
    metric.load_state_dict(short)
    assert metric.radius_sum.dtype == torch.float64


def test_the_state_can_be_left_out_of_the_state_dict():
    metric = CoverageMetric(GRID)
    assert set(metric.state_dict()) == set(metric.metric_state)
    metric.persistent(False)
    assert not metric.state_dict()


@pytest.mark.parametrize(
    "other",
    [
        CoverageMetric(GRID, **{**OPTIONS, "thresholds": (0.4, 0.7)}),
        CoverageMetric(GRID, **{**OPTIONS, "max_radius": 4.0}),
        CoverageMetric(BevGrid(**{**SHAPE, "x": (-1.0, 3.0)}), **OPTIONS),
    ],
    ids=["thresholds", "max_radius", "grid"],
)
def test_a_state_about_something_else_is_not_loaded_or_merged(other):
    metric = metric_over([make_step(0)])
    before = snapshot(metric)
    with pytest.raises(ValueError, match="the state was made with another grid, thresholds, max_radius or options"):
        metric.load_state_dict(other.state_dict())
    with pytest.raises(ValueError, match="the state was made with another grid"):
        metric.merge_state(other.metric_state)
    assert_state(metric, before)


def test_a_state_of_another_shape_is_not_loaded():
    metric = CoverageMetric(GRID, (0.4,))
    with pytest.raises(ValueError, match=r"'detection_sum' has shape \(1, 2, 32\); this metric's .* need \(1, 1, 32\)"):
        metric.load_state_dict(CoverageMetric(GRID, (0.4, 0.8)).state_dict())


# Merging


@settings(max_examples=10, deadline=None)
@given(seeds=st.lists(st.integers(0, 1000), max_size=5), cut=st.integers(0, 5), last=st.booleans())
def test_merged_parts_are_the_whole_in_any_order(seeds, cut, last):
    steps = [make_step(seed) for seed in seeds]
    parts = [metric_over(steps[:cut]), metric_over(steps[cut:])]
    first, second = parts[::-1] if last else parts
    first.merge_state(second)
    whole = metric_over(steps)
    assert first.steps == len(steps)
    for name, value in whole.metric_state.items():
        torch.testing.assert_close(first.metric_state[name], value, rtol=1e-12, atol=0)
    if steps:
        assert_same(first.compute(), whole.compute())


def test_merging_is_associative():
    def parts():
        return [metric_over([make_step(seed)]) for seed in range(3)]

    a, b, c = parts()
    a.merge_state(b)
    a.merge_state(c)
    d, e, f = parts()
    e.merge_state(f)
    d.merge_state(e)
    assert_same(a.compute(), d.compute())


@pytest.mark.parametrize("as_dict", [False, True], ids=["metric", "state"])
def test_merging_leaves_the_other_alone(as_dict):
    one, other = metric_over([make_step(0)]), metric_over([make_step(1)])
    before = snapshot(other)
    one.merge_state(other.metric_state if as_dict else other)
    one.update(*make_step(2))
    assert_state(other, before)
    assert_same(other.compute(), metric_over([make_step(1)]).compute())
    assert one.compute().counts["steps"] == 3


def test_merging_outdates_what_was_computed_before():
    """torchmetrics would answer with the result from before the merge."""
    one = metric_over([make_step(0)])
    one.compute()
    one.merge_state(metric_over([make_step(1)]))
    assert_same(one.compute(), metric_over([make_step(0), make_step(1)]).compute())


def test_merging_into_an_empty_metric():
    empty = CoverageMetric(GRID, **OPTIONS)
    empty.merge_state(metric_over([make_step(0)]))
    assert_same(empty.compute(), metric_over([make_step(0)]).compute())
    nothing = CoverageMetric(GRID, **OPTIONS)
    nothing.merge_state(CoverageMetric(GRID, **OPTIONS))
    with pytest.warns(UserWarning, match="before the ``update``"):
        nothing.compute()


SWAPPED = {"b": (0.0, 2.0), "a": (-2.0, 0.0)}


@pytest.mark.parametrize(
    ("mine", "other", "name"),
    [
        ({}, {"thresholds": (0.4, 0.7)}, "thresholds"),
        ({}, {"thresholds": (0.8, 0.4)}, "thresholds"),
        ({}, {"max_radius": 4.0}, "max_radius"),
        ({}, {"maximum": False}, "maximum"),
        ({"pooled": False}, {}, "pooled"),
        ({}, {"quantiles": (0.9,)}, "quantiles"),
        ({}, {"grid": BevGrid(**{**SHAPE, "x": (-1.0, 3.0)})}, "grid"),
        (
            {"grid": BevGrid(**{**SHAPE, "heights": dict(reversed(SWAPPED.items()))})},
            {"grid": BevGrid(**{**SHAPE, "heights": SWAPPED})},
            "grid",
        ),
    ],
)
def test_metrics_about_different_things_are_not_merged(mine, other, name):
    one, two = (CoverageMetric(**{"grid": GRID, **OPTIONS, **options}) for options in (mine, other))
    before = snapshot(one)
    with pytest.raises(ValueError, match=f"cannot merge metrics with different {name}: "):
        one.merge_state(two)
    assert_state(one, before)


@pytest.mark.parametrize("other", [3, None, SumMetric()])
def test_only_coverage_metrics_are_merged(other):
    with pytest.raises(ValueError, match="Expected incoming state to be"):
        CoverageMetric(GRID).merge_state(other)


# The step value, and collections


def test_forward_gives_the_step_and_adds_it():
    metric = CoverageMetric(GRID, **OPTIONS)
    for seed in range(3):
        assert_same(metric(*make_step(seed)), metric_over([make_step(seed)]).compute())
    assert_same(metric.compute(), metric_over([make_step(seed) for seed in range(3)]).compute())


def test_no_step_holds_on_to_its_graph():
    sensor, reference = (cloud.requires_grad_() for cloud in make_step(0))
    metric = CoverageMetric(GRID, **OPTIONS)
    metric.update(sensor, reference)
    result = metric(sensor, reference)
    assert not any(value.requires_grad for value in metric.metric_state.values())
    assert not result.radius.requires_grad
    assert_same(copy.deepcopy(metric).compute(), metric_over([make_step(0)] * 2).compute())


def test_a_collection_keeps_metrics_apart_that_agree_at_first():
    """torchmetrics lets metrics share one state if theirs are equal after the first step (its issue 2596)."""
    collection = MetricCollection(
        {
            "tight": CoverageMetric(GRID, (0.5,)),
            "tight too": CoverageMetric(GRID, (0.5,)),
            "loose": CoverageMetric(GRID, (5.0,)),
            "saturated": CoverageMetric(GRID, (0.5,), max_radius=2.0),
        }
    )
    near, far = torch.zeros(1, 3), torch.tensor([[0.0, 0.9, 0.0], [1.9, 0.9, 1.9]])
    collection.update(sensor=near, reference=near)
    collection.update(sensor=near, reference=far)
    results = collection.compute()
    for name, metric in {"tight": (0.5,), "tight too": (0.5,), "loose": (5.0,)}.items():
        alone = CoverageMetric(GRID, metric)
        alone.update([near, near], [near, far])
        torch.testing.assert_close(results[name].detection, alone.compute().detection, equal_nan=True)
    assert results["saturated"].radius.nan_to_num().max() == 2.0
    assert results["loose"].radius.nan_to_num().max() > 2.0


def test_a_collection_resets_and_runs_forward():
    collection = MetricCollection({"coverage": CoverageMetric(GRID, **OPTIONS)}, prefix="val/")
    assert_same(collection(*make_step(0))["val/coverage"], metric_over([make_step(0)]).compute())
    collection.reset()
    collection.update(*make_step(1))
    assert_same(collection.compute()["val/coverage"], metric_over([make_step(1)]).compute())


# Two processes


def test_two_processes_add_up(tmp_path):
    steps = [make_step(seed) for seed in range(3)]
    extra = make_step(9)
    torch.save({"grid": SHAPE, "options": OPTIONS, "steps": steps, "extra": extra}, tmp_path / "steps.pt")
    environment = {**os.environ, "GLOO_SOCKET_IFNAME": "lo0" if sys.platform == "darwin" else "lo"}
    environment.update(OMP_NUM_THREADS="1", PYTHONPATH=os.pathsep.join(p for p in sys.path if p))
    ranks = [
        subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("one_rank.py")), str(rank), str(tmp_path)],
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        errors = [process.communicate(timeout=100)[1] for process in ranks]
    finally:
        for process in ranks:
            process.kill()
    assert [process.returncode for process in ranks] == [0, 0], errors
    for rank in range(2):
        assert_same(Coverage.load(tmp_path / f"{rank}.npz"), metric_over(steps).compute())
        assert_same(Coverage.load(tmp_path / f"{rank}_extra.npz"), metric_over([*steps, extra, extra]).compute())


def test_the_reduction_over_ranks_is_declared_for_every_state():
    """What two ranks gather: sums add up, the maximum is the larger one, the fingerprint stays."""
    one, two = metric_over([make_step(0)]), metric_over([make_step(1)])
    metric = metric_over([make_step(0)])
    gathered = {id(value): name for name, value in metric.metric_state.items()}
    metric.dist_sync_fn = lambda state, group=None: [
        one.metric_state[gathered[id(state)]],
        two.metric_state[gathered[id(state)]],
    ]
    metric.distributed_available_fn = lambda: True
    assert_same(metric.compute(), metric_over([make_step(0), make_step(1)]).compute())
    assert metric.steps == 1
    assert math.isfinite(np.nanmax(metric.compute().maximum.numpy()))
