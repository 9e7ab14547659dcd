"""Heights above the local ground against closed forms, on hills and for any attitude of the ego vehicle."""

import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch

from torchcover.data import RecordedFrames, SimulatedFrames, collate_frames
from torchcover.frames.transforms import scale
from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import Scenario, Simulator, SurfaceReference
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.ground_faces import find_ground_faces, find_level_faces
from torchcover.simulation.local_ground import LocalGround
from torchcover.simulation.reference_sensor import ReferenceContext
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box, Cylinder, Mesh
from torchcover.simulation.writing import write_recording

from .small_scenarios import EGO, FLOOR, assert_agrees, box, scenario, sum_weights

EGO_MESH = Box(type="box", size_m=(4, 2, 1.5)).build_mesh()


def build_sheet(heights, half=60.0, every=5.0, down=False):
    """Build a terrain over a square from heights as a function of x and y."""
    side = np.arange(-half, half + every / 2, every)
    x, y = np.meshgrid(side, side, indexing="ij")
    number = np.arange(x.size).reshape(x.shape)
    corner, right, above, across = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((corner, right, across), (corner, across, above))])
    vertices = np.stack([x.ravel(), y.ravel(), heights(x, y).ravel()], axis=1)
    return Mesh(vertices, faces[:, ::-1] if down else faces)


def build_box(size, x=0.0, y=0.0, z=0.0, yaw=0.0):
    return (
        Box(type="box", size_m=size)
        .build_mesh()
        .transform(build_transform(convert_euler_to_rotation(yaw, 0, 0), [x, y, z]))
    )


def build_ramp(x, y, z):
    """Build a closed ramp that rises along x."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    bottom = [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]]
    top = [[x1, y0, z1], [x1, y1, z1]]
    faces = [[0, 3, 2], [0, 2, 1], [0, 5, 3], [0, 4, 5], [1, 2, 5], [1, 5, 4], [0, 1, 4], [3, 5, 2]]
    return Mesh(np.array(bottom + top, dtype=float), np.array(faces))


def find_ground(static, positions=((0.0, 0.0, 0.0),)):
    masks = find_ground_faces(static, np.array(positions))
    return LocalGround([Mesh(m.vertices_m, m.faces[k]) for m, k in zip(static, masks, strict=True)], np.zeros(3))


def heights(ground, *points):
    return ground.compute_heights_m(np.array(points, dtype=np.float64)).tolist()


PLANE = build_sheet(lambda x, y: 0 * x)


def test_sidewalks_are_ground_and_roofs_are_not():
    house, pavement, car = build_box((9, 9, 6), 20), build_box((9, 3, 0.15), -20), build_box((4, 2, 1.4), 0, 10)
    ground = find_ground([PLANE, house, pavement, car])
    heights_m = heights(ground, [20, 0, 7], [-20, 0, 1.15], [0, 10, 1.4], [5, 5, 2], [5, 5, -1], [5, 5, -0.02])
    np.testing.assert_allclose(heights_m, [7, 1, 1.4, 2, np.nan, -0.02], atol=1e-5)
    assert math.isnan(heights(ground, [500, 0, 2])[0])


def test_ramps_connect_a_bridge_with_the_road():
    up = build_ramp((10, 30), (-3, 3), (0, 5))
    deck = build_box((20, 6, 0.8), 40, 0, 4.2)
    down = build_ramp((10, 30), (-3, 3), (0, 5)).transform(
        build_transform(convert_euler_to_rotation(180, 0, 0), [80, 0, 0])
    )
    ground = find_ground([PLANE, up, deck, down])
    heights_m = heights(
        ground, [20, 0, 2.5], [20, 0, 3.5], [40, 0, 6], [40, 0, 2], [40, 0, 4.6], [40, 10, 6], [55, 0, 6]
    )
    # On the ramp, above it, above the bridge, below it, in it (the road is the ground), next to it, on the way down.
    np.testing.assert_allclose(heights_m, [0, 1, 1, 2, 4.6, 6, 6 - 3.75], atol=1e-5)
    # A bridge without a ramp is a roof.
    np.testing.assert_allclose(heights(find_ground([PLANE, deck]), [40, 0, 6]), [6], atol=1e-5)


def test_stairs_connect_levels_of_a_parking_garage():
    stairs = [build_box((0.3, 2, 0.18 * (k + 1)), 5 + 0.3 * k, 12) for k in range(16)]
    deck = build_box((30, 20, 0.3), 24.65, 12, 0.18 * 17 - 0.3)
    pillar = (
        Cylinder(type="cylinder", radius_m=0.3, height_m=2.76)
        .build_mesh()
        .transform(build_transform(np.eye(3), [24, 14, 0]))
    )
    ground = find_ground([PLANE, *stairs, deck, pillar])
    top = 0.18 * 17
    heights_m = heights(ground, [24, 12, 1.5], [24, 12, top + 1.5], [6.5, 12, 2.0], [8, 0, 1.0])
    np.testing.assert_allclose(heights_m, [1.5, 1.5, 2.0 - 0.18 * 6, 1.0], atol=1e-5)


@pytest.mark.parametrize("down", [False, True])
def test_terrain_is_ground_for_any_face_orientation(down):
    slope = build_sheet(lambda x, y: 0.1 * x - 0.05 * y, down=down)
    ground = find_ground([slope])
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-59, 59, (300, 2)), np.full(300, 30.0)])
    expected = 30 - 0.1 * points[:, 0] + 0.05 * points[:, 1]
    np.testing.assert_allclose(ground.compute_heights_m(points), expected, atol=1e-4)
    assert np.isnan(ground.compute_heights_m(points - [0, 0, 60])).all()
    assert ground.is_below_ground(np.array([0.0, 0.0, -0.5]))
    assert not ground.is_below_ground(np.array([0.0, 0.0, 0.5]))


def test_heights_are_along_the_world_vertical():
    ground = find_ground([PLANE, build_box((9, 3, 0.15), -20)])
    rng = np.random.default_rng(2)
    world_points_m = np.column_stack([rng.uniform(-50, 50, (200, 2)), rng.uniform(-0.03, 9, 200)])
    pose = build_transform(convert_euler_to_rotation(70, 3, -2), [4, -7, 1.0])
    inside = (world_points_m - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(
        ground.compute_heights_m(inside, pose), ground.compute_heights_m(world_points_m), atol=1e-4
    )


def test_steep_or_distant_faces_are_not_ground():
    assert find_level_faces(build_ramp((0, 1), (0, 1), (0, 0.9))).sum() == 2
    assert find_level_faces(build_ramp((0, 1), (0, 1), (0, 1.1))).sum() == 0
    for seed in range(50):  # 45 degrees up to rounding
        turn, side = build_transform(convert_euler_to_rotation(seed, 0, 0), [seed, 7.3, -0.1]), 1 / (1 + seed)
        assert find_level_faces(build_ramp((0, side), (0, 1), (0, side)).transform(turn)).sum() == 2
    walls = [build_box((0.2, 40, 5), 5), build_box((0.2, 40, 5), -5)]
    assert np.isnan(heights(find_ground(walls), [0, 0, 1])).all()
    roof = build_box((9, 9, 0.2), 0, 0, 3)
    assert np.isnan(heights(find_ground([*walls, roof]), [0, 0, 4])).all()
    # Ground far below counts; without any, a sheet above counts: the ego is below the ground.
    for z in (0.9, 1.5, -30.0):
        assert math.isclose(heights(find_ground([PLANE, roof], [(0, 0, z)]), [20, 0, 1])[0], 1, abs_tol=1e-5)
    assert math.isclose(heights(find_ground([PLANE, roof], [(0, 0, 3.3)]), [0, 0, 4])[0], 0.8, abs_tol=1e-5)


@pytest.mark.parametrize(("top_m", "height_m"), [(0.95, 2.05), (1.05, 3.0)])
def test_surfaces_within_a_meter_of_positions_are_ground(top_m, height_m):
    ground = find_ground([PLANE, build_box((9, 9, 0.2), 0, 0, top_m - 0.2)])
    assert math.isclose(heights(ground, [0, 0, 3])[0], height_m, abs_tol=1e-5)


def test_height_bounds_contain_all_points_of_triangles():
    bumpy = build_sheet(lambda x, y: 2 * np.sin(x / 9) + np.cos(y / 7) + 0.02 * x, half=100, every=4)
    ground = find_ground([bumpy, build_box((9, 9, 0.15), 30, 0, 3.0), build_box((20, 20, 1), -40, 0, 6.0)], [(0, 0, 1)])
    rng = np.random.default_rng(3)
    middle = np.column_stack([rng.uniform(-110, 110, (4000, 2)), rng.uniform(-4, 9, 4000)])
    triangles = (middle + rng.normal(0, 1, (3, 4000, 3)) * rng.choice([0.1, 1, 6], 4000)[:, None]).swapaxes(1, 2)
    low, high = ground.height_pyramid.compute_height_bounds_m(triangles)
    for _ in range(20):
        share = rng.dirichlet([0.5] * 3)
        heights_m = ground.compute_heights_m(np.einsum("c,cin->ni", share, triangles))
        has_ground = np.isfinite(heights_m)
        assert (heights_m[has_ground] >= low[has_ground]).all()
        assert (heights_m[has_ground] <= high[has_ground]).all()


def scan(scene, sensor, seed, time_step_index=0):
    """Scan a scene once with a reference sensor."""
    geometry = SceneGeometry(scene)
    return sensor.scan(
        ReferenceContext(geometry, geometry.get_snapshot(time_step_index), np.random.default_rng(seed), "a test")
    )


def build_static_scene(static, **pose):
    position = [pose.pop(key, 0.0) for key in ("x", "y", "z")]
    matrix = build_transform(
        convert_euler_to_rotation(*(pose.get(key, 0.0) for key in ("yaw", "pitch", "roll"))), position
    )
    return Scene(tuple(static), Actor("ego", "ego", EGO_MESH, Trajectory.from_poses([0.0], matrix[None])))


AREA = (((5.0, 45.0), (-10.0, 10.0)),)
OBSTACLE = SurfaceReference(AREA, num_rays=600, num_poses=2, bands_m=((0.5, 2.0),), band_frame="ground")


@pytest.mark.parametrize("slope", [0.0, 0.06, -0.06])
def test_walls_are_cut_by_height_above_slope(fix_position, slope):
    fix_position([2.6, 0.0, 1.0])
    wall = Mesh(np.array([[25, -8, -5], [25, 8, -5], [25, 8, 9], [25, -8, 9.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    scene = build_static_scene(
        [build_sheet(lambda x, y: slope * x + 0.04 * y), wall], pitch=-math.degrees(math.atan(slope))
    )
    scans = [scan(scene, OBSTACLE, seed) for seed in range(40)]
    for scan_ in scans:
        assert ((scan_.heights_m >= 0.5) & (scan_.heights_m < 2)).all()
        np.testing.assert_allclose(scan_.points[:, 0] - 25 * math.hypot(1, slope), 0, atol=1.0)
    assert_agrees(np.array([scan_.weights.astype(np.float64).sum() for scan_ in scans]), 16 * 1.5)


def test_sampling_by_height_is_unbiased():
    waves = build_sheet(lambda x, y: np.sin(x / 11), every=2)
    scene = SceneGeometry(build_static_scene([waves, build_box((4, 4, 3), 20, 0, -1), build_box((2, 9, 2), 30, 3, -1)]))
    areas = (((5.0, 45.0), (-10.0, 10.0)), ((15.0, 25.0), (-5.0, 5.0)))
    bands = ((0.5, 2.0), (-0.5, 0.5), (0.2, 1.0))

    def compute_sums(rays, num_poses, count):
        sensor = SurfaceReference(areas, rays, num_poses, bands, band_frame="ground")
        sum_weights = []
        for seed in range(count):
            reference_scan = sensor.scan(
                ReferenceContext(scene, scene.get_snapshot(0), np.random.default_rng(seed), "a test")
            )
            low = (reference_scan.heights_m < 0.5) & (reference_scan.points[:, 0] > 6)
            sum_weights.append(
                [reference_scan.weights[low].sum(), reference_scan.weights[reference_scan.heights_m >= 0.5].sum()]
            )
        return np.array(sum_weights, dtype=np.float64)

    exact = compute_sums(10_000, 8, 25)
    for rays, num_poses, count in ((400, 2, 200), (30, 1, 500)):
        sums_ = compute_sums(rays, num_poses, count)
        error = np.hypot(*(kind.std(axis=0, ddof=1) / math.sqrt(len(kind)) for kind in (sums_, exact)))
        assert (np.abs(sums_.mean(axis=0) - exact.mean(axis=0)) < 4 * error).all()
        assert (error < 0.1 * exact.mean(axis=0)).all()


def test_both_band_frames_agree_on_level_ground(fix_position):
    fix_position([2.6, 0.0, 1.0])
    wall = box([0.2, 10, 3], x_m=20)
    made = scenario({**FLOOR, "ground": True}, wall)
    for frame in ("ground", "vehicle"):
        sensor = SurfaceReference((((15.0, 25.0), (-6.0, 6.0)),), 500, 1, ((0.5, 2.0),), band_frame=frame)
        assert_agrees(sum_weights(made, sensor), 15.0)


def test_sunken_bodies_count_from_the_ground_up(fix_position):
    """The upper 5 cm of the front of a ledge of 4 x 4 m count as its top, as for curbs."""
    fix_position([2.6, 0.0, 2.0])
    ledge = {"name": "ledge", "ground": True, "shape": {"type": "box", "size_m": [4, 4, 2]}, "poses": [{"x_m": 12}]}
    for sunk_m in (0.0, 1.0, 1.6):
        made = scenario({**FLOOR, "ground": True}, {**ledge, "poses": [{"x_m": 12, "z_m": -sunk_m}]})
        high_m = 2.0 - sunk_m
        front = SurfaceReference((((9.5, 14.5), (-2.5, 2.5)),), 300, 1, ((0.5, 2.0),))
        assert_agrees(sum_weights(made, front, num_frames=20), 4 * max(high_m - 0.05 - 0.5, 0))
        if high_m < 2:  # the top is visible from here
            area = SurfaceReference((((10.0, 14.0), (-2.0, 2.0)),), 300, 1, ((-0.5, 0.5),))
            assert_agrees(sum_weights(made, area, num_frames=20), 16 + 4 * min(high_m, 0.5 + 0.05))


def test_moving_bodies_are_cut_by_height_above_ground(fix_position):
    fix_position([2.6, 0.0, 1.0])
    hill = build_sheet(lambda x, y: 0.08 * x)
    times = np.array([0.0, 1.0])
    lane = np.array([[20.0, -4, 1.6], [21, -4, 1.68]])
    truck = Actor("t", "truck", build_box((6, 2, 3)), Trajectory(times, lane, np.zeros((2, 3))))
    drive = Trajectory(times, np.array([[0.0, 0, 0], [1, 0, 0.08]]), np.zeros((2, 3)))
    scene = Scene((hill,), Actor("ego", "ego", EGO_MESH, drive), (truck,), 1.0, 1.0)
    only = [scan(scene, OBSTACLE, seed) for seed in range(60)]
    for reference_scan in only:
        assert ((reference_scan.heights_m >= 0.5) & (reference_scan.heights_m < 2)).all()
    # Side and upright rear that face the ego: 1.5 m of each, up to a bevel by the slope.
    weights = np.array(
        [reference_scan.weights[reference_scan.points[:, 1] > -3.001].sum() for reference_scan in only],
        dtype=np.float64,
    )
    assert_agrees(weights, 6 * 1.5, max_relative_error=0.05)


def list_attitudes():
    return [{}, {"pitch": 2.0}, {"pitch": -2.0}, {"roll": 2.0}, {"pitch": 1.5, "roll": -1.5}]


def test_heights_are_independent_of_ego_attitude():
    """The same world positions have the same heights for any attitude of the ego vehicle."""
    static = [build_sheet(lambda x, y: 0.03 * x), build_box((3, 3, 2.5), 20, 2), build_box((8, 3, 0.15), -20, 0, -0.6)]
    rng = np.random.default_rng(4)
    positions = np.column_stack([rng.uniform(-50, 50, (2000, 2)), rng.uniform(-1, 4, 2000)])
    all_heights_m = []
    for pose in list_attitudes():
        scene = build_static_scene(static, z=0.1, **pose)
        snapshot = SceneGeometry(scene).get_snapshot(0)
        inside = (positions - snapshot.world_T_vehicle[:3, 3]) @ snapshot.world_T_vehicle[:3, :3]
        all_heights_m.append(snapshot.compute_heights_m(inside.astype(np.float32)))
    for heights_m in all_heights_m[1:]:
        np.testing.assert_allclose(heights_m, all_heights_m[0], atol=2e-4)


def test_positions_below_ground_are_refused():
    flat = {True: build_sheet(lambda x, y: 0 * x, down=True), False: PLANE}
    for mesh in flat.values():
        snapshot = SceneGeometry(build_static_scene([mesh])).get_snapshot(0)
        assert not snapshot.is_occupied(np.array([3.0, 0.0, 0.3]))
        assert snapshot.is_occupied(np.array([3.0, 0.0, -0.3]))
    roof = build_sheet(lambda x, y: 0 * x + 3, half=5)
    inside = build_box((4, 4, 2), 8)
    snapshot = SceneGeometry(build_static_scene([PLANE, roof, inside])).get_snapshot(0)
    assert not snapshot.is_occupied(np.array([3.0, 0.0, 0.5]))  # under an open roof whose faces point up
    assert snapshot.is_occupied(np.array([8.0, 0.0, 1.0]))


def test_frames_keep_heights_through_transforms_and_storage(tmp_path):
    frames = SimulatedFrames("courtyard", "front_roof_32", num_frames=2, boxes=True)
    frame = frames[0]
    assert frame.reference_heights_m.shape == frame.reference_weights.shape
    assert torch.equal(pickle.loads(pickle.dumps(frame)).reference_heights_m, frame.reference_heights_m)
    assert torch.equal(frame.to("cpu").reference_heights_m, frame.reference_heights_m)
    batch = collate_frames([frame, frames[1]])
    assert [len(h) for h in batch.get_heights_m("ground")] == [len(points) for points in batch.reference]
    with pytest.raises(ValueError, match=r"sampled for bands above the ground; use the band frame ground$"):
        batch.get_heights_m("vehicle")
    unknown = dataclasses.replace(frame, reference_heights_m=None)
    with pytest.raises(ValueError, match=r"courtyard step 0.* are unknown; use the band frame vehicle$"):
        collate_frames([frame, unknown]).get_heights_m("ground")
    assert collate_frames([unknown]).get_heights_m("vehicle") is None
    torch.testing.assert_close(scale(frame, 2.0).reference_heights_m, 2 * frame.reference_heights_m)
    write_recording(frames, tmp_path / "there")
    loaded_frame = RecordedFrames(tmp_path / "there")[0]
    assert torch.equal(loaded_frame.reference_heights_m, frame.reference_heights_m)
    torch.testing.assert_close(loaded_frame.boxes.bottom_heights_m, frame.boxes.bottom_heights_m)


def test_boxes_have_bottom_heights_above_ground():
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=1, seed=2, boxes=True)
    boxes = frames[0].boxes
    assert len(boxes) > 20
    assert boxes.bottom_heights_m.abs().max() < 0.3
    assert (boxes.center_m[:, 2] - boxes.size_m[:, 2] / 2).abs().max() > 1.0


def test_unmarked_ground_is_found_and_noted():
    wall = box([0.2, 10, 3], x_m=20)
    deck = {"name": "deck", "shape": {"type": "box", "size_m": [9, 9, 4]}, "poses": [{"x_m": -30}]}
    guessed = Simulator(scenario(FLOOR, wall, deck), {}, OBSTACLE)
    assert "of 'floor'; bodies with" in guessed.ground_note
    marked = Simulator(scenario(FLOOR, wall, {**deck, "ground": True}), {}, OBSTACLE)
    assert marked.ground_note == ""
    assert [bool(mask.any()) for mask in marked.get_scene_geometry(0)[0].ground_masks] == [False, False, True]
    nothing = Simulator(scenario(wall, ego={**EGO, "pose": {"z_m": 30}}), {}, OBSTACLE)
    assert "none was found" in nothing.ground_note
    assert np.isnan(nothing.simulate_frame(0).reference_heights_m).all()


def test_bodies_without_level_faces_cannot_be_ground():
    part = {"name": "p", "ground": True, "shape": {"type": "box", "size_m": [1, 1, 1]}}
    with pytest.raises(ValueError, match="part 'p' is ground"):
        Vehicle.model_validate({"name": "v", "parts": [part]})
    upright = {
        "name": "wall",
        "ground": True,
        "shape": {"type": "plane", "size_m": [9, 9]},
        "poses": [{"roll_deg": 90}],
    }
    with pytest.raises(ValueError, match="body 'wall' is ground, but none of its faces"):
        scenario(FLOOR, upright).build_scene()
    with pytest.raises(ValueError, match="band_frame: ground or vehicle is needed; got 'world'"):
        SurfaceReference(AREA, band_frame="world")
    with pytest.raises(
        ValueError, match=r"bands_m: nothing is visible below the ground, and \(-3.0, -1.0\) m lies there"
    ):
        SurfaceReference(AREA, bands_m=((0.5, 2.0), (-3.0, -1.0)))
    SurfaceReference(AREA, bands_m=((-3.0, -1.0),), band_frame="vehicle")


def test_ground_of_the_courtyard_matches_the_search():
    scene = Scenario.load("courtyard").build_scene()
    marked, found_masks = (
        SceneGeometry(dataclasses.replace(scene, ground_mesh_indices=ground_indices)).ground_masks
        for ground_indices in (scene.ground_mesh_indices, None)
    )
    assert [mask.tolist() for mask in marked] == [mask.tolist() for mask in found_masks]
