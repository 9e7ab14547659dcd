"""Rigs of recordings: scan patterns of LiDARs, extrinsics of LiDARs and cameras."""

import json
import re

import numpy as np
import pytest
import torch

from tests.recordings import bags, layouts
from tests.recordings.drives import Drive
from torchcover.data import RecordingSettings, Scan, build_rig_document, open_recording
from torchcover.files import BadFileError
from torchcover.geometry import build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.recordings.formats import argoverse2, kitti, nuscenes
from torchcover.simulation import Lidar, Rig, list_builtin_names
from torchcover.simulation.camera_sensor import MOUNT_T_CAMERA
from torchcover.simulation.scan_estimate import estimate_scan, infer_laser_indices


def simulate_room_scan(lidar, seed, dropout=0.2):
    """Simulate the points of a LiDAR in a room, in its frame; rays are lost by chance only."""
    directions = lidar.compute_directions()
    random = np.random.default_rng(seed)
    size_m = np.array([30.0, 12.0, 8.0])[:, None, None]
    range_m = (size_m / np.maximum(np.abs(directions), 1e-12)).min(axis=0)
    range_m += random.normal(scale=0.02, size=range_m.shape)
    return (range_m * directions)[:, random.random(range_m.shape) > dropout].T


@pytest.mark.parametrize("model", list_builtin_names("lidars"))
def test_scan_pattern_of_every_model_is_estimated(model):
    lidar = Lidar.model_validate({"name": "a", "model": model, "columns": 240})
    found = estimate_scan([simulate_room_scan(lidar, seed) for seed in range(2)])
    np.testing.assert_allclose(found.elevations_deg, np.sort(lidar.compute_elevations_deg())[::-1], atol=1e-9)
    step_deg = lidar.horizontal_fov_deg / lidar.columns
    if lidar.horizontal_fov_deg < 360 and lidar.azimuth_offsets_deg is not None:  # rows begin at different azimuths
        assert found.horizontal_fov_deg / found.num_columns == pytest.approx(step_deg, rel=1e-3)
        return
    assert (found.num_columns, found.center_azimuth_deg) == (240, pytest.approx(0.0, abs=0.01))
    assert found.horizontal_fov_deg == pytest.approx(lidar.horizontal_fov_deg, abs=1e-6)


def test_noisy_rows_are_found_but_not_blended_ones():
    lidar = Lidar.model_validate({"name": "a", "model": "velodyne_hdl32e", "columns": 400})
    points_m = simulate_room_scan(lidar, 0, 0.0)

    def shake_rows(by_deg):
        angles = np.random.default_rng(1).normal(scale=np.deg2rad(by_deg), size=len(points_m))
        flat_m = np.hypot(points_m[:, 0], points_m[:, 1])
        return points_m + np.c_[0 * flat_m, 0 * flat_m, angles * flat_m]

    found = estimate_scan([shake_rows(0.15)])
    spacing_deg = 1.33
    np.testing.assert_allclose(found.elevations_deg, lidar.compute_elevations_deg(), atol=spacing_deg / 10)
    assert estimate_scan([shake_rows(0.8)]) is None
    assert estimate_scan([points_m[:1]]) is None
    assert estimate_scan([]) is None


class Turning(Drive):
    """LiDAR in a street with walls, on a car at 20 m/s in a bend; its points are motion compensated."""

    lidar = Lidar.model_validate({"name": "a", "model": "velodyne_vlp16", "columns": 300})
    sensors, rigs = ("roof",), {"one": ("roof",)}
    mount = build_transform(convert_euler_to_rotation(0.0, 2.0, 0.0), [0.5, 0.0, 1.7])

    def __init__(self, sense=-1, begin_deg=120.0, before=0.3, *, told=(), moved=True):
        super().__init__(steps=3)
        self.turn, self.told_of, self.moved = (sense, begin_deg, before), told, moved

    def pose(self, time_s):
        place_m = np.stack([20.0 * time_s, 1.75 * time_s**2, 0.0 * time_s], axis=-1)
        return build_transform(convert_euler_to_rotation(10.0 * time_s, 0.0 * time_s, 0.0 * time_s), place_m)

    def get_world_T_vehicle(self, index):
        return self.pose(np.array([0.1 * index]))[0]

    def read_scan(self, sensor, index):
        sense, begin_deg, before = self.turn
        directions = self.lidar.compute_directions().reshape(3, -1)
        azimuth_deg = np.rad2deg(np.arctan2(directions[1], directions[0]))
        offsets_s = 0.1 * (np.mod(sense * (azimuth_deg - begin_deg), 360.0) / 360.0 - before)
        world_T_cast = self.pose(0.1 * index + offsets_s) @ self.mount
        world = np.einsum("nij,jn->in", world_T_cast[:, :3, :3], directions)
        start = world_T_cast[:, :3, 3]
        # Walls 9 m to the left and right of the street, the ground, and a bridge.
        walls = np.stack([(np.sign(world[k]) * far - start[:, k]) / world[k] for k, far in ((0, 60.0), (1, 9.0))])
        level = np.where(world[2] < 0, -start[:, 2], 12.0 - start[:, 2]) / world[2]
        range_m = np.minimum(walls.min(axis=0), level)
        seen_m = start + range_m[:, None] * world.T
        local_T_world = invert(world_T_cast if not self.moved else self.pose(np.array([0.1 * index])) @ self.mount)
        points_m = np.einsum(
            "nij,nj->ni", np.broadcast_to(local_T_world, world_T_cast.shape), np.c_[seen_m, np.ones(len(seen_m))]
        )[:, :3]
        told = {"rings": np.repeat(np.arange(16), 300), "offsets_s": offsets_s}
        return Scan(points_m, self.mount, "roof", **{name: told[name] for name in self.told_of})


@pytest.mark.parametrize(
    ("drive", "said"),
    [
        (Turning(told=("rings", "offsets_s")), "each ray at its own time"),
        (Turning(told=("offsets_s",)), "each ray at its own time"),
        (Turning(), "motion undone .rotates clockwise from"),
        (Turning(1, -70.0, 1.0), "motion undone .rotates counterclockwise from"),
        (Turning(moved=False), "farthest return[.]$"),
        (Turning(told=("rings",)), "motion undone .rotates clockwise from"),
    ],
)
def test_rows_of_a_moving_vehicle_are_recovered(drive, said):
    rig = build_rig_document(drive)
    (lidar,) = Rig.model_validate(rig).sensors
    assert re.search(said, rig["description"])
    assert (
        "min_range_m" not in rig["sensors"][0]
    )  # a minimum range from the nearest return would exclude nearer objects
    true_deg = drive.lidar.compute_elevations_deg()
    assert len(lidar.compute_elevations_deg()) == len(true_deg)
    np.testing.assert_allclose(lidar.compute_elevations_deg(), np.sort(true_deg)[::-1], atol=0.05)
    np.testing.assert_allclose(lidar.mount.to_matrix(), drive.mount, atol=1e-5)


def test_motion_is_not_undone_for_distant_frames():
    drive = Turning(told=("rings",))
    drive.times_s = 100.0 * drive.times_s
    said = build_rig_document(drive)["description"]
    assert "motion within a revolution not undone, frames are 10 s apart (at most 0.25 s are needed" in said
    drive.told_of = ("rings", "offsets_s")
    with pytest.raises(ValueError, match=r"the poses before and after .* are 10 s apart; .* over at most 1 s"):
        build_rig_document(drive)


def test_clouds_stored_by_laser_need_no_separable_rows():
    # The upper half of the lasers is 0.1 m above the others: elevations of different lasers overlap.
    lidar = Lidar.model_validate({"name": "a", "model": "velodyne_hdl64e", "columns": 400})
    points_m = simulate_room_scan(lidar, 0, 0.0)
    laser = np.repeat(np.arange(64), 400)
    points_m[:, 2] += np.where(laser < 32, 0.2, 0.1)
    turned = np.mod(np.arctan2(points_m[:, 1], points_m[:, 0]), 2 * np.pi)
    order = np.lexsort((turned, laser))
    assert np.array_equal(infer_laser_indices(points_m[order]), laser[order])
    assert infer_laser_indices(np.random.default_rng(0).permutation(points_m)) is None
    found = estimate_scan([points_m[order]], [infer_laser_indices(points_m[order])])
    np.testing.assert_allclose(found.elevations_deg, np.sort(lidar.compute_elevations_deg())[::-1], atol=0.03)
    assert found.origin_height_m == pytest.approx(0.15, abs=0.02)


def test_field_of_view_and_range_are_estimated():
    lidar = Lidar(name="a", channels=4, vertical_fov_deg=(-9, 0), columns=40, horizontal_fov_deg=80, max_range_m=99)
    turned = build_transform(convert_euler_to_rotation(170.0, 0.0, 0.0), np.zeros(3))
    points_m = transform_points(turned, simulate_room_scan(lidar, 0, 0.0))
    found = estimate_scan([points_m])
    assert (found.num_columns, found.horizontal_fov_deg) == (40, pytest.approx(80.0))
    assert found.center_azimuth_deg == pytest.approx(170.0)
    ranges_m = np.linalg.norm(points_m, axis=1)
    assert found.max_range_m == ranges_m.max()


def write_nuscenes_with_camera(drive, root):
    path = layouts.nuscenes_tables(drive, root)
    K = [[1266.0, 0.0, 816.0], [0.0, 1250.0, 491.0], [0.0, 0.0, 1.0]]
    camera = {"token": "cam", "sensor_token": "s", "camera_intrinsic": K, "rotation": [0.5, -0.5, 0.5, -0.5]}
    tables = {
        name: json.loads((path / "v1.0-mini" / f"{name}.json").read_text())
        for name in ("calibrated_sensor", "sample_data")
    }
    tables["calibrated_sensor"].append({**camera, "translation": [1.7, 0.1, 1.5]})
    tables["sensor"] = [{"token": "s", "channel": "CAM_FRONT"}]
    for row in tables["sample_data"]:
        if "CAM_FRONT" in row["filename"]:
            row.update(calibrated_sensor_token="cam", width=1600, height=900)
    for row in tables["calibrated_sensor"]:
        row.setdefault("sensor_token", "l")
    for name, rows in tables.items():
        (path / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))

    def pixels(points_m):
        # In the ego frame; the camera looks along x.
        x, y, z = (transform_points(invert(nuscenes.vehicle_T_ego), points_m) - [1.7, 0.1, 1.5]).T
        return np.stack([816.0 - 1266.0 * y / x, 491.0 - 1250.0 * z / x], axis=1)

    return path, "CAM_FRONT", (1600, 900), pixels


def write_argoverse2_with_camera(drive, root):
    import pyarrow as pa
    from pyarrow import feather

    path = layouts.argoverse2_log(drive, root)
    (path / "calibration").mkdir()
    ego_T_camera = build_transform(convert_euler_to_rotation(40.0, 3.0, 2.0), [1.5, 0.2, 1.4]) @ MOUNT_T_CAMERA
    wxyz = bags.convert_rotation_to_quaternion(ego_T_camera[:3, :3])
    turned = dict(zip(("qw", "qx", "qy", "qz"), map(float, wxyz), strict=True))
    places = dict(zip(("tx_m", "ty_m", "tz_m"), map(float, ego_T_camera[:3, 3]), strict=True))
    lidars = [
        {"sensor_name": f"{one}_lidar", **layouts.posed(build_transform(np.eye(3), [1.35, 0.0, z]))}
        for one, z in (("up", 1.64), ("down", 1.53))
    ]
    rows = [{"sensor_name": "ring_front_left", **turned, **places}, *lidars]
    lens = {"fx_px": 1687.0, "fy_px": 1680.0, "cx_px": 1031.0, "cy_px": 768.0, "k1": -0.28, "k2": -0.04, "k3": 0.1}
    sizes = {"height_px": 1550, "width_px": 2048}
    feather.write_feather(pa.Table.from_pylist(rows), str(path / "calibration" / "egovehicle_SE3_sensor.feather"))
    feather.write_feather(
        pa.Table.from_pylist([{"sensor_name": "ring_front_left", **lens, **sizes}]),
        str(path / "calibration" / "intrinsics.feather"),
    )

    def pixels(points_m, raw=False):
        x, y, z = transform_points(invert(argoverse2.vehicle_T_ego @ ego_T_camera), points_m).T
        x, y = x / z, y / z
        r2 = raw * (x * x + y * y)
        radial = 1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * lens["k3"]))
        return np.stack([1031.0 + 1687.0 * x * radial, 768.0 + 1680.0 * y * radial], axis=1)

    return path, "ring_front_left", (2048, 1550), pixels


P2 = np.array([[721.5, 0.0, 609.5, 44.8], [0.0, 721.5, 172.8, 0.2], [0.0, 0.0, 1.0, 0.003]])
camera0_T_velodyne = np.vstack(
    [
        np.c_[convert_euler_to_rotation(0.2, -0.5, 0.4) @ MOUNT_T_CAMERA[:3, :3].T, [-0.01, -0.07, -0.29]],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
R0 = convert_euler_to_rotation(0.3, 0.4, -0.5)


K2 = np.array([[959.7, 0.0, 696.0], [0.0, 956.9, 224.2], [0.0, 0.0, 1.0]])
D2 = [-0.37, 0.19, 1.1e-3, 1.8e-3, -0.06]
camera2_T_camera0 = build_transform(convert_euler_to_rotation(0.3, 0.2, -0.4), [0.06, 0.0, 0.004])


def project_by_kitti(points_m, raw=False):
    """Compute pixels of the left color camera by the formula of the development kit, or of OpenCV for raw images."""
    velodyne_m = transform_points(invert(kitti.vehicle_T_velodyne), points_m)
    if raw:
        x, y, z = transform_points(camera2_T_camera0 @ camera0_T_velodyne, velodyne_m).T
        x, y = x / z, y / z
        k1, k2, p1, p2, k3 = D2
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([696.0 + 959.7 * bent_x, 224.2 + 956.9 * bent_y], axis=1)
    rectified = np.c_[transform_points(camera0_T_velodyne, velodyne_m) @ R0.T, np.ones(len(points_m))]
    seen = rectified @ P2.T
    return seen[:, :2] / seen[:, 2:]


def format_numbers(array):
    return " ".join(repr(float(number)) for number in np.ravel(array))


def write_kitti_raw_with_cameras(drive, root):
    path = layouts.kitti_raw(drive, root)
    velodyne = f"R: {format_numbers(camera0_T_velodyne[:3, :3])}\nT: {format_numbers(camera0_T_velodyne[:3, 3])}\n"
    (path.parent / "calib_velo_to_cam.txt").write_text(velodyne)
    lines = ["calib_time: 09-Jan-2012 13:57:47", f"R_rect_00: {format_numbers(R0)}"]
    for name in ("00", "01", "02", "03"):
        lines += [
            f"S_rect_{name}: 1242 375",
            f"P_rect_{name}: {format_numbers(P2)}",
            f"S_{name}: 1392 512",
            f"K_{name}: {format_numbers(K2)}",
            f"D_{name}: {format_numbers(D2)}",
            f"R_{name}: {format_numbers(camera2_T_camera0[:3, :3])}",
            f"T_{name}: {format_numbers(camera2_T_camera0[:3, 3])}",
            f"R_rect_{name.replace('00', '9')}: {format_numbers(R0)}",
        ]
    (path.parent / "calib_cam_to_cam.txt").write_text("\n".join(lines))
    return path, "image_02", (1242, 375), project_by_kitti


def write_kitti_object_with_camera(drive, root):
    for folder in ("velodyne", "calib", "image_2"):
        (root / folder).mkdir()
    (root / "velodyne" / "000001.bin").write_bytes(layouts.records(np.eye(3), 4))
    rows = {**{f"P{number}": P2 for number in range(4)}, "R0_rect": R0, "Tr_velo_to_cam": camera0_T_velodyne[:3]}
    (root / "calib" / "000001.txt").write_text("".join(f"{key}: {format_numbers(row)}\n" for key, row in rows.items()))
    size = (1224).to_bytes(4, "big") + (370).to_bytes(4, "big")
    (root / "image_2" / "000001.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + size)
    return root, "P2", (1224, 370), project_by_kitti


CAMERAS = {
    "nuscenes": write_nuscenes_with_camera,
    "argoverse2": write_argoverse2_with_camera,
    "kitti_raw": write_kitti_raw_with_cameras,
    "kitti_object": write_kitti_object_with_camera,
}


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("layout", CAMERAS)
def test_cameras_project_points_like_their_data_set(layout, raw, tmp_path):
    """Released images are undistorted or rectified; raw images have the distortion of the lenses."""
    path, name, size, pixels = CAMERAS[layout](Drive(steps=3), tmp_path)
    recording = open_recording(path, RecordingSettings(format=layout))
    models = dict.fromkeys(recording.sensors, "velodyne_vlp16")
    if raw and layout in ("nuscenes", "kitti_object"):
        with pytest.raises(ValueError, match="leave out --raw-images"):
            build_rig_document(recording, lidar_models=models, raw_images=True)
        return
    rig = Rig.model_validate(build_rig_document(recording, lidar_models=models, raw_images=raw))
    sensor = next(one for one in rig.sensors if one.name == name)
    assert (sensor.width, sensor.height) == ((1392, 512) if raw and layout == "kitti_raw" else size)
    ahead_m = (
        sensor.mount.to_matrix()
        @ np.c_[np.random.default_rng(0).uniform([5, -2, -1], [30, 2, 1], (50, 3)), np.ones(50)].T
    )
    vehicle_m = ahead_m[:3].T
    in_camera_m = transform_points(invert(sensor.mount.to_matrix() @ MOUNT_T_CAMERA), vehicle_m)
    found, shown = sensor.build_camera().project(torch.from_numpy(in_camera_m))
    assert shown.sum() > 30
    np.testing.assert_allclose(
        found[shown].numpy(), pixels(vehicle_m, **{"raw": True} if raw else {})[shown.numpy()], atol=0.01
    )  # mounts have 6 decimals
    assert name in rig.description
    assert "as calibrated" in rig.description


def test_lidar_extrinsics_come_from_calibrations(tmp_path):
    path, *_ = write_argoverse2_with_camera(Drive(steps=2), tmp_path)
    rig = build_rig_document(
        open_recording(path), sensor_names=["down_lidar"], lidar_models={"down_lidar": "velodyne_vlp32c"}
    )
    lidar = rig["sensors"][0]
    assert lidar["mount"] == {"x_m": 0.011, "y_m": 0.0, "z_m": 1.83, "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}
    assert lidar["model"] == "velodyne_vlp32c"
    drive = Drive(steps=3)
    rig = build_rig_document(
        open_recording(bags.ros(drive, tmp_path)), lidar_models=dict.fromkeys(drive.sensors, "velodyne_vlp16")
    )
    for lidar in Rig.model_validate(rig).sensors:
        np.testing.assert_allclose(lidar.mount.to_matrix(), drive.vehicle_T_sensor(lidar.name), atol=1e-5)
    assert "transforms to base_link" in rig["description"]


def test_recordings_without_usable_sensors_are_refused(tmp_path):
    drive = Drive(steps=2)
    with pytest.raises(ValueError, match="no LiDAR roof, other; the recording has left, right"):
        build_rig_document(drive, sensor_names=["roof", "left"], lidar_models={"other": "velodyne_vlp16"})
    with pytest.raises(ValueError, match=r"points of left do not lie in rows .* --lidar left=MODEL"):
        build_rig_document(drive)
    with pytest.raises(FileNotFoundError, match=r"neither a .yaml file nor one of the built-in lidars"):
        build_rig_document(drive, lidar_models={"left": "velodyne"})
    (tmp_path / "sensor").mkdir()
    (tmp_path / "sensor" / "a.xyz").write_text("1 2 3\n")
    with pytest.raises(ValueError, match="the extrinsics of sensor are unknown"):
        build_rig_document(open_recording(tmp_path), lidar_models={"sensor": "velodyne_vlp16"})
    with pytest.raises(FileNotFoundError, match=r"egovehicle_SE3_sensor.feather: no such file"):
        build_rig_document(open_recording(layouts.argoverse2_log(drive, tmp_path / "av2")))


@pytest.mark.parametrize(
    ("line", "instead", "told"),
    [
        (
            "S_rect_01: 1242 375",
            "S_rect_01: 1242",
            "12 numbers of P_rect_01 and 2 of S_rect_01 are needed; got 12 and 1",
        ),
        ("P_rect_03", "P_rect_04", "12 numbers of P_rect_03"),
        ("P_rect_02: 721.5", "P_rect_02: 0.0", "P_rect_02 has no focal length"),
        ("R_rect_00", "R_rect_07", "R_rect_00 with 12 numbers"),
    ],
)
def test_invalid_kitti_calibrations_are_refused(tmp_path, line, instead, told):
    path, *_ = write_kitti_raw_with_cameras(Drive(steps=2), tmp_path)
    file = path.parent / "calib_cam_to_cam.txt"
    assert line in file.read_text()
    file.write_text(file.read_text().replace(line, instead))
    with pytest.raises(ValueError, match=told) as error:
        build_rig_document(open_recording(path), lidar_models={"velodyne": "velodyne_hdl64e"})
    assert str(file) in str(error.value)
    file.unlink()
    rig = build_rig_document(open_recording(path), lidar_models={"velodyne": "velodyne_hdl64e"})
    assert [sensor["name"] for sensor in rig["sensors"]] == ["velodyne"]
    assert "no cameras without calib_cam_to_cam.txt" in rig["description"]


def test_invalid_cameras_of_recordings_are_refused(tmp_path):
    from pyarrow import feather

    path, *_ = write_argoverse2_with_camera(Drive(steps=2), tmp_path)
    table = path / "calibration" / "egovehicle_SE3_sensor.feather"
    feather.write_feather(feather.read_table(table).slice(0, 2), str(table))
    with pytest.raises(BadFileError, match=r"egovehicle_SE3_sensor.feather has no down_lidar"):
        build_rig_document(open_recording(path))
    (tmp_path / "object").mkdir()
    path, *_ = write_kitti_object_with_camera(None, tmp_path / "object")
    (path / "image_2" / "000001.png").write_bytes(b"JFIF")
    with pytest.raises(BadFileError, match=r"000001.png: not a PNG image"):
        build_rig_document(open_recording(path))
