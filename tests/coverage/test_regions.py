import math

import pytest
import torch

from torchcover import BevGrid, Region, forward_regions
from torchcover.coverage import check_regions

GRID = BevGrid(x_m=(-4.0, 4.0), y_m=(-2.0, 2.0), cell_m=0.5)


def test_the_papers_regions():
    assert [(r.name, r.x_m, r.y_m) for r in forward_regions()] == [
        ("20m", (0, 20), (-5, 5)),
        ("80m", (0, 80), (-20, 20)),
        ("160m", (0, 160), (-40, 40)),
    ]
    assert forward_regions((2.5,)) == (Region("2.5m", x_m=(0.0, 2.5), y_m=(-0.625, 0.625)),)
    assert forward_regions(()) == ()


def test_cells_belong_to_the_region_of_their_center():
    # Centers along x: ..., 0.25, 0.75, 1.25, ...; along y: -1.75, ..., 1.75.
    mask = Region("r", x_m=(0.25, 1.25), y_m=(-0.3, 0.25)).mask_cells(GRID)
    assert mask.shape == (8, 16)
    inside = [
        (GRID.y_centers_m[row].item(), GRID.x_centers_m[column].item()) for row, column in mask.nonzero().tolist()
    ]
    assert inside == [(-0.25, 0.25), (-0.25, 0.75)]  # half-open: 1.25 and y = 0.25 are out, 0.25 is in


def test_regions_of_grid_size_contain_all_cells():
    assert Region("all", x_m=GRID.x_m, y_m=GRID.y_m).mask_cells(GRID).all()


def test_small_regions_may_contain_no_cell_center():
    assert not Region("gap", x_m=(0.3, 0.7), y_m=(0.0, 1.0)).mask_cells(GRID).any()


def test_two_regions_side_by_side_share_no_cell():
    masks = [Region("r", x_m=bounds, y_m=(-2.0, 2.0)).mask_cells(GRID) for bounds in ((-4.0, 0.75), (0.75, 4.0))]
    assert torch.equal(masks[0], ~masks[1])


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (
            {"x_m": (0.0, 4.5), "y_m": (-2.0, 2.0)},
            "spans x = 0 to 4.5 m, beyond the grid's -4 to 4 m; enlarge the grid",
        ),
        ({"x_m": (-5.0, 4.0), "y_m": (-2.0, 2.0)}, "spans x = -5 to 4 m, beyond"),
        ({"x_m": (0.0, 4.0), "y_m": (-3.0, 2.0)}, "spans y = -3 to 2 m, beyond"),
        ({"x_m": (0.0, 4.0), "y_m": (-2.0, 2.5)}, "spans y = -2 to 2.5 m, beyond"),
    ],
)
def test_a_region_beyond_the_grid_is_refused(bounds, message):
    with pytest.raises(ValueError, match=f"region 'far' {message}"):
        Region("far", **bounds).mask_cells(GRID)


@pytest.mark.parametrize("bounds", [(1.0, 1.0), (2.0, 1.0), (0.0, math.inf), (-math.inf, 0.0), (math.nan, 1.0)])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_bounds_without_inside_are_refused(axis, bounds):
    with pytest.raises(ValueError, match=f"region 'r': {axis} needs finite bounds, lower first; got"):
        Region("r", **{"x_m": (0.0, 1.0), "y_m": (0.0, 1.0), f"{axis}_m": bounds})


def test_a_region_needs_a_name():
    with pytest.raises(ValueError, match="a region needs a name"):
        Region("", x_m=(0.0, 1.0), y_m=(0.0, 1.0))


def test_a_forward_region_of_no_range_is_refused():
    with pytest.raises(ValueError, match="region '-1m': x needs finite bounds"):
        forward_regions((-1.0,))


def test_regions_without_cells_are_refused_early():
    check_regions([Region("all", x_m=GRID.x_m, y_m=GRID.y_m)], GRID)
    with pytest.raises(ValueError, match="region 'gap' holds no cell center; use smaller cells than"):
        check_regions([Region("gap", x_m=(0.3, 0.7), y_m=(0.0, 1.0))], GRID)


@pytest.mark.parametrize(
    ("x", "y"), [((-4.0, 4.0), (-2.0, 2.0)), ((0.25, 1.25), (-0.3, 0.25)), ((-1.1, 0.6), (0.75, 2.0))]
)
def test_rectangles_as_polygons_equal_rectangles(x, y):
    # 0.25, -0.25 and so on are cell centers on an edge.
    corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    for order in (corners, corners[::-1], [*corners, corners[0]]):
        polygon = Region.from_corners("r", order)
        assert (polygon.x_m, polygon.y_m) == (x, y)
        assert torch.equal(polygon.mask_cells(GRID), Region("r", x, y).mask_cells(GRID))


def test_polygons_with_a_common_edge_partition_cells():
    # The edge passes through cell centers.
    left = Region.from_corners("left", [(-4.0, -2.0), (0.25, -2.0), (2.25, 2.0), (-4.0, 2.0)])
    right = Region.from_corners("right", [(0.25, -2.0), (4.0, -2.0), (4.0, 2.0), (2.25, 2.0)])
    assert torch.equal(left.mask_cells(GRID), ~right.mask_cells(GRID))
    assert 0 < left.mask_cells(GRID).sum() < 128


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)], r"its edges cross .*Self-intersection\[0.5 0.5\]"),
        ([(0.0, 0.0), (1.0, 0.0)], "three different corners or more are needed; got 2"),
        ([(0.0, 0.0), (1.0, 0.0), (math.nan, 1.0)], "corners need finite coordinates"),
    ],
)
def test_corners_that_are_no_polygon_are_refused(corners, message):
    with pytest.raises(ValueError, match=f"region 'r': {message}"):
        Region.from_corners("r", corners)


def test_a_polygon_has_the_bounds_of_its_corners():
    with pytest.raises(ValueError, match="region 'r': its corners have other bounds than"):
        Region("r", (0.0, 2.0), (0.0, 1.0), ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))


def test_a_name_is_given_once():
    with pytest.raises(ValueError, match="regions: each name may be given once; got 'r' again"):
        check_regions([Region("r", (0.0, 1.0), (0.0, 1.0)), Region("r", (0.0, 2.0), (0.0, 1.0))], GRID)


def test_polygons_with_a_common_edge_partition_points():
    # Corners, exact points on the edge, and random points near it.
    left = Region.from_corners("left", [(-4.0, -2.0), (0.3, -2.0), (2.1, 2.0), (-4.0, 2.0)])
    right = Region.from_corners("right", [(0.3, -2.0), (4.0, -2.0), (4.0, 2.0), (2.1, 2.0)])
    share = torch.linspace(0, 1, 1001, dtype=torch.float64)
    y = torch.cat([-2 + 4 * share, 4 * share - 2.5])
    x = torch.cat([0.3 + 1.8 * share, 8 * share.roll(500) - 4])
    inside = (x >= -4) & (x < 4) & (y >= -2) & (y < 2)
    assert torch.equal(left.mask_points(x, y) ^ right.mask_points(x, y), inside)
    assert not (left.mask_points(x, y) & right.mask_points(x, y)).any()
