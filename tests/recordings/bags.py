"""Bags of ROS 1 and 2, written with rosbags."""

from dataclasses import fields, is_dataclass

import numpy as np
from rosbags import rosbag1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from torchcover.geometry import build_transform, convert_euler_to_rotation, convert_rotation_to_quaternion, invert

TYPES, TYPES_OF_1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
TYPES_OF_1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
T0_NS = 1_700_000_000_000_000_000
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def made(name, *values):
    return TYPES.types[name](*values)


def header(time_ns, frame):
    seconds, nanoseconds = divmod(int(time_ns), 1_000_000_000)
    return made("std_msgs/msg/Header", made("builtin_interfaces/msg/Time", seconds, nanoseconds), frame)


def cloud(columns, time_ns, frame, *, height=1, gap=0, end=0, order="<"):
    """A cloud of arrays by name, with bytes between the fields and at the end of each row."""
    names, arrays = list(columns), [np.asarray(column) for column in columns.values()]
    formats = [np.dtype(array.dtype).newbyteorder(order) for array in arrays]
    offsets = np.cumsum([gap, *(kind.itemsize + gap for kind in formats)])
    layout = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets[:-1].tolist(), "itemsize": int(offsets[-1])}
    )
    table = np.zeros(len(arrays[0]), layout)
    for name, array in zip(names, arrays, strict=True):
        table[name] = array
    width = len(table) // height
    rows = [table[k * width : (k + 1) * width].tobytes() + bytes(end) for k in range(height)]
    fields = [
        made("sensor_msgs/msg/PointField", name, int(offset), CODES[array.dtype.str[1:]], 1)
        for name, offset, array in zip(names, offsets, arrays, strict=False)
    ]
    data = np.frombuffer(b"".join(rows), np.uint8)
    step = layout.itemsize
    return made(
        "sensor_msgs/msg/PointCloud2",
        *(header(time_ns, frame), height, width, fields, order == ">", step, step * width + end, data, False),
    )


def points(points_m, **others):
    """The columns of a cloud."""
    return {axis: np.asarray(points_m)[:, k].astype(np.float32) for k, axis in enumerate("xyz")} | others


def place(matrix, kind):
    """Position and orientation, as a `Transform` or a `Pose`."""
    w, x, y, z = map(float, convert_rotation_to_quaternion(matrix[:3, :3]))
    name = "Vector3" if kind == "Transform" else "Point"
    return made(
        f"geometry_msgs/msg/{kind}",
        made(f"geometry_msgs/msg/{name}", *map(float, matrix[:3, 3])),
        made("geometry_msgs/msg/Quaternion", x, y, z, w),
    )


def link(parent, child, matrix, time_ns=0):
    return made("geometry_msgs/msg/TransformStamped", header(time_ns, parent), child, place(matrix, "Transform"))


def tree(*links):
    return made("tf2_msgs/msg/TFMessage", list(links))


def odometry(matrix, time_ns, child="base_link"):
    zero = made("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    twist = made("geometry_msgs/msg/TwistWithCovariance", made("geometry_msgs/msg/Twist", zero, zero), np.zeros(36))
    pose = made("geometry_msgs/msg/PoseWithCovariance", place(matrix, "Pose"), np.zeros(36))
    return made("nav_msgs/msg/Odometry", header(time_ns, "odom"), child, pose, twist)


def posed(matrix, time_ns):
    return made("geometry_msgs/msg/PoseStamped", header(time_ns, "map"), place(matrix, "Pose"))


def bag(path, messages, storage="mcap", compression=None):
    """Write (topic, time of recording, message) in this order; `compression` is "MESSAGE" or "STORAGE"."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression is not None:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, time_ns, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(connections[topic], int(time_ns), TYPES.serialize_cdr(message, kind))
    return path


def bag1(path, messages, compression=None):
    """The same as a file of ROS 1; `compression` is "BZ2" or "LZ4"."""
    writer = rosbag1.Writer(path)
    if compression is not None:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        connections = {}
        for topic, time_ns, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES_OF_1)
            writer.write(connections[topic], int(time_ns), TYPES_OF_1.serialize_ros1(as_ros1(message), kind))
    return path


def as_ros1(message):
    if isinstance(message, list):
        return [as_ros1(one) for one in message]
    if not is_dataclass(message):
        return message
    values = {field.name: as_ros1(getattr(message, field.name)) for field in fields(message)}
    kind = message.__msgtype__
    return TYPES_OF_1.types[kind](**values, **({"seq": 0} if kind.endswith("/Header") else {}))


# A sensor stands on a mast, which is turned, on the roof.
roof_T_mast = build_transform(convert_euler_to_rotation(30.0, 0.0, 0.0), [0.1, 0.0, 0.4])
vehicle_T_roof = build_transform(np.eye(3), [0.0, 0.0, 1.4])


def mounts(drive):
    """Static transforms of a drive: `left` is connected through two frames, `right` directly to the vehicle."""
    mast_T_left = invert(vehicle_T_roof @ roof_T_mast) @ drive.vehicle_T_sensor("left")
    return [
        link("base_link", "roof", vehicle_T_roof),
        link("mast", "left", mast_T_left),
        link("roof", "mast", roof_T_mast),
        link("base_link", "right", drive.vehicle_T_sensor("right")),
    ]


def of_drive(drive, poses=odometry, topic="/poses"):
    """The messages of a drive; they are recorded 20 ms after their stamps, the two sensors' at different times."""
    messages = [("/tf_static", T0_NS, tree(*mounts(drive)))]
    for index in range(drive.steps):
        time_ns = T0_NS + round(1e9 * drive.times_s[index])
        messages.append((topic, time_ns + 1_000_000, poses(drive.get_world_T_vehicle(index), time_ns)))
        for number, sensor in enumerate(drive.sensors):
            message = cloud(points(drive.read_scan(sensor, index).points_m), time_ns, sensor)
            messages.append((f"/{sensor}", time_ns + 20_000_000 + number, message))
    return messages


def ros(drive, root):
    return bag(root / "drive", of_drive(drive))


def in_map(pose, time_ns):
    return tree(link("map", "base_link", pose, time_ns))


def ros_database(drive, root):
    return bag(root / "drive", of_drive(drive, in_map, "/tf"), "sqlite3")


def ros1(drive, root):
    return bag1(root / "drive.bag", of_drive(drive))
