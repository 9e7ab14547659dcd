"""The contract of `nearest` and `blind_spot_radius`, for every backend."""

import math
import warnings
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pykdtree.kdtree import KDTree

from torchcover import blind_spot_radius, nearest
from torchcover.neighbors import BACKENDS, backend_choice, cdist, check_cloud, kdtree
from torchcover.neighbors.query import _rescale

DTYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
# Rounding of the search decides between points that are this close to equally near; the distance is rounded once.
ULPS = {torch.float32: 4 * 2.0**-23, torch.float64: 4 * 2.0**-52}

LIBRARIES = {"packets": "numba", "warp": "warp"}
INSTALLED = sorted(name for name in BACKENDS if name not in LIBRARIES or find_spec(LIBRARIES[name]))
backends = pytest.mark.parametrize("backend", INSTALLED)


def cloud(*rows, dtype=torch.float32):
    return torch.tensor(rows, dtype=dtype).reshape(-1, 3)


def random_cloud(count, seed, scale=10.0, dtype=torch.float32):
    return (torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * scale).to(dtype)


def brute_force(query, points):
    """(N,) distances in float64, or wider where NumPy has it."""
    difference = query.double().numpy()[:, None].astype(np.longdouble) - points.double().numpy()[None]
    return np.sqrt((difference**2).sum(axis=2)).min(axis=1)


def assert_exact(query, points, backend):
    """Right to the last bits, and the distance is the one to the point that the index names."""
    found = nearest(query, points, backend=backend)
    expected = brute_force(query, points)
    np.testing.assert_allclose(found.distance.double().numpy(), expected, rtol=ULPS[found.distance.dtype], atol=0)
    named = (query.double() - points[found.index].double()).norm(dim=1).to(found.distance.dtype)
    torch.testing.assert_close(found.distance, named, rtol=ULPS[found.distance.dtype], atol=0)


# What is found


@backends
def test_a_case_by_hand(backend):
    points = cloud([0, 0, 0], [10, 0, 0], [0, 10, 0])
    distance, index = nearest(cloud([9, 0, 0], [3, 4, 0], [0, 8, 1]), points, backend=backend)
    torch.testing.assert_close(distance, torch.tensor([1.0, 5.0, math.sqrt(5.0)]))
    assert index.tolist() == [1, 0, 2]
    assert index.dtype == torch.int64


@backends
@pytest.mark.parametrize("counts", [(1, 1), (7, 1), (1, 300), (50, 255), (50, 256), (50, 257), (300, 5000)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_points(backend, counts, dtype):
    assert_exact(random_cloud(counts[0], 1, dtype=dtype), random_cloud(counts[1], 2, dtype=dtype), backend)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    counts=st.tuples(st.integers(1, 60), st.integers(1, 700)),
    offset=st.sampled_from([0.0, 1.0, 1e3, 5e6]),
    scale=st.sampled_from([1e-6, 1e-2, 1.0, 1e4]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_every_backend_agrees_with_brute_force(seed, counts, offset, scale, dtype):
    query = (random_cloud(counts[0], seed, scale, torch.float64) + offset).to(dtype)
    points = (random_cloud(counts[1], seed + 1, scale, torch.float64) + offset).to(dtype)
    for backend in INSTALLED:
        assert_exact(query, points, backend)


@backends
def test_ties_return_one_of_the_nearest_points(backend):
    points = cloud([1, 0, 0], [-1, 0, 0], [0, 1, 0], [5, 5, 5])
    distance, index = nearest(cloud([0, 0, 0]), points, backend=backend)
    assert distance.item() == 1.0
    assert index.item() in (0, 1, 2)


@backends
@pytest.mark.parametrize("count", [2, 1000])
def test_all_points_equal(backend, count):
    distance, index = nearest(cloud([3, 4, 0], [0, 0, 0]), torch.zeros(count, 3), backend=backend)
    assert distance.tolist() == [5.0, 0.0]
    assert ((index >= 0) & (index < count)).all()


@backends
def test_duplicates_among_other_points(backend):
    points = random_cloud(400, 3).repeat(3, 1)
    distance, index = nearest(points, points, backend=backend)
    assert (distance == 0).all()
    assert torch.equal(points[index], points)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_trees_of_many_equal_points_use_distinct_ones(monkeypatch, dtype):
    """It cannot split equal points, and queries near them would look through all of them."""
    built = []

    def noted(points, **settings):
        built.append(len(points))
        return KDTree(points, **settings)

    monkeypatch.setattr("torchcover.neighbors.kdtree.KDTree", noted)
    random = torch.Generator().manual_seed(4)
    query, distinct = (torch.rand(count, 3, generator=random, dtype=dtype) - 0.5 for count in (300, 2000))
    zeros = torch.zeros(3000, 3, dtype=dtype)
    zeros[1::2] = -0.0
    points = torch.cat([zeros, distinct, zeros])
    expected = nearest(query, points, backend="cdist").distance
    found = nearest(query, points, backend="kdtree")
    assert torch.equal(found.distance, expected)
    assert torch.equal((query.double() - points[found.index].double()).norm(dim=1).to(dtype), expected)
    near = nearest(query, points, max_distance=0.05, backend="kdtree")
    assert torch.equal(near.index >= 0, expected <= 0.05)
    nearest(query, distinct, backend="kdtree")
    assert built == [2001, 2001, 2000]


@backends
def test_no_query_and_no_point(backend):
    none = torch.zeros(0, 3)
    distance, index = nearest(none, random_cloud(5, 0), backend=backend)
    assert (distance.shape, index.shape, index.dtype) == ((0,), (0,), torch.int64)
    distance, index = nearest(random_cloud(2, 0), none, backend=backend)
    assert distance.tolist() == [math.inf, math.inf]
    assert index.tolist() == [-1, -1]
    assert nearest(none, none, backend=backend).distance.shape == (0,)


# Types, strides, extents


@backends
@pytest.mark.parametrize("query_dtype", DTYPES)
@pytest.mark.parametrize("points_dtype", DTYPES)
def test_types_are_widened_exactly(backend, query_dtype, points_dtype):
    query, points = random_cloud(20, 4).to(query_dtype), random_cloud(500, 5).to(points_dtype)
    distance, _ = nearest(query, points, backend=backend)
    wider = torch.float64 if torch.float64 in (query_dtype, points_dtype) else torch.float32
    assert distance.dtype == wider
    np.testing.assert_allclose(distance.double().numpy(), brute_force(query, points), rtol=ULPS[wider])


@backends
def test_views_with_any_strides(backend):
    query, points = random_cloud(40, 6), random_cloud(900, 7)
    expected = nearest(query, points, backend=backend)
    strided = nearest(query.T.contiguous().T, torch.cat([points, points], 1)[:, 3:], backend=backend)
    reverse = nearest(query.flip(0)[:, [2, 1, 0]], points[:, [2, 1, 0]], backend=backend)
    expanded = nearest(query[:1].expand(5, 3), points[::2], backend=backend)
    assert torch.equal(strided.distance, expected.distance)
    torch.testing.assert_close(reverse.distance.flip(0), expected.distance, rtol=ULPS[torch.float32], atol=0)
    assert torch.equal(expanded.distance, nearest(query[:1], points[::2], backend=backend).distance.expand(5))


@backends
@pytest.mark.parametrize(
    ("scale", "dtype"),
    [
        (1e30, torch.float32),
        (1e-30, torch.float32),
        (1e-41, torch.float32),  # subnormal
        (1e200, torch.float64),
        (1e-200, torch.float64),
        (1e-310, torch.float64),  # subnormal
    ],
)
def test_extents_with_overflowing_squares_are_exact(backend, scale, dtype):
    query, points = random_cloud(30, 8, dtype=torch.float64), random_cloud(400, 9, dtype=torch.float64)
    query, points = (query * scale).to(dtype), (points * scale).to(dtype)
    # Scaled back to 1 by powers of two, without rounding.
    up = 2.0 ** -(math.frexp(scale)[1] // 2)
    expected = brute_force(query.double() * up * up, points.double() * up * up) / up / up
    distance, _ = nearest(query, points, backend=backend)
    resolution = float(torch.finfo(dtype).smallest_normal * torch.finfo(dtype).eps)
    np.testing.assert_allclose(distance.double().numpy(), expected, rtol=ULPS[dtype], atol=2 * resolution)
    assert (distance > 0).all()


@pytest.mark.parametrize("scale", [2.0**exponent for exponent in (-1000, -600, -599, 300, 301, 1000)])
def test_search_scales_by_powers_of_two(scale):
    """Not a bit is rounded, so that not a tie is broken."""
    query, points = (random_cloud(count, count, dtype=torch.float32).double() for count in (30, 40))
    *scaled, reach = _rescale(query * scale, points * scale, 3.0 * scale)
    ratio = reach / 3.0
    assert math.frexp(ratio)[0] == 0.5
    assert all(torch.equal(one, cloud * ratio) for one, cloud in zip(scaled, (query, points), strict=True))
    assert 0.5 <= max(float(cloud.abs().max()) for cloud in scaled) < 1.0


@backends
def test_a_far_point_does_not_spoil_the_others(backend):
    points = cloud([2, 0, 0], [1, 0, 0], [1e30, 0, 0])
    assert nearest(cloud([0, 0, 0]), points, backend=backend).distance.item() == 1.0
    wide = cloud([0, 0, 0], [1e200, 0, 0], dtype=torch.float64)
    distance = nearest(wide, cloud([1e-5, 0, 0], dtype=torch.float64), backend=backend).distance
    assert distance.tolist() == [1e-5, 1e200]


@backends
@pytest.mark.parametrize(("far", "dtype"), [(3e38, torch.float32), (1.7e308, torch.float64)])
def test_overflowing_distances_are_infinite_and_still_found(backend, far, dtype):
    distance, index = nearest(cloud([far, 0, 0], dtype=dtype), cloud([-far, 0, 0], dtype=dtype), backend=backend)
    assert (distance.item(), index.item()) == (math.inf, 0)


@backends
def test_wide_clouds_keep_fine_detail_near_origins(backend):
    """Centring the cloud would round the small coordinates away."""
    detail = random_cloud(2000, 10, scale=1e-6)
    points = torch.cat([detail, random_cloud(3000, 11, scale=1.0) + 100.0])
    assert_exact(random_cloud(300, 12, scale=1e-6), points, backend)


@backends
def test_a_utm_offset_in_float64_costs_no_precision(backend):
    """Trap 7: the same clouds with and without an offset of 5e6 m, both representable."""
    query, points = random_cloud(50, 13).round(decimals=3), random_cloud(600, 14).round(decimals=3)
    query, points = (query.double() * 1024).round() / 1024, (points.double() * 1024).round() / 1024
    offset = torch.tensor([4.5e5, 5.4e6, 300.0], dtype=torch.float64)
    here, there = nearest(query, points, backend=backend), nearest(query + offset, points + offset, backend=backend)
    assert torch.equal(here.distance, there.distance)


# Within max_distance


@backends
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("limit", [0.0, 1e-45, 1e-25, 0.1, 0.4, 1.0, 3.3e7])
def test_max_distance_is_inclusive(backend, limit, dtype):
    points = cloud([limit, 0, 0], [9e7, 0, 0], dtype=dtype)
    at, index = nearest(cloud([0, 0, 0], dtype=dtype), points, max_distance=limit, backend=backend)
    assert (at.item(), index.item()) == (torch.tensor(limit, dtype=dtype).item(), 0)
    beyond = torch.nextafter(points, torch.tensor(math.inf, dtype=dtype))[:1]
    out, index = nearest(cloud([0, 0, 0], dtype=dtype), beyond, max_distance=limit, backend=backend)
    assert (out.item(), index.item()) == (math.inf, -1)


@backends
@pytest.mark.parametrize("limit", [0.5, 2.0, 8.0, 1e300])
def test_max_distance_only_masks_results(backend, limit):
    query, points = random_cloud(200, 15), random_cloud(800, 16)
    everything = nearest(query, points, backend=backend)
    bounded = nearest(query, points, max_distance=limit, backend=backend)
    within = everything.distance <= limit
    assert torch.equal(bounded.distance, everything.distance.where(within, math.inf))
    assert torch.equal(bounded.index, everything.index.where(within, -1))


@backends
@pytest.mark.parametrize(
    ("scale", "dtype"), [(2.0**100, torch.float32), (2.0**665, torch.float64), (2.0**-665, torch.float64)]
)
def test_max_distance_with_coordinates_of_any_size(backend, scale, dtype):
    query = cloud([0, 0, 0], [1, 0, 0], dtype=dtype) * scale
    points = cloud([0.125, 0, 0], [1, 0.25, 0], dtype=dtype) * scale
    for limit, index in ((0.0625, [-1, -1]), (0.125, [0, -1]), (0.25, [0, 1])):
        assert nearest(query, points, max_distance=limit * scale, backend=backend).index.tolist() == index


# Laws


def rotation(seed):
    q, _ = torch.linalg.qr(random_cloud(3, seed, dtype=torch.float64))
    return q


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32), backend=st.sampled_from(INSTALLED))
def test_distances_are_invariant_to_frame_and_order(seed, backend):
    query, points = random_cloud(30, seed, dtype=torch.float64), random_cloud(300, seed + 1, dtype=torch.float64)
    turn, shift = rotation(seed + 2), random_cloud(1, seed + 3, dtype=torch.float64)
    expected = nearest(query, points, backend=backend).distance
    moved = nearest(query @ turn + shift, points @ turn + shift, backend=backend).distance
    torch.testing.assert_close(moved, expected, rtol=1e-11, atol=1e-12)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(seed))
    shuffled = nearest(query.flip(0), points[order], backend=backend)
    torch.testing.assert_close(shuffled.distance.flip(0), expected, rtol=1e-15, atol=0)


@backends
def test_the_inputs_are_bit_equal_afterwards(backend):
    query, points = random_cloud(300, 17), random_cloud(3000, 18)
    before = query.clone(), points.clone()
    nearest(query, points, backend=backend)
    nearest(query * 1e30, points, backend=backend)
    blind_spot_radius(points, query, max_radius=1.0, backend=backend)
    assert torch.equal(query, before[0])
    assert torch.equal(points, before[1])


def test_backends_agree_under_autocast():
    """Coordinates in bfloat16 would pick wrong neighbours."""
    query, points = random_cloud(300, 19), random_cloud(3000, 20)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for backend in INSTALLED:
            assert_exact(query, points, backend)


@pytest.mark.parametrize(
    ("counts", "dtype", "chosen"),
    [
        ((1, 10_000), torch.float32, "kdtree"),
        ((17_000, 100), torch.float32, "packets"),
        ((100, 700_000), torch.float32, "packets"),
        ((17_000, 100), torch.float64, "kdtree"),
        ((6_000, 300_000), torch.float32, "kdtree"),
        ((1, 1), torch.float32, "kdtree"),
        ((16, 700_000), torch.float32, "packets"),
    ],
)
def test_auto_chooses_packets_where_loading_pays(counts, dtype, chosen, monkeypatch):
    """Stood in for by what any machine has: which is chosen, not what it finds."""
    monkeypatch.setattr(backend_choice, "_can_search", lambda *_: True)
    for name in BACKENDS.keys() - {chosen}:
        monkeypatch.setitem(BACKENDS, name, f"not.chosen.{name}")
    monkeypatch.setitem(BACKENDS, chosen, "torchcover.neighbors.cdist")
    clouds = (random_cloud(count, 21, dtype=dtype) for count in counts)
    assert backend_choice.choose_search(*clouds, "auto") is cdist.search


@pytest.mark.parametrize(("scale", "chosen"), [((1, 0, 0), False), ((1, 1, 0), False), ((1, 1, 1), True)])
def test_packets_do_not_pay_around_lines_or_planes(scale, chosen, monkeypatch):
    """All of a packet's queries are compared with what is near any of them; flat boxes of the tree are soon passed."""
    monkeypatch.setattr(backend_choice, "_can_search", lambda *_: True)
    query, points = random_cloud(100_000, 22), random_cloud(300_000, 23) * torch.tensor(scale, dtype=torch.float32)
    assert (backend_choice.choose_shared_backend(query, [points]) == "packets") is chosen
    assert backend_choice.choose_shared_backend(points, [points]) == "packets"  # queries among them are near few


def test_packets_pay_in_many_clouds(monkeypatch):
    monkeypatch.setattr(backend_choice, "_can_search", lambda *_: True)
    query, points = random_cloud(2_000, 24), random_cloud(100, 25)
    assert backend_choice.choose_shared_backend(query, [points]) != "packets"
    assert backend_choice.choose_shared_backend(query, [points] * 20) == "packets"


def test_packets_are_fast_within_one_plane():
    query, points = (random_cloud(10_000, seed) * torch.tensor([1.0, 1.0, 0.0]) for seed in (28, 29))
    assert backend_choice._estimate_packet_loss_s(query, points) == 0.0


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_estimated_loss_does_not_depend_on_units(scale):
    query, points = random_cloud(10_000, 26), random_cloud(10_000, 27) * torch.tensor([1.0, 1.0, 0.0])
    lost_s = backend_choice._estimate_packet_loss_s(query, points)
    assert lost_s > 0.0
    assert backend_choice._estimate_packet_loss_s(query * scale, points * scale) == pytest.approx(lost_s, rel=1e-5)


@pytest.mark.parametrize("counts", [(0, 700_000), (17_000, 0)])
def test_empty_clouds_have_no_estimated_loss(counts, monkeypatch):
    monkeypatch.setattr(backend_choice, "_can_search", lambda *_: True)
    query, points = (torch.zeros(count, 3) for count in counts)
    assert backend_choice.choose_shared_backend(query, [points]) == "packets"


def box_of(extent, count, low=(5.0, -20.0, 300.0)):
    """Half of the points at each end of a box: all that its extent is told by."""
    ends = torch.tensor([low, low]) + torch.tensor([[0.0, 0.0, 0.0], extent])
    return ends.repeat_interleave(count // 2, dim=0)


@pytest.mark.parametrize(
    ("asked", "at", "extent", "share"),
    [
        ((160.0, 62.5, 100.0), (0.0, 0.0, 10.0), (80.0, 160.0, 0.0), 0.5 * 0.25),
        ((160.0, 62.5, 100.0), (0.0, 0.0, 90.0), (80.0, 20.0, 0.0), 0.5),
        ((160.0, 62.5, 100.0), (0.0, 54.0, 28.0), (400.0, 0.0, 0.0), 0.1),
        ((1000.0, 100.0, 0.0), (0.0, 90.0, 0.0), (80.0, 0.0, 0.0), 0.5),
        ((20.0, 50.0, 1000.0), (0.0, 0.0, 100.0), (20.0, 20.0, 1.0), 1.0),  # as thick as a thousandth: in a plane
        ((20.0, 50.0, 1000.0), (0.0, 0.0, 100.0), (20.0, 20.0, 1.0625), 0.0),
    ],
)
def test_estimated_loss_equals_a_hand_computation(asked, at, extent, share):
    """64 of 64,000 queries are 10 m wide, the farthest points 90 m away: the next 10 + sqrt(2 * 45 * 10) m are near."""
    query = box_of(asked, 64_000)
    points = box_of(extent, 2, tuple(float(c) for c in query[0] + torch.tensor(at)))
    assert backend_choice._estimate_packet_loss_s(query, points) == pytest.approx(
        backend_choice.BackendParams().time_per_pair_s * 64_000 * 2 * share, rel=1e-5
    )


@pytest.mark.parametrize(("count", "chosen"), [(28_000, "packets"), (30_000, "auto")])
def test_packets_are_chosen_until_losses_exceed_gains(count, chosen, monkeypatch):
    monkeypatch.setattr(backend_choice, "_can_search", lambda *_: True)
    query, points = box_of((160.0, 62.5, 100.0), 64_000), box_of((80.0, 160.0, 0.0), count, (5.0, -20.0, 310.0))
    assert backend_choice.choose_shared_backend(query, [points]) == chosen


@pytest.fixture
def untried():
    """Whether numba and Warp work is asked anew, and afterwards again."""
    backend_choice._can_search.cache_clear()
    yield
    backend_choice._can_search.cache_clear()


LARGE = (random_cloud(17_000, 50), random_cloud(200, 51))


def test_without_numba_the_tree_searches_and_logs(monkeypatch, caplog, untried):
    monkeypatch.setitem(BACKENDS, "packets", "no.such.module")
    with caplog.at_level("INFO", logger="torchcover"):
        found = [nearest(*LARGE) for _ in range(2)]
    expected = nearest(*LARGE, backend="kdtree")
    assert all(torch.equal(each.index, expected.index) for each in found)
    (line,) = caplog.messages
    assert "the KD-tree searches" in line
    assert "pip install 'torchcover[fast]'" in line


def test_broken_numba_warns_once_and_uses_trees(monkeypatch, tmp_path, untried):
    (tmp_path / "broken_backend.py").write_text("raise OSError('libllvm: no such file\\nand a trace')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(BACKENDS, "packets", "broken_backend")
    with pytest.warns(UserWarning, match="the KD-tree searches, as backend 'packets' .*libllvm: no such file$") as said:
        found = [nearest(*LARGE) for _ in range(2)]
    assert len(said) == 1
    assert torch.equal(found[0].index, nearest(*LARGE, backend="kdtree").index)


# Gradients


@backends
def test_gradients_agree_with_finite_differences(backend):
    query, points = random_cloud(6, 23, dtype=torch.float64), random_cloud(15, 24, dtype=torch.float64)
    inputs = query.requires_grad_(), points.requires_grad_()
    assert torch.autograd.gradcheck(lambda q, p: nearest(q, p, backend=backend).distance, inputs)
    assert torch.autograd.gradcheck(lambda q, p: blind_spot_radius(p, q, max_radius=8.0, backend=backend), inputs)


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_are_the_same_for_every_backend(dtype):
    gradients = []
    for backend in INSTALLED:
        query = random_cloud(50, 25).to(dtype).requires_grad_()
        points = random_cloud(700, 26).to(dtype).requires_grad_()
        nearest(query, points, backend=backend).distance.sum().backward()
        gradients.append((query.grad, points.grad))
    for others in gradients[1:]:
        assert all(torch.equal(a, b) for a, b in zip(gradients[0], others, strict=True))
    torch.testing.assert_close(gradients[0][0].double().norm(dim=1), torch.ones(50).double(), rtol=1e-2, atol=0)


@backends
def test_the_gradient_at_distance_zero_is_zero(backend):
    query = cloud([1, 2, 3], [0, 0, 1]).requires_grad_()
    points = cloud([1, 2, 3], [0, 0, 3]).requires_grad_()
    nearest(query, points, backend=backend).distance.sum().backward()
    assert query.grad.tolist() == [[0, 0, 0], [0, 0, -1]]
    assert points.grad.tolist() == [[0, 0, 0], [0, 0, 1]]


@backends
def test_what_is_out_of_reach_has_no_gradient(backend):
    query = cloud([0, 0, 0], [5, 0, 0]).requires_grad_()
    points = cloud([1, 0, 0]).requires_grad_()
    radius = blind_spot_radius(points, query, max_radius=2.0, backend=backend)
    radius.sum().backward()
    assert radius.tolist() == [1.0, 2.0]
    assert query.grad.tolist() == [[-1, 0, 0], [0, 0, 0]]
    assert points.grad.tolist() == [[1, 0, 0]]


@backends
def test_no_points_and_a_gradient(backend):
    query = cloud([0, 0, 0]).requires_grad_()
    assert nearest(query, torch.zeros(0, 3), backend=backend).distance.item() == math.inf


# The blind spot radius


@backends
def test_one_sensor_point_gives_the_distance_to_it(backend):
    x, y = torch.meshgrid(torch.arange(-20.0, 20.0), torch.arange(-20.0, 20.0), indexing="ij")
    plane = torch.stack([x.flatten(), y.flatten(), torch.zeros(1600)], dim=1)
    radius = blind_spot_radius(cloud([3, -4, 2]), plane, backend=backend)
    torch.testing.assert_close(radius, ((plane[:, 0] - 3) ** 2 + (plane[:, 1] + 4) ** 2 + 4).sqrt())


@backends
def test_an_empty_sensor_cloud_is_blind(backend):
    reference = random_cloud(3, 27)
    assert blind_spot_radius(torch.zeros(0, 3), reference, backend=backend).tolist() == [math.inf] * 3
    saturated = blind_spot_radius(torch.zeros(0, 3), reference, max_radius=7.0, backend=backend)
    assert saturated.tolist() == [7.0] * 3
    assert blind_spot_radius(reference, torch.zeros(0, 3), backend=backend).shape == (0,)


@backends
@pytest.mark.parametrize("max_radius", [0.0, 0.4, 2.0, 1e39, 1e300, math.inf])
def test_max_radius_saturates(backend, max_radius):
    query, points = random_cloud(100, 28), random_cloud(200, 29)
    expected = torch.minimum(nearest(query, points, backend=backend).distance, torch.tensor(max_radius))
    assert torch.equal(blind_spot_radius(points, query, max_radius=max_radius, backend=backend), expected)


# Trap 5


@pytest.mark.parametrize("offset", [1e3, 1e5])
def test_small_distances_survive_without_matrix_products(offset):
    """pytorch issues 42479 and 57690: ||q||^2 - 2 q.p + ||p||^2 cancels."""
    step = 2.0**-6
    line = torch.zeros(400, 3)
    line[:, 0] = offset + torch.arange(400) * step
    query = line + torch.tensor([0, 0.5 * step, 0])
    truth = brute_force(query, line)
    by_product = torch.cdist(query, line, compute_mode="use_mm_for_euclid_dist").min(dim=1).values
    assert np.abs(by_product.double().numpy() - truth).max() > 0.3 * truth.max()
    for backend in INSTALLED:
        np.testing.assert_allclose(nearest(query, line, backend=backend).distance.numpy(), truth, rtol=1e-6)


# What is refused


@backends
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("function", "names"), [(nearest, ("query", "points")), (blind_spot_radius, ("sensor", "reference"))]
)
def test_coordinates_that_are_not_finite_are_refused(backend, value, function, names):
    good, bad = random_cloud(5, 30), random_cloud(4, 31)
    bad[1, 2] = bad[3, 0] = bad[3, 1] = value
    for clouds, name in (((bad, good), names[0]), ((good, bad), names[1])):
        with pytest.raises(ValueError, match=f"^{name}: 2 of 4 points have NaN or infinite coordinates"):
            function(*clouds, backend=backend)


@backends
@pytest.mark.parametrize("shape", [(3,), (4, 2), (4, 4), (1, 4, 3), ()])
def test_other_shapes_are_refused(backend, shape):
    message = rf"points: shape \(N, 3\) is needed; got \({', '.join(map(str, shape))}"
    with pytest.raises(ValueError, match=message):
        nearest(random_cloud(4, 32), torch.zeros(shape), backend=backend)


@pytest.mark.parametrize(
    ("bad", "arrived"),
    [
        (torch.zeros(2, 3, dtype=torch.int32), "torch.int32"),
        (torch.zeros(2, 3, dtype=torch.complex64), "torch.complex64"),
        (np.zeros((2, 3)), "a NumPy array of float64"),
        ([[0.0, 0.0, 0.0]], "list"),
    ],
)
def test_other_types_are_refused(bad, arrived):
    with pytest.raises(TypeError, match=f"query: a floating-point torch tensor is needed; got {arrived}"):
        nearest(bad, random_cloud(2, 33))
    with pytest.raises(TypeError, match=f"mine: .* got {arrived}"):
        check_cloud(bad, "mine")


@pytest.mark.parametrize("limit", [-1.0, math.nan])
def test_invalid_max_distances_are_rejected(limit):
    with pytest.raises(ValueError, match=f"max_distance .*>= 0 is needed; got {limit}"):
        nearest(random_cloud(2, 34), random_cloud(2, 35), max_distance=limit)
    with pytest.raises(ValueError, match=r"max_radius.* >= 0 is needed"):
        blind_spot_radius(random_cloud(2, 35), random_cloud(2, 34), max_radius=limit)


@pytest.mark.parametrize("budget", [0.0, -1.0, math.nan])
def test_a_memory_budget_that_is_none_is_refused(budget):
    with pytest.raises(ValueError, match=f"memory_mb: a positive number of megabytes is needed; got {budget}"):
        nearest(random_cloud(2, 36), random_cloud(2, 37), memory_mb=budget)


def test_unknown_backends_are_rejected_with_a_list():
    with pytest.raises(ValueError, match="backend: one of auto, cdist, kdtree, packets, warp is needed; got 'faiss'"):
        nearest(random_cloud(2, 38), random_cloud(2, 39), backend="faiss")


def on_another_device(count, name="meta"):
    """A tensor that is not on the CPU, on any machine; its coordinates pass as finite."""

    class Elsewhere(torch.Tensor):
        device = torch.device(name)

    return torch.zeros(count, 3).as_subclass(Elsewhere)


def test_two_devices_are_refused():
    with pytest.raises(ValueError, match="the clouds are on cpu and on meta; move them to one device"):
        nearest(random_cloud(2, 40), on_another_device(2))


@pytest.mark.parametrize(("backend", "kinds"), [("kdtree", "cpu"), ("packets", "cpu"), ("warp", "cpu and cuda")])
def test_the_trees_are_not_for_any_device(backend, kinds):
    with pytest.raises(ValueError, match=f"backend '{backend}' runs on {kinds}; the clouds are on meta"):
        nearest(on_another_device(2), on_another_device(3), backend=backend)


# Without a GPU: which backend is chosen for one, and what is said. Never run on one.


@pytest.fixture
def unsaid():
    backend_choice._warn_about_cpu_search.cache_clear()
    yield
    backend_choice._warn_about_cpu_search.cache_clear()


@pytest.mark.parametrize(
    ("device", "faster"), [("meta", "all pairs"), ("cuda", "all pairs; faster still: .*torchcover.warp.*")]
)
def test_many_pairs_move_to_the_cpu_once_logged(monkeypatch, unsaid, device, faster):
    params = backend_choice.BackendParams(max_device_pairs=5)
    monkeypatch.setattr(backend_choice, "_can_search", lambda backend, *_: backend != "warp")
    few, many = ([on_another_device(count, device) for count in counts] for counts in ((1, 5), (2, 3)))
    assert backend_choice.choose_search(*few, "auto", params) is cdist.search
    said = f"clouds on {device} with more than 5 pairs are searched on the CPU, .* than comparing {faster}$"
    with pytest.warns(UserWarning, match=said) as warned:
        searches = [backend_choice.choose_search(*many, "auto", params) for _ in range(2)]
    assert len(warned) == 1
    query, points = random_cloud(20, 60), random_cloud(300, 61)
    expected = nearest(query, points, backend="kdtree").index
    assert all(torch.equal(search(query, points, math.inf, 1.0), expected) for search in searches)


@pytest.mark.parametrize(("device", "chosen"), [("cuda", "warp"), ("meta", "cdist")])
def test_auto_takes_warp_on_cuda_alone(monkeypatch, device, chosen):
    """Stood in for by what any machine has."""
    asked = []
    monkeypatch.setattr(backend_choice, "_can_search", lambda *what: asked.append(what[:2]) or True)
    monkeypatch.setitem(BACKENDS, "warp", "not.chosen.warp")
    monkeypatch.setitem(BACKENDS, chosen, "torchcover.neighbors.kdtree")
    search = backend_choice.choose_search(on_another_device(9, device), on_another_device(9, device), "auto")
    assert search is kdtree.search
    assert asked == [("warp", torch.device("cuda"))] * (device == "cuda")


def test_without_warp_the_log_names_the_package(monkeypatch, caplog, untried):
    monkeypatch.setitem(BACKENDS, "warp", "no.such.module")
    with caplog.at_level("INFO", logger="torchcover"):
        works = [backend_choice._can_search("warp", torch.device("cpu"), "others search") for _ in range(2)]
    assert works == [False, False]
    (line,) = caplog.messages
    assert line.startswith("nearest: others search; warp is faster: pip install 'torchcover[warp]'")


def test_unusable_warp_is_skipped_and_logged_once(monkeypatch, untried):
    """As on a GPU of another make, which torch calls cuda too. On `meta`, where there are no numbers to search."""
    monkeypatch.setitem(BACKENDS, "warp", "torchcover.neighbors.kdtree")
    with pytest.warns(UserWarning, match="^nearest: others search, as backend 'warp' does not work here: ") as said:
        works = [backend_choice._can_search("warp", torch.device("meta"), "others search") for _ in range(2)]
    assert works == [False, False]
    assert len(said) == 1


@pytest.mark.parametrize(("backend", "extra"), [("packets", "fast"), ("warp", "warp")])
def test_broken_requested_backends_raise_one_line(monkeypatch, tmp_path, backend, extra):
    (tmp_path / "broken_backend.py").write_text("raise OSError('libllvm: no such file\\nand a trace')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(BACKENDS, backend, "broken_backend")
    with pytest.raises(ImportError) as raised:
        nearest(*LARGE, backend=backend)
    assert str(raised.value) == (
        f"backend '{backend}' does not work here (libllvm: no such file); try 'auto', or reinstall it: "
        f"pip install 'torchcover[{extra}]'"
    )


# Where pairs are compared on a GPU


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_by_squared_differences_the_same_are_nearest(monkeypatch, dtype, scale):
    monkeypatch.setattr(cdist, "_compute_distances", cdist._compute_squared_distances)
    assert_exact(random_cloud(300, 70, scale, dtype), random_cloud(500, 71, scale, dtype), "cdist")


# Where the memory of a GPU is too small


class SmallMemory:
    """A search that can be asked so many queries at a time, within so many megabytes."""

    def __init__(self, most, search):
        self.most, self.search, self.parts = most, search, []

    def __call__(self, query, points, max_distance, memory_mb):
        if len(query) > self.most:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 7.00 GiB.\nGPU 0 has ...")
        self.parts.append((len(query), memory_mb))
        return self.search(query, points, max_distance, memory_mb)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_queries_are_split_when_memory_runs_out(monkeypatch, dtype):
    query, points = random_cloud(5001, 62, dtype=dtype), random_cloud(400, 63, dtype=dtype)
    inputs = [cloud.requires_grad_() for cloud in (query, points)]
    expected = nearest(query, points, max_distance=9.0)
    expected_gradients = torch.autograd.grad(expected.distance.nan_to_num(posinf=0).sum(), inputs)
    small = SmallMemory(1300, kdtree.search)
    monkeypatch.setattr("torchcover.neighbors.query.choose_search", lambda *_: small)
    found = nearest(query, points, max_distance=9.0, memory_mb=8.0)
    gradients = torch.autograd.grad(found.distance.nan_to_num(posinf=0).sum(), inputs)
    assert small.parts == [(1251, 2.0)] * 3 + [(1248, 2.0)]
    assert torch.equal(found.index, expected.index)
    assert torch.equal(found.distance, expected.distance)
    torch.testing.assert_close(gradients, expected_gradients, rtol=1e-6, atol=1e-6)


def test_few_queries_out_of_memory_raise_the_size(monkeypatch):
    monkeypatch.setattr("torchcover.neighbors.query.choose_search", lambda *_: SmallMemory(0, kdtree.search))
    said = (
        "^cpu: not enough memory to search 400 points for 3,000 queries, 750 at a time: CUDA out of memory.*7.00 GiB.$"
    )
    with pytest.raises(MemoryError, match=said):
        nearest(random_cloud(3000, 64), random_cloud(400, 65))


# Traced and transformed by torch


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")
def test_transforms_of_torch_give_what_eager_code_gives():
    query, points = random_cloud(50, 66), random_cloud(40, 67)
    wanted = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(blind_spot_radius(wanted, query).sum(), wanted)

    def total(points, **options):
        return blind_spot_radius(points, query, **options).sum()

    for backend in ("auto", "cdist", "kdtree", "packets"):
        torch.testing.assert_close(torch.func.grad(partial(total, backend=backend))(points), gradient)
        _, along = torch.func.jvp(partial(total, backend=backend), (points,), (torch.ones_like(points),))
        torch.testing.assert_close(along, gradient.sum())
        both = torch.stack([points, points + 0.5])
        each = torch.vmap(partial(blind_spot_radius, reference=query, backend=backend))(both)
        assert torch.equal(each, torch.stack([blind_spot_radius(cloud, query, backend=backend) for cloud in both]))
    assert torch.equal(
        torch.vmap(nearest, in_dims=(1, None))(query[:, None], points).index, nearest(query, points).index[None]
    )
    second = torch.func.hessian(total)(points)
    assert second.isfinite().all()
    assert second.abs().sum() > 0


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")
def test_compiled_code_equals_eager_code(untried):
    compiled = torch.compile(
        lambda query, points: nearest(query, points, max_distance=0.3), backend="eager", fullgraph=True
    )
    for count in (40, 50, 0):
        query, points = random_cloud(30, 68), random_cloud(count, 69)
        for found, expected in zip(compiled(query, points), nearest(query, points, max_distance=0.3), strict=True):
            assert torch.equal(found, expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # such as that packets do not work here
        compiled(*LARGE)
        assert nearest(*LARGE).distance.isfinite().all()
    with pytest.raises(ValueError, match="points: 1 of 40 points have NaN"):
        compiled(query, torch.cat([random_cloud(39, 70), torch.full((1, 3), math.nan)]))
