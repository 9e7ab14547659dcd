"""Scenarios of recorded tracks: poses, ground and repetition."""

import numpy as np
import pytest

from tests.recordings.drives import CAR_SIZE_M, Drive
from tests.recordings.layouts import LAYOUTS
from tests.simulation.recorded.drives import (
    EGO,
    ORIGIN_M,
    OTHERS,
    STEP_S,
    STEPS,
    TIMES_S,
    RecordedBox,
    compute_flat_heights_m,
    compute_hill_heights_m,
    poses,
    rewrite,
    write_all,
    write_argoverse2,
    write_csv,
    write_nuscenes,
)
from torchcover import Rig, Scenario
from torchcover.evaluation.task import compute_frame_interval_s
from torchcover.geometry import BoundingBox, build_transform, invert
from torchcover.simulation import PaperReference, SimulatedFrames, Simulator
from torchcover.simulation.builtin import get_builtin_folder, list_builtin_names
from torchcover.simulation.height_field import GroundHeightField

FEW = PaperReference(rows=24, columns=48)
LIDAR = {"name": "top", "mount": {"z_m": 2.0}, "channels": 8, "vertical_fov_deg": (-20, 0), "columns": 60,
         "horizontal_fov_deg": 360, "max_range_m": 100}  # fmt: skip
RIG = Rig.model_validate({"name": "rig", "sensors": [LIDAR]})


def build_scenario(path, **keys):
    return Scenario.model_validate({"name": "drive", "traffic": {"type": "tracks", "path": str(path), **keys}})


def build_drive(folder, **keys):
    """Scenario of the drive that `write_csv` writes."""
    return build_scenario(folder / "boxes.csv", ego_trajectory=str(folder / "ego.csv"), **keys)


def raise_row(row, by_m, *names):
    """Raise a row of `boxes.csv` if it has one of some names."""
    return [*row[:5], str(float(row[5]) + by_m), *row[6:]] if row[1] in names else row


def of(world, name):
    return next(actor for actor in world.actors if actor.name == name)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("written")
    write_all(folder)
    return folder


FORMATS = {
    "argoverse2": ("argoverse2", {}, compute_hill_heights_m, STEP_S, 1e-6),
    "nuscenes": ("nuscenes", {}, compute_flat_heights_m, 5 * STEP_S, 1e-6),
    "commonroad": ("commonroad.xml", {"ego_id": 1}, compute_flat_heights_m, STEP_S, 2e-6),
    "table": ("table/boxes.csv", {"ego_trajectory": "ego.csv"}, compute_hill_heights_m, STEP_S, 1e-6),
}


def open_scenario(written, kind):
    path, keys, *rest = FORMATS[kind]
    beside = (written / path).parent
    keys = {key: str(beside / value) if key.endswith("trajectory") else value for key, value in keys.items()}
    return build_scenario(written / path, **keys), *rest


@pytest.mark.parametrize("kind", FORMATS)
def test_actor_poses_equal_a_reference_implementation(written, kind):
    drive, heights, recorded_s, atol = open_scenario(written, kind)
    world = drive.build_scene()
    ego = OTHERS[0] if kind == "commonroad" else EGO
    for time_s in (0.0, 0.4, 1.37, 2.05, 4.0):
        for one in (ego, *OTHERS):
            name = str([EGO, *OTHERS].index(one)) if kind == "commonroad" else one.name
            actor = world.ego if one is ego else of(world, name)
            known_s = TIMES_S[one.first : one.last + 1 : round(recorded_s / STEP_S)]
            if kind == "nuscenes":  # samples are every fifth frame
                known_s = np.array([time for time in TIMES_S[::5] if TIMES_S[one.first] <= time <= TIMES_S[one.last]])
            there = (one.speed_mps == 0 and kind == "commonroad") or known_s[0] <= time_s <= known_s[-1]
            at = actor.trajectory.interpolate_positions_m(np.array([time_s]))[0]
            if actor is not world.ego and not there:
                assert np.isnan(at).all(), (name, time_s)
                continue
            dense_s = {"argoverse2": STEP_S / 2, "nuscenes": STEP_S}.get(kind, STEP_S) * np.arange(-1, 2 * STEPS)
            own_s = dense_s if one is EGO else known_s
            places_m = poses(one, heights, own_s)[:, :3, 3]
            twin = [np.interp(time_s, own_s, column) for column in places_m.T]
            np.testing.assert_allclose(at, twin, atol=atol, err_msg=f"{name} {time_s}")
    turned = poses(ego, heights)[4, :3, :3]
    np.testing.assert_allclose(world.ego.trajectory.interpolate(TIMES_S[4])[:3, :3], turned, atol=1e-6)


@pytest.mark.parametrize("kind", FORMATS)
def test_runs_repeat_after_the_end_of_the_recording(written, kind):
    drive, *_ = open_scenario(written, kind)
    assert drive.is_repeating
    assert (drive.num_time_steps, drive.num_distinct_time_steps) == (41, 41)
    assert [drive.locate(index) for index in (0, 40, 41, 100)] == [(0, 0), (0, 40), (0, 0), (0, 18)]
    simulator = Simulator(drive, {"rig": RIG}, FEW, frame_interval_s=0.3)
    assert simulator.num_distinct_frames == 41
    assert [simulator.get_block_index(index) for index in (0, 1, 13, 14, 41)] == [0, 3, 39, 1, 0]
    assert simulator.get_run_index(1000) == 0
    assert round(compute_frame_interval_s(drive, None) / 0.1) == 25  # the golden ratio of its frames


def test_repeated_frames_are_counted_and_equal(written):
    drive, *_ = open_scenario(written, "table")
    simulator = Simulator(drive, {"rig": RIG}, FEW)
    first, again = simulator.simulate_frame(3), simulator.simulate_frame(3 + 41)
    assert (first.counts["repeated_frames"], again.counts["repeated_frames"]) == (0, 1)
    np.testing.assert_array_equal(first.clouds["rig"], again.clouds["rig"])
    assert not np.array_equal(first.reference, again.reference)


def test_recorded_scenes_do_not_depend_on_seeds(written):
    drive, *_ = open_scenario(written, "argoverse2")
    again, *_ = open_scenario(written, "argoverse2")
    one, other = drive.build_scene(seed=1), again.build_scene(seed=2, run_index=5)
    np.testing.assert_array_equal(one.static_meshes[0].vertices_m, other.static_meshes[0].vertices_m)
    for mine, its in zip((one.ego, *one.actors), (other.ego, *other.actors), strict=True):
        assert (mine.name, mine.category) == (its.name, its.category)
        np.testing.assert_array_equal(mine.trajectory.positions_m, its.trajectory.positions_m)


def get_heights(mesh, places_m):
    """Get the heights of a mesh of a raster."""
    corners = np.unique(mesh.vertices_m[:, 0]), np.unique(mesh.vertices_m[:, 1])
    raster = np.full((len(corners[1]), len(corners[0])), np.nan)
    raster[np.searchsorted(corners[1], mesh.vertices_m[:, 1]), np.searchsorted(corners[0], mesh.vertices_m[:, 0])] = (
        mesh.vertices_m[:, 2]
    )
    return GroundHeightField(np.array([corners[0][0], corners[1][0]]), raster, np.empty((0, 0))).compute_heights_m(
        places_m
    )


def compute_ground_offsets_m(world, others, heights=compute_hill_heights_m):
    """Compute the distance of the ground from the positions of some objects at all times."""
    places_m = np.concatenate([poses(one, heights)[one.first : one.last + 1, :3, 3] for one in others])
    return get_heights(world.static_meshes[0], places_m[:, :2]) - places_m[:, 2]


def test_ground_lies_below_tracks_within_centimeters(written):
    world = open_scenario(written, "argoverse2")[0].build_scene()
    assert np.abs(compute_ground_offsets_m(world, [EGO])).max() < 0.03
    # Other objects may hang above the ground; the bicycles of Argoverse have no rider.
    off_m = np.abs(
        compute_ground_offsets_m(world, [one for one in OTHERS if one.category not in ("bollard", "bicycle")])
    )
    assert off_m.max() < 0.05
    assert np.median(off_m) < 0.01


@pytest.mark.parametrize("kind", ["table", "argoverse2"])
def test_wheels_stand_on_slopes(written, kind):
    world = open_scenario(written, kind)[0].build_scene()
    for actor in world.actors:
        if actor.category not in ("car", "truck", "bus"):
            continue
        trajectory, length_m = actor.trajectory, np.ptp(actor.mesh.vertices_m[:, 0])
        for time_s in trajectory.times_s[::4]:
            pose = trajectory.interpolate(time_s)
            wheels_m = np.array([[along * length_m, across, 0.0] for along in (-0.3, 0.3) for across in (-0.8, 0.8)])
            wheels_m = wheels_m @ pose[:3, :3].T + pose[:3, 3]
            assert np.abs(wheels_m[:, 2] - compute_hill_heights_m(wheels_m[:, :2])).max() < 0.07
    people = [actor for actor in world.actors if actor.category == "pedestrian"]
    assert people
    assert kind != "table" or not any(person.trajectory.angles_deg[:, 1:].any() for person in people)


def test_ground_extends_beyond_tracks(written):
    world = open_scenario(written, "argoverse2")[0].build_scene()
    vertices_m = world.static_meshes[0].vertices_m
    assert np.isfinite(vertices_m).all()
    assert (np.ptp(vertices_m[:, :2], axis=0) > 500).all()
    assert (np.abs(vertices_m[:, 2] - 31.0) < 8.0).all()


def test_outliers_do_not_lift_the_ground(tmp_path):
    drive = build_drive(write_csv(tmp_path))
    rewrite(tmp_path / "boxes.csv", lambda row: raise_row(row, 3.0, "a5", "a8"))
    good = [EGO, *(one for one in OTHERS if one.name in ("a1", "a2", "a3", "a4", "a6", "a7"))]
    assert np.abs(compute_ground_offsets_m(drive.build_scene(), good)).max() < 0.08
    assert (
        np.abs(compute_ground_offsets_m(drive.build_scene(), [one for one in OTHERS if one.name == "a5"])).max() < 0.5
    )


def test_large_coordinates_change_nothing(tmp_path):
    seen = []
    for shift_m in (0.0, 1e6, 5e6):
        folder = write_csv(tmp_path / f"{shift_m:g}")
        for name, at in (("boxes.csv", 3), ("ego.csv", 1)):
            rewrite(
                folder / name,
                lambda row: row if row[0] == "t" else [*row[:at], f"{float(row[at]) + shift_m:.9f}", *row[at + 1 :]],  # noqa: B023
            )
        seen.append(Simulator(build_drive(folder), {"rig": RIG}, FEW).simulate_frame(11).clouds["rig"])
    assert len(seen[0]) > 200
    for cloud in seen[1:]:
        np.testing.assert_allclose(cloud, seen[0], atol=2e-4)


def test_flat_recordings_have_flat_ground(written):
    assert len(open_scenario(written, "commonroad")[0].build_scene().static_meshes[0].faces) == 2


def test_bodies_are_scaled_to_boxes(written):
    for kind, of_category in (("argoverse2", {"car", "truck", "bus", "pedestrian"}), ("nuscenes", {"cyclist"})):
        world = open_scenario(written, kind)[0].build_scene()
        for one in OTHERS:
            actor = of(world, one.name)
            np.testing.assert_allclose(BoundingBox.from_points(actor.mesh.vertices_m).size_m, one.size_m)
            if one.category in of_category:
                assert actor.category == one.category
                assert len(actor.mesh.faces) > 12
    assert of(world, "a8").category == "cyclist"
    assert (of(world, "a9").category, len(of(world, "a9").mesh.faces)) == ("movable_object.barrier", 12)


def test_bodies_without_recorded_height_keep_theirs(written):
    world = open_scenario(written, "commonroad")[0].build_scene()
    size_m = BoundingBox.from_points(of(world, "3").mesh.vertices_m).size_m
    np.testing.assert_allclose(size_m, (9.5, 2.5, 1.07 * 3.45))  # the truck whose length is nearest


def test_any_track_can_be_the_ego(written):
    world = build_scenario(written / "argoverse2", ego_id="a1").build_scene()
    np.testing.assert_allclose(
        world.ego.trajectory.interpolate(1.0), poses(OTHERS[0], times_s=np.array([1.0]))[0], atol=2e-4
    )
    own = of(world, "ego")
    np.testing.assert_allclose(own.trajectory.interpolate(1.0), poses(EGO, times_s=np.array([1.0]))[0], atol=2e-4)
    np.testing.assert_allclose(BoundingBox.from_points(own.mesh.vertices_m).size_m, (4.869, 1.852, 1.476))
    assert "a1" not in [actor.name for actor in world.actors]


def test_ego_frame_can_be_set(written):
    known = build_scenario(written / "argoverse2").build_scene().ego.trajectory.interpolate(1.0)
    given = (
        build_scenario(written / "argoverse2", ego_T_vehicle={"x_m": 0.339, "z_m": -0.3})
        .build_scene()
        .ego.trajectory.interpolate(1.0)
    )
    np.testing.assert_allclose(given, known @ build_transform(np.eye(3), [-1.0, 0.0, 0.0]), atol=1e-9)


def test_planning_problem_is_one_frame_without_a_duration(written):
    start = build_scenario(written / "commonroad.xml")
    assert (start.num_time_steps, start.num_distinct_time_steps) == (1, 1)
    np.testing.assert_allclose(start.build_scene().ego.trajectory.interpolate(0.0)[:2, 3], ORIGIN_M)
    standing = build_scenario(written / "commonroad.xml", duration_s=1.0)
    assert standing.num_time_steps == 11
    world = standing.build_scene()
    assert not world.ego.trajectory.is_moving
    assert len(Simulator(standing, {"rig": RIG}, FEW).simulate_frame(3).clouds["rig"]) > 200


def test_objects_are_absent_during_long_gaps(tmp_path):
    gap = (RecordedBox("a1", "car", (4.5, 1.8, 1.5), (24.0, 0.0), 0.0, 9.0), *OTHERS[1:])
    folder = write_csv(tmp_path, gap)
    rewrite(folder / "boxes.csv", lambda row: None if row[1] == "a1" and 1.1 < float(row[0]) < 2.5 else row)
    world = build_drive(folder).build_scene()
    times_s = np.array([0.9, 1.0, 1.1, 1.8, 2.5, 2.6, 3.0])
    there = [np.isfinite(of(world, name).trajectory.interpolate_positions_m(times_s)[:, 0]) for name in ("a1", "a1 #2")]
    np.testing.assert_array_equal(there, [[1, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1, 1]])
    assert np.isfinite(
        of(build_drive(folder, max_gap_s=2.0).build_scene(), "a1").trajectory.interpolate_positions_m(times_s)
    ).all()


def test_objects_that_overlap_the_ego_are_removed(tmp_path):
    inside = RecordedBox("inside", "car", (4.0, 1.8, 1.5), (10.0, 0.5), 0.0)
    above = RecordedBox("sign", "sign", (4.0, 1.8, 0.5), (20.0, 0.0), 0.0)
    folder = write_csv(tmp_path, (*OTHERS, inside, above))
    rewrite(folder / "boxes.csv", lambda row: raise_row(row, 5.0, "sign"))
    with pytest.warns(
        UserWarning, match=r"boxes.csv: 1 of 11 tracks overlap the ego vehicle at some time \('inside'\)"
    ):
        names = [actor.name for actor in build_drive(folder).build_scene().actors]
    assert "inside" not in names
    assert "sign" in names


def test_time_offsets_do_not_remove_objects(written):
    for begin_s in (0.2, 0.6, 1.4):
        drive, *_ = open_scenario(written, "table")
        world = Scenario.model_validate(
            {"name": "part", "traffic": drive.traffic.model_copy(update={"begin_s": begin_s}).model_dump()}
        ).build_scene()
        last = round((2.8 - begin_s) / 0.1)
        times_s = 0.1 * np.array([last, last + 1], dtype=np.float64)
        np.testing.assert_array_equal(
            np.isfinite(of(world, "a8").trajectory.interpolate_positions_m(times_s)[:, 0]),
            [True, False],
            err_msg=str(begin_s),
        )


@pytest.mark.parametrize(
    ("layout", "name", "faces"), [("kitti_raw", "0", 13), ("carla", "17", 13), ("folder", "car", 12)]
)
def test_recordings_with_boxes_become_traffic(tmp_path, layout, name, faces):
    recorded = Drive()
    drive = build_scenario(LAYOUTS[layout](recorded, tmp_path))
    world = drive.build_scene()
    (car,) = world.actors
    assert (drive.num_time_steps, car.name) == (5, name)
    np.testing.assert_allclose(BoundingBox.from_points(car.mesh.vertices_m).size_m, CAR_SIZE_M, atol=1e-6)
    assert len(car.mesh.faces) >= faces  # the plain folder has the category "car, red", which is no road user
    for instant, time_s in enumerate(recorded.times_s):
        wanted = invert(recorded.get_world_T_vehicle(instant)) @ recorded.world_T_car(instant)
        wanted = wanted @ build_transform(np.eye(3), [0.0, 0.0, -CAR_SIZE_M[2] / 2])
        found = invert(world.ego.trajectory.interpolate(time_s)) @ car.trajectory.interpolate(time_s)
        np.testing.assert_allclose(found, wanted, atol=1e-4, err_msg=str(instant))
    assert len(Simulator(drive, {"rig": RIG}, FEW).simulate_frame(2).clouds["rig"]) > 100


def test_recorded_ego_becomes_an_actor_of_another_ego(tmp_path):
    world = build_scenario(LAYOUTS["kitti_raw"](Drive(), tmp_path), ego_id="0").build_scene()
    (own,) = world.actors
    assert own.name == "ego"
    np.testing.assert_allclose(BoundingBox.from_points(own.mesh.vertices_m).size_m, (4.774, 1.82, 1.93))


def test_one_scene_of_several_is_shown(tmp_path):
    folder = write_nuscenes(tmp_path / "v1.0-mini", scenes=("first", "second"))
    for path in (tmp_path, folder):
        for called in ("first", "s0"):
            assert build_scenario(path, scene=called).num_time_steps == 41
    with pytest.raises(ValueError, match="scene: one of first, second is needed; got none"):
        build_scenario(tmp_path).build_scene()
    with pytest.raises(ValueError, match="got 'third'"):
        build_scenario(tmp_path, scene="third").build_scene()


def test_fingerprint_depends_on_file_contents(tmp_path):
    folder = write_argoverse2(tmp_path / "log")
    before = build_scenario(folder).collect_content()
    assert before == build_scenario(write_argoverse2(tmp_path / "copy")).collect_content()
    first = OTHERS[0]
    for others in (
        OTHERS[:-1],
        (first._replace(start_m=(24.0, 0.1)), *OTHERS[1:]),
        (first._replace(size_m=(4.5, 1.8, 1.6)), *OTHERS[1:]),
        (first._replace(category="bus"), *OTHERS[1:]),
    ):
        assert before != build_scenario(write_argoverse2(folder, others)).collect_content()
    assert (
        before != build_scenario(write_argoverse2(tmp_path / "flat", heights=compute_flat_heights_m)).collect_content()
    )
    assert before != build_scenario(tmp_path / "copy", begin_s=1.0).collect_content()


def test_built_in_tracks_equal_the_written_files(written):
    built_in = get_builtin_folder("scenarios") / "tracks"
    for path in written.rglob("*.*"):
        if path.suffix in (".csv", ".json", ".xml"):
            assert path.read_text() == built_in.joinpath(path.relative_to(written)).read_text(), path
    for name in list_builtin_names("scenarios"):
        if name.startswith("tracks_"):
            drive = Scenario.load(name)
            drive.build_scene()
            Simulator(drive, {"rig": RIG}, FEW).check_run(4)


def test_sampled_scenery_avoids_recorded_tracks(written):
    path = written / "argoverse2"
    bare, drawn = build_scenario(path).build_scene(0), build_scenario(path, built_share=1.0).build_scene(0)
    assert len(bare.static_meshes) == 1
    assert len(drawn.static_meshes) == 3
    assert len(build_scenario(path, built_share=0.0, roadside_density=0.0).build_scene(0).static_meshes) == 1
    np.testing.assert_array_equal(bare.static_meshes[0].vertices_m, drawn.static_meshes[0].vertices_m)
    houses_m = drawn.static_meshes[1].vertices_m[:, :2]
    assert len(houses_m) > 100
    for actor in (drawn.ego, *drawn.actors):
        for place_m in actor.trajectory.positions_m[:, :2]:
            assert np.linalg.norm(houses_m - place_m, axis=1).min() > 2.0
    said = "Sampled, not recorded: scenery along the tracks, with houses on 100% of the sides."
    for traffic, notes in ((build_scenario(path), []), (build_scenario(path, built_share=1.0), [said])):
        record = SimulatedFrames(traffic, RIG, num_frames=1, reference_sensor=FEW).describe_reference()
        assert [note for note in record["notes"] if "own vehicle" not in note] == notes
    # Scenery begins on the ground, next to hills below their top.
    assert drawn.static_meshes[1].vertices_m[:, 2].min() < bare.static_meshes[0].vertices_m[:, 2].max()


@pytest.mark.parametrize(
    "keys", [{"roadside_density": 2.0}, {"built_share": 1.0, "ground": "road.ply"}, {"built_share": 2.0}]
)
def test_scenery_options_are_checked_together(keys, written):
    with pytest.raises(ValueError, match="built_share"):
        build_scenario(written / "argoverse2", **keys)
