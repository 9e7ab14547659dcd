"""Of packets and of Warp: exact in their type, smallest index of a tie, whatever the order, the parts, the threads."""

import math
import sys
from importlib import import_module
from importlib.util import find_spec
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.killing import run_in_fork
from torchcover import nearest

ROOT = Path(__file__).parents[2]
INSTALLED = find_spec("numba") is not None
BACKENDS = ["packets"] * INSTALLED
if find_spec("warp"):
    BACKENDS += ["warp", "warp on a GPU"] if torch.cuda.is_available() else ["warp"]
if INSTALLED:
    from torchcover.neighbors import packets
    from torchcover.neighbors.packets import compute_morton_order


def generator(seed):
    return np.random.default_rng(seed)


def uniform(count, seed, low=-50.0, high=50.0):
    return generator(seed).uniform(low, high, (count, 3)).astype(np.float32)


def line(count, seed):
    return (generator(seed).uniform(-80, 80, (count, 1)) * [0.8, 0.599, 0.03]).astype(np.float32)


def scan(rows, columns):
    """Where the rays of a LiDAR at 2 m height meet the ground or a wall: rings, denser near the sensor."""
    elevation, azimuth = np.meshgrid(np.linspace(-0.5, -0.02, rows), np.linspace(-3.1, 3.1, columns), indexing="ij")
    reach = np.minimum(2.0 / np.sin(-elevation), 30.0)
    over_ground = reach * np.cos(elevation)
    xyz = over_ground * np.cos(azimuth), over_ground * np.sin(azimuth), 2.0 + reach * np.sin(elevation)
    return np.stack(xyz, axis=-1).reshape(-1, 3).astype(np.float32)


def grid(side):
    """Whole metres: almost every query between them has ties."""
    axis = np.arange(side, dtype=np.float32)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def sphere(count, seed):
    """All at about the same distance from the origin: which one is nearest to it, rounding decides."""
    directions = generator(seed).normal(size=(count, 3))
    return (10 * directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


CLOUDS = {
    "random": (uniform(700, 1), uniform(3000, 2)),
    "scan": (uniform(700, 3, [-30, -30, 0], [30, 30, 3]), scan(40, 120)),
    "ties": (grid(9) + np.float32(0.5), generator(4).permutation(grid(10))),
    "every point 8 times": (uniform(300, 5), generator(6).permutation(np.repeat(uniform(300, 7), 8, axis=0))),
    "all equal": (uniform(200, 8), np.ones((3000, 3), np.float32)),
    "queries all equal": (np.ones((200, 3), np.float32), uniform(3000, 9)),
    "on a line": (line(500, 10), line(3000, 11)),
    "in a plane": (uniform(500, 12) * np.float32([1, 1, 0]), uniform(3000, 13) * np.float32([1, 1, 0])),
    "on a sphere": (uniform(300, 28) * np.float32(1e-7), sphere(3000, 29)),
    "far apart": (uniform(300, 14), uniform(3000, 15) + np.float32([1e6, 0, 0])),
    "one far away": (uniform(300, 16), np.concatenate([uniform(3000, 17), np.float32([[1e9, -1e9, 0]])])),
    "huge": (uniform(300, 18) * np.float32(2e7), uniform(3000, 19) * np.float32(2e7)),
    "tiny": (uniform(300, 20) * np.float32(1e-11), uniform(3000, 21) * np.float32(1e-11)),
    "one point": (uniform(300, 22), uniform(1, 23)),
    "one query": (uniform(1, 24), uniform(3000, 25)),
    "17 points": (uniform(65, 26), uniform(17, 27)),
}
clouds = pytest.mark.parametrize("name", CLOUDS)
backends = pytest.mark.parametrize("backend", BACKENDS)
if_installed = pytest.mark.parametrize("installed", [True] if INSTALLED else [])


def slow_twin(query, points):
    """The same sums in the type of the clouds, one after the other: the first of the least."""
    x, y, z = (query[:, None, axis] - points[None, :, axis] for axis in range(3))
    return (x * x + y * y + z * z).argmin(axis=1)


def there(cloud, backend):
    return torch.from_numpy(cloud).to("cuda" if "GPU" in backend else "cpu")


def search(query, points, backend):
    module = import_module(f"torchcover.neighbors.{backend.split()[0]}")
    return module.search(there(query, backend), there(points, backend), math.inf, 1.0).cpu().numpy()


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def as_python(threads, monkeypatch):
    """The loops of packets are run by Python, on one thread: others do not know what errors are ignored."""
    threads(1)
    for function, compiled in vars(packets).copy().items():
        if hasattr(compiled, "py_func"):
            monkeypatch.setattr(packets, function, compiled.py_func)


@clouds
@backends
def test_the_index_is_the_slow_twins(name, backend):
    query, points = CLOUDS[name]
    np.testing.assert_array_equal(search(query, points, backend), slow_twin(query, points))


@if_installed
@pytest.mark.parametrize("name", ["random", "ties", "every point 8 times", "all equal", "17 points", "one point"])
def test_uncompiled_loops_stay_within_their_arrays(name, installed, as_python, monkeypatch):
    """Compiled ones do not look where they write."""
    monkeypatch.setattr(packets, "CROWD", 20)
    query, points = (cloud[:count] for cloud, count in zip(CLOUDS[name], (70, 90), strict=True))
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(search(query, points, "packets"), slow_twin(query, points))


def boxes_around(count, seed):
    """(count, 6) boxes around two random points each, and around one of them."""
    ends = np.stack([uniform(count, seed), uniform(count, seed + 1)])
    ends[1, ::4] = ends[0, ::4]
    return np.concatenate([ends.min(axis=0), ends.max(axis=0)], axis=1)


@if_installed
def test_gaps_between_boxes_equal_their_closed_form(installed):
    one, other = boxes_around(60, 33), boxes_around(60, 35)
    (low, high), (least, most) = ((boxes[:, :3], boxes[:, 3:]) for boxes in (one, other))
    apart = np.maximum(np.maximum(low - most, least - high), 0)
    between_centres = np.abs((low + high) - (least + most)).sum(axis=1)
    for name, expected in (("_compute_gap", (apart**2).sum(axis=1)), ("_compute_center_gap", between_centres)):
        gap = getattr(packets, name).py_func
        found = [gap(one, node, around) for node, around in enumerate(other)]
        np.testing.assert_allclose(found, expected, rtol=1e-4, err_msg=name)


@pytest.mark.parametrize("backend", [name for name in BACKENDS if name == "warp"])
def test_gap_to_a_box_ends_at_nearest_point(backend):
    """As Python runs it: a smaller one would be found out by nothing but the time that a search takes."""
    boxes, points = boxes_around(60, 37), uniform(60, 39)
    gap = import_module("torchcover.neighbors.warp")._compute_gap.func
    found = [gap(boxes, node, *point) for node, point in enumerate(points)]
    expected = ((np.clip(points, boxes[:, :3], boxes[:, 3:]) - points) ** 2).sum(axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("backend", [name for name in BACKENDS if name == "warp"])
def test_searches_visit_at_most_twice_the_needed_boxes(backend, monkeypatch):
    """As Python runs it: those beneath a box that is nearer than the nearest point, which nobody knows beforehand."""
    warp = import_module("torchcover.neighbors.warp")
    points = generator(43).normal(0, 9, (600, 3)).astype(np.float32)
    query = points[:100] + np.float32(0.1)
    tree = [part.numpy() for part in warp.build_box_tree(torch.from_numpy(points))]
    looked = []

    def noted(*given, gap=warp._compute_gap.func):
        looked.append(given[1])
        return gap(*given)

    monkeypatch.setattr(warp, "_compute_gap", noted)
    monkeypatch.setattr(warp, "_is_better", warp._is_better.func)
    stand_in = {"max": max, "int32": int, "where": lambda truth, one, other: one if truth else other}
    found = np.full(len(query), warp.NO_INDEX)
    for number in range(len(query)):
        monkeypatch.setattr(warp, "wp", SimpleNamespace(tid=lambda number=number: number, **stand_in))
        warp._walk_tree.func(query, *tree, np.float32(np.inf), found)
    nearest_of_all = slow_twin(query, points)
    np.testing.assert_array_equal(found, nearest_of_all)
    inner = tree[2][1 : len(tree[2]) // 2, None]
    gaps = ((np.clip(query, inner[..., :3], inner[..., 3:]) - query) ** 2).sum(axis=2)
    assert len(looked) < 2 * 2 * (gaps <= ((points[nearest_of_all] - query) ** 2).sum(axis=1)).sum()


@if_installed
def test_packets_that_begin_near_visit_fewer_leaves(installed, as_python, monkeypatch):
    """Of the many whose boxes meet its own, as where points are asked for their neighbours."""
    points = generator(41).normal(0, 9, (600, 3)).astype(np.float32)
    query = points + np.float32(0.1)
    looked = []

    def noted(*given, visit=packets._visit_leaf):
        looked.append(given[-1])
        return visit(*given)

    def leaves_looked_into():
        looked.clear()
        with np.errstate(over="ignore"):
            np.testing.assert_array_equal(search(query, points, "packets"), slow_twin(query, points))
        return len(looked)

    monkeypatch.setattr(packets, "_visit_leaf", noted)
    from_the_middle = leaves_looked_into()
    monkeypatch.setattr(packets, "_compute_center_gap", lambda *_: 0.0)
    assert from_the_middle < 0.8 * leaves_looked_into()


@clouds
@pytest.mark.parametrize("backend", [name for name in BACKENDS if name != "packets"])
def test_in_float64_too(name, backend):
    """With coordinates that float32 does not hold, and ties where there were some."""
    query, points = (cloud.astype(np.float64) / 3 for cloud in CLOUDS[name])
    np.testing.assert_array_equal(search(query, points, backend), slow_twin(query, points))


@backends
def test_ties_return_the_smallest_index(backend):
    """Every leaf holds one place, and all are as far away as the nearest one."""
    places = {each for x in (-3, 3) for y in (-4, 4) for each in permutations((x, y, 0))}
    points = np.repeat(np.array(sorted(places), dtype=np.float32), 32, axis=0)
    for first in range(len(places)):
        assert search(np.zeros((1, 3), np.float32), np.roll(points, 32 * first, axis=0), backend).tolist() == [0]


@clouds
@backends
def test_order_chunks_and_threads_change_no_bit(name, backend, threads, monkeypatch):
    query, points = CLOUDS[name]
    threads(1)
    expected = search(query, points, backend)
    order = generator(30).permutation(len(query))
    threads(3)
    if backend == "packets":
        monkeypatch.setattr(packets, "CHUNK_SIZE", 70)
    np.testing.assert_array_equal(search(query[order], points, backend), expected[order])
    parts = [search(part, points, backend) for part in np.array_split(query, 3) if len(part)]
    np.testing.assert_array_equal(np.concatenate(parts), expected)


@if_installed
@pytest.mark.parametrize(("count", "asked"), [(1, 0), (2, 2)])
def test_sort_and_search_use_several_threads(installed, threads, monkeypatch, count, asked):
    threads(count)
    calls = []

    class Noted(packets.ThreadPoolExecutor):
        def map(self, *given):
            calls.append(given)
            return super().map(*given)

    monkeypatch.setattr(packets, "ThreadPoolExecutor", Noted)
    search(*CLOUDS["random"], "packets")
    assert len(calls) == asked


@clouds
@backends
@pytest.mark.parametrize("quantile", [0.0, 0.5, 1.0])
def test_a_bound_only_leaves_out_what_is_beyond(name, backend, quantile):
    query, points = (there(cloud, backend) for cloud in CLOUDS[name])
    backend = backend.split()[0]
    everything = nearest(query, points, backend=backend)
    limit = float(everything.distance.quantile(quantile, interpolation="nearest"))
    bounded = nearest(query, points, max_distance=limit, backend=backend)
    within = everything.distance <= limit
    assert torch.equal(bounded.index, everything.index.where(within, -1))
    assert torch.equal(bounded.distance, everything.distance.where(within, torch.inf))


def leaf_sizes(cloud):
    """The diagonals of the boxes around every 16 points in order."""
    leaves = cloud[compute_morton_order(cloud)][: len(cloud) // 16 * 16].reshape(-1, 16, 3)
    return np.linalg.norm(np.ptp(leaves.astype(np.float64), axis=1), axis=1)


@if_installed
def test_a_far_point_does_not_coarsen_the_order(installed):
    cloud = uniform(20_000, 31)
    far = np.float32([[1e9, 1e9, 1e9]])
    alone = np.median(leaf_sizes(cloud))
    assert np.median(leaf_sizes(np.concatenate([cloud, far]))) < 1.2 * alone
    assert alone < 0.2 * np.median(np.linalg.norm(np.ptp(cloud.reshape(-1, 16, 3), axis=1), axis=1))


@if_installed
def test_keys_interleave_the_bits_of_cells(installed):
    cells = generator(44).integers(0, packets.AXIS_CELLS, (500, 3))
    cells[:2] = [[0] * 3, [packets.AXIS_CELLS - 1] * 3]
    keys = packets._compute_morton_keys(cells.astype(np.float32) - 7)
    in_turn = sum(((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for axis in range(3) for bit in range(11))
    np.testing.assert_array_equal(keys, (in_turn.astype(np.uint64) << np.uint64(31)) + np.arange(500, dtype=np.uint64))
    assert keys[1] >> np.uint64(31) == 2**33 - 1
    np.testing.assert_array_equal(packets._sort_keys(keys.copy()), np.sort(keys))


@if_installed
def test_crowds_are_long_runs_of_equal_cells(installed):
    counts = [3, packets.CROWD, packets.CROWD + 1, 1, 5000, packets.CROWD - 1, 2 * packets.CROWD]
    cells, ends = np.repeat(np.arange(len(counts), dtype=np.uint64), counts), np.cumsum(counts)
    keys = (cells << np.uint64(31)) + np.arange(len(cells), dtype=np.uint64)[::-1]
    runs = [[end - count, end] for count, end in zip(counts, ends, strict=True) if count > 1024]
    np.testing.assert_array_equal(packets._find_crowds(keys), runs)


@if_installed
@pytest.mark.parametrize("count", [1, 16, 17, 100, 1000])
def test_nodes_bound_all_points_below_them(installed, count):
    points, order = uniform(count, 46), generator(47).permutation(count)
    leaves, indices, boxes, smallest = packets._build_tree(points, order)
    filled = np.concatenate([order, np.repeat(order[-1:], -count % 16)]).reshape(-1, 16)
    np.testing.assert_array_equal(indices, filled)
    np.testing.assert_array_equal(leaves.transpose(0, 2, 1), points[filled])
    first = len(boxes) // 2
    assert first / 2 < len(filled) <= first
    for node in range(1, 2 * first):
        below = first.bit_length() - node.bit_length()
        beneath = filled[(node << below) - first : ((node + 1) << below) - first].ravel()
        ends = np.concatenate([points[beneath].min(axis=0, initial=3e38), points[beneath].max(axis=0, initial=-3e38)])
        np.testing.assert_array_equal(boxes[node], ends)
        assert smallest[node] == beneath.min(initial=2**31 - 1)


@if_installed
@pytest.mark.parametrize("count", [64, 40])
def test_packets_know_which_boxes_may_improve_them(installed, as_python, count):
    query, part = uniform(100, 48), generator(49).permutation(100)[:count]
    points = np.sort(uniform(64, 50), axis=0) + np.float32([60, 0, 0])  # some boxes beside all queries
    leaves, indices, boxes, smallest = packets._build_tree(points, np.arange(64))
    packet, found, around = np.zeros(packets.WORST + 1, np.float32), np.zeros(64, np.int32), np.zeros(6, np.float32)
    packets._load_packet(query, part, packet, found, np.float32(3e38), around)
    members = query[np.concatenate([part, np.repeat(part[-1:], 64 - count)])]
    np.testing.assert_array_equal(packet[:192].reshape(3, 64), members.T)
    np.testing.assert_array_equal(around, np.concatenate([members.min(axis=0), members.max(axis=0)]))
    squared = ((members[:, None] - points) ** 2).sum(axis=2)
    for leaf in range(4):
        most = packets._visit_leaf(packet, found, leaves, indices, leaf)
        least = squared[:, : 16 * leaf + 16].min(axis=1)
        np.testing.assert_allclose(packet[packets.BEST : packets.BOX], least, rtol=1e-5)
        np.testing.assert_array_equal(found, squared[:, : 16 * leaf + 16].argmin(axis=1))
        assert most == packet[packets.BEST : packets.BOX].max()
    for node, (low, high) in enumerate(boxes[1:].reshape(-1, 2, 3), 1):
        x, y, z = (np.clip(members, low, high) - members).T
        to_box = x * x + y * y + z * z
        for bound in (0.0, to_box.min(), to_box.min() * 1.001, to_box.max()):
            packet[packets.BEST : packets.BOX], found[:] = bound, smallest[node]
            assert packets._can_improve(packet, found, boxes, smallest, node) == (to_box < bound).any()
            found[to_box.argmin()] += 1
            assert packets._can_improve(packet, found, boxes, smallest, node) == (to_box.min() <= bound)


@if_installed
@pytest.mark.parametrize("axis", range(3))
def test_order_is_equally_fine_along_each_axis(installed, axis):
    cloud = uniform(20_000, 45) * np.float32([100, 1, 0.01])
    assert np.median(leaf_sizes(np.roll(cloud, axis, axis=1))) < 1.1 * np.median(leaf_sizes(cloud)) < 60


@if_installed
@pytest.mark.parametrize("count", [1, 2, 5000])
@pytest.mark.parametrize("extent", [0.0, 1e-45, 1e-38, 1e-3, 1e9])
def test_the_order_is_a_permutation(installed, count, extent):
    for cloud in (uniform(count, 32, 0, 1) * np.float32(extent), np.full((count, 3), np.float32(extent))):
        assert sorted(compute_morton_order(cloud)) == list(range(count))


@if_installed
def test_equal_points_keep_their_order(installed):
    assert compute_morton_order(np.ones((5000, 3), np.float32)).tolist() == list(range(5000))


def test_backends_name_the_library_to_install(monkeypatch):
    for name in ("packets", "compiled", "morton", "warp"):
        monkeypatch.delitem(sys.modules, f"torchcover.neighbors.{name}", raising=False)
    for backend, library, extra in (("packets", "numba", "fast"), ("warp", "warp", "warp")):
        monkeypatch.setitem(sys.modules, library, None)
        install = rf"backend '{backend}' needs \w+: pip install 'torchcover\[{extra}\]'"
        with pytest.raises(ModuleNotFoundError, match=install):
            nearest(*torch.zeros(2, 1, 3), backend=backend)


@if_installed
def test_a_forked_process_searches(installed):
    """As the workers of a DataLoader do, after the main process has searched on several threads."""
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        clouds = torch.rand(2, 20_000, 3, generator=torch.Generator().manual_seed(0))
        index = nearest(*clouds, backend="packets").index

        def search():
            torch.set_num_threads(1)
            assert torch.equal(nearest(*clouds, backend="packets").index, index)

        assert run_in_fork(search)[1] == 0
    finally:
        torch.set_num_threads(threads)
