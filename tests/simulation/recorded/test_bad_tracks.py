"""Unusable recordings are refused in one line that names them."""

import json
import re
import sys
import warnings

import numpy as np
import pytest
import trimesh

from tests.recordings.drives import Drive
from tests.recordings.layouts import kitti_raw, plain_folder
from tests.simulation.recorded.drives import (
    EGO,
    OTHERS,
    rewrite,
    write_argoverse2,
    write_commonroad,
    write_csv,
    write_nuscenes,
)
from tests.simulation.recorded.test_tracks import FEW, RIG, build_scenario
from torchcover import Scenario
from torchcover.cli.app import main
from torchcover.files import BadFileError, isolated
from torchcover.geometry import convert_euler_to_rotation
from torchcover.recordings.formats import read_objects
from torchcover.simulation import Simulator


def assert_fails(drive, message, error=ValueError):
    with pytest.raises(error, match=message) as caught:
        drive.build_scene()
    assert "\n" not in str(caught.value)


def replace_text(path, old, new, count=1):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))
    return path


@pytest.fixture
def table(tmp_path):
    folder = write_csv(tmp_path / "table")
    return folder / "boxes.csv", {"ego_trajectory": str(folder / "ego.csv")}


def test_paths_without_recordings_are_refused(tmp_path):
    assert_fails(
        build_scenario(tmp_path / "none"), "none: no such file or folder; recorded tracks are needed", FileNotFoundError
    )
    assert_fails(build_scenario(tmp_path), "recorded tracks are .* a log of Argoverse 2 .*; a table of boxes")
    (tmp_path / "a.txt").write_text("x")
    assert_fails(build_scenario(tmp_path / "a.txt"), r"a\.txt: recorded tracks are")


def test_recordings_without_tracks_are_refused(tmp_path):
    drive = Drive()
    log = kitti_raw(drive, tmp_path / "kitti")
    assert_fails(build_scenario(log, scene="a"), "scene: applies to tables of nuScenes only")
    (log / "tracklet_labels.xml").unlink()
    assert_fails(build_scenario(log), rf"{log}: no frame has labeled objects", BadFileError)
    folder = plain_folder(drive, tmp_path / "folder")
    boxes = folder / "boxes" / "f1.csv"
    boxes.write_text(boxes.read_text().replace(",car,", ",,"))
    assert_fails(build_scenario(folder), rf"{folder}: an object of f1 has no id", BadFileError)
    (folder / "poses.csv").unlink()
    assert_fails(build_scenario(folder), rf"{folder}: the vehicle has no poses with times", BadFileError)


def test_absent_egos_are_refused(tmp_path, table):
    path, keys = table
    assert_fails(build_scenario(path), "ego_id: the recording has no ego vehicle; name one of its tracks: 'a1', 'a2'")
    assert_fails(build_scenario(path, ego_id="a11"), "ego_id: there is no 'a11' in the recording; it has 'a1'")
    assert_fails(build_scenario(path, ego_id="a1", **keys), "ego_id and ego_trajectory exclude each other")
    assert_fails(
        build_scenario(path, ego_id="a1", ego_T_vehicle={"x_m": 1.0}),
        "ego_T_vehicle: only an ego vehicle without a box",
    )
    log = write_argoverse2(tmp_path / "log")
    assert_fails(build_scenario(log, ego_id=7), "there is no '7' in the recording")


def test_egos_that_leave_or_jump_are_refused(tmp_path, table):
    path, keys = table
    assert_fails(
        build_scenario(path, ego_id="a8", duration_s=4.0), r"'a8' and the others are known for 2\.8 s; begin_s 0 and"
    )
    assert build_scenario(path, ego_id="a8").num_time_steps == 29
    assert_fails(build_scenario(path, begin_s=9.0, **keys), "known for 4 s; begin_s 9 and duration_s 0 reach beyond")
    whole = path.read_text()
    rewrite(path, lambda row: None if row[1] == "a1" and 1.3 < float(row[0]) < 2.9 else row)
    assert_fails(
        build_scenario(path, ego_id="a1"),
        r"a gap of over 1 s \(max_gap_s\), or jumps. It is there from 0 to 1.2 s, 3 to 4 s",
    )
    assert build_scenario(path, ego_id="a1", begin_s=3.0).num_time_steps == 11
    path.write_text(whole)
    rewrite(path, lambda row: [*row[:3], "9999", *row[4:]] if row[:2] == ["2.0", "a1"] else row)
    assert_fails(build_scenario(path, ego_id="a1"), "or jumps. It is there from 0 to 1.8 s, 2 to 2 s, 2.2 to 4 s")


def test_egos_and_tracks_at_different_times_are_refused(table):
    path, keys = table
    path.write_text(re.sub(r"(?m)^(\d\.\d),", r"10\1,", path.read_text()))
    assert_fails(build_scenario(path, **keys), "the ego 'ego.csv' is there from 0 to 4 s, the others from 100 to 104 s")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("4.5,1.8,1.5", "0,1.8,1.5", "id a1: a box needs a positive length, width and height"),
        ("4.5,1.8,1.5", "4.5,nan,1.5", "line 2: width: a finite number is needed"),
        ("1425.800000", "nan", "line 3: x: a finite number is needed; got 'nan'"),
        ("0.2,a1", "0.0,a1", "id a1: .*must ascend"),
        ("category", "kind", "missing: category"),
    ],
)
def test_invalid_box_tables_are_refused(table, old, new, message):
    path, keys = table
    with pytest.raises(BadFileError, match=message) as caught:
        build_scenario(replace_text(path, old, new), **keys).build_scene()
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<rectangle><length>4.5</length><width>1.8</width></rectangle>", "", "id 1: no rectangle, circle or polygon"),
        ("<length>4.5</length>", "<length>-1</length>", "id 1: a box needs a positive length"),
        ("<length>4.5</length>", "", "id 1: <rectangle> needs a number as its <length>; got None"),
        ("<x>1424.000000</x>", "<x>nan</x>", "id 1: .*NaN"),
        ("<time><exact>1</exact></time>", "<time><exact>0</exact></time>", "id 1: .*must ascend"),
        ("<point><x>1424.000000</x><y>2200.000000</y></point>", "<circle/>", "id 1: a state needs a point"),
        ('timeStepSize="0.2"', 'timeStepSize="0"', "timeStepSize: a positive number is needed"),
        ("commonRoad ", "OpenSCENARIO ", "mismatched tag"),
        ("<commonRoad", '<!DOCTYPE a [<!ENTITY b "c">]><commonRoad', "without entities"),
    ],
)
def test_invalid_commonroad_scenarios_are_refused(tmp_path, old, new, message):
    path = replace_text(write_commonroad(tmp_path / "a.xml"), old, new)
    assert_fails(build_scenario(path), rf"a\.xml: .*{message}", BadFileError)


def test_commonroad_polygons_become_boxes(tmp_path):
    box = "<rectangle><length>4.5</length><width>1.8</width></rectangle>"
    corners = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in ((0, -1), (4, -1), (4, 1), (0, 1)))
    path = replace_text(write_commonroad(tmp_path / "a.xml"), box, f"<polygon>{corners}</polygon>")
    actor = build_scenario(path, ego_id=5, duration_s=0.4).build_scene().actors[0]
    np.testing.assert_allclose(np.ptp(actor.mesh.vertices_m, axis=0)[:2], [4.0, 2.0])
    np.testing.assert_allclose(actor.trajectory.interpolate(0.0)[:2, 3], [1426.0, 2200.0])


RECTANGLE = "<rectangle><length>4.5</length><width>1.8</width>{}</rectangle>"


@pytest.mark.parametrize(
    ("shapes", "size_m", "middle_m", "turn_deg"),
    [
        (RECTANGLE.format("<center><x>1.4</x><y>-0.5</y></center>"), (4.5, 1.8), (1.4, -0.5), 0),
        (
            RECTANGLE.format("<orientation>0.5</orientation><center><x>1</x><y>2</y></center>"),
            (4.5, 1.8),
            (1, 2),
            28.648,
        ),
        ("<circle><radius>1</radius><center><x>0.3</x><y>0</y></center></circle>", (2, 2), (0.3, 0), 0),
        (
            RECTANGLE.format("") + "<circle><radius>1</radius><center><x>4</x><y>0</y></center></circle>",
            (7.25, 2),
            (1.375, 0),
            0,
        ),
    ],
)
def test_commonroad_shapes_have_centers_and_orientations(tmp_path, shapes, size_m, middle_m, turn_deg):
    path = write_commonroad(tmp_path / "a.xml")
    before = read_objects(path).tracks[0].trajectory
    replace_text(path, RECTANGLE.format(""), shapes)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        track = read_objects(path).tracks[0]
    assert ["replaced by the box around them" in str(one.message) for one in caught] == [True] * (
        shapes.count("<center>") == 1 and shapes.count("rectangle") == 2 and "circle" in shapes
    )
    np.testing.assert_allclose(track.size_m[:2], size_m)
    yaw_deg = before.angles_deg[0, 0]
    turn = convert_euler_to_rotation(yaw_deg, 0.0, 0.0)[:2, :2]
    np.testing.assert_allclose(
        track.trajectory.positions_m[0, :2], before.positions_m[0, :2] + turn @ middle_m, atol=1e-6
    )
    np.testing.assert_allclose(track.trajectory.angles_deg[0, 0] - yaw_deg, turn_deg, atol=1e-3)


def test_commonroad_exclusions_are_reported(tmp_path):
    path = write_commonroad(tmp_path / "a.xml")
    before = read_objects(path).tracks[0].trajectory
    text = path.read_text()
    building = '<environmentObstacle id="90"><type>building</type></environmentObstacle></commonRoad>'
    start = text[text.index("<initialState>") + len("<initialState>") : text.index("</initialState>")]
    text = text.replace("<trajectory>", f"<trajectory><state>{start}</state>", 1)
    path.write_text(text.replace("</commonRoad>", building))
    with pytest.warns(UserWarning, match=r"1 environmentObstacle \(building\) excluded"):
        after = read_objects(path).tracks[0].trajectory
    np.testing.assert_array_equal(after.times_s, before.times_s)
    np.testing.assert_array_equal(after.positions_m, before.positions_m)


def test_invalid_nuscenes_tables_are_refused(tmp_path):
    folder = write_nuscenes(tmp_path)
    annotations = folder / "sample_annotation.json"
    good = json.loads(annotations.read_text())
    for change, message in (
        ({"size": [0.0, 4.0, 1.0]}, "id a1: a box needs a positive length"),
        ({"size": [2.0, 4.0, float("inf")]}, "size: three finite numbers are needed"),
        ({"size": [1.8]}, "size: three finite numbers are needed"),
        ({"rotation": [0, 0, 0, 0]}, "quaternion of norm 0"),
        ({"translation": [float("nan"), 0, 0]}, "id a1: .*NaN"),
        ({"instance_token": "nobody"}, "no row has the token 'nobody'"),
    ):
        annotations.write_text(json.dumps([{**good[0], **change}, *good[1:]]))
        assert_fails(build_scenario(folder), message, BadFileError)
    annotations.write_text("[]")
    assert len(build_scenario(folder).build_scene().actors) == 0
    (folder / "ego_pose.json").write_text("[]")
    assert_fails(build_scenario(folder), "no ego_pose from the first sample", BadFileError)
    (folder / "instance.json").unlink()
    assert_fails(build_scenario(folder), r"instance\.json: no such file", FileNotFoundError)


def write_feather(path, **columns):
    import pyarrow as pa
    from pyarrow import feather

    table = feather.read_table(path).to_pydict()
    feather.write_feather(
        pa.table({**table, **{name: change(table[name]) for name, change in columns.items()}}), str(path)
    )


@pytest.mark.parametrize(
    ("column", "change", "message"),
    [
        ("length_m", lambda lengths: [0.0] * len(lengths), "annotations.feather: id a1: a box needs a positive length"),
        ("tx_m", lambda places: [float("nan"), *places[1:]], "annotations.feather: id a1: .*NaN"),
        ("qw", lambda _: [float("nan")] * len(_), "annotations.feather: a quaternion needs four finite numbers"),
        ("timestamp_ns", lambda times: [time + 10**12 for time in times], "are both of one log"),
        ("timestamp_ns", lambda times: [times[0]] * len(times), "id a1: .*must ascend"),
    ],
)
def test_invalid_argoverse_logs_are_refused(tmp_path, column, change, message):
    log = write_argoverse2(tmp_path)
    write_feather(log / "annotations.feather", **{column: change})
    assert_fails(build_scenario(log), message, BadFileError)


def test_incomplete_logs_are_refused(tmp_path, monkeypatch):
    log = write_argoverse2(tmp_path, (*OTHERS, EGO._replace(category="ego_vehicle")))
    (log / "annotations.feather").rename(log / "annotations_with_ego.feather")
    assert "ego" not in [actor.name for actor in build_scenario(log).build_scene().actors]
    assert_fails(build_scenario(log, scene="a"), "scene: applies to tables of nuScenes only")
    remove_pyarrow(monkeypatch)
    assert_fails(build_scenario(log), r"annotations_with_ego.feather: .*pip install 'torchcover\[av2\]'", ImportError)
    monkeypatch.undo()
    (log / "city_SE3_egovehicle.feather").unlink()
    assert_fails(build_scenario(log), r"city_SE3_egovehicle\.feather: no such file", FileNotFoundError)


def remove_pyarrow(monkeypatch):
    """Run in the process that reads."""
    monkeypatch.setattr(isolated, "_processes", {})
    monkeypatch.setattr(isolated, "PROGRAM", f"import sys; sys.modules['pyarrow'] = None; {isolated.PROGRAM}")


def test_missing_packages_are_reported_in_one_line(monkeypatch, capsys):
    remove_pyarrow(monkeypatch)
    monkeypatch.setattr(sys, "argv", ["torchcover", "evaluate", "front_roof_32", "--scenario", "tracks_argoverse2"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'torchcover[av2]'" in line


def test_distant_ground_causes_a_hint(tmp_path, table):
    path, keys = table
    plate = trimesh.creation.box((900.0, 900.0, 2.0))
    for height_m, hinted in ((29.0, False), (12.0, True)):
        plate.apply_translation([1400.0, 2200.0, height_m - plate.bounds[1][2]])
        plate.export(tmp_path / "ground.ply")
        low = build_scenario(path, ground=str(tmp_path / "ground.ply"), **keys)
        if not hinted:
            replace_text(path, "category", "category")
        simulator = Simulator(low, {"rig": RIG}, FEW)
        if hinted:
            with pytest.warns(UserWarning, match="ground within 1 m below or above the wheels") as told:
                simulator.check_run(8)
            assert {"the ego had", "other moving actors had"} <= {
                part
                for warning in told
                for part in ("the ego had", "other moving actors had")
                if part in str(warning.message)
            }
    Simulator(build_scenario(path, **keys), {"rig": RIG}, FEW).check_run(8)


def test_true_poses_above_a_plane_cause_the_hint(tmp_path):
    folder = write_csv(tmp_path)
    given = Scenario.model_validate(
        {
            "name": "given",
            "ego": {"trajectory": str(folder / "ego.csv")},
            "bodies": [{"name": "g", "shape": {"type": "plane", "size_m": [9e3, 9e3]}}],
            "boxes": str(folder / "boxes.csv"),
            "duration_s": 4.0,
        }
    )
    with pytest.warns(UserWarning, match="given: .*Traffic of type 'tracks' without `ground` makes ground") as told:
        Simulator(given, {"rig": RIG}, FEW).check_run(8)
    assert len(told) == 2
    resting = given.model_copy(update={"ego": given.ego.model_copy(update={"trajectory": None}), "boxes": None})
    Simulator(resting, {"rig": RIG}, FEW).check_run(8)
