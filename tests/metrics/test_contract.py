"""What every metric of the package promises as a torchmetrics `Metric`, whatever it measures."""

import copy
import importlib
import itertools
import pickle
import pkgutil
from dataclasses import replace

import matplotlib.pyplot as plt
import pytest
import torch
from torchmetrics import Metric, MetricCollection
from torchmetrics.aggregation import SumMetric
from torchmetrics.wrappers import BootStrapper, MinMaxMetric

import torchcover.contrib
import torchcover.coverage
import torchcover.detection
from torchcover import BevGrid, CoverageMetric
from torchcover.contrib import FrameMetric, SceneRatios
from torchcover.coverage import CoverageSums
from torchcover.metrics import BlockedSums, MergeableMetric

from .cases import CASES, flat, in_lists
from .two_ranks import in_two_processes

EVERY = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
EVERY_CHANGE = pytest.mark.parametrize(
    ("case", "change"),
    [pytest.param(case, change, id=f"{name}: {change}") for name, case in CASES.items() for change in case.changes],
)


def states(metric: Metric):
    return {name: value.clone() for name, value in metric.metric_state.items()}


def assert_states(metric, expected):
    """Bit for bit."""
    found = metric.metric_state
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name].dtype == value.dtype, name
        assert torch.equal(found[name], value), name


def with_arrays(step):
    """The step, or the frame in it, with one tensor after the other as an array of NumPy: by its name."""
    if "frame" in step:
        frame = step["frame"]
        return {name: {"frame": replace(frame, **{name: getattr(frame, name).numpy()})} for name in ("reference",)}
    tensors = {name: value for name, value in step.items() if isinstance(value, torch.Tensor)}
    return {name: {**step, name: tensor.numpy()} for name, tensor in tensors.items()}


def assert_same(result, expected):
    """Equal up to the order in which numbers were added up."""
    found, expected = flat(result), flat(expected)
    assert found.keys() == expected.keys()
    for path, value in expected.items():
        if isinstance(value, torch.Tensor | float):
            torch.testing.assert_close(found[path], value, rtol=1e-12, atol=0, equal_nan=True, msg=path)
        else:
            assert found[path] == value, path


# Steps.


def test_every_metric_of_the_package_is_asked():
    for room in (torchcover.coverage, torchcover.detection, torchcover.contrib):
        for module in pkgutil.iter_modules(room.__path__, f"{room.__name__}."):
            importlib.import_module(module.name)
    bases = {MergeableMetric, BlockedSums, FrameMetric, SceneRatios, CoverageSums}
    kinds = {kind for base in bases for kind in base.__subclasses__()} - bases
    # Who needs a world is asked in its own room.
    rooms = ("torchcover.coverage.", "torchcover.detection.", "torchcover.contrib.")
    own = {kind for kind in kinds if kind.__module__.startswith(rooms)}
    asked = {kind for case in CASES.values() for kind in type(case.make()).__mro__}
    assert asked >= own


@EVERY
def test_metrics_without_frames_return_unknown_values(case):
    metric = case.make()
    with pytest.warns(UserWarning, match="was called before the ``update`` method"):
        metric.compute()
    assert metric.num_frames == 0
    assert not metric.update_called


@EVERY
def test_lists_are_the_same_as_one_by_one(case):
    at_once = case.make()
    at_once.update(**in_lists(case.frames))
    assert_states(at_once, case.whole[0])
    assert at_once.num_frames == len(case.frames)


@EVERY
def test_the_inputs_are_as_they_were(case):
    given = copy.deepcopy(case.frames[:2])
    case.over(given).compute()
    for step, before in zip(given, case.frames, strict=False):
        assert_same(step, before)


@EVERY
@pytest.mark.parametrize("in_a_list", [False, True])
def test_numpy_arrays_are_rejected_and_not_added(case, in_a_list):
    metric = case.over(case.frames[:1])
    before, step = states(metric), case.frames[1]
    given_as_arrays = with_arrays(step)
    assert given_as_arrays
    for name, given in given_as_arrays.items():
        with pytest.raises(TypeError, match=rf"^{name}.* got a NumPy array of float.*; torch.from_numpy\(array\)"):
            metric.update(**(in_lists([given]) if in_a_list else given))
    assert_states(metric, before)


@EVERY
def test_forward_gives_the_step_and_adds_it(case):
    metric = case.make()
    for step in case.frames[:3]:
        assert_same(metric(**step), case.over([step]).compute())
    for step in case.frames[3:]:
        metric(**step)
    assert_same(metric.compute(), case.whole[1])
    assert metric.num_frames == len(case.frames)


@EVERY
def test_compute_changes_nothing_and_sees_later_steps(case):
    metric = case.over(case.frames[:4])
    before = states(metric)
    first = metric.compute()
    kept = copy.deepcopy(first)
    assert_states(metric, before)
    metric.update(**case.frames[4])
    assert_same(metric.compute(), case.after(*range(5)))
    assert_same(first, kept)


@EVERY
def test_reset_forgets_every_step(case):
    metric = case.over(case.frames[:4])
    metric.compute()
    metric.reset()
    assert_states(metric, states(case.make()))
    metric.update(**case.frames[5])
    assert_same(metric.compute(), case.over(case.frames[5:6]).compute())
    assert_states(case.make(), states(case.over([])))


@EVERY
def test_plot_gives_figure_and_axes_and_changes_nothing(case):
    metric = case.over(case.frames[:3])
    before, other = states(metric), case.over(case.frames[3:6]).compute()
    try:
        figure, axes = metric.plot()
        assert (axes.figure, axes) == metric.plot(metric.compute(), axes) == (figure, axes)
        wide, (left, right) = plt.subplots(1, 2)
        assert metric.plot(other, right) == (wide, right)
        assert (left.has_data(), right.has_data()) == (False, True)
        assert MetricCollection({"one": metric}).plot(ax=[left]) == [(wide, left)]
        with pytest.raises(TypeError, match=r"^val: "):
            metric.plot([other])
    finally:
        plt.close("all")
    assert_states(metric, before)


# What the state is.


BEFORE = {
    "nothing": lambda case, metric: None,
    "reset": lambda case, metric: metric.reset(),
    "forward": lambda case, metric: (metric(**case.frames[0]), metric.reset()),
    "move": lambda case, metric: metric.to("cpu"),
    "load": lambda case, metric: metric.load_state_dict(case.make().state_dict()),
    "merge": lambda case, metric: metric.merge_state(case.make()),
    "compute": lambda case, metric: (metric.update(**case.frames[0]), metric.compute(), metric.reset()),
}


@EVERY
@pytest.mark.parametrize("before", BEFORE.values(), ids=list(BEFORE))
def test_frames_are_added_under_and_after_inference_mode(case, before):
    metric = case.make()
    with torch.inference_mode():
        before(case, metric)
        metric.update(**case.frames[0])
        metric(**case.frames[1])
    metric.update(**case.frames[-1])
    assert_same(metric.compute(), case.after(0, 1, -1))


@EVERY
def test_metrics_made_under_inference_mode_still_update(case):
    with torch.inference_mode():
        metric = case.over(case.frames[:1])
    metric.update(**case.frames[1])
    metric.merge_state(case.over(case.frames[-1:]))
    assert_same(metric.compute(), case.after(0, 1, -1))


@EVERY
def test_what_the_sums_start_from_takes_no_memory(case):
    """It is one number; torchmetrics would keep as many as there are sums."""
    metric = case.over(case.frames[:2])
    for name in metric._defaults.keys() - {"fingerprint"}:
        start = metric._defaults[name]
        assert start.untyped_storage().nbytes() <= start.element_size(), name
        assert getattr(metric, name).is_contiguous(), name


@EVERY
def test_states_except_tables_have_fixed_size(case):
    metric = case.make()

    def sizes():
        state = metric.metric_state
        return {name: state[name].untyped_storage().nbytes() for name in state.keys() - set(metric._tables)}

    before = sizes()
    metric.update(**in_lists(case.frames))
    assert sizes() == before


@EVERY
def test_sums_are_float64_and_counts_are_int64(case):
    assert {value.dtype for value in case.over(case.frames[:1]).metric_state.values()} <= {torch.float64, torch.int64}


CASTS = {
    "half": lambda m: m.half(),
    "float": lambda m: m.float(),
    "double": lambda m: m.double(),
    "to half": lambda m: m.to(torch.float16),
    "to bfloat16": lambda m: m.to(torch.bfloat16),
    "set_dtype": lambda m: m.set_dtype(torch.float16),
    "child half": lambda m: torch.nn.ModuleList([m]).half()[0],
    "child to": lambda m: torch.nn.ModuleList([m]).to(torch.float16)[0],
    "child bfloat16": lambda m: torch.nn.ModuleList([m]).bfloat16()[0],
}


@EVERY
def test_a_cast_leaves_the_sums_alone(case):
    metric = case.over(case.frames[:1])
    before = states(metric)
    for cast in CASTS.values():
        assert cast(metric) is metric
        assert_states(metric, before)
    metric.update(**case.frames[1])
    metric.reset()
    assert_states(metric, states(case.make()))


@EVERY
def test_a_move_takes_every_state_along(case):
    metric = case.over(case.frames[:1])
    metric.compute()
    types = {name: value.dtype for name, value in metric.metric_state.items()}
    assert metric.to("cpu").to("meta") is metric
    assert metric.device == torch.device("meta")
    metric.reset()
    assert {value.device.type for value in metric.metric_state.values()} == {"meta"}
    assert {name: value.dtype for name, value in metric.metric_state.items()} == types


# Copies and files.


@pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)), lambda m: m.clone()],
    ids=["deepcopy", "pickle", "clone"],
)
@EVERY
def test_a_copy_goes_its_own_way(case, copied):
    metric = case.over(case.frames[:1])
    other = copied(metric)
    before = states(metric)
    other.update(**case.frames[1])
    assert_states(metric, before)
    assert_same(other.compute(), case.after(0, 1))
    assert_same(metric.compute(), case.after(0))
    metric.merge_state(other)


@pytest.mark.parametrize("inside", [False, True], ids=["alone", "in a module"])
@EVERY
def test_a_state_dict_goes_round_without_aliases(case, inside):
    def wrap(metric):
        return torch.nn.ModuleDict({"metric": metric}) if inside else metric

    metric, other = case.over(case.frames[:1]), case.over(case.frames[5:7])
    metric.persistent(True)
    other.compute()
    saved = wrap(metric).state_dict()
    kept = copy.deepcopy(saved)
    wrap(other).load_state_dict(saved)
    assert_same(other.compute(), metric.compute())
    before = states(metric)
    other.update(**case.frames[1])
    assert_states(metric, before)
    assert all(torch.equal(saved[name], kept[name]) for name in kept)
    assert_same(other.compute(), case.after(0, 1))


@EVERY
def test_loaded_metrics_compute_without_a_warning(case):
    fresh, saved = case.make(), case.over(case.frames[:3])
    saved.persistent(True)
    fresh.load_state_dict(saved.state_dict())
    assert fresh.update_called
    assert_same(fresh.compute(), case.after(0, 1, 2))


@EVERY
def test_rounded_states_keep_float64_sums(case):
    metric = case.make()
    metric.persistent(True)
    types = {name: value.dtype for name, value in metric.metric_state.items()}
    short = {name: v.float() if v.is_floating_point() else v for name, v in metric.state_dict().items()}
    metric.load_state_dict(short)
    assert {name: value.dtype for name, value in metric.metric_state.items()} == types


@EVERY
def test_states_are_in_state_dicts_on_request(case):
    """As in torchmetrics: a checkpoint of a model loads into one with another metric, or with none."""
    metric = case.over(case.frames[:1])
    assert not metric.state_dict()
    before = states(metric)
    metric.load_state_dict({})
    assert_states(metric, before)
    metric.persistent(True)
    assert set(metric.state_dict()) == set(metric.metric_state)
    other = case.make(**next(iter(case.changes.values())))
    model, saved = torch.nn.ModuleDict({"metric": other}), torch.nn.ModuleDict({"metric": metric}).state_dict()
    before = states(other)
    assert len(model.load_state_dict(saved, strict=False).unexpected_keys) == len(saved)
    assert_states(other, before)
    with pytest.raises(RuntimeError, match="the state belongs to another metric"):
        model.load_state_dict(saved)


# Merging.


@pytest.mark.parametrize("cut", [0, 1])
@EVERY
def test_merged_parts_equal_the_whole_in_any_order(case, cut):
    parts = case.over(case.frames[:cut]), case.over(case.frames[cut:])
    whole, result = case.whole
    for last_first, as_dict in itertools.product([False, True], repeat=2):
        first, second = copy.deepcopy(parts[::-1] if last_first else parts)
        if first.update_called:
            first.compute()  # outdated by the merge
        before = states(second)
        first.merge_state(second.metric_state if as_dict else second)
        assert first.num_frames == len(case.frames)
        assert_same(states(first), whole)
        assert_same(first.compute(), result)
        first.update(**case.frames[-1])
        assert_states(second, before)


@EVERY
def test_nothing_and_nothing_is_nothing(case):
    nothing = case.make()
    nothing.merge_state(case.make())
    with pytest.warns(UserWarning, match="before the ``update``"):
        nothing.compute()


@EVERY
def test_merging_is_associative(case):
    def parts():
        return [case.over(case.frames[k::3]) for k in range(3)]

    a, b, c = parts()
    a.merge_state(b)
    a.merge_state(c)
    d, e, f = parts()
    e.merge_state(f)
    d.merge_state(e)
    assert_same(states(a), states(d))


@EVERY
def test_merging_a_metric_with_itself_doubles_it(case):
    metric = case.over(case.frames[:5])
    metric.merge_state(metric)
    assert_same(states(metric), states(case.over([*case.frames[:5], *case.frames[:5]])))


# What is refused.


@EVERY_CHANGE
def test_sums_of_other_parameters_are_not_merged(case, change):
    metric, other = case.over(case.frames[:1]), case.over(case.frames[:1], **case.changes[change])
    parameter = change.replace(",", " ").split()[0]
    before = states(metric)
    with pytest.raises(ValueError, match=f"cannot merge metrics with different {parameter}: "):
        metric.merge_state(other)
    with pytest.raises(ValueError, match=rf"the state belongs to another .* with other .*\b{parameter}\b"):
        metric.merge_state(other.metric_state)
    other.persistent(True)
    with pytest.raises(RuntimeError, match=rf"the state belongs to another .* with other .*\b{parameter}\b"):
        metric.load_state_dict(other.state_dict())
    assert_states(metric, before)


@pytest.fixture(scope="module")
def of_every_case():
    return [case.over(case.frames[:1]) for case in CASES.values()]


@EVERY
def test_other_classes_are_not_merged(case, of_every_case):
    metric = case.over(case.frames[:1])
    before = states(metric)
    for other in (SumMetric(), *(other for other in of_every_case if type(other) is not type(metric))):
        with pytest.raises(ValueError, match=f"cannot merge a {type(other).__name__} into a {type(metric).__name__}"):
            metric.merge_state(other)
        with pytest.raises(ValueError, match="belongs to another metric"):
            metric.merge_state(other.metric_state)
    for other in (3, None, [metric]):
        with pytest.raises(
            ValueError, match=f"a {type(metric).__name__} or its metric_state is needed; got {type(other).__name__}"
        ):
            metric.merge_state(other)
    assert_states(metric, before)


@EVERY
def test_states_with_gaps_or_other_shapes_raise(case):
    metric, other = case.over(case.frames[:2]), case.over(case.frames[2:4])
    before = states(metric)
    for name, value in other.metric_state.items():
        lacks = {key: state for key, state in states(other).items() if key != name}
        wrong = {**states(other), name: value[None]}
        for broken in (lacks, wrong):
            with pytest.raises(ValueError, match=f"'{name}'|belongs to another metric"):
                metric.merge_state(broken)
            with pytest.raises(RuntimeError, match=f"'{name}'|belongs to another metric"):
                metric.load_state_dict(broken)
    assert_states(metric, before)


@pytest.mark.parametrize("name", ["fingerprint", "num_frames"])
@pytest.mark.parametrize("kind", ["number", "meta", "sparse", "expanded"])
def test_stored_states_that_are_no_dense_tensors_raise(name, kind):
    metric = CoverageMetric(BevGrid(x_m=(-8.0, 8.0), y_m=(-8.0, 8.0), cell_m=8.0))
    state = metric.metric_state[name]
    values = {
        "number": 5,
        "meta": torch.empty(state.shape, device="meta"),
        "sparse": state.reshape(1, -1).to_sparse(),
        "expanded": torch.zeros(1).expand(2**45),  # 4 bytes in a file, 2**48 bytes as int64
    }
    with pytest.raises(ValueError, match=r"belongs to another metric|is needed; got"):
        metric.merge_state({**metric.metric_state, name: values[kind]})


@EVERY
def test_resampling_points_instead_of_frames_is_refused(case):
    for wrapped in (case.make(), MinMaxMetric(case.make())):
        with pytest.raises(TypeError, match="BootStrapper resamples the points of each frame, not the frames"):
            BootStrapper(wrapped, num_bootstraps=2)
    BootStrapper(SumMetric(), num_bootstraps=2)


# Collections.


@EVERY
def test_collections_keep_initially_equal_metrics_apart(case):
    """torchmetrics lets metrics share one state if theirs are equal after the first step (its issue 2596)."""
    wanted = {"one": {}, "the same": {}, **case.changes}
    collection = MetricCollection({name: case.make(**changes) for name, changes in wanted.items()})
    steps = [case.bland, case.frames[0]]
    for step in steps:
        collection.update(**step)
    results = collection.compute()
    for name, changes in wanted.items():
        assert_same(results[name], case.over(steps, **changes).compute())


@EVERY
def test_a_collection_resets_and_runs_forward(case):
    collection = MetricCollection({"this": case.make()}, prefix="val/")
    assert_same(collection(**case.frames[0])["val/this"], case.after(0))
    collection.reset()
    collection.update(**case.frames[1])
    assert_same(collection.compute()["val/this"], case.over(case.frames[1:2]).compute())


# Two processes.


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What each of two processes found, which are started once for all cases."""
    return in_two_processes(tmp_path_factory.mktemp("ranks"))


@pytest.mark.parametrize("name", CASES)
def test_two_processes_equal_one(answers, name):
    case = CASES[name]
    more = flat(case.over([*case.frames, case.frames[0], case.frames[0]]).compute())
    for answer in (of_rank[name] for of_rank in answers):
        assert_same(answer["whole"], flat(case.whole[1]))
        assert answer["unchanged"], "the sums of all ranks stayed in the state of one"
        assert_same(answer["more"], more)
        assert_same(answer["alone"], flat(case.after(*range(5))))


@EVERY_CHANGE
def test_ranks_with_other_parameters_all_raise(answers, case, change):
    name = next(name for name, other in CASES.items() if other is case)
    for answer in answers:
        assert "has other parameters on rank 1 than on rank 0" in (answer[name]["complaints"][change] or "no complaint")
