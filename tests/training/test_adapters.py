"""Frames from batches of other frameworks, and the metric for MMEngine with its real classes."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from mmengine.evaluator import BaseMetric, Evaluator
from mmengine.registry import METRICS, TRANSFORMS
from mmengine.structures import BaseDataElement

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.data import Frame
from torchcover.training import FrameDeduplicator, MMEngineCoverage, convert_batch_dict, convert_data_batch
from torchcover.training import mmengine as adapter

GRID = {"x_m": (0.0, 8.0), "y_m": (-2.0, 2.0), "cell_m": 1.0}
REGION = {"name": "all", "x_m": GRID["x_m"], "y_m": GRID["y_m"]}
# 1.7 m above the ground, turned by 90 degrees to the left.
VEHICLE_T_LIDAR = torch.tensor(
    [[0.0, -1.0, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.7], [0.0, 0.0, 0.0, 1.0]]
)

KINDS_OF_THREE = [3, np.int64(3), torch.tensor(3)]


def cloud(points, seed, columns=4):
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([8.0, 4.0, 2.0, *[1.0] * (columns - 3)])
    return torch.rand(points, columns, generator=generator) * scale - torch.tensor(
        [0.0, 2.0, 0.2, *[0.0] * (columns - 3)]
    )


def make_metric():
    return CoverageMetric(BevGrid(**GRID), max_radius_m=9.0)


def truth_of(pairs):
    metric = make_metric()
    for sensor, reference in pairs:
        metric.update(sensor[:, :3], reference[:, :3])
    return metric.compute()


def in_one_array(clouds):
    """Collate clouds as `collate_batch` of OpenPCDet, with the sample index in the first column."""
    padded = [np.pad(cloud.numpy(), ((0, 0), (1, 0)), constant_values=k) for k, cloud in enumerate(clouds)]
    return np.concatenate(padded, axis=0)


@pytest.mark.parametrize("convert", [lambda array: array, torch.from_numpy], ids=["arrays", "tensors"])
def test_a_batch_dict_of_openpcdet(convert):
    sensors, references = [cloud(30, 0), cloud(0, 1), cloud(20, 2)], [cloud(50, 3), cloud(40, 4), cloud(0, 5)]
    batch_dict = {
        "points": convert(in_one_array(sensors)),
        "reference_points": convert(in_one_array(references)),
        "frame_id": np.array(["000134", "000007", "a1"]),
        "batch_size": 3,
    }
    batch = convert_batch_dict(batch_dict)
    assert [(frame.name, frame.index) for frame in batch.frames] == [("000134", 134), ("000007", 7), ("a1", -1)]
    for frame, sensor, reference in zip(batch.frames, sensors, references, strict=True):
        assert frame.sensor.dtype == torch.float32
        torch.testing.assert_close(frame.sensor, sensor[:, :3])
        torch.testing.assert_close(frame.reference, reference[:, :3])
    metric = make_metric()
    metric.update(batch.sensor, batch.reference)
    np.testing.assert_array_equal(metric.compute().radius, truth_of(zip(sensors, references, strict=True)).radius)


def test_lidar_points_are_moved_to_the_vehicle_frame():
    points = in_one_array([torch.tensor([[3.0, 1.0, -1.7, 0.5]])])
    batch = convert_batch_dict(
        {"points": points, "reference_points": points, "batch_size": 1}, vehicle_T_lidar=VEHICLE_T_LIDAR
    )
    torch.testing.assert_close(batch.sensor[0], torch.tensor([[-0.5, 3.0, 0.0]]))
    torch.testing.assert_close(batch.reference[0], batch.sensor[0])


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"points": None}, "has no 'points'; it has reference_points, batch_size"),
        ({"reference_points": None}, "has no 'reference_points'"),
        ({"points": np.zeros((5, 3))}, r"points: shape \(N, 1 \+ 3 \+ ...\)"),
        ({"batch_size": 1}, "sample numbers 0 to 0 are needed; got 0 to 1"),
    ],
)
def test_wrong_batch_dicts_are_refused(change, complaint):
    points = in_one_array([cloud(3, 0), cloud(4, 1)])
    batch_dict = {"points": points, "reference_points": points, "batch_size": 2, **change}
    with pytest.raises(ValueError, match=complaint):
        convert_batch_dict({key: value for key, value in batch_dict.items() if value is not None})


def data_batch(numbers):
    """Create the inputs and samples that MMEngine passes to metrics of MMDetection3D."""
    samples = [{"sample_idx": k, "reference_points": cloud(40, 100 + k).numpy()} for k in numbers]
    return {"inputs": {"points": [cloud(20 + k, k) for k in numbers]}}, samples


def pairs(numbers):
    return [(cloud(20 + k, k), cloud(40, 100 + k)) for k in numbers]


def test_a_data_batch_of_mmdetection3d():
    batch = convert_data_batch(*data_batch([3, 1]))
    assert [(frame.name, frame.index, len(frame.sensor)) for frame in batch.frames] == [("3", 3, 23), ("1", 1, 21)]
    inputs, samples = data_batch([0, 1])
    with pytest.raises(ValueError, match=r"a cloud for each of the 1 samples is needed; got 2"):
        convert_data_batch(inputs, samples[:1])
    with pytest.raises(ValueError, match="sample 1 has no 'reference_points'; add it"):
        convert_data_batch(inputs, [samples[0], {"sample_idx": 1}])
    with pytest.raises(ValueError, match=r"vehicle_T_lidar: shape \(4, 4\)"):
        convert_data_batch(inputs, samples, vehicle_T_lidar=torch.eye(3))


@TRANSFORMS.register_module()
class PackAsMMDetection3D:
    """Minimal `Pack3DDetInputs`: points as inputs, and some keys in the data sample."""

    def __init__(self, keys, meta_keys=("box_type_3d", "sample_idx")):
        self.keys, self.meta_keys = keys, meta_keys

    def __call__(self, results):
        if isinstance(results, list):
            return [self(one) for one in results]
        sample = BaseDataElement(metainfo={key: results[key] for key in self.meta_keys if key in results})
        return {"inputs": {key: results.pop(key) for key in self.keys}, "data_samples": sample}


@pytest.mark.parametrize("augmented", [False, True])
def test_packed_samples_keep_the_default_meta_keys(augmented):
    config = {"type": "PackWithReference", "pack": {"type": "PackAsMMDetection3D", "keys": ["points"]}}
    pack = TRANSFORMS.build(config)
    results = {"points": cloud(20, 0), "reference_points": cloud(40, 100), "sample_idx": 0, "box_type_3d": "lidar"}
    packed = pack([results] if augmented else results)
    packed = packed[0] if augmented else packed
    sample = packed["data_samples"].to_dict() | dict(packed["data_samples"].metainfo_items())
    assert (sample["box_type_3d"], sample["sample_idx"]) == ("lidar", 0)
    batch = convert_data_batch({"inputs": {"points": [packed["inputs"]["points"]]}}, [sample])
    torch.testing.assert_close(batch.frames[0].reference, cloud(40, 100)[:, :3])
    with pytest.raises(ValueError, match="the results have no 'reference_points'"):
        pack({"points": cloud(20, 0)})


def test_processes_without_samples_evaluate_by_area():
    metric = MMEngineCoverage({"grid": GRID, "has_area_weights": True})
    assert all(math.isnan(value) for name, value in metric.evaluate(0).items() if "radius_m" in name)
    assert metric.coverage.average == "area"


def test_mmengine_requires_area_weights_of_the_metric():
    frame = Frame({"rig": cloud(9, 0, 3)}, cloud(9, 1, 3), 0, "0")
    without, metric = (
        MMEngineCoverage({"grid": GRID, "has_area_weights": True}, get_frames=lambda batch, _: batch) for _ in range(2)
    )
    without.process([frame], [{}])
    with pytest.raises(ValueError, match="area of each reference point in m2 is needed"):
        without.evaluate(1)
    metric.process([replace(frame, reference_weights=torch.ones(9))], [{}])
    metric.evaluate(1)
    assert metric.coverage.counts["num_frames"] == 1


def test_mmengine_evaluates_it_as_any_of_its_metrics():
    """The registry builds the metric from a config, and the real `Evaluator` runs it twice."""
    config = {
        "type": "MMEngineCoverage",
        "metric": {"grid": GRID, "thresholds_m": (0.4,), "max_radius_m": 9.0},
        "regions": [REGION],
    }
    evaluator = Evaluator([config])
    (metric,) = evaluator.metrics
    assert isinstance(metric, BaseMetric)
    assert METRICS.get("MMEngineCoverage") is MMEngineCoverage
    evaluator.dataset_meta = {"classes": ("car",)}
    truth = truth_of(pairs(range(5)))
    for _ in range(2):
        for numbers in ([0, 1], [2, 3], [4]):
            inputs, samples = data_batch(numbers)
            evaluator.process(data_samples=samples, data_batch=inputs)
        scalars = evaluator.evaluate(5)
        expected = {f"coverage/{name}": value for name, value in truth.scalars([Region(**REGION)]).items()}
        assert scalars == pytest.approx(expected, rel=1e-12)
        np.testing.assert_array_equal(metric.coverage.radius, truth.radius)
        assert metric.results == []


@pytest.mark.parametrize(("samples", "processes"), [(5, 1), (5, 2), (7, 4), (1, 3)])
def test_mmengine_padding_is_excluded_by_dataset_size(monkeypatch, samples, processes):
    """Return the samples of a process as `DefaultSampler` of MMEngine: the last round repeats the first samples."""
    rounds = math.ceil(samples / processes)
    dealt = (list(range(samples)) * processes)[: rounds * processes]
    total = make_metric()
    for rank in range(processes):
        monkeypatch.setattr(adapter, "get_dist_info", lambda rank=rank: (rank, processes))
        metric = MMEngineCoverage(make_metric(), regions=[REGION], prefix="rig")
        for number in dealt[rank::processes]:
            metric.process(*data_batch([number]))
        scalars = metric.evaluate(samples)
        assert all(name.startswith("rig/") for name in scalars)
        own = [k for position, k in enumerate(dealt) if position % processes == rank and position < samples]
        assert metric.coverage.counts["num_frames"] == len(own)
        for sensor, reference in pairs(own):
            total.update(sensor[:, :3], reference[:, :3])
    assert total.num_frames == samples


def test_mmengine_adds_up_where_its_processes_exchange_tensors(monkeypatch):
    """NCCL refuses CPU tensors; without a GPU, check the device of the sums before they are reduced."""
    calls = []

    class Spy(CoverageMetric):
        def to(self, device):
            calls.append(device)
            return self

        def compute(self):
            calls.append("compute")
            return super().compute()

    monkeypatch.setattr(adapter, "get_comm_device", lambda: torch.device("cuda", 1))
    metric = MMEngineCoverage(Spy(BevGrid(**GRID), max_radius_m=9.0), regions=[REGION])
    metric.process(*data_batch([0]))
    metric.evaluate(1)
    assert calls == [torch.device("cuda", 1), "compute"]


def test_other_batches_of_mmengine():
    metric = MMEngineCoverage(
        make_metric(),
        regions=[Region(**REGION)],
        get_frames=lambda batch, samples: convert_batch_dict({**batch, "batch_size": len(samples)}),
    )
    points = in_one_array([cloud(30, 0)])
    metric.process({"points": points, "reference_points": points}, [{}])
    assert metric.evaluate(1)["coverage/radius_m/all/ground"] == 0


HIDE = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"lightning", "mmengine"}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Hidden())
import torchcover.training
assert not {"lightning", "mmengine", "tensorboard", "matplotlib"} & set(sys.modules)
torchcover.training.convert_batch_dict, torchcover.training.convert_data_batch, torchcover.training.FrameDeduplicator
assert not {"lightning", "mmengine", "tensorboard", "matplotlib"} & set(sys.modules)
for name in ("CoverageCallback", "MMEngineCoverage"):
    try:
        getattr(torchcover.training, name)
    except ImportError as error:
        print(name, error)
"""


def test_missing_frameworks_affect_only_their_class():
    done = subprocess.run([sys.executable, "-c", HIDE], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    callback, evaluator = done.stdout.splitlines()
    assert callback.startswith("CoverageCallback")
    assert "pip install 'torchcover[lightning]'" in callback
    assert evaluator.startswith("MMEngineCoverage")
    assert "pip install mmengine" in evaluator


def test_frames_count_once_for_any_integer_type():
    once = FrameDeduplicator()
    frames = [Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=index, name="a") for index in KINDS_OF_THREE]
    assert len(once.select_new(frames)) == 1
    assert {type(frame.index) for frame in frames} == {type(frame.block_index) for frame in frames} == {int}
