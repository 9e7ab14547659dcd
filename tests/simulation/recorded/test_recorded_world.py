"""A drive through a small street becomes a scenario."""

import numpy as np
import pytest

from tests.recordings.drives import Drive
from torchcover.recordings import open_recording
from torchcover.simulation import Rig, Scenario, SimulatedFrames, write_recording, write_scenario
from torchcover.simulation.cell_mesh import CELL_M, build_cell_mesh
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box

SPEED_MPS, CAR_MPS, SECONDS = 8.0, -6.0, 2.4
WALL_M, UPHILL = 9.0, np.tan(np.deg2rad(1.0))
JUMP = 50.0 * np.eye(4)[:, :1] * np.eye(4)[3]
SCENARIO = f"""
name: street
duration_s: {SECONDS}
ego: {{shape: {{type: box, size_m: [4.0, 1.8, 1.4]}}, trajectory: ego.csv}}
bodies:
  - {{name: road, shape: {{type: plane, size_m: [200, 200]}}, poses: [{{pitch_deg: -1}}], ground: true}}
  - name: wall
    shape: {{type: box, size_m: [60, 1, 6]}}
    poses: [{{y_m: {WALL_M + 0.5}, z_m: -1}}]
actors:
  - {{name: van, category: car, shape: {{type: box, size_m: [5, 2, 2.2]}}, trajectory: car.csv}}
"""
LIDAR = {
    "type": "lidar",
    "name": "roof",
    "channels": 48,
    "vertical_fov_deg": (-30.0, 10.0),
    "horizontal_fov_deg": 360.0,
    "columns": 720,
    "max_range_m": 80.0,
    "mount": {"z_m": 1.8},
}


def build_trajectory_text(first_m, speed_mps, y_m):
    """Write a trajectory along x, on the slope."""
    rows = [
        (t, first_m + speed_mps * t, y_m, np.tan(np.deg2rad(1.0)) * (first_m + speed_mps * t)) for t in (0, SECONDS)
    ]
    return "t,x,y,z,roll,pitch,yaw\n" + "".join(f"{t},{x},{y},{z},0,-1,0\n" for t, x, y, z in rows)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("street")
    (folder / "street.yaml").write_text(SCENARIO)
    (folder / "ego.csv").write_text(build_trajectory_text(-12.0, SPEED_MPS, 0.0))
    (folder / "car.csv").write_text(build_trajectory_text(16.0, CAR_MPS, 4.0))
    frames = SimulatedFrames(
        Scenario.load(folder / "street.yaml"),
        Rig(name="one", sensors=[LIDAR]),
        num_frames=round(SECONDS / 0.1) + 1,
        frame_interval_s=0.1,
        boxes=True,
    )
    write_recording(frames, folder / "recording")
    return folder


@pytest.fixture(scope="module", params=["labels", "none"])
def made(request, drive):
    recording = open_recording(drive / "recording")
    if request.param == "none":
        recording.read_boxes = lambda index: None
    told = write_scenario(recording, drive / request.param)
    return recording, told, Scenario.load(drive / request.param / "scenario.yaml").build_scene()


def test_ground_matches_the_simulated_slope(made):
    recording, _, world = made
    ground, low_m = SceneGeometry(world).ground, np.array([[0.0, -3.0, 0.0], [30.0, -6.0, 0.0]])
    ground_m = low_m + UPHILL * low_m[:, :1] * np.array([0.0, 0.0, 1.0])
    placed_m = ground_m - recording.get_world_T_vehicle(0)[:3, 3]
    np.testing.assert_allclose(
        ground.compute_heights_m(placed_m + np.array([0.0, 0.0, 1.0]), np.eye(4)), 1.0, atol=0.05
    )


def test_walls_are_static_and_driven_areas_free(made):
    recording, _, world = made
    first_m = recording.get_world_T_vehicle(0)[:3, 3]
    corners_m = world.static_meshes[1].vertices_m + first_m - world.ego.trajectory.positions_m[0]
    assert (np.abs(corners_m[:, 1] - WALL_M) < 1.3).all()  # the wall is the only static object
    x, z = np.meshgrid(np.arange(-10.0, 10.0, 0.5), np.arange(0.8, 4.0, 0.5))
    wall_m = np.stack([x.ravel(), np.full(x.size, WALL_M), z.ravel()], axis=1)
    apart_m = np.linalg.norm(wall_m[:, None] - corners_m[None], axis=2).min(axis=1)
    assert apart_m.max() < 1.75 * CELL_M  # distance to the corner of a cell


def test_moving_objects_follow_their_tracks(made):
    recording, told, world = made
    assert "1 moving objects" in told
    (car,) = world.actors
    times_s = car.trajectory.times_s
    assert times_s[-1] - times_s[0] > SECONDS / 2
    placed_m = car.trajectory.positions_m + recording.get_world_T_vehicle(0)[:3, 3]
    np.testing.assert_allclose(placed_m[:, 1], 4.0, atol=0.5)
    off_m = np.abs(placed_m[:, 0] - 16.0 - CAR_MPS * times_s)
    assert np.median(off_m) < 0.4
    assert off_m.max() < 2.0  # only the front of oncoming vehicles is visible
    assert (np.abs(np.ptp(car.mesh.vertices_m, axis=0) - [5.0, 2.0, 2.2]) < [1.0, 0.5, 0.5]).all()


def test_ego_vehicle_follows_its_recorded_path(made):
    recording, _, world = made
    assert world.num_time_steps == len(recording.frame_names)
    moved = recording.get_world_T_vehicle(7)[:3, 3] - recording.get_world_T_vehicle(0)[:3, 3]
    np.testing.assert_allclose(world.ego.trajectory.interpolate(0.7)[:3, 3], moved, atol=1e-6)


def test_fewer_frames_make_a_shorter_world(drive):
    write_scenario(open_recording(drive / "recording"), drive / "short", num_frames=6)
    assert Scenario.load(drive / "short" / "scenario.yaml").build_scene().num_time_steps == 6


def test_cell_mesh_is_closed_with_correct_volume():
    cells = np.argwhere(np.ones((3, 4, 5), dtype=bool)) - [1, 2, 3]
    mesh, block = build_cell_mesh(cells), Box(type="box", size_m=(3, 4, 5)).build_mesh()
    assert len(np.unique(mesh.vertices_m, axis=0)) == len(mesh.vertices_m)
    edges = np.concatenate([mesh.faces[:, [one, (one + 1) % 3]] for one in range(3)])
    np.testing.assert_array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))

    def compute_area_and_volume(vertices, faces):
        a, b, c = vertices[faces].transpose(1, 0, 2)
        crossed = np.cross(b - a, c - a)
        return np.linalg.norm(crossed, axis=1).sum() / 2, (a * crossed).sum() / 6

    own, whole = (
        compute_area_and_volume(mesh.vertices_m / CELL_M, mesh.faces),
        compute_area_and_volume(block.vertices_m, block.faces),
    )
    np.testing.assert_allclose(own, whole)  # the volume is positive if faces point outwards


def test_unusable_drives_are_refused():
    alone = Drive(steps=8)
    with pytest.raises(ValueError, match="no ground is observed around the vehicle"):
        write_scenario(alone, alone.path)
    gap = Drive(steps=8)
    gap.times_s = gap.times_s + 60.0 * (np.arange(8) > 3)
    with pytest.raises(
        ValueError, match=r"nothing is recorded for 60\.1 s after f3, and a scene needs .* 5 s; .*\(--num-frames 4\)"
    ):
        write_scenario(gap, gap.path)
    jumping = Drive(steps=8)
    place = jumping.get_world_T_vehicle
    jumping.get_world_T_vehicle = lambda index: place(index) + JUMP * (index > 4)
    with pytest.raises(ValueError, match=r"the poses jump within 2\.5 s of f"):
        write_scenario(jumping, jumping.path)
