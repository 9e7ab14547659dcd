"""Robots of URDF files: poses of links and sensors, meshes, and invalid files."""

import math
import time

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


def join(parent, child, xyz="0 0 0", rpy="0 0 0", inside="", kind="revolute"):
    ends = f"<parent link='{parent}'/><child link='{child}'/><origin xyz='{xyz}' rpy='{rpy}'/>"
    return f"<joint name='{parent}_{child}' type='{kind}'>{ends}{inside}</joint>"


def embed(link, *sensors):
    return f"<gazebo reference='{link}'>{''.join(sensors)}</gazebo>"


@pytest.fixture
def robot_of(tmp_path):
    def read(*content, packages=None):
        (tmp_path / "a.urdf").write_text(f"<robot name='a'>{''.join(content)}</robot>")
        return read_robot(tmp_path / "a.urdf", packages)

    return read


def test_sensor_pose_chains_all_joints_at_zero(robot_of):
    turns = [("0.3 0 0.5", (0.1, -0.2, 1.0)), ("0 0.4 0", (0.0, 0.5, -0.3))]
    places = [np.eye(4), np.eye(4), np.eye(4)]
    for place, (xyz, rpy) in zip(places, [*turns, ("0.01 0.02 0.03", (0.0, 0.0, 0.2))], strict=True):
        place[:3, :3], place[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), np.array(xyz.split(), float)
    words = [" ".join(map(str, rpy)) for _, rpy in turns]
    pose = "<pose>0.01 0.02 0.03 0 0 0.2</pose>"
    robot = robot_of(
        CHASSIS, "<link name='arm'/><link name='head'/>", join("base", "arm", turns[0][0], words[0]),
        join("arm", "head", turns[1][0], words[1]), embed("head", LIDAR.format("l", pose, 0.0).replace("181", "1")),
    )  # fmt: skip
    expected = places[0] @ places[1] @ places[2]
    expected[2, 3] += 0.2  # the center of the chassis is 0.2 m above the ground
    (keys,) = robot.sensors
    rig = Rig.model_validate({"name": "a", "sensors": [keys]})
    np.testing.assert_allclose(rig.sensors[0].mount.to_matrix(), expected, atol=2e-4)
    assert (rig.sensors[0].rate_hz, rig.sensors[0].range_noise_m) == (20.0, 0.02)


def test_lidar_rays_equal_those_of_gazebo(robot_of):
    keys = robot_of(CHASSIS, embed("base", LIDAR.format("left", "<pose>0 0 1 0 0 0</pose>", math.pi))).sensors[0]
    (lidar,) = Rig.model_validate({"name": "a", "sensors": [keys]}).sensors
    rays = np.einsum("ij,jrc->irc", lidar.mount.to_matrix()[:3, :3], lidar.compute_directions())
    np.testing.assert_allclose(np.arctan2(rays[1], rays[0])[0], np.linspace(0.0, math.pi, 181), atol=1e-4)
    np.testing.assert_allclose(np.arcsin(rays[2])[:, 0], [-0.1, 0.1, 0.3], atol=1e-5)


def test_cameras_have_poses_names_and_depth_ranges(robot_of):
    depth = CAMERA.format("").replace(
        "</camera>", "<depth_camera><clip><near>0.3</near><far>5</far></clip></depth_camera></camera>"
    )
    two = CAMERA.format(" name='l'") + CAMERA.format(" name='r'").replace(
        "</camera>", "<pose>0 -0.1 0 0 0 0</pose></camera>"
    )
    robot = robot_of(
        CHASSIS,
        embed("base", f"<sensor name='d' type='rgbd_camera'>{depth}</sensor>", "<sensor name='i' type='imu'/>"),
        embed("base", f"<sensor name='m' type='multicamera'><pose>0.5 0 0 0 0 0</pose>{two}</sensor>"),
    )
    named = {keys["name"]: keys for keys in robot.sensors}
    assert list(named) == ["d", "m_l", "m_r"]
    assert (named["d"]["min_range_m"], named["d"]["max_range_m"], named["m_l"]["max_range_m"]) == (0.3, 5.0, 9.0)
    assert named["m_r"]["mount"] == {"x_m": 0.5, "y_m": -0.1, "z_m": 0.2}
    assert named["d"]["fov_deg"] == pytest.approx(math.degrees(1.5), abs=1e-4)
    assert robot.notes[:2] == ["Excluded: i, of type imu.", "m: a camera, which is simulated as a depth camera."]


@pytest.mark.parametrize("scale", [1.0, -0.5])
@pytest.mark.parametrize(
    ("shape", "size_m"),
    [
        ("<box size='0.4 0.2 0.6'/>", (0.4, 0.2, 0.6)),
        ("<cylinder radius='0.2' length='0.6'/>", (0.4, 0.4, 0.6)),
        ("<sphere radius='0.3'/>", (0.6, 0.6, 0.6)),
        ("<capsule radius='0.2' length='0.2'/>", (0.4, 0.4, 0.6)),
        ("<mesh filename='m.stl' scale='{0} 1 1'/>", (0.4, 0.2, 0.6)),
        ("<mesh filename='file://m.dae' scale='{0} 1 1'/>", (0.4, 0.2, 0.6)),
    ],
)
def test_shapes_are_centered_and_face_outwards(robot_of, tmp_path, shape, size_m, scale):
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


def test_meshes_of_packages_are_found(tmp_path):
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
        assert BoundingBox.from_points(read_robot(root / file, packages).body.vertices_m).size_m == pytest.approx(
            (1, 2, 3)
        )


def test_housings_are_excluded_except_the_largest_body(robot_of):
    links = (
        "<link name='l'>" + BOX.format("0.1 0.1 0.1") + "</link><link name='m'>" + BOX.format("0.1 0.1 0.2") + "</link>"
    )
    joints = join("base", "l", "0 0 0.5") + join("base", "m", "0.3 0 0.5")
    robot = robot_of(
        CHASSIS, links, joints, embed("l", LIDAR.format("l", "", 1.0)), embed("base", LIDAR.format("b", "", 1.0))
    )
    assert len(robot.body.vertices_m) == 16
    assert robot.notes == [
        "Excluded: housings of sensors, 1 of 3 bodies.",
        "Rays that end on the own vehicle: l 108 of 543 (19.9%), b 543 of 543 (100.0%).",
    ]


def test_posts_around_a_lidar_stay_and_block_rays(robot_of):
    """The bounding box of the posts contains the sensor, but posts of 2 cm at 6 cm are no housing."""
    corners = [f"{x} {y} 0" for x in (-0.06, 0.06) for y in (-0.06, 0.06)]
    posts = "".join(BOX.format("0.02 0.02 0.2").replace("<geo", f"<origin xyz='{xyz}'/><geo") for xyz in corners)
    full_turn = LIDAR.format("l", "", 2 * math.pi).replace("181", "3600")
    robot = robot_of(CHASSIS, f"<link name='l'>{posts}</link>", join("base", "l", "0 0 0.5"), embed("l", full_turn))
    assert len(robot.body.vertices_m) == 5 * 8
    # From the center, a post spans from one of its corners to the opposite one.
    span_rad = 4 * 2 * (math.atan2(0.07, 0.05) - math.pi / 4)
    (note,) = robot.notes
    share = float(note.split("(")[1].split("%")[0])
    assert share == pytest.approx(100 * span_rad / (2 * math.pi), abs=0.1)


@pytest.mark.parametrize("pose", [
    "<pose degrees='true'>0.1 0 0 0 10 90</pose>",
    "<pose rotation_format='quat_xyzw'>0.1 0 0 -0.061628417 0.061628417 0.704416026 0.704416026</pose>",
    "<pose relative_to='base_l' degrees='1'>-0.1 0 -0.3 0 10 90</pose>",
    "<pose relative_to='l'>-0.1 0 -0.3 0 0.174532925 1.570796327</pose>",
    "<pose frame='__model__' degrees='true'>0.1 0 0 0 10 90</pose>",
])  # fmt: skip
def test_pose_attributes_are_applied(robot_of, pose):
    links = "<link name='l'/>" + join("base", "l", "0.2 0 0.3")
    mount = robot_of(CHASSIS, links, embed("base", f"<sensor name='c' type='depth'>{pose}{CAMERA.format('')}</sensor>"))
    assert mount.sensors[0]["mount"] == {"x_m": 0.1, "z_m": 0.2, "yaw_deg": 90.0, "pitch_deg": 10.0}


def test_camera_distortion_and_noise_are_applied(robot_of):
    """Gazebo counts the principal point from the corner of the image, torchcover from the center of the first pixel."""
    inside = (
        "<lens><intrinsics><fx>{}</fx><fy>320</fy><cx>320</cx><cy>{}</cy><s>0</s></intrinsics></lens>"
        "<distortion><k1>{}</k1></distortion><noise><stddev>0.02</stddev><mean>0.1</mean></noise></camera>"
    )
    cases = [("320", "240", "0"), ("310", "200", "0"), ("320", "240", "-0.1")]
    sensors = [f"<sensor name='c' type='depth'>{CAMERA.format('').replace('</camera>', inside.format(*case))}</sensor>"
               for case in cases]  # fmt: skip
    robot = robot_of(CHASSIS, embed("base", *sensors))
    plain, shifted, distorted = robot.sensors
    assert (plain["fov_deg"], plain["range_noise_m"]) == (90.0, 0.02)
    assert [shifted[key] for key in ("fx", "fy", "cx", "cy")] == [310.0, 320.0, 319.5, 199.5]
    assert (distorted["lens"], distorted["coefficients"]) == ("brown_conrady", [-0.1, 0.0, 0.0, 0.0, 0.0])
    assert "c: <noise><mean> 0.1 is not applied; noise has a mean of 0." in robot.notes
    assert "c: cy is counted from the top of the image; Gazebo Classic 10 counts from below." in robot.notes


@pytest.mark.parametrize(("samples", "resolution", "channels"), [(1, 0.1, 1), (4, 0.5, 2), (3, 2, 6), (3, 1, 3)])
def test_resolution_is_applied_as_in_gazebo_classic(robot_of, samples, resolution, channels):
    lidar = LIDAR.format("l", "", 1.0).replace(
        "<samples>3</samples>", f"<samples>{samples}</samples><resolution>{resolution}</resolution>"
    )
    robot = robot_of(CHASSIS, embed("base", lidar))
    assert robot.sensors[0]["channels"] == channels
    note = f"Gazebo (gz-sim) ignores <resolution> and has {samples}."
    assert any(note in words for words in robot.notes) == (resolution != 1)


def test_ignored_settings_are_named(robot_of):
    plugin = "<plugin><min_range>0.9</min_range><updateRate>20.0</updateRate><topic>x</topic></plugin>"
    lens = "<lens><type>equidistant</type></lens><visibility_mask>7</visibility_mask></camera>"
    camera = CAMERA.format("").replace("</camera>", lens)
    lidar = LIDAR.format("l", "", 1.0).replace("</sensor>", f"{plugin}</sensor>")
    notes = robot_of(CHASSIS, embed("base", lidar, f"<sensor name='c' type='depth'>{camera}</sensor>")).notes
    assert "l: settings of its plugin are not applied: <min_range> 0.9; set them in rig.yaml." in notes
    assert any(note.startswith("c: <lens><type> equidistant is not applied, a pinhole is assumed") for note in notes)
    assert "c: <visibility_mask> 7 is not applied; the sensor sees all bodies." in notes


def test_mimic_joints_have_offsets_and_limits_are_noted(robot_of):
    """b slides by 0.1 m; c follows b with 2 * 0.1 + 0.05 m along y; d is at 0, outside of its limits."""
    links = "".join(f"<link name='{name}'>{BOX.format('0.1 0.1 0.1')}</link>" for name in "bcd")
    limit = "<limit lower='0.2' upper='0.6'/>"
    mimics = [f"<axis xyz='0 2 0'/><mimic joint='{of}' multiplier='2' offset='{offset}'/>"
              for of, offset in (("base_d", 0.1), ("base_b", 0.05))]  # fmt: skip
    robot = robot_of(
        CHASSIS, links, join("base", "d", "0 0 1", inside=limit),
        join("base", "c", "0 0 2", "0 0 1", mimics[1], "prismatic"),
        join("base", "b", "0 0 3", "", mimics[0], "prismatic").replace("rpy=''", ""),
    )  # fmt: skip
    center_m = robot.body.vertices_m.reshape(4, 8, 3).mean(axis=1)
    np.testing.assert_allclose(center_m[1], [0.0, 0.1, 3.2], atol=1e-9)
    np.testing.assert_allclose(center_m[2], [-0.25 * math.sin(1), 0.25 * math.cos(1), 2.2], atol=1e-9)
    (note,) = robot.notes
    assert note.startswith("Joints outside of their limits: 'base_d' at 0 rad (0.2 to 0.6)")


def test_reading_time_is_linear_in_links(robot_of):
    """A chain and a star of 20,000 links are read in seconds."""
    names = [f"l{k}" for k in range(20_000)]
    links = "".join(f"<link name='{name}'/>" for name in names)
    joints = "".join(join(names[k - 1] if k % 2 else names[0], names[k], "0 0 0.001") for k in range(1, len(names)))
    start_s = time.process_time()
    robot_of(CHASSIS, links, joints, join("base", "l0"))
    assert time.process_time() - start_s < 20.0


def test_written_robots_can_be_simulated(robot_of, tmp_path):
    nasty = "&lt;b&gt;"
    sensor = LIDAR.format(nasty, "<pose>0 0 0.5 0 0 0</pose>", 6.28)
    robot = robot_of(CHASSIS, embed("base", sensor))
    files = {path.name for path in robot.save(tmp_path / "out")}
    assert files == {"body.ply", "vehicle.yaml", "rig.yaml", "summary.json"}
    rig, vehicle = Rig.load(tmp_path / "out" / "rig.yaml"), Vehicle.load(tmp_path / "out" / "vehicle.yaml")
    assert rig.sensors[0].name == "<b>"
    np.testing.assert_allclose(vehicle.build_mesh().vertices_m, robot.body.vertices_m, atol=1e-6)
    frame = SimulatedFrames(Scenario.load("courtyard"), tmp_path / "out" / "rig.yaml", num_frames=1)[0]
    assert len(frame.sensor) > 100


def test_robots_without_sensors_have_no_rig(robot_of, tmp_path):
    assert {path.name for path in robot_of(CHASSIS).save(tmp_path / "out")} == {
        "body.ply",
        "vehicle.yaml",
        "summary.json",
    }


SKEWED = CAMERA.format("").replace(
    "</camera>", "<lens><intrinsics><fx>9</fx><fy>9</fy><s>2</s></intrinsics></lens></camera>"
)
TWO = "<link name='b'/><link name='c'/>"
MESH = "<link name='base'><visual><geometry><mesh filename='package://p/{}.stl'/></geometry></visual></link>"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ([CHASSIS, TWO, join("base", "b"), join("b", "c"), join("base", "c")], "'c' is the child of 'b' and of"),
        ([CHASSIS, TWO, join("b", "c"), join("c", "b")], "'b', 'c' form a ring"),
        ([TWO, join("b", "c"), join("c", "b")], "'b', 'c' form a ring"),
        ([CHASSIS, TWO, join("b", "c")], "'base', 'b' have no parent"),
        ([CHASSIS, join("base", "nowhere")], "refers to 'nowhere', which is no link"),
        ([CHASSIS, CHASSIS], "several of <link> are named 'base'"),
        ([CHASSIS, join("base", "b"), join("base", "b"), TWO], "several of <joint> are named 'base_b'"),
        ([CHASSIS, "<link name='b'/>", join("base", "b", inside="<mimic joint='x'/>")], "mimics 'x', which is no"),
        ([CHASSIS, "<link name='b'/>", join("base", "b", inside="<mimic joint='base_b'/>")], "mimics itself"),
        (["<link name='b'><visual><geometry><heightmap/></geometry></visual></link>"], "<heightmap> cannot be applied"),
        ([CHASSIS, embed("base", LIDAR.format("l", "<pose relative_to='x'/>", 1.0))], "sensor 'l' is on 'x'"),
        ([CHASSIS, embed("base", LIDAR.format("l", "<pose rotation_format='axis'/>", 1.0))], "rotation_format 'axis'"),
        ([CHASSIS, embed("base", LIDAR.format("l", "", -1.0))], "horizontal_fov_deg"),
        ([CHASSIS, embed("base", f"<sensor name='c' type='depth'>{SKEWED}</sensor>")], "s 2 cannot be applied"),
        ([CHASSIS, embed("nowhere", LIDAR.format("l", "", 1.0))], "sensor 'l' is on 'nowhere'"),
        (["<link name='base'/>"], "no link has a visual"),
        ([MESH.format("one")], "1 of 1 meshes are missing: package://p/one.stl. Name the folder"),
        ([CHASSIS.replace("0.8", "1e308")], "the body reaches beyond 1e+09 m"),
        ([CHASSIS.replace("0.8", "4e9")], "the body reaches beyond 1e+09 m"),
        ([CHASSIS.replace("0.8", "wide")], "box size: 3 numbers needed; got 'wide 0.6 0.4'"),
        ([CHASSIS, embed("base", LIDAR.format("l", "", "far"))], "horizontal/max_angle: 1 number needed; got 'far'"),
        ([CHASSIS, embed("base", "<sensor name='l' type='ray'/>")], "<lidar> or <ray> is missing"),
        (["<link name='base'/><x:include xmlns:x='http://ros.org/wiki/xacro'/>"], "xacro a.urdf > a_expanded.urdf"),
        ([], "a <robot> with links is needed"),
    ],
)  # fmt: skip
def test_invalid_robots_are_refused_in_one_line(robot_of, content, told):
    with pytest.raises(BadFileError, match=r"a\.urdf: ") as caught:
        robot_of(*content)
    assert told in str(caught.value)
