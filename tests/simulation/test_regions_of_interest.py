"""Regions of interest: the document, and the query plan for one vehicle."""

import math

import numpy as np
import pytest
import torch

from torchcover import Region, RegionsOfInterest, Rig, Scenario, evaluate
from torchcover.coverage import build_near_field_regions

ROBOT_M = np.array([[0.5, 0.4], [-0.5, 0.4], [-0.5, -0.4], [0.5, -0.4]])
SIDES = ["front_3m", "rear_3m", "left_3m", "right_3m"]


def rectangle(x, y):
    return {"x_m": x, "y_m": y}


def test_default_regions_are_paper_regions_and_near_field():
    plan = RegionsOfInterest().build_query_plan(ROBOT_M)
    assert [region.name for region in plan.regions] == ["20m", "80m", "160m", *SIDES]
    assert (plan.grid.x_m, plan.grid.y_m, plan.grid.cell_m, plan.bands_m) == (
        (-40.0, 160.0),
        (-40.0, 40.0),
        0.25,
        ((-0.5, 0.5), (0.5, 2.0)),
    )
    # One area for all of the near field, and the grid last.
    assert plan.areas[3:] == (((-3.5, 3.5), (-3.4, 3.4)), (plan.grid.x_m, plan.grid.y_m))
    assert [region.name for region in RegionsOfInterest().build_query_plan().regions] == ["20m", "80m", "160m"]


@pytest.mark.parametrize("cell", [0.1, 0.25, 0.5])
def test_near_field_parts_cover_it_exactly_once(cell):
    plan = RegionsOfInterest().build_query_plan(ROBOT_M, cell)
    covered = sum(region.mask_cells(plan.grid).long() for region in plan.regions if region.name in SIDES)
    x, y = plan.grid.x_centers_m, plan.grid.y_centers_m[:, None]
    is_near_field = (x >= -3.5) & (x < 3.5) & (y >= -3.4) & (y < 3.4)
    vehicle = (x >= -0.5) & (x < 0.5) & (y >= -0.4) & (y < 0.4)
    assert torch.equal(covered, (is_near_field & ~vehicle).long())


def test_default_regions_outside_the_grid_are_omitted():
    small = RegionsOfInterest(grid={"x_m": (-5.0, 5.0), "y_m": (-5.0, 5.0), "cell_m": 0.5}).build_query_plan(ROBOT_M)
    assert [region.name for region in small.regions] == SIDES
    assert [region.name for region in RegionsOfInterest().build_query_plan(ROBOT_M, 8.0).regions] == [
        "20m",
        "80m",
        "160m",
    ]
    elsewhere = RegionsOfInterest(grid={"x_m": (50.0, 55.0), "y_m": (-5.0, 5.0)}).build_query_plan(ROBOT_M)
    assert elsewhere.regions == (Region("grid", (50.0, 55.0), (-5.0, 5.0)),)
    assert elsewhere.areas == (((50.0, 55.0), (-5.0, 5.0)),)


def test_distant_regions_enlarge_the_default_grid():
    plan = RegionsOfInterest(regions={"side": rectangle((-41.1, 0.0), (30.0, 55.0))}).build_query_plan(ROBOT_M)
    assert (plan.grid.x_m, plan.grid.y_m) == ((-41.25, 160.0), (-40.0, 55.0))
    assert plan.areas == (((-41.1, 0.0), (30.0, 55.0)), (plan.grid.x_m, plan.grid.y_m))


def test_regions_outside_a_given_grid_are_refused():
    grid_keys = {"x_m": (-5.0, 5.0), "y_m": (-5.0, 5.0)}
    with pytest.raises(ValueError, match="region 'side' spans x = 0 to 6 m, beyond the grid's -5 to 5 m; enlarge"):
        RegionsOfInterest(regions={"side": rectangle((0.0, 6.0), (0.0, 1.0))}, grid=grid_keys).build_query_plan(ROBOT_M)


def test_regions_inside_the_vehicle_cause_a_warning():
    hidden = RegionsOfInterest(regions={"hold": rectangle((-0.4, 0.4), (-0.3, 0.3))})
    with pytest.warns(UserWarning, match="region 'hold' lies within the vehicle"):
        hidden.build_query_plan(ROBOT_M)
    assert hidden.build_query_plan().regions[0].name == "hold"  # without a vehicle this is unknown


def test_regions_without_cell_centers_are_refused():
    with pytest.raises(ValueError, match=r"region 'thin' holds no cell center; use smaller cells than 0.25 m"):
        RegionsOfInterest(regions={"thin": rectangle((0.0, 0.1), (0.0, 1.0))}).build_query_plan(ROBOT_M)


def test_yaml_and_python_regions_are_equal(tmp_path):
    (tmp_path / "ask.yaml").write_text(
        "regions:\n"
        "  behind: {x_m: [-4, -0.5], y_m: [-1, 1]}\n"
        "  corner: {polygon_m: [[0.5, 0.4], [3.5, 0.4], [0.5, 3.4]]}\n"
        "heights: {dog: [0.05, 0.5], child: [0.1, 1.1]}\n"
        "grid: {x_m: [-10, 10], y_m: [-10, 10], cell_m: 0.1}\n"
    )
    regions = RegionsOfInterest.load(tmp_path / "ask.yaml")
    assert regions == RegionsOfInterest(
        regions={
            "behind": rectangle((-4.0, -0.5), (-1.0, 1.0)),
            "corner": {"polygon_m": ((0.5, 0.4), (3.5, 0.4), (0.5, 3.4))},
        },
        heights={"dog": (0.05, 0.5), "child": (0.1, 1.1)},
        grid={"x_m": (-10.0, 10.0), "y_m": (-10.0, 10.0), "cell_m": 0.1},
    )
    plan = regions.build_query_plan(ROBOT_M)
    assert plan.grid.heights == {"dog": (0.05, 0.5), "child": (0.1, 1.1)}
    assert plan.areas[1] == ((0.5, 3.5), (0.4, 3.4))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("regions: {a: {x_m: [1, 1], y_m: [0, 1]}}", "regions.a.x_m: the lower bound must be below the upper one"),
        ("regions: {a: {x_m: [.nan, 1], y_m: [0, 1]}}", r"regions.a.x_m.0: a finite number"),
        ("regions: {a: {x_m: [0, 1]}}", "regions.a: give x_m and y_m, two bounds each, or the corners of polygon_m"),
        ("regions: {a: {polygon_m: [[0, 0], [1, 1], [1, 0], [0, 1]]}}", "regions.a: .*edges cross .*Self-intersection"),
        ("regions: {a: {polygon_m: [[0, 0], [1, 1], [2, 2]]}}", "regions.a: .*edges cross"),
        ("regions: {a: {polygon_m: [[0, 0], [1, 1]]}}", "three different corners or more are needed; got 2"),
        ("heights: {low: [0.5, 0.5]}", "heights.low: the lower bound must be below the upper one; got 0.5 to 0.5 m"),
        ("heights: {low: [0, 1], low: [0, 2]}", "low"),
        ("grid: {cell_m: 0}", "grid.cell_m: a number above 0"),
        ("regions: {a: {x: [0, 1], y: [0, 1]}}", "regions.a.x: .*regions.a.y: "),
    ],
)
def test_empty_regions_are_refused(tmp_path, content, message):
    (tmp_path / "ask.yaml").write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        RegionsOfInterest.load(tmp_path / "ask.yaml")
    assert str(tmp_path / "ask.yaml") in str(caught.value)


def test_grids_too_large_for_memory_are_refused():
    grid_keys = {"x_m": (-1000.0, 1000.0), "y_m": (-1000.0, 1000.0), "cell_m": 0.1}
    with pytest.raises(ValueError, match="800,000,000 cells, over 100,000,000: use larger cells"):
        RegionsOfInterest(grid=grid_keys).build_query_plan()


def test_the_sides_are_named_by_their_reach():
    names = [region.name for region in build_near_field_regions((-1.0, 1.0), (-1.0, 1.0), distance_m=1.5)]
    assert names == ["front_1.5m", "rear_1.5m", "left_1.5m", "right_1.5m"]
    assert math.prod(build_near_field_regions((-1.0, 1.0), (-1.0, 1.0))[2].x_m) == -1.0


# Rooms.


def office(size_m=(14.0, 10.0), ego=None, **keys):
    floor = {"name": "floor", "ground": True, "shape": {"type": "plane", "size_m": size_m}}
    ego = {"shape": {"type": "box", "size_m": (0.9, 0.6, 0.5)}} | (ego or {})
    return Scenario.model_validate({"name": "office", "ego": ego, "bodies": [floor], **keys})


def test_rooms_are_walls_in_the_vehicle_frame(tmp_path):
    np.testing.assert_allclose(office().find_room_bounds_m(), [(-7, 7), (-5, 5)])
    turned = office(ego={"pose": {"x_m": -3.0, "yaw_deg": 90.0}})
    np.testing.assert_allclose(turned.find_room_bounds_m(), [(-5, 5), (-10, 4)], atol=1e-9)
    (tmp_path / "way.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,-5,0,0,0,0,0\n2,5,1,0,0,0,0\n")
    driving = office(ego={"trajectory": tmp_path / "way.csv"}, duration_s=2.0)
    np.testing.assert_allclose(driving.find_room_bounds_m(), [(-12, 12), (-6, 5)], atol=1e-9)


def test_rooms_enclose_the_ego_and_fit_its_size():
    assert office((100.0, 10.0)).find_room_bounds_m() is None
    assert office(ego={"pose": {"x_m": 20.0}}).find_room_bounds_m() is None
    assert Scenario.load("urban").find_room_bounds_m() is None
    with pytest.raises(
        ValueError, match=r"'office': all its bodies together are 0.014 x 0.01 m, smaller than box; is the"
    ):
        office((0.014, 0.010)).find_room_bounds_m()


@pytest.mark.parametrize(
    ("max_range_m", "name", "x", "forward"),
    [(100.0, "room", (-7.0, 7.0), ["5m"]), (6.0, "range", (-6.25, 6.25), ["5m"]), (3.0, "range", (-3.5, 3.5), [])],
)
def test_grid_and_regions_fit_room_and_range(max_range_m, name, x, forward):
    rig = Rig.model_validate(
        {"name": "r", "sensors": [{"name": "s", "mount": {"x_m": 0.2, "z_m": 1.0}, "channels": 2, "columns": 4,
         "vertical_fov_deg": (-30, 0), "horizontal_fov_deg": 360, "max_range_m": max_range_m}]}
    )  # fmt: skip
    result = evaluate(rig, office(), num_frames=1, num_rays=256, test_targets="none")
    grid = result.coverage.grid
    assert grid.x_m == x
    near_field_names = ["front_3m", "rear_3m", "left_3m", "right_3m"]
    assert [region.name for region in result.regions] == [*forward, name, *near_field_names]
    matching_region = next(region for region in result.regions if region.name == name)
    assert (matching_region.x_m, matching_region.y_m) == (grid.x_m, grid.y_m)
    plan = RegionsOfInterest(grid={"x_m": (-10.0, 50.0)})
    assert evaluate(rig, office(), num_frames=1, num_rays=256, test_targets="none", regions=plan).coverage.grid.x_m == (
        -10.0,
        50.0,
    )
