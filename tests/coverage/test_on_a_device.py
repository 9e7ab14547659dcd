"""Sums of a metric on another device, without mixed devices and copies to the host; by default on an emulated GPU."""

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

from torchcover import BevGrid, Camera, CoverageMetric, blind_spot_radius, nearest
from torchcover.coverage import FrameQuantiles, Maximum, PooledMean, Quantiles, Region
from torchcover.detection import (
    Boxes,
    RecallByVisibility,
    compute_bev_iou,
    find_points_in_boxes,
    measure_box_visibility,
)
from torchcover.frames import Frame, rotate
from torchcover.neighbors import backend_choice

GPU, MPS = torch.device("cuda", 0), torch.device("mps", 0)
# Functions that accept tensors on two devices.
MOVES = ("to", "cpu", "numpy", "tolist", "copy_")


class OnGpu(torch.Tensor):
    """CPU tensor that pretends to be on a GPU."""

    device = GPU
    __torch_function__ = torch._C._disabled_torch_function_impl


class OnMps(OnGpu):
    """CPU tensor that pretends to be on an Apple GPU."""

    device = MPS


def is_device(leaf):
    return isinstance(leaf, torch.device) or (isinstance(leaf, str) and leaf in map(str, (GPU, MPS)))


def goal_of(name, args, kwargs):
    """Return the requested device, if any."""
    given = [kwargs.get("device"), *(args[1:] if name == "to" else ()), "cpu" if name == "cpu" else None]
    devices = [one.device if isinstance(one, torch.Tensor) else one for one in given]
    return next((torch.device(one) for one in devices if isinstance(one, torch.device | str)), None)


class PretendedGpu(TorchFunctionMode):
    """Mode that rejects operations that a GPU rejects or that copy silently, and lists copies to the host by size."""

    def __init__(self, device=GPU):
        super().__init__()
        self.device, self.to_host = device, []

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs, name = kwargs or {}, function.__name__
        if function is torch.device:
            return function(*args, **kwargs)
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        there = any(isinstance(tensor, OnGpu) for tensor in tensors)
        goal = goal_of(name, args, kwargs)
        if there and name not in MOVES:
            here = [tuple(tensor.shape) for tensor in tensors if not isinstance(tensor, OnGpu) and tensor.dim()]
            assert not here, f"{name}: one on the GPU, and on the CPU {here}"
        elif isinstance(tensors[0] if tensors else None, OnGpu) and (name != "to" or (goal and goal != self.device)):
            self.to_host.append((name, tensors[0].numel()))
        args, kwargs = tree_map(
            lambda leaf: torch.device("cpu") if is_device(leaf) else leaf, (args, dict(kwargs)), is_leaf=is_device
        )
        on_gpu = goal == self.device if goal else there
        kind = (OnMps if self.device == MPS else OnGpu) if on_gpu else torch.Tensor
        made = function(*args, **kwargs)
        if kind is OnMps and any(getattr(leaf, "dtype", None) == torch.float64 for leaf in tree_leaves(made)):
            raise TypeError("Cannot convert a MPS Tensor to float64 dtype")
        return tree_map(lambda leaf: leaf.as_subclass(kind) if isinstance(leaf, torch.Tensor) else leaf, made)


def on_gpu(*clouds):
    return [cloud.as_subclass(OnGpu) for cloud in clouds]


def as_values(tensor):
    return tensor.as_subclass(torch.Tensor).numpy()


def each_step():
    random = torch.Generator().manual_seed(0)
    for _ in range(10):
        sensor, reference = (torch.rand(count, 3, generator=random) * 22 - 1 for count in (60, 500))
        yield sensor, reference, torch.rand(500, generator=random) + 0.1


def test_the_sums_stay_on_the_device():
    grid = BevGrid(x_m=(0.0, 20.0), y_m=(0.0, 20.0), cell_m=1.0, heights={"low": (0.0, 4.0), "high": (4.0, 20.0)})
    every = (Maximum(), PooledMean(), Quantiles((0.5, 0.9)), FrameQuantiles((0.9,)))
    # 8 blocks for 10 frames, so that some blocks are merged.
    options = {"max_radius_m": 30.0, "num_blocks": 8, "aggregations": every, "has_area_weights": True}
    here, there = (CoverageMetric(grid, (0.4, 1.0), backend="cdist", **options) for _ in range(2))
    for sensor, reference, weights in each_step():
        here.update(sensor, reference, weights=weights)
    with PretendedGpu() as gpu:
        for name in there._defaults:
            setattr(there, name, getattr(there, name).as_subclass(OnGpu))
        for clouds in each_step():
            sensor, reference, weights = on_gpu(*clouds)
            there.update(sensor, reference, weights=weights)
        result = there.compute()
        assert gpu.to_host == []
        assert all(isinstance(layer.values, OnGpu) for layer in result.layers.values())
        scalars = result.scalars([Region("front", (0.0, 20.0), (5.0, 15.0))])
    expected = here.compute()
    for key, layer in expected.layers.items():
        np.testing.assert_array_equal(as_values(result.layers[key].values), layer.values.numpy())
    assert scalars == expected.scalars([Region("front", (0.0, 20.0), (5.0, 15.0))])
    assert max((count for _, count in gpu.to_host), default=0) <= 2 * 20 * 20


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_adds_up_what_the_cpu_does():
    """Results are equal up to the order of float64 sums and the last bit of distances."""
    grid = BevGrid(x_m=(0.0, 20.0), y_m=(0.0, 20.0), cell_m=1.0, heights={"low": (0.0, 4.0), "high": (4.0, 20.0)})
    options = {
        "max_radius_m": 30.0,
        "num_blocks": 8,
        "aggregations": (Maximum(), PooledMean()),
        "has_area_weights": True,
    }
    metrics = [CoverageMetric(grid, (0.4, 1.0), **options).to(device) for device in ("cpu", "cuda")]
    for metric in metrics:
        for clouds in each_step():
            sensor, reference, weights = (cloud.to(metric.device) for cloud in clouds)
            metric.update(sensor, reference, weights=weights)
    expected, result = (metric.compute() for metric in metrics)
    for key, layer in expected.layers.items():
        torch.testing.assert_close(result.layers[key].values.cpu(), layer.values, rtol=1e-6, atol=0, equal_nan=True)


def test_box_visibility_stays_on_the_device(monkeypatch):
    monkeypatch.setattr(backend_choice, "_can_search", lambda *_: False)
    boxes = Boxes.from_rows(
        torch.tensor([[5.0, 5, 5, 8, 8, 8, 0.3], [15.0, 15, 15, 8, 8, 8, 0], [99.0, 0, 0, 1, 1, 1, 0]])
    )
    sensor, reference, weights = next(each_step())
    expected = measure_box_visibility(sensor, reference, boxes, reference_weights=weights)
    with PretendedGpu() as gpu:
        clouds = on_gpu(sensor, reference)
        result = measure_box_visibility(*clouds, boxes, reference_weights=weights.as_subclass(OnGpu))
    assert isinstance(result.share, OnGpu)
    np.testing.assert_array_equal(as_values(result.share), expected.share.numpy())
    assert all(count <= len(boxes) for _, count in gpu.to_host)


def test_devices_without_float64_get_what_the_cpu_computes():
    """Results return to the device of the caller, float64 as float32; sums stay on the CPU."""
    grid = BevGrid(x_m=(0.0, 20.0), y_m=(0.0, 20.0), cell_m=1.0, heights={"low": (0.0, 4.0), "high": (4.0, 20.0)})
    boxes = Boxes.from_rows(torch.tensor([[5.0, 5, 5, 8, 8, 8, 0.3], [15.0, 15, 15, 8, 8, 8, 0]]))
    camera = Camera.from_fov(4, 3, 90.0)
    sensor, reference, weights = next(each_step())
    depth = torch.rand(3, 4) + 1

    def compute_all(sensor, reference, weights, boxes, depth):
        seen = measure_box_visibility(sensor, reference, boxes, reference_weights=weights)
        frame = Frame({"rig": sensor}, reference, index=0, name="a", boxes=boxes)
        turned = rotate(frame, 0.3)
        region = Region.from_corners("corner", [(0.0, 0.0), (20.0, 0.0), (20.0, 20.0)])
        return [
            *nearest(reference, sensor),
            blind_spot_radius(sensor, reference, max_radius=2.0),
            grid.find_cells(reference),
            *grid.assign_cells(reference),
            grid.count_points_by_column(reference),
            region.mask_points(*reference[:, :2].T),
            *find_points_in_boxes(reference, boxes),
            seen.share,
            seen.reference_points,
            compute_bev_iou(boxes.rows, boxes.rows),
            turned.reference,
            turned.boxes.rows,
            *camera.project(reference),
            camera.unproject(depth),
            *camera.rays(reference[:, :2]),
            camera.convert_z_to_distance(depth),
            camera.to_vehicle(reference),
        ]

    def measure(sensor, reference, weights, boxes):
        metric, recall = CoverageMetric(grid, max_radius_m=30.0, has_area_weights=True), RecallByVisibility()
        for each in (metric, recall):
            each.to(reference.device)
        metric.update(sensor, reference, weights=weights)
        recall.update(boxes.rows, boxes, measure_box_visibility(sensor, reference, boxes, reference_weights=weights))
        return metric.compute().scalars([Region("front", (0.0, 20.0), (5.0, 15.0))]) | recall.compute().to_scalars()

    expected = compute_all(sensor, reference, weights, boxes, depth)
    numbers = measure(sensor, reference, weights, boxes)
    with PretendedGpu(MPS):
        there = [tensor.as_subclass(OnMps) for tensor in (sensor, reference, weights)]
        result = compute_all(*there, boxes.to(MPS), depth.as_subclass(OnMps))
        assert measure(*there, boxes.to(MPS)) == pytest.approx(numbers, nan_ok=True, rel=1e-6)
    for here, tensor in zip(expected, result, strict=True):
        assert isinstance(tensor, OnMps)
        np.testing.assert_allclose(as_values(tensor), here.numpy(), rtol=1e-6)


def test_what_is_pretended_is_noticed():
    with PretendedGpu() as gpu:
        (there,) = on_gpu(torch.rand(4))
        assert (there + 1).device == there[1:].device == torch.ones(2, device=there.device).device == GPU
        with pytest.raises(AssertionError, match="add: one on the GPU, and on the CPU"):
            there + torch.rand(4)
        with pytest.raises(AssertionError, match="getitem"):
            torch.rand(4)[there.long()]
        assert there.cpu().device == there.to("cpu").device == torch.device("cpu")
        assert gpu.to_host == [("cpu", 4), ("to", 4)]
