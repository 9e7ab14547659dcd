"""Object strata: additional points cover the visible surface of objects and change no other number."""

import numpy as np
import pytest
import torch

from torchcover.data import SimulatedFrames
from torchcover.detection import measure_box_visibility
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import Rig, SurfaceReference
from torchcover.simulation.mounted_sensor import compute_visibility
from torchcover.simulation.patches import Patches, UprightBoxes
from torchcover.simulation.reference_sensor import ReferenceContext
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box, Plane
from torchcover.simulation.surface_strata import SurfaceStrata

from .small_scenarios import AHEAD, FLOOR, assert_agrees, box, scenario

BEHIND = (((-20.0, -10.0), (-5.0, 5.0)),)
GROUND = Plane(type="plane", size_m=(400.0, 400.0)).build_mesh()
EGO = Actor(
    "ego", "ego", Box(type="box", size_m=(4.0, 2.0, 1.5)).build_mesh(), Trajectory.create_static([0.0, 0.0, 0.0])
)


def place_box(x_m, y_m=0.0, z_m=0.0, *, size_m=(2.0, 2.0, 1.5), moves=False, until_s=None):
    """Place a box; a moving one arrives there at 1 s."""
    position = [x_m, y_m, z_m]
    track = Trajectory.from_arrays([0.0, 1.0], [[x_m + 5.0, y_m, z_m], position], np.zeros((2, 3)))
    if until_s is not None:
        track = Trajectory(
            np.array([0.0, until_s]), np.array([position, position]), np.zeros((2, 3)), is_transient=True
        )
    return Actor(
        "box",
        "car",
        Box(type="box", size_m=size_m).build_mesh(),
        track if moves else Trajectory.create_static(position),
    )


def build_scene(actors=(), parked=(), static=()):
    return Scene((GROUND, *static), EGO, tuple(actors), 1.0, 3.0, tuple(parked))


def scan_repeatedly(made, sensor, steps=40, time_step_index=1):
    scene = SceneGeometry(made)
    surroundings = (
        ReferenceContext(scene, scene.get_snapshot(time_step_index), np.random.default_rng([3, index]), "test")
        for index in range(steps)
    )
    return [sensor.scan(context) for context in surroundings]


def sum_areas_m2(scans_, which=lambda x, y, z: x > 5.0):
    """Sum the area in m² of the points that satisfy a condition; (scans,)."""
    return np.array([scan.weights.astype(np.float64)[which(*scan.points.T)].sum() for scan in scans_])


def build_scenes_with(actor_of):
    """Build the same box as an actor at rest, a moving actor, and a static actor."""
    return [
        build_scene([actor_of(moves=False)]),
        build_scene([actor_of(moves=True)]),
        build_scene(parked=[actor_of(moves=False)]),
    ]


@pytest.mark.parametrize(
    "made", build_scenes_with(lambda moves: place_box(10.0, moves=moves)), ids=["rests", "moves", "parked"]
)
def test_visible_object_surface_is_sampled_outside_areas_too(fix_position, made):
    fix_position([2.5, 3.0, 2.5])
    object_scans = scan_repeatedly(made, SurfaceReference(BEHIND, num_rays=100, num_poses=1, points_per_object=64))
    assert all(scan.sampled_point_counts.tolist() == [64] for scan in object_scans)
    # One point in each of 64 equal parts of three visible faces: no scan deviates by more than a part.
    np.testing.assert_allclose(sum_areas_m2(object_scans), 3.0 + 3.0 + 4.0, rtol=1e-5)
    assert_agrees(sum_areas_m2(object_scans, lambda x, y, z: (x > 5.0) & (z > 1.49999)), 4.0)
    assert_agrees(sum_areas_m2(object_scans, lambda x, y, z: (x > 5.0) & (z < 0.75)), 3.0)


@pytest.mark.parametrize(
    "made", build_scenes_with(lambda moves: place_box(10.0, moves=moves)), ids=["rests", "moves", "parked"]
)
def test_object_strata_do_not_change_the_areas(fix_position, made):
    fix_position([2.5, 3.0, 2.5])
    # The area holds a quarter of the box in x, and the upper band half of it.
    areas, bands = (((4.0, 9.5), (-5.0, 5.0)),), ((-0.5, 0.5), (0.75, 2.0))
    object_scans = [
        scan_repeatedly(
            made, SurfaceReference(areas, num_rays=1200, num_poses=2, bands_m=bands, points_per_object=points)
        )
        for points in (0, 40)
    ]
    parts = {
        "ground": (lambda x, y, z: (x < 9.5) & (z < 1e-3), None),
        "front": (lambda x, y, z: (x < 9.001) & (z >= 0.75), 1.5),
        "side": (lambda x, y, z: (x > 9.001) & (x < 9.5) & (y > 0.999) & (z >= 0.75), 0.375),
        "top": (lambda x, y, z: (x < 9.5) & (z > 1.499), 1.0),
    }
    for which, exact in parts.values():
        without, with_ = (sum_areas_m2(scan, which) for scan in object_scans)
        assert_agrees(without, exact or with_.mean(), max_relative_error=0.05)
        assert_agrees(with_, exact or without.mean(), max_relative_error=0.05)


def test_each_object_has_the_requested_points(fix_position):
    fix_position([2.5, 3.0, 2.5])
    made = build_scene([place_box(10.0), place_box(30.0, moves=True)], parked=[place_box(90.0)])
    (scan,) = scan_repeatedly(made, SurfaceReference(BEHIND, num_rays=100, num_poses=4, points_per_object=10), steps=1)
    assert scan.sampled_point_counts.tolist() == [12, 12, 12]
    # Added to the other points, half of which found no surface.
    assert 36 + 40 < scan.num_rays < 36 + 60
    (scan,) = scan_repeatedly(made, SurfaceReference((AHEAD,), num_rays=400, num_poses=4), steps=1)
    # Without object strata, objects have their share of the points of the areas.
    assert scan.sampled_point_counts[0] > 0
    assert scan.sampled_point_counts[1:].tolist() == [0, 0]


def test_the_inside_of_overlapping_objects_is_hidden(fix_position):
    fix_position([2.5, 0.0, 1.0])
    made = build_scene([place_box(10.0), place_box(12.0, size_m=(4.0, 1.0, 3.0))])
    object_scans = scan_repeatedly(made, SurfaceReference(BEHIND, num_rays=10, num_poses=1, points_per_object=128))
    assert_agrees(sum_areas_m2(object_scans, lambda x, y, z: np.abs(x - 9.0) < 1e-3), 3.0)
    assert_agrees(sum_areas_m2(object_scans, lambda x, y, z: np.abs(x - 10.0) < 1e-3), 3.0 - (1.0 + 0.5 * 7.5 / 6.5))
    assert_agrees(sum_areas_m2(object_scans), 6.0 - (1.0 + 0.5 * 7.5 / 6.5))
    assert all(scan.sampled_point_counts.tolist() == [128, 128] for scan in object_scans)


def test_surface_below_ground_is_sampled_and_invisible(fix_position):
    fix_position([2.5, 0.0, 0.9])
    made = build_scene(parked=[place_box(10.0, z_m=-0.5)])
    assert_agrees(
        sum_areas_m2(scan_repeatedly(made, SurfaceReference(BEHIND, num_rays=10, num_poses=1, points_per_object=128))),
        2.0,
    )


def test_one_position_and_point_are_unbiased():
    object_scans = scan_repeatedly(
        build_scene([place_box(10.0)]),
        SurfaceReference(BEHIND, num_rays=1, num_poses=1, points_per_object=1),
        steps=150,
    )
    exact = scan_repeatedly(
        build_scene([place_box(10.0)]),
        SurfaceReference(BEHIND, num_rays=1, num_poses=8, points_per_object=512),
        steps=30,
    )
    assert all(scan.sampled_point_counts.tolist() == [1] for scan in object_scans)
    assert_agrees(sum_areas_m2(object_scans), sum_areas_m2(exact).mean(), max_relative_error=0.1)


def test_without_an_object_nothing_changes():
    scene = SceneGeometry(build_scene())
    with_, without = (
        SurfaceReference((AHEAD,), num_rays=200, points_per_object=points).scan(
            ReferenceContext(scene, scene.get_snapshot(0), np.random.default_rng(0), "test")
        )
        for points in (64, 0)
    )
    assert with_.sampled_point_counts.shape == (0,)
    np.testing.assert_array_equal(with_.points, without.points)
    np.testing.assert_array_equal(with_.weights, without.weights)


def test_absent_and_distant_objects_are_not_sampled(fix_position):
    fix_position([-2.5, 0.0, 1.0])
    made = build_scene([place_box(10.0, moves=True, until_s=1.5), place_box(37.0), place_box(40.0)])
    sensor = SurfaceReference(BEHIND, num_rays=100, num_poses=2, points_per_object=20, max_range_m=39.0)
    (while_there,) = scan_repeatedly(made, sensor, steps=1, time_step_index=1)
    (afterwards,) = scan_repeatedly(made, sensor, steps=1, time_step_index=2)
    assert while_there.sampled_point_counts.tolist() == [20, 20, 0]
    assert afterwards.sampled_point_counts.tolist() == [0, 20, 0]


def test_inner_sides_of_an_object_are_hidden():
    mesh = Box(type="box", size_m=(20.0, 20.0, 20.0)).build_mesh()
    place_m = np.array([1.0, 2.0, 3.0])
    far_box = UprightBoxes(np.full((1, 3), 90.0), np.full((1, 3), 99.0))
    patches = Patches.from_mesh(mesh)
    strata = SurfaceStrata(patches._replace(object_indices=np.zeros_like(patches.object_indices)), far_box)
    drawn = strata.sample_points(place_m, 5.0, np.random.default_rng(0), points_per_object=50)
    assert drawn.object_indices.tolist() == [0] * 50
    snapshot = SceneGeometry(Scene((mesh,), EGO)).get_snapshot(0)
    assert not compute_visibility(snapshot, place_m, drawn.points_m + np.float32(1e-3) * drawn.normals).is_visible.any()
    assert compute_visibility(snapshot, place_m, drawn.points_m - np.float32(1e-3) * drawn.normals).is_visible.all()


def test_objects_of_any_size_are_sampled_completely():
    huge = Patches.from_mesh(Plane(type="plane", size_m=(1e6, 10.0)).build_mesh())
    assert len(huge.is_outward) < 10_000
    assert np.linalg.norm(huge.normals_m2.astype(np.float64), axis=0).sum() / 2 == pytest.approx(1e7, rel=1e-5)
    assert max(np.abs(huge.first_edge_m).max(), np.abs(huge.second_edge_m).max()) <= 1e6 / 64
    car = Patches.from_mesh(Box(type="box", size_m=(18.0, 2.5, 4.0)).build_mesh())
    assert max(np.linalg.norm(edges, axis=0).max() for edges in (car.first_edge_m, car.second_edge_m)) <= 4.0


LIDAR = {
    "type": "lidar", "name": "top", "mount": {"z_m": 1.9}, "channels": 32, "vertical_fov_deg": (-30, 5),
    "horizontal_fov_deg": 180, "columns": 720, "max_range_m": 120,
}  # fmt: skip


def test_visibility_tells_hidden_objects_from_distant_ones(fix_position):
    fix_position([-2.5, 0.0, 1.9])
    cars = [
        {"name": name, "category": "car", "shape": {"type": "box", "size_m": [4, 2, 1.5]}, "pose": pose}
        for name, pose in [
            ("ahead", {"x_m": 15}), ("behind a wall", {"x_m": 40}), ("at the edge", {"x_m": 59.9}),
            ("behind", {"x_m": -15})
        ]
    ]  # fmt: skip
    made = scenario(FLOOR, box([0.2, 20, 6], x_m=30), actors=cars)
    rig = Rig.model_validate({"name": "r", "sensors": [LIDAR]})
    sensor = SurfaceReference((AHEAD,), num_rays=100, points_per_object=64, max_range_m=60.0)
    (frame,) = SimulatedFrames(made, rig, num_frames=1, reference_sensor=sensor, boxes=True)
    visibility = measure_box_visibility(
        frame.sensor, frame.reference, frame.boxes, reference_weights=frame.reference_weights
    )
    assert frame.boxes.ids == ("ahead", "behind a wall", "at the edge", "behind")
    assert visibility.observed.tolist() == [True, False, False, True]
    assert visibility.hidden.tolist() == [False, True, False, False]
    assert visibility.sampled_points.tolist()[1:] == [64, 0, 64]
    # Only the front: the rig hits no part of the roof at this flat angle.
    assert abs(float(visibility.share[0]) - 3 / 11) < 0.05
    assert visibility.share[3] == 0.0
    assert torch.equal(frame.boxes.select(visibility.hidden).sampled_points, torch.tensor([64]))


def test_frames_with_boxes_sample_all_objects():
    frames = [SimulatedFrames("courtyard", "front_roof_32", num_frames=1, boxes=boxes) for boxes in (False, True)]
    assert [frames_.reference_sensor.points_per_object for frames_ in frames] == [0, 64]
    assert frames[0].reference_sensor.areas == frames[1].reference_sensor.areas
