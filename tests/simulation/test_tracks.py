"""Trajectories and recorded actors from files, good and bad."""

import re
from contextlib import nullcontext

import numpy as np
import pytest

from torchcover import Scenario
from torchcover.geometry import convert_euler_to_rotation
from torchcover.recordings.formats.tracks import read_trajectory
from torchcover.simulation import Pose
from torchcover.simulation.rays import compute_unit_directions, split_into_tiles
from torchcover.simulation.recorded.bodies import read_box_actors
from torchcover.simulation.scene_geometry import SceneGeometry

HEADER = "t,x,y,z,roll,pitch,yaw\n"
BOXES = "t,id,category,x,y,z,length,width,height,yaw\n"


def write(folder, content, name="track.csv"):
    path = folder / name
    path.write_text(content)
    return path


def test_csv_columns_may_have_any_order(tmp_path):
    path = write(tmp_path, "yaw, t, x, note, y, z, roll, pitch\n90, 0, 1, a, 2, 3, 10, 20\n90, 1, 1,, 2, 3, 10, 20\n")
    pose = read_trajectory(path).interpolate(0.5)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(pose[:3, :3], convert_euler_to_rotation(90, 20, 10), atol=1e-12)


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_headings_that_look_like_radians_are_reported(tmp_path, unit):
    """A left bend, a reverse drive, and parked cars; the same drives in degrees cause no warning."""
    turn = np.linspace(0.0, 1.2, 30)
    for way, place in ((turn, 1.0), (turn + np.pi, -1.0)):
        x_m, y_m = place * 20 * np.sin(turn), place * 20 * (1 - np.cos(turn))
        yaw = (way if place > 0 else way - np.pi) * (1 if unit == "rad" else 180 / np.pi)
        rows = [f"{0.1 * k:.1f},{x_m[k]:.4f},{y_m[k]:.4f},0,0,0,{yaw[k]:.4f}" for k in range(30)]
        boxes = [f"{0.1 * k:.1f},a,car,{x_m[k]:.4f},{y_m[k]:.4f},0,4,2,1.5,{yaw[k]:.4f}" for k in range(30)]
        parked = f"0,a,car,5,5,0,4,2,1.5,{1.5708 if unit == 'rad' else 90}"
        for read, text, message in (
            (read_trajectory, HEADER + "\n".join(rows), "yaw: up to .* along the way as radians only"),
            (read_box_actors, BOXES + "\n".join(boxes), "yaw: up to .* along the way as radians only"),
            (read_box_actors, BOXES + parked, "yaw: 1.5708 looks like 90 degrees in radians"),
        ):
            with pytest.warns(UserWarning, match=message) if unit == "rad" else nullcontext():
                read(write(tmp_path, text))


def test_small_headings_in_degrees_are_not_reported(tmp_path):
    """A straight street to the north-east by east, whose headings jitter by a degree."""
    noise = np.random.default_rng(0).normal(0.0, 1.0, 200)
    rows = [f"{0.1 * k:.1f},{k},{0.05 * k:.3f},0,0,0,{2.86 + noise[k].clip(-3, 3):.4f}" for k in range(200)]
    read_trajectory(write(tmp_path, HEADER + "\n".join(rows)))


def test_poses_are_read(tmp_path):
    poses = np.stack([Pose(x_m=k, yaw_deg=10 * k, roll_deg=3).to_matrix() for k in range(4)])
    np.savez(tmp_path / "p.npz", times_s=np.arange(4.0), world_T_body=poses)
    track = read_trajectory(tmp_path / "p.npz")
    for k in range(4):
        np.testing.assert_allclose(track.interpolate(k), poses[k], atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEADER, "holds no row"),
        ("", "an empty file"),
        ("a\n1\n", "has to name the columns t, x, y, z, roll, pitch, yaw; missing: t, x, y, z, roll, pitch, yaw"),
        ("t,x,y,z,yaw\n0,0,0,0,0\n", "missing: roll, pitch"),
        (HEADER + "0,0,0,0,0,0,0\n1,0,zero,0,0,0,0\n", "line 3: y: a finite number is needed; got 'zero'"),
        (HEADER + "0,0,0,0,0,0,0\n1,0,0\n", "line 3: 7 columns are needed"),
        (HEADER + "0,0,0,0,0,0,0\n1,nan,0,0,0,0,0\n", "line 3: x: a finite number is needed; got 'nan'"),
        (HEADER + "0,0,0,0,0,0,0\n0,1,0,0,0,0,0\n", r"must ascend; pose 1 is at 0 s, after 0 s"),
        (HEADER + "0,0,0,0,0,0,0\n2,1,0,0,0,0,0\n1,1,0,0,0,0,0\n", r"must ascend; pose 2 is at 1 s, after 2 s"),
        (HEADER + "".join(f"{t},0,0,0,0,0,0\n" for t in (0, 1, 2, 9, 10)), "a gap of 7 s after t = 2 s"),
    ],
)
def test_a_bad_trajectory_names_the_file(tmp_path, content, message):
    path = write(tmp_path, content)
    with pytest.raises(ValueError, match=message) as caught:
        read_trajectory(path)
    assert str(caught.value).startswith(f"{path}: ")


UNIX_S = 1_700_000_000


def create_scenario_at(folder, ego_s, actor_s, boxes_s):
    """Build a run of 4 s of an ego, an actor and a box at 2, 3 and 4 m/s, each with a different start time."""
    for name, start_s, speed in (("ego", ego_s, 2), ("actor", actor_s, 3)):
        rows = "".join(f"{start_s + k / 4:.6f},{speed * k / 4},{10 * speed},0,0,0,0\n" for k in range(17))
        write(folder, HEADER + rows, f"{name}.csv")
    rows = "".join(f"{boxes_s + k / 4:.6f},1,car,{k},9,0,4,2,1.5,0\n" for k in range(17))
    write(folder, BOXES + rows, "boxes.csv")
    text = (
        "name: clocks\nego: {trajectory: ego.csv}\nboxes: boxes.csv\nduration_s: 4\ntime_step_s: 0.5\n"
        "bodies: [{name: ground, shape: {type: plane, size_m: [90, 90]}}]\n"
        "actors: [{name: a, category: car, shape: {type: box, size_m: [4, 2, 1]}, trajectory: actor.csv}]\n"
    )
    return Scenario.load(write(folder, text, "clocks.yaml"))


@pytest.mark.parametrize("start_s", [0, UNIX_S, 1e5])
def test_trajectories_of_another_clock_move_alike(tmp_path, start_s):
    scene = create_scenario_at(tmp_path, start_s, start_s + 1, start_s).build_scene()
    places_m = [
        actor.trajectory.interpolate_positions_m(np.array([0.0, 1.5, 3.0]))[:, 0]
        for actor in (scene.ego, *scene.actors)
    ]
    np.testing.assert_allclose(places_m, [[0, 3, 6], [0, 1.5, 6], [0, 6, 12]], atol=1e-5)


def test_trajectories_of_different_clocks_are_named(tmp_path):
    with pytest.warns(UserWarning, match="give all trajectories one clock") as warned:
        create_scenario_at(tmp_path, UNIX_S, 0, UNIX_S).build_scene()
    first, second = (str(warning.message) for warning in warned)
    assert first.startswith(
        "ego rests: its times, 1700000000.000 to 1700000004.000 s, lie outside of the run, 0.000 to"
    )
    assert second.startswith("1 is not there: its times, 1700000000.000 to")


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (np.arange(4) * 100_000_000, "times in seconds are needed; their median interval is 1e+08: divide them by"),
        (np.arange(4) * 100, "times in seconds are needed; their median interval is 100: divide them by 1e3"),
        (
            (np.arange(4) * 0.1 + 1e5).astype("f4"),
            "times of float32 are rounded to 0.0078125 s, with a median interval of",
        ),
    ],
)
def test_times_in_other_units_are_refused(tmp_path, times, message):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    np.savez(tmp_path / "p.npz", times_s=times, world_T_body=poses)
    with pytest.raises(ValueError, match=f"p.npz: {re.escape(message)}"):
        read_trajectory(tmp_path / "p.npz")


def test_poses_that_are_not_rigid_are_refused(tmp_path):
    np.savez(tmp_path / "p.npz", times_s=[0.0], world_T_body=[np.diag([2.0, 1, 1, 1])])
    with pytest.raises(ValueError, match=r"p\.npz: pose 0: not a rigid transform"):
        read_trajectory(tmp_path / "p.npz")
    np.savez(tmp_path / "q.npz", times=[0.0])
    with pytest.raises(ValueError, match=r"q\.npz: needs the arrays times_s and world_T_body; got times"):
        read_trajectory(tmp_path / "q.npz")


def test_missing_files_and_other_formats_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.csv: no such file; a trajectory is needed"):
        read_trajectory(tmp_path / "none.csv")
    with pytest.raises(ValueError, match=r"a trajectory is a \.csv or \.npz file; got \.txt"):
        read_trajectory(write(tmp_path, HEADER).rename(tmp_path / "t.txt"))
    with pytest.raises(FileNotFoundError, match="no such file; a file of boxes is needed"):
        read_box_actors(tmp_path / "none.csv")


def test_recorded_boxes_become_transient_actors(tmp_path):
    rows = [f"{t},a,car,{5 + t},0,0,4,2,1.5,0" for t in (1, 2, 3)] + ["1,b,truck,0,9,0,8,2.5,3,90"]
    a, b = read_box_actors(write(tmp_path, BOXES + "\n".join(rows)))
    assert (a.name, a.category, b.name, b.category) == ("a", "car", "b", "truck")
    np.testing.assert_allclose(np.ptp(a.mesh.vertices_m, axis=0), [4, 2, 1.5])
    np.testing.assert_allclose(a.trajectory.interpolate(1.5)[:3, 3], [6.5, 0, 0])
    np.testing.assert_allclose(b.trajectory.interpolate(1.0)[:3, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1,a,car,0,0,0,0,2,1,0", "id a: a box needs a positive length"),
        ("1,a,car,0,0,0,nan,2,1,0", "line 2: length: a finite number is needed"),
        ("1,a,car,nan,0,0,4,2,1,0", "line 2: x: a finite number is needed"),
        ("1,a,car,0,0,0,4,2,1,0\n1,a,car,0,0,0,4,2,1,0", "id a: .*must ascend"),
    ],
)
def test_bad_boxes_name_their_id(tmp_path, row, message):
    with pytest.raises(ValueError, match=message):
        read_box_actors(write(tmp_path, BOXES + row))


SCENARIO = """
name: s
time_step_s: 1.0
duration_s: 4.0
ego: {shape: {type: box, size_m: [4, 2, 1.5]}, trajectory: ego.csv}
bodies:
  - {name: ground, shape: {type: plane, size_m: [400, 400]}}
actors:
  - {name: bus, category: bus, shape: {type: box, size_m: [12, 2.5, 3]}, trajectory: bus.csv}
boxes: boxes.csv
"""


def test_a_scenario_of_files_plays(tmp_path):
    write(tmp_path, HEADER + "0,0,0,0,0,0,0\n4,40,0,0,0,0,0\n", "ego.csv")
    write(tmp_path, HEADER + "0,30,4,0,0,0,0\n4,30,4.004,0,0,0,0\n", "bus.csv")
    write(tmp_path, BOXES + "1,a,car,20,-5,0,4,2,1.5,0\n2,a,car,20,-5,0,4,2,1.5,0\n", "boxes.csv")
    scene = Scenario.load(write(tmp_path, SCENARIO, "s.yaml")).build_scene()
    assert scene.num_time_steps == 5
    scene = SceneGeometry(scene)
    sphere = split_into_tiles(
        compute_unit_directions(np.linspace(-60, 30, 90)[:, None], np.linspace(-180, 179, 360)[None])
    )
    rear_of_bus, box_seen = [], []
    for step in range(5):
        x, y, z = scene.get_snapshot(step).scan(Pose(z_m=2.0).to_matrix(), sphere).points.T
        rear_of_bus.append(x[(y > 2.7) & (z > 0.1)].min())
        box_seen.append(bool(((y < -3) & (z > 0.5)).any()))
    np.testing.assert_allclose(rear_of_bus, [24 - 10 * step for step in range(5)], atol=0.5)
    assert box_seen == [False, True, True, False, False]


def test_actors_have_either_pose_or_trajectory(tmp_path):
    invalid = SCENARIO.replace("trajectory: ego.csv", "trajectory: ego.csv, pose: {x_m: 1}")
    with pytest.raises(ValueError, match="ego: give a pose or a trajectory, not both"):
        Scenario.load(write(tmp_path, invalid, "s.yaml"))
