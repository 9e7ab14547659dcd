"""Calibrations from the files of others, written here as their tools write them."""

import json

import cv2
import numpy as np
import pytest
import torch

from torchcover.cameras import Camera, convert_carla_pose
from torchcover.files import BadFileError
from torchcover.geometry import convert_euler_to_rotation, invert, transform_points

MATRIX = np.array([[520.0, 0.0, 318.0], [0.0, 510.0, 242.0], [0.0, 0.0, 1.0]])

ROS_FILE = """image_width: 640
image_height: 480
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [520., 0., 318., 0., 510., 242., 0., 0., 1.]}
distortion_model: %s
distortion_coefficients: {rows: 1, cols: %d, data: %s}
"""
ROS_MESSAGE = """header: {frame_id: head}
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.2, 0.1, 0.0, 0.001, 0.02]
k: [520.0, 0.0, 318.0, 0.0, 510.0, 242.0, 0.0, 0.0, 1.0]
"""


def check_matrix(camera, width=640, height=480):
    assert (camera.width, camera.height) == (width, height)
    assert camera.intrinsics.tolist() == [520.0, 510.0, 318.0, 242.0]


@pytest.mark.parametrize(
    ("theirs", "ours", "coefficients"),
    [
        ("plumb_bob", "brown_conrady", [-0.2, 0.1, 0.0, 0.001, 0.02]),
        ("rational_polynomial", "brown_conrady", [0.1] * 8),
        ("equidistant", "kannala_brandt", [0.1, 0.2, 0.3, 0.4]),
        ("plumb_bob", "pinhole", []),
    ],
)
def test_ros(tmp_path, theirs, ours, coefficients):
    (tmp_path / "head.yaml").write_text(ROS_FILE % (theirs, len(coefficients), coefficients))
    camera = Camera.from_ros(tmp_path / "head.yaml")
    check_matrix(camera)
    assert (camera.name, camera.model, camera.coefficients.tolist()) == ("head", ours, coefficients)


def ros_region(x_offset, y_offset, width, height, binning):
    roi = f"roi: {{x_offset: {x_offset}, y_offset: {y_offset}, width: {width}, height: {height}, do_rectify: false}}\n"
    return f"binning_x: {binning}\nbinning_y: {binning}\n{roi}"


# A message as `ros2 topic echo` ends it, and several that differ in their stamps.
@pytest.mark.parametrize("messages", [1, 2])
@pytest.mark.parametrize(
    ("said", "region", "intrinsics", "size"),
    [
        ((640, 480), (0, 0, 0, 0, 0), (520, 510, 318, 242), (640, 480)),
        ((640, 480), (0, 0, 0, 0, 2), (260, 255, 159, 121), (320, 240)),
        ((640, 480), (100, 80, 320, 200, 1), (520, 510, 218, 162), (320, 200)),
        ((640, 480), (100, 80, 320, 200, 2), (260, 255, 109, 81), (160, 100)),
        # Drivers that give the size of the region for that of the sensor.
        ((320, 200), (100, 80, 320, 200, 1), (520, 510, 218, 162), (320, 200)),
    ],
)
def test_camera_info_describes_the_published_image(tmp_path, messages, said, region, intrinsics, size):
    text = ROS_MESSAGE.replace("640", str(said[0])).replace("480", str(said[1])) + ros_region(*region)
    echoed = [text.replace("head}", f"head, seq: {number}}}") + "---\n" for number in range(messages)]
    (tmp_path / "info.yaml").write_text("".join(echoed))
    camera = Camera.from_ros(tmp_path / "info.yaml")
    assert (camera.width, camera.height) == size
    assert camera.intrinsics.tolist() == list(intrinsics)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            ROS_MESSAGE + "---\n" + ROS_MESSAGE.replace("318", "319"),
            "2 messages of different content; keep one of them",
        ),
        (ROS_MESSAGE + ros_region(400, 0, 320, 200, 1), "roi: .* width of 640 pixels is needed; got 320 from 400 on"),
        (ROS_MESSAGE + ros_region(400, 0, 0, 0, 1), "roi: .* got 0 from 400 on; give the region that was read"),
        (
            ROS_MESSAGE.replace("318", "79") + ros_region(0, 0, 0, 0, 4),
            "binning_x 4: K seems .* binned image already",
        ),
        (ROS_MESSAGE + "roi: 3", "roi: x_offset, y_offset, width and height are needed; got 3"),
        (ROS_MESSAGE.replace("height", "hight"), "image_height or height is missing"),
        (ROS_MESSAGE.replace("plumb_bob", "wide"), "'wide' is unknown; allowed: plumb_bob"),
        (ROS_MESSAGE.replace("plumb_bob", "[a, b]"), "distortion_model a list is unknown"),
        (ROS_MESSAGE.replace("480", "480.5"), "height: a whole number is needed; got 480.5"),
        (ROS_MESSAGE.replace("480", "-480"), "height must be a positive integer; got -480"),
        (ROS_MESSAGE.replace("k: [520.0, ", "k: ["), "the camera matrix has 9 numbers; got 8"),
        (ROS_MESSAGE.replace("k: [520.0", "k: [.nan"), "k: a list of finite numbers is needed; got a list"),
        (ROS_MESSAGE.replace("k: [520.0", "k: [0.0"), r"fx and fy must be positive; got \[0.0, 510.0\]"),
        (ROS_MESSAGE.replace("-0.2", "[1, [2, 3]]"), "d: a list of finite numbers is needed; got a list"),
        (ROS_MESSAGE.replace("-0.2, 0.1, ", ""), "takes 4 or 5 .* coefficients"),
        (
            ROS_FILE.replace("rows: 3", "rows: 4") % ("plumb_bob", 4, [0.0] * 4),
            "4 rows and 3 columns are not 9 numbers",
        ),
        (
            ROS_FILE.replace("cols: 3", "cols: a") % ("plumb_bob", 4, [0.0] * 4),
            "cols: a whole number is needed; got 'a'",
        ),
        ("- 1", "a mapping of names to values is needed; got list"),
        ("a: [1", "not a YAML file"),
        ("", "an empty file"),
    ],
)
def test_invalid_ros_files_are_refused(tmp_path, text, message):
    (tmp_path / "info.yaml").write_text(text)
    with pytest.raises(BadFileError, match=rf"info\.yaml: .*({message})"):
        Camera.from_ros(tmp_path / "info.yaml")


def test_nested_yaml_aliases_are_refused(tmp_path):
    """Nested aliases: 9^11 numbers, of which nobody may ask."""
    laughs = "a0: &a0 [1.0, 1.0]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12))
    for key in ("distortion_model", "d", "k", "width"):
        lines = [line for line in ROS_MESSAGE.splitlines() if not line.startswith(f"{key}:")]
        (tmp_path / "info.yaml").write_text(laughs + "\n".join([*lines, f"{key}: *a11"]))
        with pytest.raises(BadFileError, match="more than 200,000 values, those of aliases included"):
            Camera.from_ros(tmp_path / "info.yaml")


def write_opencv(path, **entries):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, value)
    storage.release()


def test_opencv(tmp_path):
    distortion = np.array([[-0.2, 0.1, 0.0, 0.001, 0.02]])
    write_opencv(
        tmp_path / "left.yml",
        image_width=640,
        image_height=480,
        camera_matrix=MATRIX,
        distortion_coefficients=distortion,
    )
    camera = Camera.from_opencv(tmp_path / "left.yml")
    check_matrix(camera)
    assert (camera.model, camera.coefficients.tolist()) == ("brown_conrady", distortion[0].tolist())


def test_opencv_fisheye_and_stereo_names(tmp_path):
    write_opencv(tmp_path / "s.yml", fisheye_model=1, M1=MATRIX, D1=np.array([[0.1], [0.2], [0.3], [0.4]]))
    camera = Camera.from_opencv(tmp_path / "s.yml", matrix_key="M1", distortion_key="D1", size=(640, 480))
    check_matrix(camera)
    assert (camera.model, camera.coefficients.tolist()) == ("kannala_brandt", [0.1, 0.2, 0.3, 0.4])
    with pytest.raises(
        ValueError, match=r"camera_matrix, .*image_height not in the file; it contains fisheye_model, M1, D1"
    ):
        Camera.from_opencv(tmp_path / "s.yml")
    with (tmp_path / "s.yml").open("a") as file:
        file.write("xi: 0.9\n")
    with pytest.raises(BadFileError, match="xi: the omnidirectional model of OpenCV is not read"):
        Camera.from_opencv(tmp_path / "s.yml", matrix_key="M1", distortion_key="D1", size=(640, 480))


def test_opencv_written_as_its_manual_shows(tmp_path):
    (tmp_path / "c.yml").write_text(
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
        "   dt: d\n   data: [ 520., 0., 318., 0.,\n       510., 242., 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n   data: [ 1e-1, 0., 0., 0. ]\n"
    )
    camera = Camera.from_opencv(tmp_path / "c.yml")
    check_matrix(camera)
    assert camera.coefficients.tolist() == [0.1, 0.0, 0.0, 0.0]


def row(values):
    return " ".join(f"{value:.12e}" for value in np.asarray(values).ravel())


@pytest.mark.parametrize("layout", ["object", "odometry"])
def test_kitti_projection_equals_its_own_matrices(tmp_path, layout):
    P = MATRIX @ np.array([[1.0, 0.0, 0.0, 0.06], [0.0, 1.0, 0.0, -0.01], [0.0, 0.0, 1.0, 0.003]])
    velodyne = np.array([[0.0, -1.0, 0.0, 0.01], [0.0, 0.0, -1.0, -0.07], [1.0, 0.0, 0.0, -0.27]])
    rectify = convert_euler_to_rotation(0.5, -0.3, 0.2) if layout == "object" else np.eye(3)
    key = "Tr_velo_to_cam" if layout == "object" else "Tr"
    r0 = f"R0_rect: {row(rectify)}\n" if layout == "object" else ""
    (tmp_path / "c.txt").write_text(f"P0: {row(MATRIX @ np.eye(3, 4))}\nP2: {row(P)}\n{r0}{key}: {row(velodyne)}\n\n")
    camera = Camera.from_kitti(tmp_path / "c.txt", 2, width=640, height=480)
    lidar = np.random.default_rng(0).uniform([4.0, -2.0, -1.0], [30.0, 2.0, 1.0], (50, 3))
    rectified = (lidar @ velodyne[:, :3].T + velodyne[:, 3]) @ rectify.T
    homogeneous = np.c_[rectified, np.ones(50)] @ P.T
    pixels, _ = camera.project(camera.to_camera(torch.from_numpy(lidar)))
    np.testing.assert_allclose(pixels.numpy(), homogeneous[:, :2] / homogeneous[:, 2:], rtol=0, atol=1e-6)


def test_kitti_extrinsics_follow_from_the_lidar(tmp_path):
    (tmp_path / "c.txt").write_text(f"P0: {row(MATRIX @ np.eye(3, 4))}\nTr: {row(np.eye(3, 4))}\n")
    pose = np.eye(4)
    pose[:3, 3] = [0.76, 0.0, 1.73]
    camera = Camera.from_kitti(tmp_path / "c.txt", 0, width=640, height=480, vehicle_T_lidar=pose)
    np.testing.assert_allclose(camera.vehicle_T_camera, pose)
    with pytest.raises(ValueError, match=r"P2 with 12 numbers is needed; got nothing; the file contains P0, Tr"):
        Camera.from_kitti(tmp_path / "c.txt", 2, width=640, height=480)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("P0: 5", "P0: a"), r"P0 with 12 numbers is needed; got a\.2"),
        (("P0: 5", "P0: nan 5"), "P0 with 12 numbers is needed; got nan"),
        (("P0: 5.200000000000e+02", "P0: 0"), "P0 has no focal length"),
        (("Tr: 1.0", "Tr: 2.0"), "P0 from the lidar: not a rigid transform"),
        (("Tr", "Ts"), "Tr with 12 numbers is needed; got nothing; the file contains P0, Ts"),
    ],
)
def test_invalid_kitti_files_are_refused(tmp_path, change, message):
    (tmp_path / "c.txt").write_text(f"P0: {row(MATRIX @ np.eye(3, 4))}\nTr: {row(np.eye(3, 4))}\n".replace(*change))
    with pytest.raises(BadFileError, match=rf"c\.txt: {message}"):
        Camera.from_kitti(tmp_path / "c.txt", 0, width=640, height=480)


def write_nuscenes(folder, *calibrations):
    (folder / "sensor.json").write_text(
        json.dumps([{"token": "s1", "channel": "CAM_FRONT"}, {"token": "s2", "channel": "LIDAR_TOP"}])
    )
    (folder / "calibrated_sensor.json").write_text(json.dumps(list(calibrations)))


def calibrated(token, x, sensor="s1"):
    return {
        "token": token,
        "sensor_token": sensor,
        "translation": [x, 0.0, 1.5],
        "rotation": [0.5, -0.5, 0.5, -0.5],
        "camera_intrinsic": MATRIX.tolist() if sensor == "s1" else [],
    }


def test_nuscenes(tmp_path):
    write_nuscenes(tmp_path, calibrated("a", 1.7), calibrated("l", 0.9, "s2"), calibrated("b", 1.7))
    camera = Camera.from_nuscenes(tmp_path, "CAM_FRONT")
    check_matrix(camera, 1600, 900)
    ahead = camera.to_vehicle(torch.tensor([[0.0, 0.0, 10.0]]))
    torch.testing.assert_close(ahead, torch.tensor([[11.7, 0.0, 1.5]]))


def test_nuscenes_vehicles_are_distinguished(tmp_path):
    write_nuscenes(tmp_path, calibrated("a", 1.7), calibrated("b", 1.8), calibrated("l", 0.9, "s2"))
    with pytest.raises(ValueError, match=r"2 calibrations of 'CAM_FRONT'.*a, b"):
        Camera.from_nuscenes(tmp_path, "CAM_FRONT")
    assert Camera.from_nuscenes(tmp_path, "CAM_FRONT", token="b").vehicle_T_camera[0, 3] == 1.8
    for channel in ("CAM_BACK", "LIDAR_TOP"):
        with pytest.raises(ValueError, match=r"no calibrated camera .*channels: \['CAM_FRONT', 'LIDAR_TOP'\]"):
            Camera.from_nuscenes(tmp_path, channel)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("sensor.json", "]", "", r"sensor\.json: Expecting"),
        ("sensor.json", '"s1"', "1", "no calibrated camera 'CAM_FRONT'"),
        ("sensor.json", "[", "[" * 100_000, r"sensor\.json: not readable as a table of rows \(RecursionError"),
        ("calibrated_sensor.json", '"sensor_token"', '"other"', r"nuScenes' tables \(KeyError: 'sensor_token'"),
        (
            "calibrated_sensor.json",
            "[1.7, 0.0, 1.5]",
            "[1.7]",
            "needs a rotation of four numbers and a translation of three",
        ),
        ("calibrated_sensor.json", "[0.5, -0.5, 0.5, -0.5]", "[0, 0, 0, 0]", "a quaternion of norm 0"),
        ("calibrated_sensor.json", "[520.0, 0.0, 318.0]", "5", "has three rows of three numbers; got a list"),
    ],
)
def test_invalid_nuscenes_tables_are_refused(tmp_path, file, old, new, message):
    write_nuscenes(tmp_path, calibrated("a", 1.7))
    content = (tmp_path / file).read_text()
    assert old in content
    (tmp_path / file).write_text(content.replace(old, new))
    with pytest.raises(BadFileError, match=rf"{tmp_path}.*{message}"):
        Camera.from_nuscenes(tmp_path, "CAM_FRONT")


def test_a_matrix(tmp_path):
    camera = Camera.from_matrix(MATRIX, 640, 480, model="kannala_brandt", coefficients=[0.1, 0.0, 0.0, 0.0], name="x")
    check_matrix(camera)
    assert (camera.name, camera.model) == ("x", "kannala_brandt")


def test_field_of_view_extends_between_image_edges():
    camera = Camera.from_fov(500, 420, 110.0)
    edges = torch.tensor([[-0.5, 209.5], [499.5, 209.5]], dtype=torch.float64)
    left, right = camera.rays(edges)[0]
    assert torch.rad2deg(torch.arccos(left @ right)).item() == pytest.approx(110.0, abs=1e-12)


def carla_matrix(location, pitch, yaw, roll):
    """carla.Transform.get_matrix(): left-handed, x forward, y right, z up."""
    (cp, cy, cr), (sp, sy, sr) = np.cos(np.deg2rad([pitch, yaw, roll])), np.sin(np.deg2rad([pitch, yaw, roll]))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
        [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
        [sp, -cp * sr, cp * cr],
    ]
    matrix[:3, 3] = location
    return matrix


@pytest.mark.parametrize(
    "angles", [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 90.0, 0.0), (0.0, 0.0, 20.0), (7.0, -50.0, 3.0)]
)
def test_carla_pose_equals_its_matrix_with_flipped_y(angles):
    pitch, yaw, roll = angles
    location = [1.5, 0.4, 2.8]
    in_camera = np.random.default_rng(0).uniform(-5.0, 5.0, (20, 3))  # x right, y down, z forward
    in_carla = np.c_[in_camera[:, 2], in_camera[:, 0], -in_camera[:, 1]]  # x forward, y right, z up
    expected = transform_points(carla_matrix(location, pitch, yaw, roll), in_carla) * [1.0, -1.0, 1.0]
    pose = convert_carla_pose(location, pitch_deg=pitch, yaw_deg=yaw, roll_deg=roll)
    np.testing.assert_allclose(transform_points(pose, in_camera), expected, atol=1e-12)
    np.testing.assert_allclose(pose @ invert(pose), np.eye(4), atol=1e-12)
