"""Surface reference: weights add up to the visible area, for any number of rays and positions."""

import math
import pickle

import numpy as np
import pytest
import torch
import trimesh
from torch.utils.data import DataLoader

from torchcover import nearest
from torchcover.coverage import BevGrid, CoverageMetric
from torchcover.data import SimulatedFrames, collate_frames
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, SurfaceReference

from .small_scenarios import AHEAD, ALL_HEIGHTS, EGO, FLOOR, assert_agrees, box, scenario, sum_weights


def write_sheet(folder, triangles, name="sheet.ply"):
    triangles = np.asarray(triangles, dtype=np.float64)
    path = folder / name
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
    mesh.export(path)
    return {"name": name, "shape": {"type": "mesh", "path": str(path)}}


def rectangle(x, y, z=0.0):
    (x0, x1), (y0, y1) = x, y
    return [[[x0, y0, z], [x1, y0, z], [x1, y1, z]], [[x0, y0, z], [x1, y1, z], [x0, y1, z]]]


def get_x(points):
    return points[:, 0].astype(np.float64)


def test_holes_reduce_the_visible_area(fix_position, tmp_path):
    parts = [((-50, 10), (-50, 50)), ((12, 50), (-50, 50)), ((10, 12), (-50, -1)), ((10, 12), (1, 50))]
    floor = write_sheet(tmp_path, [triangle for part in parts for triangle in rectangle(*part)])
    fix_position([2.5, 0.3, 1.0])
    sensor = SurfaceReference((AHEAD,), num_rays=400, num_poses=1, bands_m=ALL_HEIGHTS)
    assert_agrees(sum_weights(scenario(floor), sensor), 200.0 - 4.0)
    assert_agrees(sum_weights(scenario(floor), sensor, get_x), 200.0 * 14.0 - 4.0 * 11.0)


@pytest.mark.parametrize(
    ("pit", "m2"),
    [
        (rectangle((10, 12), (-1, 1), -1.5), 4.0),
        ((np.array(rectangle((-1.5, 0), (-1, 1)))[..., [2, 1, 0]] + [11.99, 0, 0]).tolist(), 3.0),  # a wall of the pit
        (rectangle((10, 12), (-1, 1), 1.0), 4.0),  # a cover above it
    ],
)
def test_surface_without_ground_changes_no_number(fix_position, tmp_path, pit, m2):
    parts = [((-50, 10), (-50, 50)), ((12, 50), (-50, 50)), ((10, 12), (-50, -1)), ((10, 12), (1, 50))]
    floor = write_sheet(tmp_path, [triangle for part in parts for triangle in rectangle(*part)])
    fix_position([11.0, 0.0, 2.0])
    sensor = SurfaceReference((AHEAD,), num_rays=2000, num_poses=2, bands_m=ALL_HEIGHTS)
    simulator = Simulator(scenario(floor, write_sheet(tmp_path, pit, "pit.ply")), {}, sensor)
    observations = [simulator.simulate_frame(index) for index in range(20)]
    in_no_band = [np.isnan(observation.reference_heights_m) for observation in observations]
    pairs = list(zip(observations, in_no_band, strict=True))
    assert_agrees(
        np.array([observation.reference_weights[mask].astype(np.float64).sum() for observation, mask in pairs]),
        m2,
        max_relative_error=0.05,
    )
    metric = CoverageMetric(
        BevGrid(x_m=AHEAD[0], y_m=AHEAD[1], cell_m=1.0, heights={"all": (-3.0, 3.0)}, band_frame="ground")
    )
    for observation in observations:
        clouds = torch.zeros(1, 3), torch.from_numpy(observation.reference)
        metric.update(*clouds, heights_m=torch.from_numpy(observation.reference_heights_m))
    assert metric.compute().counts["no_ground_points"] == sum(map(int, map(np.sum, in_no_band))) > 0
    without = Simulator(scenario(floor), {}, sensor)
    if m2 == 4.0 and pit[0][0][2] < 0:  # the floor is fully visible, and its random numbers are the same
        for index, (observation, mask) in enumerate(pairs):
            assert np.array_equal(observation.reference[~mask], without.simulate_frame(index).reference)


@pytest.mark.parametrize("turned", [False, True])
def test_sheets_are_visible_from_both_sides(fix_position, tmp_path, turned):
    parts = [((-4, -1), (0, 4)), ((1, 4), (0, 4)), ((-1, 1), (0, 1)), ((-1, 1), (2, 4))]
    upright = np.array([triangle for part in parts for triangle in rectangle(*part)])[..., [2, 0, 1]] + [12, 0, 0]
    sheet = write_sheet(tmp_path, upright[:, ::-1] if turned else upright)
    fix_position([2.5, 0.3, 1.0])
    sensor = SurfaceReference((AHEAD,), num_rays=400, num_poses=1, bands_m=((0.5, 2.0),))
    assert_agrees(sum_weights(scenario(sheet, FLOOR), sensor), 8 * 1.5 - 2 * 1)


def test_faces_seen_edge_on_give_no_points(fix_position, tmp_path):
    upright = np.array(rectangle((-2, 2), (0, 3)))[..., [2, 0, 1]] + [12, 0, 0]
    fix_position([12.0, -5.0, 1.0])
    sensor = SurfaceReference((AHEAD,), num_rays=400, num_poses=1, bands_m=((0.5, 2.0),))
    assert not sum_weights(scenario(write_sheet(tmp_path, upright), FLOOR), sensor).any()


def test_two_sided_sheets_count_once(fix_position, tmp_path):
    one = np.array(rectangle((-2, 2), (0, 3)))[..., [2, 0, 1]] + [12, 0, 0]
    fix_position([2.5, 0.3, 1.0])
    sensor = SurfaceReference((AHEAD,), num_rays=400, num_poses=1, bands_m=((0.5, 2.0),))
    both = write_sheet(tmp_path, np.concatenate([one, one[:, ::-1]]))
    assert_agrees(sum_weights(scenario(both, FLOOR), sensor), 4 * 1.5)


@pytest.mark.filterwarnings("ignore:.*faces lie within 1 mm")  # inside out, the bottom points up like the floor
@pytest.mark.parametrize("inside_out", [False, True])
def test_only_facing_sides_of_a_box_count(fix_position, tmp_path, inside_out):
    made = trimesh.creation.box(extents=[2, 2, 1.5])
    made.apply_translation([10, 0, 0.75])
    faces = made.vertices[made.faces]
    body = write_sheet(tmp_path, faces[:, ::-1] if inside_out else faces)
    fix_position([2.5, 3.0, 2.5])
    sensor = SurfaceReference((AHEAD,), num_rays=1000, num_poses=1, bands_m=((0.5, 2.0),))
    assert_agrees(sum_weights(scenario(body, FLOOR), sensor), 2.0 + 2.0 + 4.0)
    on_top = sum_weights(scenario(body, FLOOR), sensor, lambda points: points[:, 2] > 1.49999)
    assert_agrees(on_top, 4.0)


def test_half_occluded_walls_have_half_the_area(fix_position):
    wall, screen = box([0.2, 10, 3], x_m=20), box([0.2, 2, 10], x_m=10, y_m=1)
    fix_position([2.6, 0.0, 1.0])
    sensor = SurfaceReference((((15.0, 25.0), (-6.0, 6.0)),), num_rays=1000, num_poses=1, bands_m=((0.5, 2.0),))
    hidden_m = 2.0 * (19.9 - 2.6) / (9.9 - 2.6)
    assert_agrees(sum_weights(scenario(wall, screen, FLOOR), sensor), 1.5 * (10 - hidden_m))
    heights = sum_weights(scenario(wall, screen, FLOOR), sensor, lambda points: points[:, 2].astype(np.float64))
    assert_agrees(heights, 1.5 * 1.25 * (10 - hidden_m))


def test_the_ego_occludes_without_being_sampled(fix_position):
    fix_position([0.0, 0.0, 2.0])  # half a metre above the roof
    around = SurfaceReference((((-5.0, 5.0), (-5.0, 5.0)),), num_rays=2000, num_poses=1, bands_m=ALL_HEIGHTS)
    # The shadow of the roof, at four times the distance of the roof.
    assert_agrees(sum_weights(scenario(box([1, 1, 1], x_m=90), FLOOR), around), 100.0 - 10.0 * 8.0)
    observation = Simulator(scenario(FLOOR), {}, around).simulate_frame(0)
    assert np.abs(observation.reference[:, 2]).max() < 1e-4
    assert observation.counts["reference_self_hits"] == observation.counts["reference_rays"] - len(
        observation.reference
    )


def test_regions_pitch_with_the_vehicle(fix_position):
    fix_position([2.6, 0.0, 1.0])
    ego = {**EGO, "pose": {"z_m": 3.0, "pitch_deg": 5.0}}
    sensor = SurfaceReference((AHEAD,), num_rays=1000, num_poses=2, bands_m=((-6.0, 0.0),), band_frame="vehicle")
    assert_agrees(sum_weights(scenario(FLOOR, ego=ego), sensor), 200.0 / math.cos(math.radians(5)))


def test_the_mean_is_independent_of_sample_sizes():
    made = Scenario.load("courtyard")
    areas = (((0.0, 20.0), (-5.0, 5.0)), ((-10.0, 40.0), (-10.0, 10.0)))
    exact = sum_weights(made, SurfaceReference(areas, num_rays=8192, num_poses=4), num_frames=12)
    spread = {}
    for rays, num_poses, steps in [(1024, 1, 64), (1024, 4, 32), (64, 4, 32), (1, 1, 64)]:
        sums_ = sum_weights(
            made, SurfaceReference(areas, num_rays=rays, num_poses=num_poses), num_frames=steps, first_index=100
        )
        error = math.hypot(*(kind.std(ddof=1) / math.sqrt(len(kind)) for kind in (sums_, exact)))
        assert abs(sums_.mean() - exact.mean()) < 4 * error
        assert error < 0.1 * exact.mean() or rays == 1
        spread[rays, num_poses] = sums_.std()
    # More positions per frame reduce the error, at the same number of rays.
    assert spread[1024, 4] < 0.75 * spread[1024, 1]


def test_overlapping_strata_share_their_points(fix_position):
    fix_position([2.6, 0.0, 1.0])
    inner = ((6.0, 9.0), (-2.0, 3.0))
    sensor = SurfaceReference((AHEAD, inner, AHEAD), num_rays=900, num_poses=1, bands_m=((-0.5, 0.5), (-0.2, 0.1)))
    assert_agrees(sum_weights(scenario(FLOOR), sensor), 200.0)
    assert_agrees(sum_weights(scenario(FLOOR), sensor, lambda points: (points[:, 0] >= 6) & (points[:, 0] < 9)), 30.0)
    observation = Simulator(scenario(FLOOR), {}, sensor).simulate_frame(0)
    inside = (np.abs(observation.reference[:, 1] - 0.5) < 2.5) & (np.abs(observation.reference[:, 0] - 7.5) < 1.5)
    assert len(np.unique(observation.reference_weights.round(4))) == 2
    assert observation.reference_weights[inside].max() < observation.reference_weights[~inside].min()


def test_empty_surroundings_give_no_points(fix_position):
    fix_position([2.5, 0.0, 1.0])
    empty = SurfaceReference((AHEAD,), num_rays=100, bands_m=((1.0, 2.0), (50.0, 60.0)))
    observation = Simulator(scenario(FLOOR), {}, empty).simulate_frame(0)
    assert observation.reference.shape == (0, 3)
    assert observation.reference_weights.shape == (0,)
    assert observation.counts["reference_rays"] == 0
    behind = SurfaceReference((((15.0, 20.0), (-1.0, 1.0)),), num_rays=100)
    hidden = Simulator(scenario(box([0.2, 40, 30], x_m=8), FLOOR), {}, behind).simulate_frame(0)
    assert len(hidden.reference) == 0
    assert hidden.counts["reference_rays"] > 40


def test_faces_of_any_proportion_are_sampled_correctly(fix_position, tmp_path):
    fix_position([2.5, 0.3, 1.0])
    huge = rectangle((-1e5, 1e5), (-1e5, 1e5))
    needle = [[[5, 0, 0.6], [1e5, 0, 0.6], [5, 1e-7, 0.6]]]
    nothing = [[[6, 0, 1], [6, 0, 1], [6, 0, 1]], [[6, 0, 1], [7, 0, 1], [8, 0, 1]]]
    sensor = SurfaceReference((AHEAD,), num_rays=400, num_poses=1, bands_m=ALL_HEIGHTS)
    assert_agrees(sum_weights(scenario(write_sheet(tmp_path, [*huge, *needle, *nothing])), sensor), 200.0)


def test_threads_workers_and_pickling_change_nothing():
    car = {"category": "car", "shape": {"type": "vehicle", "vehicle": "sedan"}}
    actors = [{**car, "name": f"car {x_m}", "pose": {"x_m": x_m, "y_m": 3.0}} for x_m in (8.0, 14.0, 30.0)]
    made = scenario(FLOOR, box([2, 2, 1.5], x_m=12), actors=actors)
    sensor = SurfaceReference((AHEAD, ((0.0, 80.0), (-20.0, 20.0))), num_rays=30_000, num_poses=2, points_per_object=8)
    frames = SimulatedFrames(made, "front_roof_32", num_frames=4, seed=2, reference_sensor=sensor, boxes=True)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        shuffled = [frames[index] for index in (3, 0, 1, 2)]
        torch.set_num_threads(3)
        three = [pickle.loads(pickle.dumps(frames))[index] for index in (3, 0, 1, 2)]
    finally:
        torch.set_num_threads(threads)
    batches = DataLoader(frames, sampler=[3, 0, 1, 2], num_workers=2, collate_fn=collate_frames)
    loaded = [frame for batch in batches for frame in batch.frames]
    for frame, *variants in zip(shuffled, three, loaded, strict=True):
        for variant in variants:
            assert torch.equal(frame.sensor, variant.sensor)
            assert torch.equal(frame.reference, variant.reference)
            assert torch.equal(frame.reference_weights, variant.reference_weights)
            assert torch.equal(frame.boxes.sampled_points, variant.boxes.sampled_points)
            assert frame.counts == variant.counts


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"areas": ()}, "areas: at least one rectangle"),
        ({"areas": (((1.0, 0.0), (0.0, 1.0)),)}, "areas: finite bounds, lower first"),
        ({"bands_m": ()}, "bands_m: at least one"),
        ({"bands_m": ((0.5, 0.5),)}, "bands_m: at least one"),
        ({"bands_m": ((0.0, math.inf),)}, "bands_m: at least one"),
        ({"num_rays": 0}, "num_rays: at least 1 is needed; got 0"),
        ({"num_poses": 0}, "num_poses: at least 1 is needed; got 0"),
        ({"points_per_object": -1}, "points_per_object: at least 0 is needed; got -1"),
        ({"shell_m": 0.0}, "shell_m: a positive thickness"),
        ({"max_range_m": math.nan}, "max_range_m: a positive distance"),
    ],
)
def test_invalid_settings_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        SurfaceReference(**{"areas": (AHEAD,), **options})


def test_surface_hidden_from_roadside_rigs_is_undetected():
    """A wall of 4 m, 10 m from a mast of 6 m, hides the ground up to x = 30 m from the mast."""
    wall = {"name": "wall", "shape": {"type": "box", "size_m": [0.5, 100, 4]}, "poses": [{"x_m": 10}]}
    floor = {"name": "floor", "shape": {"type": "plane", "size_m": [300, 300]}, "ground": True}
    mast = {"shape": {"type": "cylinder", "radius_m": 0.1, "height_m": 6}, "pose": {}}
    road = Scenario.model_validate({"name": "s", "ego": mast, "bodies": [floor, wall]})
    lidar = {"type": "lidar", "name": "top", "mount": {"z_m": 6.2}, "channels": 64, "vertical_fov_deg": [-60, 0],
             "horizontal_fov_deg": 360, "columns": 256, "max_range_m": 200}  # fmt: skip
    rig = Rig.model_validate({"name": "roadside", "sensors": [lidar]})
    frames = SimulatedFrames(road, rig, num_frames=1)
    x_m, y_m, _ = frames[0].reference.T
    behind = (x_m > 11) & (x_m < 25) & (y_m.abs() < 20)
    assert behind.sum() > 100
    assert nearest(frames[0].reference[behind], frames[0].sensor).distance.min() > 0.4
    assert frames.describe_reference()["notes"][-1].startswith("Reference positions: anywhere in the regions")
    with pytest.raises(ValueError, match="close to the mast of this roadside rig"):
        SimulatedFrames(road, rig, num_frames=1, reference_sensor=PaperReference())
    on_car = SimulatedFrames("courtyard", "front_roof_32", num_frames=1).reference_sensor
    assert (on_car.is_over_areas, on_car.shell_m) == (False, 0.5)
