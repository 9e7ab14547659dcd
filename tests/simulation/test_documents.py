"""YAML documents: mistakes are reported in one line that names file and key."""

import warnings

import numpy as np
import pytest

from torchcover import Rig, Scenario
from torchcover.cameras.calibration import read_opencv, read_ros
from torchcover.recordings.formats import read_objects
from torchcover.recordings.formats.folder import read_folder_settings
from torchcover.recordings.settings import Mount
from torchcover.simulation import Lidar, LidarModel, Pose, list_builtin_names
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.camera_sensor import CameraSensor

RIG = """
name: r
sensors:
  - type: lidar
    name: top
    mount: {x_m: 1.0, z_m: 2.0}
    channels: 4
    vertical_fov_deg: [-10, 10]
    horizontal_fov_deg: 360
    columns: 8
    max_range_m: 50
"""
SCENARIO = """
name: s
ego: {shape: {type: box, size_m: [4, 2, 1.5]}}
bodies:
  - {name: ground, shape: {type: plane, size_m: [100, 100]}}
"""


def write(folder, content, name="doc.yaml"):
    path = folder / name
    path.write_text(content)
    return path


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"yaw_deg": 1.5708}, "yaw_deg: 1.5708 looks like 90 degrees"),
        ({"x_m": 1.0, "pitch_deg": -0.785, "yaw_deg": 3}, "pitch_deg: -0.785 looks like -45 degrees"),
        ({"yaw_deg": 3.141592653589793}, "looks like 180 degrees"),
        ({"roll_deg": 3.14}, "looks like 180 degrees"),
        ({"yaw_deg": 90, "pitch_deg": 1.5708}, None),
        ({"yaw_deg": 1.5, "pitch_deg": -0.35, "roll_deg": 0.8}, None),
        ({"fov_deg": 1.3963}, "fov_deg: 1.3963 looks like 80 degrees"),
        ({"vertical_fov_deg": (-0.4363, 0.03), "horizontal_fov_deg": 3}, "vertical_fov_deg: -0.4363 looks like -25"),
        ({"vertical_fov_deg": (-0.4363, 0.03), "horizontal_fov_deg": 360}, None),
    ],
)
def test_degrees_that_look_like_radians_are_reported(keys, message):
    document = (
        Pose if Pose.model_fields.keys() >= keys.keys() else Lidar if "horizontal_fov_deg" in keys else CameraSensor
    )
    further_keys = {
        Pose: {},
        Lidar: {"name": "a", "channels": 2, "columns": 8, "max_range_m": 50},
        CameraSensor: {"name": "a", "width": 4, "height": 3, "max_range_m": 50},
    }
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        document.model_validate({**further_keys[document], **keys})
    assert [message in str(warning.message) for warning in caught] == [True] * (message is not None)


def test_recording_mounts_in_radians_are_reported():
    with pytest.warns(UserWarning, match="yaw_deg: 1.5708 looks like 90 degrees"):
        Mount(x_m=1.0, y_m=0.0, z_m=0.0, yaw_deg=1.5708).to_matrix()


def test_mesh_paths_are_relative_to_the_scenario_file(tmp_path):
    content = SCENARIO + "  - {name: m, shape: {type: mesh, path: parts/m.stl}}\n"
    scenario = Scenario.load(str(write(tmp_path, content)))
    assert scenario.bodies[1].shape.path == tmp_path / "parts" / "m.stl"


@pytest.mark.parametrize("kind", ["rigs", "scenarios", "vehicles"])
def test_built_in_documents_are_valid_and_named_consistently(kind):
    model = {"rigs": Rig, "scenarios": Scenario, "vehicles": Vehicle}[kind]
    names = list_builtin_names(kind)
    assert names
    for name in names:
        document = model.load(name)
        assert document.name == name
        assert document.description


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "columns: 8",
            "colums: 8",
            r"doc\.yaml: sensors\.0\.colums: unknown key; columns is meant, which is missing$",
        ),
        ("columns: 8", "columns: 0", r"sensors\.0\.columns: .*a number above 0 is needed; got 0"),
        ("columns: 8", "columns: many", r"sensors\.0\.columns: .*integer.*got 'many'"),
        ("x_m: 1.0", "x: 1.0", r"sensors\.0\.mount\.x: unknown key"),
        ("    mount:", "    mounts:", r"sensors\.0\.mounts: unknown key; is mount meant\?$"),
        ("x_m: 1.0", "xyz: [1, 0, 1]", r"sensors\.0\.mount\.xyz: unknown key; is x_m, y_m, z_m meant\?$"),
        ("x_m: 1.0", "x_m: 1.0, pitch: 5.0", r"mount\.pitch: .*; is pitch_deg meant\?"),
        ("    mount:", "    place:", r"sensors\.0: mount: missing; meters from the ground"),
        ("x_m: 1.0", "x_m: .nan", r"sensors\.0\.mount\.x_m: .*finite"),
        ("x_m: 1.0", "x_m: .inf", r"sensors\.0\.mount\.x_m: .*finite"),
        ("x_m: 1.0", "quaternion_wxyz: [0, 0, 0, 0]", r"sensors\.0\.mount: a quaternion of norm 0"),
        ("x_m: 1.0", "yaw_deg: 3, quaternion_wxyz: [1, 0, 0, 0]", "quaternion or as yaw, pitch and roll, not both"),
        ("channels: 4", "channels: 4\n    elevations_deg: [1, 2]", "not both"),
        ("    channels: 4\n", "", "rows are missing"),
        ("[-10, 10]", "[10, -10]", "lower elevation comes first"),
        ("[-10, 10]", "[-100, 10]", r"vertical_fov_deg\.0: .*-90"),
        ("horizontal_fov_deg: 360", "horizontal_fov_deg: 361", "a number of at most 360"),
        ("max_range_m: 50", "max_range_m: 50\n    min_range_m: 60", r"min_range_m \(60\.0\) must be below"),
        ("columns: 8", "columns: 8\n    azimuth_offsets_deg: [1, 2]", "one for each of the 4 rows is needed; got 2"),
        ("  - type: lidar", "  - type: sonar", r"sensors\.0: type: a sensor is a 'lidar' or .* 'radar'; got 'sonar'"),
        ("name: r\n", "", "name: a value is needed; the key is missing"),
        ("columns: 8", "columns: true", r"columns: .*an integer is needed; got True"),
        ("columns: 8", "columns: 8.0", r"columns: .*an integer is needed; got 8\.0"),
        ("columns: 8", "columns: 0100", r"columns: .*an integer is needed; got '0100'"),
        ("columns: 8", "columns: 1:40", r"columns: .*an integer is needed; got '1:40'"),
        ("columns: 8", 'columns: "60"', r"columns: .*an integer is needed; got '60'"),
        ("max_range_m: 50", "max_range_m: '50'", r"max_range_m: .*a number is needed; got '50'"),
        ("x_m: 1.0", "x_m: true", r"mount\.x_m: .*a number is needed; got True"),
        ("[-10, 10]", "['-10', 10]", r"vertical_fov_deg\.0: .*a number is needed; got '-10'"),
        ("name: r\n", "name: 5\n", r"name: .*a text is needed; got 5"),
        ("columns: 8", "columns: 8\n    columns: 9", "the key 'columns' is there twice, in line 10 and in line 11"),
    ],
)
def test_a_wrong_rig_names_file_and_key(tmp_path, old, new, message):
    assert old in RIG
    path = write(tmp_path, RIG.replace(old, new))
    with pytest.raises(ValueError, match=message) as caught:
        Rig.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


DOUBLED = {
    "rig": (Rig.load, RIG + "sensors: []\n", "sensors"),
    "scenario": (Scenario.load, SCENARIO + "bodies: []\n", "bodies"),
    "vehicle": (Vehicle.load, "name: v\nparts: []\nparts: []\n", "parts"),
    "lidar": (LidarModel.load, "name: l\ncolumns: 5\ncolumns: 6\n", "columns"),
    "ros": (read_ros, "width: 5\nwidth: 6\n", "width"),
    "opencv": (read_opencv, "%YAML:1.0\n---\nimage_width: 5\nimage_width: 6\n", "image_width"),
    "frames": (read_folder_settings, "sensor: {}\nsensor: {}\n", "sensor"),
}


@pytest.mark.parametrize("kind", DOUBLED)
def test_repeated_keys_are_refused_in_every_document(tmp_path, kind):
    read, content, key = DOUBLED[kind]
    path = write(tmp_path, content)
    with pytest.raises(ValueError, match=f"the key '{key}' is there twice, in line .* and in line ") as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_sensor_without_mount_is_saved_at_origin(tmp_path):
    keys = {"channels": 4, "vertical_fov_deg": (-10, 10), "horizontal_fov_deg": 360, "columns": 8, "max_range_m": 50}
    Rig(name="r", sensors=(Lidar(name="a", **keys),)).save(tmp_path / "rig.yaml")
    assert Rig.load(tmp_path / "rig.yaml").sensors[0].mount == Pose()


def test_integers_lists_and_numpy_numbers_are_converted():
    keys = {"vertical_fov_deg": [-10, np.float32(10)], "horizontal_fov_deg": np.int64(360), "max_range_m": 50}
    lidar = Lidar(name="a", channels=np.int64(4), columns=8, **keys)
    assert lidar.vertical_fov_deg == (-10.0, 10.0)
    assert (lidar.channels, type(lidar.channels), type(lidar.max_range_m)) == (4, int, float)


def test_an_invalid_sensor_does_not_shorten_the_list(tmp_path):
    with pytest.raises(ValueError, match=r"sensors\.0\.colums: unknown key") as caught:
        Rig.load(write(tmp_path, RIG.replace("columns: 8", "colums: 8")))
    assert "at least 1" not in str(caught.value)


def test_messages_about_many_mistakes_stay_short(tmp_path):
    nested = "[" * 50 + "1, 2" + "]" * 50
    keys = "".join(f"key_{k}: {nested}\n" for k in range(40))
    with pytest.raises(ValueError, match="and 35 more mistakes") as caught:
        Rig.load(write(tmp_path, RIG + keys))
    assert len(str(caught.value)) < 1000


def test_a_vehicle_that_names_itself_is_refused(tmp_path):
    path = tmp_path / "v.yaml"
    path.write_text(f"name: v\nparts: [{{name: p, shape: {{type: vehicle, vehicle: {path}}}}}]\n")
    with pytest.raises(ValueError, match=r"v\.yaml: part 'p' is the vehicle '.*v\.yaml', which may contain this"):
        Vehicle.load(path)


def test_sensors_need_different_names(tmp_path):
    twice = RIG + RIG.split("sensors:\n")[1]
    with pytest.raises(ValueError, match="sensors need different names; got top, top"):
        Rig.load(write(tmp_path, twice))


def test_a_rig_needs_a_sensor(tmp_path):
    with pytest.raises(ValueError, match=r"sensors: .*at least 1"):
        Rig.load(write(tmp_path, "name: r\nsensors: []"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("- a\n- b", "mapping of keys is needed; got list"),
        ("# nothing", "got NoneType"),
        ("", "an empty file"),
        ("a: [1", "not a YAML file"),
    ],
)
def test_files_other_than_documents_are_refused(tmp_path, content, message):
    with pytest.raises(ValueError, match=rf"doc\.yaml: .*{message}"):
        Rig.load(write(tmp_path, content))


def test_an_unknown_shape_lists_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"bodies\.0\.shape: .*'plane', 'box', 'frustum', 'cylinder', 'mesh'"):
        Scenario.load(write(tmp_path, SCENARIO.replace("type: plane", "type: torus")))


@pytest.mark.parametrize("name", ["no_such_rig", "../rigs/front_roof_128", ""])
def test_unknown_names_suggest_the_nearest_name(name):
    with pytest.raises(FileNotFoundError, match=r"neither a \.yaml file nor one of the built-in rigs; is '") as caught:
        Rig.load(name)
    assert len(str(caught.value)) < 250


@pytest.mark.parametrize(
    ("load", "name", "message"),
    [
        (Scenario.load, "cut_in.xosc", "one of the scenarios is a .yaml file; OpenSCENARIO is not read"),
        (Scenario.load, "road.xodr", r"name it in a scenario, traffic: \{type: sumo, net"),
        (Scenario.load, "town.net.xml", "a network of SUMO by traffic"),
        (Vehicle.load, "car.FBX", "export it as GLB"),
        (Vehicle.load, "car.usdz", "export it as GLB"),
        (Vehicle.load, "car.stp", "CAD: export it as GLB"),
        (Vehicle.load, "car.glb", r"shape: \{type: mesh"),
        (Rig.load, "model.sdf", "convert SDF into a URDF"),
        (Rig.load, "robot.urdf", "`torchcover robot` reads a URDF"),
        (read_objects, "cut_in.xosc", "OpenSCENARIO is not read.*; recorded tracks are"),
    ],
)
def test_files_of_other_formats_name_the_conversion(tmp_path, load, name, message):
    (tmp_path / name).write_text("<OpenSCENARIO/>")
    with pytest.raises(ValueError, match=f"{name}: .*{message}"):
        load(tmp_path / name)


@pytest.mark.parametrize("name", ["map.osm", "cut_in.xosc"])
def test_networks_of_other_formats_name_the_conversion(tmp_path, name):
    scenario = f"{{name: s, traffic: {{type: sumo, net: {name}, fcd: fcd.xml}}}}"
    with pytest.raises(ValueError, match=r"a network is a \.net\.xml or \.xodr file; Open"):
        Scenario.load(write(tmp_path, scenario)).build_scene()


def test_a_quaternion_and_angles_describe_the_same_pose():
    half = np.deg2rad(30.0) / 2
    by_quaternion = Pose(quaternion_wxyz=(2 * np.cos(half), 0.0, 0.0, 2 * np.sin(half)))
    np.testing.assert_allclose(by_quaternion.to_matrix(), Pose(yaw_deg=30.0).to_matrix(), atol=1e-15)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("name: s\n", "ego and bodies missing"),
        (SCENARIO.replace("bodies:", "actors: []\nbodies_:"), "bodies_: unknown key"),
        ("name: s\ntraffic: {type: urban}\nduration_s: 5\n", "traffic makes duration_s itself"),
        ("name: s\ntraffic: {type: urban}\nego: {shape: {type: box, size_m: [4, 2, 1]}, pose: {}}", "shape only"),
        ("name: s\ntraffic: {type: rural}\n", "traffic: .*'urban', 'highway', 'parking'"),
    ],
)
def test_scenarios_have_either_bodies_or_traffic(tmp_path, content, message):
    with pytest.raises(ValueError, match=message):
        Scenario.load(write(tmp_path, content))
