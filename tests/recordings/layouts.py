"""Writers of drives in the layouts of the data sets."""

import csv
import json
import math

import numpy as np

from tests.recordings.bags import ros, ros1, ros_database
from torchcover.geometry import (
    build_transform,
    convert_euler_to_rotation,
    convert_rotation_to_euler,
    invert,
    transform_points,
)
from torchcover.recordings.formats import argoverse2, kitti, nuscenes

T0_NS = 1_532_402_927_600_000_000
LATITUDE_DEG, LONGITUDE_DEG, ALTITUDE_M = 49.01, 8.43, 115.0
velodyne_T_imu = build_transform(convert_euler_to_rotation(0.1, -0.2, 0.3), [-0.81, 0.32, -0.8])


def seen(drive, index):
    """Points of both sensors in the vehicle frame, `left` first."""
    scans = [drive.read_scan(sensor, index) for sensor in drive.sensors]
    return [transform_points(scan.vehicle_T_sensor, scan.points_m) for scan in scans]


def quaternion(matrix):
    """Compute the quaternion w, x, y, z of a rotation about z."""
    yaw = math.atan2(matrix[1, 0], matrix[0, 0])
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def records(points_m, columns):
    rows = np.full((len(points_m), columns), 0.5, dtype="<f4")
    rows[:, :3] = points_m
    return rows.tobytes()


def kitti_raw(drive, root):
    day = root / "2011_09_26"
    path = day / "2011_09_26_drive_0001_sync"
    for folder in ("velodyne_points/data", "oxts/data"):
        (path / folder).mkdir(parents=True)
    numbers = {"R": velodyne_T_imu[:3, :3].ravel(), "T": velodyne_T_imu[:3, 3]}
    lines = [
        "calib_time: 15-Mar-2012 11:37:16",
        *(f"{key}: {' '.join(map(repr, map(float, row)))}" for key, row in numbers.items()),
    ]
    (day / "calib_imu_to_velo.txt").write_text("\n".join(lines))
    times = [np.datetime64(T0_NS + round(1e9 * time_s), "ns") for time_s in drive.times_s]
    (path / "velodyne_points" / "timestamps.txt").write_text("".join(f"{str(t).replace('T', ' ')}\n" for t in times))
    vehicle_T_velodyne = kitti.vehicle_T_velodyne
    radius_m = kitti.EARTH_RADIUS_M
    first_m = None
    for index, name in enumerate(f"{k:010d}" for k in range(drive.steps)):
        points_m = transform_points(invert(vehicle_T_velodyne), np.concatenate(seen(drive, index)))
        (path / "velodyne_points" / "data" / f"{name}.bin").write_bytes(records(points_m, 4))
        pose = drive.get_world_T_vehicle(index) @ vehicle_T_velodyne @ velodyne_T_imu
        first_m = pose[:3, 3] if first_m is None else first_m
        # Inverse of the Mercator projection; the first record is at the given latitude.
        scale = math.cos(math.radians(LATITUDE_DEG))
        north = math.log(math.tan(math.pi / 4 + math.radians(LATITUDE_DEG) / 2))
        east_m, north_m, up_m = pose[:3, 3] - first_m
        latitude = 2 * math.degrees(math.atan(math.exp(north + north_m / (scale * radius_m)))) - 90
        longitude = LONGITUDE_DEG + math.degrees(east_m / (scale * radius_m))
        yaw, pitch, roll = np.deg2rad(convert_rotation_to_euler(pose[:3, :3]))
        row = [latitude, longitude, ALTITUDE_M + up_m, roll, pitch, yaw, *[0.0] * 24]
        (path / "oxts" / "data" / f"{name}.txt").write_text(" ".join(map(repr, map(float, row))))
    (path / "tracklet_labels.xml").write_text(tracklets(drive))
    return path


def tracklets(drive):
    velodyne_T_vehicle = invert(kitti.vehicle_T_velodyne)
    poses = []
    for index in range(drive.steps):
        row = drive.read_boxes(index).rows[0].double().numpy()
        x, y, z = transform_points(velodyne_T_vehicle, row[None, :3])[0] - [0.0, 0.0, row[5] / 2]
        poses.append(f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z}</tz><rx>0</rx><ry>0</ry><rz>{row[6]}</rz></item>")
    length, width, height = drive.read_boxes(0).size_m[0].tolist()
    return f"""<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9"><tracklets class_id="0"><count>1</count>
<item><objectType>Car</objectType><h>{height}</h><w>{width}</w><l>{length}</l><first_frame>0</first_frame>
<poses><count>{drive.steps}</count><item_version>2</item_version>{"".join(poses)}</poses></item>
</tracklets></boost_serialization>"""


def nuscenes_tables(drive, root):
    """Every second sweep is a key frame."""
    mount = build_transform(convert_euler_to_rotation(-90.0, 0.0, 0.0), [0.94, 0.0, 1.84])
    tables = {
        name: [] for name in ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sample_annotation")
    }
    tables["instance"] = [{"token": "i", "category_token": "c"}]
    tables["category"] = [{"token": "c", "name": "vehicle.car"}]
    tables["scene"] = [{"token": "s", "name": "scene-0001"}]
    tables["calibrated_sensor"] = [{"token": "m", "rotation": quaternion(mount), "translation": mount[:3, 3].tolist()}]
    for index in range(drive.steps):
        key, time_us = index % 2 == 0, T0_NS // 1000 + round(1e6 * drive.times_s[index])
        world_T_ego = drive.get_world_T_vehicle(index) @ nuscenes.vehicle_T_ego
        name = f"{'samples' if key else 'sweeps'}/LIDAR_TOP/n015__LIDAR_TOP__{time_us}.pcd.bin"
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        points_m = np.concatenate(seen(drive, index))
        (root / name).write_bytes(records(transform_points(invert(nuscenes.vehicle_T_ego @ mount), points_m), 5))
        tables["ego_pose"].append(
            {"token": f"p{index}", "rotation": quaternion(world_T_ego), "translation": world_T_ego[:3, 3].tolist()}
        )
        row = {
            "token": f"d{index}",
            "sample_token": f"k{index // 2}",
            "ego_pose_token": f"p{index}",
            "timestamp": time_us,
        }
        tables["sample_data"].append({**row, "calibrated_sensor_token": "m", "is_key_frame": key, "filename": name})
        tables["sample_data"].append(
            {**row, "token": f"x{index}", "filename": "samples/CAM_FRONT/a.jpg", "is_key_frame": key}
        )
        if key:
            car = drive.world_T_car(index)
            tables["sample"].append({"token": f"k{index // 2}", "scene_token": "s", "timestamp": time_us})
            seen_there = {"sample_token": f"k{index // 2}", "instance_token": "i", "size": [2.0, 4.0, 1.5]}
            pose = {"rotation": quaternion(car), "translation": car[:3, 3].tolist()}
            level = {"visibility_token": str(index % 4 + 1)}
            tables["sample_annotation"].append({"token": f"a{index}", **seen_there, **pose, **level})
    (root / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return root


def argoverse2_log(drive, root):
    import pyarrow as pa
    from pyarrow import feather

    sweeps = root / "sensors" / "lidar"
    sweeps.mkdir(parents=True)
    poses, cuboids = [], []
    for index in range(drive.steps):
        time_ns = T0_NS + round(1e9 * drive.times_s[index])
        clouds = [transform_points(invert(argoverse2.vehicle_T_ego), cloud) for cloud in seen(drive, index)]
        points_m, laser = np.concatenate(clouds), np.repeat([3, 40], [len(cloud) for cloud in clouds]).astype(np.uint8)
        columns = {axis: points_m[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
        columns |= {"laser_number": laser, "offset_ns": np.zeros(len(laser), np.int32)}
        feather.write_feather(pa.table(columns), str(sweeps / f"{time_ns}.feather"))
        pose = drive.get_world_T_vehicle(index) @ argoverse2.vehicle_T_ego
        poses.append({"timestamp_ns": time_ns, **posed(pose)})
        car = invert(pose) @ drive.world_T_car(index)
        size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5}
        cuboids.append(
            {"timestamp_ns": time_ns, "track_uuid": "u", "category": "REGULAR_VEHICLE", **size, **posed(car)}
        )
    feather.write_feather(pa.Table.from_pylist(poses[::-1]), str(root / "city_SE3_egovehicle.feather"))
    feather.write_feather(pa.Table.from_pylist(cuboids), str(root / "annotations.feather"))
    return root


def posed(matrix):
    rotation = dict(zip(("qw", "qx", "qy", "qz"), quaternion(matrix), strict=True))
    return {**rotation, **dict(zip(("tx_m", "ty_m", "tz_m"), map(float, matrix[:3, 3]), strict=True))}


HALF_TURN = build_transform(convert_euler_to_rotation(180.0, 0.0, 0.0), [0.0, 0.0, 2.0])
POSE = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
BOX = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")


def pose_row(matrix):
    return [*map(float, matrix[:3, 3]), *quaternion(matrix)]


def table(path, columns, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])


def plain_folder(drive, root):
    """Write a drive as a plain folder, with extrinsics in frames.yaml for one sensor and in a table for the other."""
    for sensor in drive.sensors:
        (root / "sensors" / sensor).mkdir(parents=True)
    poses, mounts = [], []
    for index, name in enumerate(drive.frame_names):
        poses.append([name, drive.times_s[index], *pose_row(drive.get_world_T_vehicle(index))])
        for sensor in drive.sensors:
            scan = drive.read_scan(sensor, index)
            turned = build_transform(convert_euler_to_rotation(40.0 * index, 0.0, 0.0), [index, 0.0, 1.0])
            points_m = transform_points(scan.vehicle_T_sensor, scan.points_m)
            if sensor == "left":
                mounts.append([name, *pose_row(turned)])
                points_m = transform_points(invert(turned), points_m)
            else:
                points_m = transform_points(HALF_TURN, points_m - [0.0, 0.0, 4.0]) * [
                    1,
                    -1,
                    1,
                ]  # its own inverse but for z
            np.save(root / "sensors" / sensor / f"{name}.npy", points_m)
        row = drive.read_boxes(index).rows[0].tolist()
        table(root / "boxes" / f"{name}.csv", (*BOX, "id", "category"), [[*row, "car", "car, red"]])
    table(root / "poses.csv", ("frame", "time_s", *POSE), poses[::-1])
    table(root / "sensors" / "left" / "poses.csv", ("frame", *POSE), mounts)
    (root / "frames.yaml").write_text(
        f"sensors: {{right: {{vehicle_T_sensor: {HALF_TURN.tolist()}, flip_y: true}}}}\n"
        "vehicle: {lower_m: [-2, -1, 0], upper_m: [2, 1, 1.5]}\n"
    )
    return root


CARLA_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
CARLA_BOX = ("id", "category", *CARLA_POSE, "extent_x", "extent_y", "extent_z")


def carla_row(matrix):
    """x, y, z, roll, pitch, yaw of a right-handed pose in CARLA's axes."""
    yaw, pitch, roll = convert_rotation_to_euler(matrix[:3, :3])
    x, y, z = matrix[:3, 3]
    return [float(number) for number in (x, -y, z, roll, -pitch, -yaw)]


def carla_folder(drive, root):
    """Write two ticks per frame; `left` makes half a revolution in each, and the actor origin is off center."""
    vehicle_T_actor = build_transform(np.eye(3), [-0.1, 0.2, 0.0])
    box = {"location": {"x": 0.1, "y": 0.2, "z": 0.75}, "extent": {"x": 2.0, "y": 1.0, "z": 0.75}}
    (root / "vehicle.json").write_text(json.dumps(box))
    listed, poses = [], []
    for sensor in drive.sensors:
        mount = carla_row(invert(vehicle_T_actor) @ drive.vehicle_T_sensor(sensor))
        turns = {"rotation_frequency": "10" if sensor == "left" else "20"}
        listed.append(
            {"id": sensor, "type": LIDAR_OF_CARLA, **dict(zip(CARLA_POSE, mount, strict=True)), **turns, "range": "90"}
        )
        (root / sensor).mkdir()
    (root / "sensors.json").write_text(json.dumps(listed))
    for tick in range(2 * drive.steps):
        instant, name = (tick - 1) / 2, f"{tick + 90}"
        poses.append([name, 0.1 * instant + 7, *carla_row(drive.get_world_T_vehicle(instant) @ vehicle_T_actor)])
        for sensor in drive.sensors:
            points_m = drive.read_scan(sensor, instant).points_m * [1, -1, 1]
            half = points_m[tick % 2 :: 2] if sensor == "left" else points_m
            np.save(root / sensor / f"{name}.npy", np.c_[half, np.ones(len(half))].astype(np.float32))
        row = ["17", "vehicle.car", *carla_row(drive.world_T_car(instant)), 2.0, 1.0, 0.75]
        table(root / "boxes" / f"{name}.csv", CARLA_BOX, [row])
    table(root / "poses.csv", ("frame", "time_s", *CARLA_POSE), poses)
    return root


LIDAR_OF_CARLA = "sensor.lidar.ray_cast"


LAYOUTS = {
    "kitti_raw": kitti_raw,
    "nuscenes": nuscenes_tables,
    "argoverse2": argoverse2_log,
    "carla": carla_folder,
    "folder": plain_folder,
    "ros": ros,
    "ros database": ros_database,
    "ros 1": ros1,
}
