"""The brute-force backend, and its memory."""

import weakref

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchcover.neighbors import cdist, nearest

MEGABYTES = [2.0, 24.0, 256.0]  # in many chunks, in few, at once


def random_cloud(count, seed, scale=10.0):
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)) * scale


def clustered_cloud(count, seed):
    """Points in clumps that are far apart."""
    return random_cloud(count, seed, scale=0.5) + 10 * torch.arange(count)[:, None].div(256, rounding_mode="floor")


CLOUDS = {
    "noise": (random_cloud(1000, 1), random_cloud(12_000, 2)),
    "clusters": (clustered_cloud(1000, 3), clustered_cloud(12_000, 4)),
    "all equal": (torch.ones(1000, 3), torch.ones(12_000, 3)),
    "wide": (random_cloud(500, 5), torch.cat([random_cloud(5000, 6), random_cloud(600, 7) * 1e4])),
}
clouds = pytest.mark.parametrize("clouds", CLOUDS.values(), ids=CLOUDS.keys())


def brute_force(query, points):
    return np.concatenate(
        [
            np.sqrt(((chunk[:, None] - points.double().numpy()[None]) ** 2).sum(axis=2)).min(axis=1)
            for chunk in np.array_split(query.double().numpy(), max(1, len(query) // 100))
        ]
    )


@pytest.mark.parametrize("memory_mb", [0.02, *MEGABYTES])  # the first is less than one query with all points takes
@pytest.mark.parametrize("name", ["noise", "clusters", "wide"])
def test_the_budget_does_not_change_the_result(name, memory_mb):
    query, points = CLOUDS[name][0][:200], CLOUDS[name][1]
    found = nearest(query, points, backend="cdist", memory_mb=memory_mb)
    np.testing.assert_allclose(found.distance.double().numpy(), brute_force(query, points), rtol=1e-6)


class PeakMemory(TorchDispatchMode):
    """Bytes of the tensors that are alive at once, those that exist on entry not counted."""

    def __init__(self, *existing):
        super().__init__()
        self.existing = {tensor.untyped_storage().data_ptr() for tensor in existing}
        self.references, self.now, self.peak = {}, 0, 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor):
                self.add(tensor)
        return out

    def add(self, tensor):
        storage = tensor.untyped_storage()
        if not storage.nbytes() or storage.data_ptr() in self.existing:
            return
        if not self.references.get(storage.data_ptr()):
            self.now += storage.nbytes()
            self.peak = max(self.peak, self.now)
        self.references[storage.data_ptr()] = self.references.get(storage.data_ptr(), 0) + 1
        weakref.finalize(tensor, self.drop, storage.data_ptr(), storage.nbytes())

    def drop(self, pointer, size):
        self.references[pointer] -= 1
        self.now -= 0 if self.references[pointer] else size


@clouds
@pytest.mark.parametrize("memory_mb", MEGABYTES)
@pytest.mark.parametrize(
    "between", [cdist._compute_distances, cdist._compute_squared_distances]
)  # of the CPU, and of other devices
def test_memory_stays_inside_the_budget(clouds, memory_mb, between, monkeypatch):
    monkeypatch.setattr(cdist, "_compute_distances", between)
    query, points = clouds
    with PeakMemory(query, points) as memory:
        nearest(query, points, backend="cdist", memory_mb=memory_mb)
    a_few_arrays = 6 * (query.nbytes + points.nbytes)
    assert 0.3e6 < memory.peak < memory_mb * 1e6 + a_few_arrays


def test_memory_stays_inside_the_budget_with_many_queries():
    points = CLOUDS["clusters"][1]
    query = points.repeat(4, 1) + 0.1
    with PeakMemory(query, points) as memory:
        nearest(query, points, backend="cdist", memory_mb=24)
    assert memory.peak < 24e6 + 6 * (query.nbytes + points.nbytes)


def test_the_gauge_sees_what_a_plain_comparison_takes():
    query, points = random_cloud(1000, 12), random_cloud(2000, 13)
    with PeakMemory(query, points) as memory:
        torch.cdist(query, points).min(dim=1)
    assert memory.peak >= 8e6
