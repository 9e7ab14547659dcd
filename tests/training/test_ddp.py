"""Two processes give the numbers of one, whatever padding the sampler adds."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import BatchSampler, DataLoader, DistributedSampler

from torchcover import BevGrid, Coverage, CoverageMetric, Region
from torchcover.data import Frame, collate_frames
from torchcover.training import FrameDeduplicator, convert_batch_dict, find_shard
from torchcover.training.counting import Shard

GRID = {"x_m": (0.0, 8.0), "y_m": (-2.0, 2.0), "cell_m": 1.0}
REGION = Region("all", x_m=GRID["x_m"], y_m=GRID["y_m"])


def clouds(seed):
    generator = torch.Generator().manual_seed(seed)
    size, corner = torch.tensor([8.0, 4.0, 2.0]), torch.tensor([0.0, -2.0, -0.2])
    return tuple(torch.rand(points, 3, generator=generator) * size + corner for points in (20 + seed, 40))


def test_two_processes_give_the_numbers_of_one(tmp_path):
    """Seven frames for two processes: the eighth sample repeats the first."""
    frames = [clouds(seed) for seed in range(7)]
    torch.save({"grid": GRID, "frames": frames}, tmp_path / "frames.pt")
    environment = {**os.environ, "GLOO_SOCKET_IFNAME": "lo0" if sys.platform == "darwin" else "lo"}
    environment.update(OMP_NUM_THREADS="1", PYTHONPATH=os.pathsep.join(p for p in sys.path if p))
    run = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("two_ranks.py")), str(tmp_path)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # the first process starts the second, and ends it
    )
    try:
        output = run.communicate(timeout=240)[0]
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
    assert run.returncode == 0, output

    metric = CoverageMetric(BevGrid(**GRID), max_radius_m=9.0, num_blocks=8)
    for index, (sensor, reference) in enumerate(frames):
        metric.update(sensor, reference, block_index=index)
    truth = metric.compute()
    for name in ("whole", "resumed"):
        for rank in range(2):
            job = torch.load(tmp_path / f"{name}_{rank}.pt", weights_only=False)
            for stage in ("train", "val"):
                assert_same(Coverage.load(tmp_path / f"{name}_{stage}_{rank}.npz"), truth)
                np.testing.assert_allclose(job["blocks"][stage], truth.block_sums.sums, rtol=1e-12)
                assert job["logged"][f"coverage/{stage}/num_frames"] == 7
                for tag, value in truth.scalars([REGION]).items():
                    assert job["logged"][f"coverage/{stage}/{tag}"] == pytest.approx(value, rel=1e-6, nan_ok=True)
            assert job["images"] == (2 if rank == 0 else 0), "maps are drawn by one process"


def assert_same(coverage, other):
    for name in ("observed_frames", "point_counts", "radius", "detection"):
        np.testing.assert_allclose(getattr(coverage, name), getattr(other, name), rtol=1e-12, err_msg=name)
    assert coverage.counts == other.counts


class Clouds:
    """Create frames with an index and few points."""

    def __init__(self, frames):
        self.frames = frames

    def __len__(self):
        return self.frames

    def __getitem__(self, index):
        return Frame({"rig": torch.zeros(1, 3)}, torch.zeros(1, 3), index=index, name="cloud")


@pytest.mark.parametrize("drop_last", [False, True])
@pytest.mark.parametrize("shuffle", [False, True])
@pytest.mark.parametrize(("samples", "processes"), [(1, 1), (1, 4), (3, 8), (4, 4), (5, 4), (7, 2), (8, 3), (10, 4)])
def test_every_frame_is_counted_by_one_process(samples, processes, shuffle, drop_last):
    dataset, counted, dealt = Clouds(samples), [], []
    for rank in range(processes):
        sampler = DistributedSampler(dataset, processes, rank, shuffle=shuffle, drop_last=drop_last)
        loader = DataLoader(dataset, batch_size=2, sampler=sampler, collate_fn=collate_frames)
        once = FrameDeduplicator()
        for batch in loader:
            dealt += [frame.index for frame in batch.frames]
            counted += [frame.index for frame in once.select_new(batch.frames, find_shard(loader))]
    assert sorted(counted) == sorted(set(dealt))


@pytest.mark.parametrize("batch_size", [1, 2, 5])
@pytest.mark.parametrize(("samples", "processes"), [(1, 1), (1, 4), (3, 8), (4, 4), (5, 4), (7, 2), (8, 3), (10, 4)])
def test_late_numbers_of_samples_give_equal_results(samples, processes, batch_size):
    dataset = Clouds(samples)
    for rank in range(processes):
        loader = DataLoader(
            dataset, batch_size, sampler=DistributedSampler(dataset, processes, rank), collate_fn=collate_frames
        )
        known, told_late = FrameDeduplicator(), FrameDeduplicator()
        expected = [frame for batch in loader for frame in known.select_new(batch.frames, find_shard(loader))]
        unknown = Shard(rank, processes, None)
        counted = [frame for batch in loader for frame in told_late.select_new(batch.frames, unknown)]
        counted += told_late.select_new([], find_shard(loader))
        assert [frame.index for frame in counted] == [frame.index for frame in expected]


def test_frames_without_index_and_name_are_new():
    """Create batches of OpenPCDet without `frame_id`, of clouds with equal numbers of points."""
    points = torch.zeros(64, 5)
    batch = convert_batch_dict({"points": points, "reference_points": points, "batch_size": 1})
    once = FrameDeduplicator()
    assert [len(once.select_new(batch.frames)) for _ in range(3)] == [1, 1, 1]


def test_a_batch_sampler_is_looked_through():
    sampler = DistributedSampler(range(5), num_replicas=2, rank=1)
    loader = DataLoader(range(5), batch_sampler=BatchSampler(sampler, 2, drop_last=False))
    assert find_shard(loader) == (1, 2, 5)
    assert find_shard(DataLoader(range(5))) is None
    assert find_shard([1, 2, 3]) is None


def test_equal_indices_of_two_datasets_are_different_frames():
    """Concatenated datasets each count from 0; their frames differ in name, or in numbers of points."""
    first = Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=0, name="a")
    others = [
        Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=0, name="b"),
        Frame({"rig": torch.zeros(6, 3)}, torch.zeros(9, 3), index=0, name="a"),
        Frame({"rig": torch.zeros(5, 3)}, torch.zeros(8, 3), index=0, name="a"),
    ]
    flipped = Frame({"rig": -torch.ones(5, 3)}, torch.ones(9, 3), index=0, name="a")
    once = FrameDeduplicator()
    assert once.select_new([first, *others]) == [first, *others]
    assert once.select_new([flipped]) == []
    assert once.select_new([first], loader_index=1) == [first]
    once.start_epoch()
    assert once.select_new([first]) == [first]


def test_the_state_goes_on_within_an_epoch():
    frames = [Clouds(6)[k] for k in range(6)]
    once, resumed = FrameDeduplicator(), FrameDeduplicator()
    once.select_new(frames[:3], find_shard(DataLoader(frames, sampler=DistributedSampler(frames, 2, 1))))
    resumed.load_state_dict(once.state_dict())
    shard = find_shard(DataLoader(frames[:5], sampler=DistributedSampler(frames[:5], 2, 1)))
    # The samples of this process are 1, 3, 5 of five: the last is padding.
    assert resumed.select_new(frames[2:4], shard) == once.select_new(frames[2:4], shard) == []
