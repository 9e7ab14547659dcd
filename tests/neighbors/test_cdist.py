"""The two ways of the brute-force backend, and its memory."""

import weakref

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchcover.neighbors import cdist, nearest

MEGABYTES = [2.0, 24.0, 256.0]  # by differences in many chunks; by screening with little room, and with plenty


def random_cloud(count, seed, scale=10.0):
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)) * scale


def clustered_cloud(count, seed):
    """Points along walls: blocks are far apart, so that screening rules most of them out."""
    return random_cloud(count, seed, scale=0.5) + 10 * torch.arange(count)[:, None].div(256, rounding_mode="floor")


CLOUDS = {
    "noise": (random_cloud(1000, 1), random_cloud(12_000, 2)),
    "clusters": (clustered_cloud(1000, 3), clustered_cloud(12_000, 4)),
    "all equal": (torch.ones(1000, 3), torch.ones(12_000, 3)),
    "wide": (random_cloud(500, 5), torch.cat([random_cloud(5000, 6), random_cloud(600, 7) * 1e4])),
}
clouds = pytest.mark.parametrize("clouds", CLOUDS.values(), ids=CLOUDS.keys())


@pytest.fixture
def reduced_precision():
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    yield
    torch.set_float32_matmul_precision(before)


def brute_force(query, points):
    return np.concatenate(
        [
            np.sqrt(((chunk[:, None] - points.double().numpy()[None]) ** 2).sum(axis=2)).min(axis=1)
            for chunk in np.array_split(query.double().numpy(), max(1, len(query) // 100))
        ]
    )


@pytest.mark.parametrize("memory_mb", MEGABYTES)
@pytest.mark.parametrize("name", ["noise", "clusters", "wide"])
def test_the_budget_does_not_change_the_result(name, memory_mb):
    query, points = CLOUDS[name][0][:200], CLOUDS[name][1]
    found = nearest(query, points, backend="cdist", memory_mb=memory_mb)
    np.testing.assert_allclose(found.distance.double().numpy(), brute_force(query, points), rtol=1e-6)


@clouds
@pytest.mark.parametrize("budget", [200_000, 8_000_000], ids=["several chunks", "one chunk"])
def test_screening_and_differences_agree(clouds, budget):
    query, points = clouds
    screened = cdist._search_by_screening(query, points, budget)
    compared = cdist._search_by_differences(query, points, budget=2_000_000)
    apart = [(query.double() - points[index].double()).norm(dim=1) for index in (screened, compared)]
    torch.testing.assert_close(*apart, rtol=1e-6, atol=0)


def test_screening_compares_few_pairs_where_blocks_are_far_apart(monkeypatch):
    query, points = CLOUDS["clusters"]
    pairs = []
    compare = cdist._compare_by_differences
    monkeypatch.setattr(
        cdist, "_compare_by_differences", lambda *given: (pairs.append(len(given[2])), compare(*given))[1]
    )
    nearest(query, points, backend="cdist")
    assert 0 < sum(pairs) < 0.05 * len(query) * len(points) / cdist.BLOCK


@pytest.mark.parametrize("count", [256, 257, 511, 1000])
def test_the_filling_of_the_last_block_is_never_named(count):
    query, points = random_cloud(50, 8), random_cloud(count, 9) + 30
    found = nearest(query, points, backend="cdist", memory_mb=64)
    np.testing.assert_allclose(found.distance.double().numpy(), brute_force(query, points), rtol=1e-6)
    last = nearest(torch.ones(1, 3) * 1e3, torch.arange(3.0 * count).view(-1, 3), backend="cdist", memory_mb=64)
    assert last.index.item() == min(count - 1, 333)


def test_a_tie_with_the_filling_names_the_last_point(monkeypatch):
    """Which index of a tie torch.min gives is not promised."""
    monkeypatch.setattr(cdist, "_search_rows", lambda query, *_: torch.full((len(query),), cdist.BLOCK - 1))
    found = cdist._search_by_screening(random_cloud(3, 8), random_cloud(10, 9), budget=8_000_000)
    assert found.tolist() == [9, 9, 9]


def test_fewer_points_than_a_block_are_not_screened(monkeypatch):
    monkeypatch.setattr(cdist, "_search_by_screening", fail)
    query, points = random_cloud(50, 8), random_cloud(255, 9)
    found = nearest(query, points, backend="cdist")
    np.testing.assert_allclose(found.distance.double().numpy(), brute_force(query, points), rtol=1e-6)


def fail(*_):
    raise AssertionError("a matrix product was taken")


def test_reduced_matrix_precision_is_not_trusted(monkeypatch, reduced_precision):
    monkeypatch.setattr(cdist, "_search_by_screening", fail)
    query, points = random_cloud(100, 10), random_cloud(2000, 11)
    distance = nearest(query, points, backend="cdist").distance
    np.testing.assert_allclose(distance.double().numpy(), brute_force(query, points), rtol=1e-6)


def test_full_matrix_precision_is_used(monkeypatch):
    monkeypatch.setattr(cdist, "_search_by_screening", fail)
    with pytest.raises(AssertionError, match="a matrix product was taken"):
        nearest(random_cloud(100, 10), random_cloud(2000, 11), backend="cdist")


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
def test_memory_stays_inside_the_budget(clouds, memory_mb):
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


def test_many_remaining_blocks_are_compared_in_turn():
    query, blocks = random_cloud(500, 15), random_cloud(40 * cdist.BLOCK, 16).view(40, cdist.BLOCK, 3)
    row, block = torch.cartesian_prod(torch.arange(500), torch.arange(40)).T
    with PeakMemory(query, blocks, row, block) as memory:
        index = cdist._compare_by_differences(query, blocks, row, block, budget=1_000_000)
    assert memory.peak < 4e6 + 100 * len(row)
    assert torch.equal(index, cdist._search_by_differences(query, blocks.view(-1, 3), budget=1_000_000))


def test_the_gauge_sees_what_a_plain_comparison_takes():
    query, points = random_cloud(1000, 12), random_cloud(2000, 13)
    with PeakMemory(query, points) as memory:
        torch.cdist(query, points).min(dim=1)
    assert memory.peak >= 8e6
