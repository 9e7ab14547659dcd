"""Points on a target equal a simulation with that target in the scene."""

import numpy as np
import pytest
import torch

from torchcover.evaluation.target_page import summarize_target_maps
from torchcover.geometry import BoundingBox, build_transform
from torchcover.simulation import PaperReference, Scenario, Simulator
from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.shapes import Box
from torchcover.targets import STATES, Raster, Target, counting, measure_target_visibility
from torchcover.targets.placing import compute_yaws_rad
from torchcover.targets.surface import NUM_SAMPLES, TargetSurface

from .scenes import EGO, RASTER, WALL, build_lidar, build_rig, build_scenario, count_points_on_target, write_trajectory

FREE, OCCUPIED, OUTSIDE = range(len(STATES))
REFERENCE = PaperReference(rows=2, columns=2)
CAMERA = {
    "type": "camera", "name": "cam", "mount": {"x_m": 2.1, "z_m": 0.8}, "width": 180, "height": 100, "fov_deg": 100,
    "stride": 2, "max_range_m": 3.5, "min_range_m": 1.0,
}  # fmt: skip

RADAR = {
    "type": "radar", "name": "radar", "mount": {"x_m": 2.1, "z_m": 0.6}, "horizontal_fov_deg": 120,
    "vertical_fov_deg": [-25, 25], "azimuth_cell_deg": 6, "range_cell_m": 0.3, "max_range_m": 20, "min_range_m": 0.3,
}  # fmt: skip


def add_target(scenario, name, x_m, y_m, yaw_rad):
    """Add a target to a scenario whose ego vehicle is at the origin."""
    shape = {"type": "vehicle", "vehicle": name}
    pose = {"x_m": float(x_m), "y_m": float(y_m), "yaw_deg": float(np.rad2deg(yaw_rad))}
    content = scenario.model_dump(exclude_unset=True)
    actors = [*content.get("actors", ()), {"name": "t", "category": "c", "shape": shape, "pose": pose}]
    return Scenario.model_validate({**content, "actors": actors})


@pytest.mark.parametrize(("name", "heading"), [("child", "narrow"), ("dog", "wide"), ("pole", 30.0)])
def test_points_equal_a_simulation_with_the_target(name, heading):
    target, scenario = Target.load(name), build_scenario(WALL)
    sensors = build_rig(
        build_lidar(), build_lidar("corner", mount={"x_m": 2.1, "y_m": 1.1, "z_m": 0.6, "yaw_deg": 45}), CAMERA
    )
    seen = measure_target_visibility(sensors, scenario, target, RASTER, heading=heading)
    yaw = compute_yaws_rad(heading, target.solid.bounding_box, seen.vehicle_box, RASTER.positions_m).reshape(
        RASTER.shape
    )
    compared = 0
    for row, column in [(0, 0), (4, 9), (4, 12), (6, 12), (5, 13), (8, 7), (2, 10), (5, 2)]:
        assert seen.state[row, column] == FREE
        x_m, y_m = seen.x_m[column], seen.y_m[row]
        simulator = Simulator(add_target(scenario, target.name, x_m, y_m, yaw[row, column]), {"r": sensors}, REFERENCE)
        scans = simulator.simulate_frame(0).scans["r"]
        counts = [
            sensor.pixels_per_sample * count_points_on_target(scan.points, target, x_m, y_m, yaw[row, column])
            for sensor, scan in zip(sensors.sensors, scans, strict=True)
        ]
        assert seen.sensor_points[:, row, column].tolist() == counts
        assert seen.detecting_sensors[row, column] == sum(count >= 5 for count in counts)
        compared += sum(count > 0 for count in counts)
    assert compared > 8


@pytest.mark.parametrize("name", ["adult", "dog"])
def test_radar_points_equal_a_simulation_with_the_target(name):
    """The rays of a cell hit the target, the floor and a wall behind it; the cell measures one point."""
    target, sensors = Target.load(name), build_rig(RADAR)
    behind = {"name": "w", "shape": {"type": "box", "size_m": [0.2, 8, 3]}, "poses": [{"x_m": 5.4}]}
    scenario = build_scenario(behind)
    seen = measure_target_visibility(sensors, scenario, target, Raster((2.5, 5.5), (-2.0, 2.0), 0.5), heading=0.0)
    rays = measure_target_visibility(
        build_rig({**RADAR, "azimuth_cell_deg": 1.0, "range_cell_m": 0.01}), scenario, target, seen.raster
    )
    counts = []
    for row, column in zip(*np.nonzero(seen.state == FREE), strict=True):
        place = seen.x_m[column], seen.y_m[row], 0.0
        [scan] = Simulator(add_target(scenario, target.name, *place), {"r": sensors}, REFERENCE).simulate_scans(0)["r"]
        counts.append(count_points_on_target(scan.points, target, *place))
        assert seen.points[row, column] == counts[-1]
    assert len(counts) > 20
    assert 0 < max(counts) < np.nanmax(rays.points) / 3


def test_radar_cells_measure_the_body_that_fills_them():
    """A post in the cell of a wide wall is not detected; with the wall in another cell, it is."""
    cell = {"horizontal_fov_deg": 20, "azimuth_cell_deg": 20, "vertical_fov_deg": [0, 10]}
    cell |= {"range_cell_m": 2.0, "ray_spacing_m": 0.05}
    wall = {"name": "w", "shape": {"type": "box", "size_m": [0.2, 8, 6]}, "poses": [{"x_m": 5.9}]}
    behind = {**wall, "poses": [{"x_m": 6.9}]}
    raster = Raster((5.0, 6.0), (-0.5, 0.5), 1.0)
    merged, apart = (
        measure_target_visibility(build_rig({**RADAR, **cell}), build_scenario(one), Target.load("pole"), raster)
        for one in (wall, behind)
    )
    assert (merged.state[0, 0], apart.state[0, 0]) == (FREE, FREE)
    assert (merged.points[0, 0], apart.points[0, 0]) == (0, 1)


def test_points_are_averaged_over_frames_of_moving_scenes(tmp_path):
    """The ego vehicle passes a wall that occludes the target at first; a car drives through the positions."""
    ego = {**EGO, "trajectory": write_trajectory(tmp_path, (0, 0, 0, 0), (1, 4, 0, 0))}
    passing = {
        "name": "a", "category": "car", "shape": {"type": "box", "size_m": [2, 1, 1]},
        "trajectory": write_trajectory(tmp_path, (0, 0, 3.5, 0), (1, 8, 3.5, 0), name="a.csv"),
    }  # fmt: skip
    scenario = build_scenario(WALL, ego=ego, actors=[passing], duration_s=1.0, time_step_s=0.5)
    target, sensors = Target.load("adult"), build_rig(build_lidar("low", mount={"x_m": 2.1, "z_m": 1.3}))
    seen = measure_target_visibility(sensors, scenario, target, RASTER, num_frames=3, heading=0.0)
    # The car is at the last of these positions at first.
    for row, column, free in [(6, 11, (0, 1, 2)), (7, 5, (0, 1, 2)), (2, 12, (0, 1, 2)), (8, 7, (1, 2))]:
        counts = []
        for index in free:
            pose = seen.x_m[column] + 2.0 * index, seen.y_m[row], 0.0
            step = Simulator(add_target(scenario, target.name, *pose), {"r": sensors}, REFERENCE).simulate_frame(index)
            counts.append(count_points_on_target(step.clouds["r"], target, seen.x_m[column], seen.y_m[row], 0.0))
        assert seen.points[row, column] == pytest.approx(np.mean(counts))
        assert seen.detected_share[row, column] == pytest.approx(np.mean(np.array(counts) >= 5))
        assert seen.min_points[row, column] == min(counts)
    # The car is at (0, 3.5), then at (2, 3.5) and (4, 3.5) as the ego sees it: each cell is occupied once at most.
    assert seen.free_frames[8].tolist() == [3, 3, 3, 3, 3, 3, 2, 2, 2, 2, 2, 2, 3, 3]
    assert (seen.state[8] == FREE).all()


def test_positions_are_independent_of_raster_chunks_and_threads(monkeypatch):
    target, sensors = Target.load("dog"), build_rig(build_lidar(dropout=0.2, range_noise_m=0.05))
    whole = measure_target_visibility(sensors, build_scenario(WALL), target, RASTER, num_frames=2, seed=3)
    part = measure_target_visibility(
        sensors, build_scenario(WALL), target, Raster((2.0, 7.0), (-2.0, 3.0), 1.0), num_frames=2, seed=3
    )
    for name in (
        "sensor_points",
        "detecting_sensors",
        "detected_share",
        "min_points",
        "surface_share",
        "state",
        "visible_m2",
    ):
        np.testing.assert_array_equal(getattr(whole, name)[..., 3:8, 9:], getattr(part, name))
    monkeypatch.setattr(counting, "CHUNK_SIZE", 7)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    again = measure_target_visibility(sensors, build_scenario(WALL), target, RASTER, num_frames=2, seed=3)
    torch.set_num_threads(threads)
    np.testing.assert_array_equal(again.points, whole.points)
    np.testing.assert_array_equal(again.surface_share, whole.surface_share)


def test_drop_out_removes_points_and_noise_moves_them():
    target, raster = Target.load("adult"), Raster((2.0, 6.0), (-2.0, 2.0), 1.0)
    exact = measure_target_visibility(build_rig(), build_scenario(), target, raster).points.sum()
    noisy = measure_target_visibility(
        build_rig(build_lidar(range_noise_m=0.02)), build_scenario(), target, raster, num_frames=2
    ).points.sum()
    assert noisy == exact > 200
    thinned = measure_target_visibility(
        build_rig(build_lidar(dropout=0.25)), build_scenario(), target, raster, num_frames=32
    ).points.sum()
    # The standard error is 1 %.
    assert thinned == pytest.approx(0.75 * exact, rel=0.04)
    cells = measure_target_visibility(build_rig(RADAR), build_scenario(), target, raster).points.sum()
    thinned = measure_target_visibility(
        build_rig({**RADAR, "dropout": 0.25, "range_noise_m": 0.01}), build_scenario(), target, raster, num_frames=64
    ).points
    assert thinned.sum() == pytest.approx(0.75 * cells, rel=0.06)
    assert (
        measure_target_visibility(
            build_rig(build_lidar(dropout=1.0)), build_scenario(), target, raster
        ).surface_share.max()
        == 0.0
    )


def test_narrow_sides_get_fewer_points():
    target = Target.load("cyclist")
    narrow, wide = (
        measure_target_visibility(build_rig(), build_scenario(), target, RASTER, heading=heading)
        for heading in ("narrow", "wide")
    )
    both = narrow.free_mask & wide.free_mask & (narrow.distance_m > 2)
    assert narrow.points[both].sum() < 0.7 * wide.points[both].sum()


@pytest.mark.parametrize(("heading", "yaw_deg"), [("narrow", [90, 0, 180]), ("wide", [0, -90, 90]), (17.0, [17] * 3)])
def test_targets_turn_a_side_to_the_vehicle(heading, yaw_deg):
    """The body is longer than wide; the vehicle is to its left, in front of it, and behind it."""
    car, dog = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5)), BoundingBox((-0.5, -0.1, 0.0), (0.5, 0.1, 0.7))
    places = np.array([[1.5, -3.0], [-3.0, 0.5], [4.0, 0.0]])
    turned = np.rad2deg(compute_yaws_rad(heading, dog, car, places))
    np.testing.assert_allclose(np.cos(np.deg2rad(turned - yaw_deg)), 1.0, atol=1e-12)


def test_buildings_occlude_targets_and_occupy_positions():
    building = {"name": "b", "shape": {"type": "box", "size_m": [4, 4, 6]}, "poses": [{"x_m": 5.0, "y_m": 3.0}]}
    seen = measure_target_visibility(build_rig(), build_scenario(building), Target.load("child"), RASTER)
    names = np.array(STATES)[seen.state]
    assert (names[3:7, 5:9] == "occupied").sum() == 8
    assert (names[4:6, 5:9] == "occupied").all()
    # Inside the building and its walls.
    assert (names[6:, 10:] == "outside").all()
    assert (names[:4] == "free").all()
    for array in (seen.points, seen.detecting_sensors, seen.detected_share, seen.surface_share, seen.visible_m2):
        np.testing.assert_array_equal(np.isnan(array), seen.state != FREE)
    assert seen.counts == {"free": 116, "occupied": 8, "outside": 16, "surface_share_unobserved": 0}
    assert (seen.free_frames == (seen.state == FREE)).all()


def test_rasters_inside_the_vehicle_are_occupied():
    seen = measure_target_visibility(
        build_rig(), build_scenario(), Target.load("pole"), Raster((-1.0, 1.0), (-0.5, 0.5), 0.5)
    )
    assert (seen.state == OCCUPIED).all()
    assert np.isnan(seen.points).all()


def test_invisible_targets_have_no_surface_share():
    """The child is always behind a high wall."""
    wall = {"name": "w", "shape": {"type": "box", "size_m": [0.2, 60, 9]}, "poses": [{"x_m": 4.0}]}
    seen = measure_target_visibility(
        build_rig(), build_scenario(wall), Target.load("child"), Raster((2.5, 5.5), (0.0, 1.0), 1.0)
    )
    assert 0 < seen.surface_share[0, 0] <= 1
    assert np.isnan(seen.surface_share[0, 2])
    assert (seen.points[0, 2], seen.visible_m2[0, 2]) == (0.0, 0.0)
    assert seen.counts["surface_share_unobserved"] == 1


def test_surface_share_equals_the_area_near_points():
    """One row of rays hits a wall of 2 m at 1 m: the share within 0.3 m of the row, on the side to the vehicle."""
    mesh = Box(type="box", size_m=(0.02, 4.0, 2.0)).build_mesh()
    level = build_lidar(mount={"z_m": 1.0}, channels=1, vertical_fov_deg=[0, 0], columns=36000)
    ego = {"shape": {"type": "box", "size_m": [4.0, 2.0, 0.5]}}
    raster = Raster((4.0, 12.0), (-4.0, 4.0), 8.0)
    seen = measure_target_visibility(
        build_rig(level), build_scenario(ego=ego), Target("wall", mesh), raster, threshold_m=0.3, heading="wide"
    )
    assert seen.surface_share[0, 0] == pytest.approx(0.3, abs=2.5 / np.sqrt(NUM_SAMPLES) * 0.3)
    assert seen.visible_m2[0, 0] == pytest.approx(
        8.0, rel=0.15
    )  # the ego vehicle occludes the bottom from low viewpoints
    all_of_it = measure_target_visibility(
        build_rig(level), build_scenario(ego=ego), Target("wall", mesh), raster, threshold_m=5.0, heading="wide"
    )
    assert all_of_it.surface_share[0, 0] == 1.0


def test_surface_samples_represent_the_outer_area():
    """Surface inside other parts is excluded; nearby samples agree with distances."""
    target = Target.load("adult")
    surface = TargetSurface.from_target(target)
    corners = target.mesh.vertices_m[target.mesh.faces]
    whole = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert 0.6 * whole < surface.sample_area_m2 * NUM_SAMPLES < 0.97 * whole
    hits = np.random.default_rng(0).normal(size=(500, 3))
    near = np.unpackbits(surface.find_nearby_samples(hits, 0.4), axis=1).astype(bool)
    distance = np.linalg.norm(hits[:, None] - surface.points_m, axis=2)
    np.testing.assert_array_equal(near, distance <= 0.4)


def test_targets_occlude_their_own_rear():
    """Two plates of a square meter, one behind the other."""
    front, rear = (
        Box(type="box", size_m=(0.02, 1, 1)).build_mesh().transform(build_transform(np.eye(3), [x, 0, 0]))
        for x in (0.1, -0.1)
    )
    raster = Raster((11.0, 13.0), (-1.0, 1.0), 2.0)
    seen = measure_target_visibility(
        build_rig(), build_scenario(), Target("plates", merge_meshes([front, rear])), raster, heading="wide"
    )
    assert seen.visible_m2[0, 0] == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize(("low_m", "thick_m", "hit"), [(0.7, 0.03, False), (0.08, 0.05, True), (-0.4, 0.5, True)])
def test_targets_keep_their_height_above_the_ground(tmp_path, low_m, thick_m, hit):
    """A level scan at 0.0925 m hits a bar of 0.2 m, 3 m ahead, with the rays in its angle, or misses it."""
    shape, pose = f"{{type: box, size_m: [0.02, 0.2, {thick_m}]}}", f"{{x_m: 7.0, z_m: {low_m}}}"
    (tmp_path / "bar.yaml").write_text(f"name: bar\nparts: [{{name: b, shape: {shape}, poses: [{pose}]}}]\n")
    scanner = build_lidar(mount={"x_m": 2.01, "z_m": 0.0925}, channels=1, vertical_fov_deg=[0, 0], columns=36_000)
    target, raster = Target.load(tmp_path / "bar.yaml"), Raster((3.5, 5.5), (-0.5, 0.5), 1.0)
    seen = measure_target_visibility(build_rig(scanner), build_scenario(), target, raster, heading=0.0)
    expected = 2 * np.rad2deg(np.arctan2(0.1, 5.0 - 0.01 - 2.01)) / 0.01 if hit else 0.0
    assert seen.points[0, 1] == pytest.approx(expected, abs=1.0)
    assert seen.target_bottom_m == target.bottom_m == pytest.approx(max(low_m, 0.0))
    assert f"{max(low_m, 0):.2f} to {max(low_m, 0) + thick_m:.2f} m above the ground" in seen.target_description
    assert (f", {low_m:.2f} m above the ground, is detected" in summarize_target_maps({"r": seen})[0]) == (low_m > 0)
