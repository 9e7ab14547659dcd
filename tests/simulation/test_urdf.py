"""Robots of URDF: places of links and sensors in closed form, meshes wherever they lie, and what is no robot."""

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from torchcover.files import BadFileError
from torchcover.geometry import BoundingBox
from torchcover.simulation import Rig, Scenario, SimulatedFrames, read_robot
from torchcover.simulation.bodies import Vehicle

BOX = "<visual><geometry><box size='{}'/></geometry></visual>"
CHASSIS = f"<link name='base'>{BOX.format('0.8 0.6 0.4')}</link>"
LIDAR = """<sensor name='{}' type='gpu_lidar'><update_rate>20</update_rate>{}<lidar><scan>
<horizontal><samples>181</samples><min_angle>0.0</min_angle><max_angle>{}</max_angle></horizontal>
<vertical><samples>3</samples><min_angle>-0.1</min_angle><max_angle>0.3</max_angle></vertical></scan>
<range><min>0.1</min><max>30</max></range><noise><stddev>0.02</stddev></noise></lidar></sensor>"""
CAMERA = """<camera{}><horizontal_fov>1.5</horizontal_fov><image><width>640</width><height>480</height></image>
<clip><near>0.2</near><far>9</far></clip></camera>"""


def joint(parent, child, xyz="0 0 0", rpy="0 0 0", name="j"):
    ends = f"<parent link='{parent}'/><child link='{child}'/>"
    return f"<joint name='{name}' type='revolute'>{ends}<origin xyz='{xyz}' rpy='{rpy}'/></joint>"


def on(link, *sensors):
    return f"<gazebo reference='{link}'>{''.join(sensors)}</gazebo>"


@pytest.fixture
def robot_of(tmp_path):
    def read(*content, packages=None):
        (tmp_path / "a.urdf").write_text(f"<robot name='a'>{''.join(content)}</robot>")
        return read_robot(tmp_path / "a.urdf", packages)

    return read


def test_a_link_and_its_sensor_are_where_all_joints_before_them_are_at_0(robot_of):
    turns = [("0.3 0 0.5", (0.1, -0.2, 1.0)), ("0 0.4 0", (0.0, 0.5, -0.3))]
    places = [np.eye(4), np.eye(4), np.eye(4)]
    for place, (xyz, rpy) in zip(places, [*turns, ("0.01 0.02 0.03", (0.0, 0.0, 0.2))], strict=True):
        place[:3, :3], place[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), np.array(xyz.split(), float)
    words = [" ".join(map(str, rpy)) for _, rpy in turns]
    pose = "<pose>0.01 0.02 0.03 0 0 0.2</pose>"
    robot = robot_of(
        CHASSIS, "<link name='arm'/><link name='head'/>", joint("base", "arm", turns[0][0], words[0]),
        joint("arm", "head", turns[1][0], words[1], "k"), on("head", LIDAR.format("l", pose, 0.0).replace("181", "1")),
    )  # fmt: skip
    expected = places[0] @ places[1] @ places[2]
    expected[2, 3] += 0.2  # the middle of the chassis is so far above the ground
    (keys,) = robot.sensors
    rig = Rig.model_validate({"name": "a", "sensors": [keys]})
    np.testing.assert_allclose(rig.sensors[0].mount.matrix(), expected, atol=2e-4)
    assert (rig.sensors[0].rate_hz, rig.sensors[0].range_noise_m) == (20.0, 0.02)


def test_the_rays_of_a_lidar_are_those_that_gazebo_casts(robot_of):
    keys = robot_of(CHASSIS, on("base", LIDAR.format("left", "<pose>0 0 1 0 0 0</pose>", math.pi))).sensors[0]
    (lidar,) = Rig.model_validate({"name": "a", "sensors": [keys]}).sensors
    rays = np.einsum("ij,jrc->irc", lidar.mount.matrix()[:3, :3], lidar.directions())
    np.testing.assert_allclose(np.arctan2(rays[1], rays[0])[0], np.linspace(0.0, math.pi, 181), atol=1e-4)
    np.testing.assert_allclose(np.arcsin(rays[2])[:, 0], [-0.1, 0.1, 0.3], atol=1e-5)


def test_cameras_have_their_own_poses_and_names_and_the_range_of_their_depth(robot_of):
    depth = CAMERA.format("").replace(
        "</camera>", "<depth_camera><clip><near>0.3</near><far>5</far></clip></depth_camera></camera>"
    )
    two = CAMERA.format(" name='l'") + CAMERA.format(" name='r'").replace(
        "</camera>", "<pose>0 -0.1 0 0 0 0</pose></camera>"
    )
    robot = robot_of(
        CHASSIS,
        on("base", f"<sensor name='d' type='rgbd_camera'>{depth}</sensor>", "<sensor name='i' type='imu'/>"),
        on("base", f"<sensor name='m' type='multicamera'><pose>0.5 0 0 0 0 0</pose>{two}</sensor>"),
    )
    named = {keys["name"]: keys for keys in robot.sensors}
    assert list(named) == ["d", "m_l", "m_r"]
    assert (named["d"]["min_range_m"], named["d"]["max_range_m"], named["m_l"]["max_range_m"]) == (0.3, 5.0, 9.0)
    assert named["m_r"]["mount"] == {"x_m": 0.5, "y_m": -0.1, "z_m": 0.2}
    assert named["d"]["fov_deg"] == pytest.approx(math.degrees(1.5), abs=1e-4)
    assert robot.notes == ["Left out: i, of type imu.", "m: a camera, which counts as if it measured depth."]


@pytest.mark.parametrize("scale", [1.0, -0.5])
@pytest.mark.parametrize(
    ("shape", "size_m"),
    [
        ("<box size='0.4 0.2 0.6'/>", (0.4, 0.2, 0.6)),
        ("<cylinder radius='0.2' length='0.6'/>", (0.4, 0.4, 0.6)),
        ("<sphere radius='0.3'/>", (0.6, 0.6, 0.6)),
        ("<mesh filename='m.stl' scale='{0} 1 1'/>", (0.4, 0.2, 0.6)),
        ("<mesh filename='file://m.dae' scale='{0} 1 1'/>", (0.4, 0.2, 0.6)),
    ],
)
def test_shapes_have_their_middle_at_their_origin_and_face_outwards(robot_of, tmp_path, shape, size_m, scale):
    box = trimesh.creation.box((0.4, 0.2, 0.6))
    box.export(tmp_path / "m.stl")
    dae = trimesh.exchange.dae.export_collada(box.copy().apply_scale(100)).replace(
        b"<up_axis>", b'<unit name="cm" meter="0.01"/><up_axis>'
    )
    (tmp_path / "m.dae").write_bytes(dae)
    shape = shape.format(scale)
    if "mesh" in shape:
        size_m = np.array(size_m) * [abs(scale), 1, 1]
    body = f"<visual><origin xyz='0.05 0 0'/><geometry>{shape}</geometry></visual>"
    mesh = robot_of(f"<link name='base'>{BOX.format('0.01 0.01 2')}{body}</link>").body
    of_shape = mesh.vertices_m[8:]
    np.testing.assert_allclose(np.ptp(of_shape, axis=0), size_m, rtol=1e-6)
    np.testing.assert_allclose((of_shape.max(axis=0) + of_shape.min(axis=0))[2] / 2, 1.0, atol=1e-6)
    assert trimesh.Trimesh(mesh.vertices_m, mesh.faces).volume > 0


def test_meshes_of_a_package_are_found_around_the_file_or_where_it_is_told(tmp_path):
    urdf = "<robot name='a'><link name='b'><visual><geometry><mesh filename='package://bot/meshes/m.stl'/></geometry></visual></link></robot>"
    for root, file, packages in (
        (tmp_path / "ws" / "bot", "urdf/a.urdf", None),
        (tmp_path / "cloned_as_another", "urdf/a.urdf", None),
        (tmp_path / "elsewhere", "../a.urdf", {"bot": tmp_path / "elsewhere"}),
    ):
        (root / "meshes").mkdir(parents=True)
        (root / "urdf").mkdir()
        trimesh.creation.box((1, 2, 3)).export(root / "meshes" / "m.stl")
        (root / file).write_text(urdf)
        assert BoundingBox.around(read_robot(root / file, packages).body.vertices_m).size_m == pytest.approx((1, 2, 3))


def test_what_a_sensor_is_built_into_is_left_out_and_the_largest_body_stays(robot_of):
    links = (
        "<link name='l'>" + BOX.format("0.1 0.1 0.1") + "</link><link name='m'>" + BOX.format("0.1 0.1 0.2") + "</link>"
    )
    joints = joint("base", "l", "0 0 0.5") + joint("base", "m", "0.3 0 0.5", name="k")
    robot = robot_of(
        CHASSIS, links, joints, on("l", LIDAR.format("l", "", 1.0)), on("base", LIDAR.format("b", "", 1.0))
    )
    assert len(robot.body.vertices_m) == 16
    assert robot.notes == ["Left out: what sensors are built into, 1 of 3 bodies."]


def test_what_is_written_can_be_simulated_and_names_stay_names(robot_of, tmp_path):
    nasty = "&lt;b&gt;"
    sensor = LIDAR.format(nasty, "<pose>0 0 0.5 0 0 0</pose>", 6.28)
    robot = robot_of(CHASSIS, on("base", sensor))
    files = {path.name for path in robot.save(tmp_path / "out")}
    assert files == {"body.ply", "vehicle.yaml", "rig.yaml", "summary.json"}
    rig, vehicle = Rig.load(tmp_path / "out" / "rig.yaml"), Vehicle.load(tmp_path / "out" / "vehicle.yaml")
    assert rig.sensors[0].name == "<b>"
    np.testing.assert_allclose(vehicle.mesh().vertices_m, robot.body.vertices_m, atol=1e-6)
    frame = SimulatedFrames(Scenario.load("courtyard"), tmp_path / "out" / "rig.yaml", steps=1)[0]
    assert len(frame.sensor) > 100


def test_without_sensors_there_is_no_rig(robot_of, tmp_path):
    assert {path.name for path in robot_of(CHASSIS).save(tmp_path / "out")} == {
        "body.ply",
        "vehicle.yaml",
        "summary.json",
    }


TWO = "<link name='b'/><link name='c'/>"
MESH = "<link name='base'><visual><geometry><mesh filename='package://p/{}.stl'/></geometry></visual></link>"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ([CHASSIS, TWO, joint("base", "b"), joint("b", "c"), joint("base", "c")], "'c' hangs on 'b' and on 'base'"),
        ([CHASSIS, TWO, joint("b", "c"), joint("c", "b")], "'b', 'c' hang on each other in a ring"),
        ([TWO, joint("b", "c"), joint("c", "b")], "'b', 'c' hang on each other in a ring"),
        ([CHASSIS, TWO, joint("b", "c")], "'base', 'b' hang on no other"),
        ([CHASSIS, joint("base", "nowhere")], "about 'nowhere', which is no link"),
        ([CHASSIS, CHASSIS], "several of <link> are called 'base'"),
        ([CHASSIS, on("nowhere", LIDAR.format("l", "", 1.0))], "sensor 'l' is on 'nowhere'"),
        (["<link name='base'/>"], "no link has a visual"),
        ([MESH.format("one")], "1 of 1 meshes are missing: package://p/one.stl. Name the folder"),
        ([CHASSIS.replace("0.8", "wide")], "box size: 3 numbers needed; got 'wide 0.6 0.4'"),
        ([CHASSIS, on("base", LIDAR.format("l", "", "far"))], "scan/horizontal/max_angle: 1 number needed; got 'far'"),
        ([CHASSIS, on("base", "<sensor name='l' type='ray'/>")], "<lidar> or <ray> is missing"),
        (["<link name='base'/><x:include xmlns:x='http://ros.org/wiki/xacro'/>"], "xacro a.urdf > a_expanded.urdf"),
        ([], "a <robot> with links is needed"),
    ],
)  # fmt: skip
def test_what_is_no_robot_is_told_in_one_line(robot_of, content, told):
    with pytest.raises(BadFileError, match=r"a\.urdf: ") as caught:
        robot_of(*content)
    assert told in str(caught.value)
