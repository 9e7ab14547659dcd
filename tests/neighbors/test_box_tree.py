"""What the walk relies on: every point in a leaf, every box around what is beneath it, and leaves that are small."""

import pytest
import torch

from torchcover.neighbors.box_tree import (
    AXIS_CELLS,
    LEAF_SIZE,
    NO_INDEX,
    SPREAD_STEPS,
    build_box_tree,
    compute_morton_order,
)


def random_cloud(count, seed, dtype=torch.float32):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) * 100 - 50


@pytest.mark.parametrize("count", [1, LEAF_SIZE, LEAF_SIZE + 1, 3 * LEAF_SIZE, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_boxes_and_smallest_numbers_are_of_all_beneath(count, dtype):
    points = random_cloud(count, count, dtype)
    tree = build_box_tree(points)
    assert tree.point_indices.unique().tolist() == list(range(count))
    assert torch.equal(tree.points, points[tree.point_indices])
    first = len(tree.boxes) // 2
    assert first.bit_count() == 1
    leaves = list(zip(tree.points.split(LEAF_SIZE), tree.point_indices.split(LEAF_SIZE), strict=True))
    assert len(leaves) == -(-count // LEAF_SIZE) <= first
    for node in range(1, 2 * first):
        depth = first.bit_length() - node.bit_length()
        beneath = leaves[(node << depth) - first : ((node + 1) << depth) - first]
        if not beneath:
            assert tree.boxes[node].tolist() == [torch.inf] * 3 + [-torch.inf] * 3
            assert tree.min_point_indices[node] == NO_INDEX
            continue
        cloud, numbers = (torch.cat(parts) for parts in zip(*beneath, strict=True))
        assert torch.equal(tree.boxes[node], torch.cat([cloud.amin(dim=0), cloud.amax(dim=0)]))
        assert tree.min_point_indices[node] == numbers.min()


def leaf_sizes(cloud):
    """The diagonals of the boxes around every `LEAF_SIZE` points in order."""
    leaves = cloud[compute_morton_order(cloud)][: len(cloud) // LEAF_SIZE * LEAF_SIZE].view(-1, LEAF_SIZE, 3)
    return (leaves.amax(dim=1) - leaves.amin(dim=1)).double().norm(dim=1)


@pytest.mark.parametrize("far_m", [1e6, 1e9])
def test_points_far_away_do_not_coarsen_the_order(far_m):
    cloud = random_cloud(20_000, 1)
    alone = leaf_sizes(cloud).median()
    assert leaf_sizes(torch.cat([cloud, far_m * random_cloud(100, 2)])).median() < 1.2 * alone
    assert alone < 1.5 * (LEAF_SIZE / len(cloud)) ** (1 / 3) * 3**0.5 * 100


def test_cells_are_spread_to_every_third_bit():
    cell = torch.randint(AXIS_CELLS, (500,), generator=torch.Generator().manual_seed(6))
    spread = cell
    for bits, mask in SPREAD_STEPS:
        spread = (spread | (spread << bits)) & mask
    assert torch.equal(spread, sum(((cell >> bit) & 1) << (3 * bit) for bit in range(21)))


@pytest.mark.parametrize("height_m", [0.0, 1e5])
def test_equal_points_do_not_coarsen_the_order(height_m):
    above = torch.tensor([0.0, 0.0, height_m])
    sizes = leaf_sizes(torch.cat([random_cloud(3000, 3), torch.zeros(250_000, 3)]) + above)
    assert sizes[sizes > 0].mean() < 50


@pytest.mark.parametrize("count", [1, 2, 5000])
@pytest.mark.parametrize("extent", [0.0, 1e-45, 1e-38, 1e-3, 1e9])
def test_the_order_is_a_permutation(count, extent):
    for cloud in (random_cloud(count, 4) * extent, torch.full((count, 3), extent)):
        assert compute_morton_order(cloud).sort().values.tolist() == list(range(count))


def test_equal_points_keep_their_order():
    assert compute_morton_order(torch.ones(5000, 3)).tolist() == list(range(5000))


@pytest.mark.parametrize("sign", [-1, 1])
def test_outliers_are_at_an_end_of_the_curve(sign):
    cloud = torch.cat([sign * torch.full((1, 3), 1e6), random_cloud(2000, 5)])
    order = compute_morton_order(cloud)
    assert order[-1 if sign > 0 else 0] == 0
