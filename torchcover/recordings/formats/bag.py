"""Bags of ROS 1 and 2: index of messages, single messages and their point clouds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import guard_reader, parse_yaml, read_short_text, report_bad_file
from torchcover.geometry.arrays import Float64, Int64
from torchcover.recordings.clouds.arrays import Points
from torchcover.recordings.isolated_readers import (
    METADATA,
    ROS1_SUFFIX,
    find_repair_command,
    find_ros1_files,
    read_bag_index,
    read_bag_messages,
    read_header_stamps,
)
from torchcover.recordings.recording import NO_RETURN_M

# Storage of ROS 2 bags and the suffix of its files.
SUFFIXES = {"sqlite3": ".db3", "mcap": ".mcap"}
# Message type of transforms between frames.
TF_TYPE = "tf2_msgs/msg/TFMessage"
# Former names of message types.
RENAMED_TYPES = {"tf/msg/tfMessage": TF_TYPE}


@dataclass(frozen=True)
class StampParams:
    """Parameters that decide whether the stamps of a long bag follow from a sample.

    Args:
        num_samples: Number of messages whose stamps are read.
        max_delay_change_ns: Largest difference between delays of logging for which the delay counts as constant.
        max_irregularity: Intervals between log times differ from their median by less than this share.
    """

    num_samples: int = 65
    max_delay_change_ns: int = 2_000_000
    max_irregularity: float = 0.5


class Bag:
    """ROS bag: folder with `metadata.yaml` and `.db3` or `.mcap` files, folder with `.bag` files, or one such file.

    Needs `torchcover[ros]`. Only the index is read at first. Messages are parsed by the standard definitions of their
    types; definitions in the bag are ignored, because code would be generated from them.

    Args:
        path: Folder or file.

    Raises:
        FileNotFoundError: A file is missing.
        BadFileError: The path is no bag, or an incomplete one, has no index, or is compressed as a whole.
        ImportError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        files = find_ros1_files(path)
        self._is_ros1 = bool(files)
        if not files and path.is_dir():
            if not (path / METADATA).exists():
                raise FileNotFoundError(
                    f"{path / METADATA}: no such file; `ros2 bag reindex {path}` writes it, or name one file of the bag"
                )
            check_metadata(path / METADATA)
            files = [*path.glob("*.db3"), *path.glob("*.mcap")]
        elif not files:
            check_suffix(path)
            files = [path]
        for file in files:
            check_storage(file)
        with report_bad_file(path, "a bag"):
            index = read_bag_index(path)
        topics, types = index["topics"].tolist(), index["types"].tolist()
        times_ns = np.split(index["times_ns"], np.cumsum(index["counts"]))
        self.type_by_topic = {topic: RENAMED_TYPES.get(name, name) for topic, name in zip(topics, types, strict=True)}
        self._times_ns: dict[str, Int64] = dict(zip(topics, times_ns, strict=False))

    def get_log_times_ns(self, topic: str) -> Int64:
        """Return the (M,) ascending log times of the messages of a topic; empty for an unknown topic."""
        return self._times_ns.get(topic, np.empty(0, np.int64))

    def read_stamps_ns(self, topic: str, params: StampParams = StampParams()) -> Int64:
        """Read the header stamps of the messages of a topic, ordered by log time.

        If a sample of a long bag shows a constant delay between stamps and regular log times, the delay gives the other
        stamps.

        Args:
            topic: Topic whose messages have a header.
            params: Size of the sample and limits of its variation.

        Returns:
            (M,) stamps.

        Raises:
            BadFileError: The bag is damaged.
        """
        times_ns = self.get_log_times_ns(topic)
        if len(times_ns) > params.num_samples:
            rows = np.unique(np.linspace(0, len(times_ns) - 1, params.num_samples).astype(int))
            delays_ns = times_ns[rows] - self._read_stamps(topic, times_ns[rows])
            intervals_ns = np.diff(times_ns)
            median_ns = np.median(intervals_ns)
            is_regular = (np.abs(intervals_ns - median_ns) < params.max_irregularity * median_ns).all()
            if is_regular and np.ptp(delays_ns) <= params.max_delay_change_ns:
                return np.asarray(times_ns - np.int64(np.median(delays_ns)))
        return self._read_stamps(topic, None)

    def _read_stamps(self, topic: str, times_ns: Int64 | None) -> Int64:
        """Read the stamps of messages with some log times (None: all) and check their number."""
        with report_bad_file(self.path, f"a bag, in {topic}"):
            requested_ns = None if times_ns is None else times_ns.tolist()
            stamps_ns = read_header_stamps(self.path, topic, requested_ns)["stamps_ns"]
            expected = len(self.get_log_times_ns(topic) if times_ns is None else times_ns)
            if len(stamps_ns) != expected:
                repair = find_repair_command(self.path)
                raise ValueError(f"{expected} messages are in the index, {len(stamps_ns)} are there; {repair}")
            return np.asarray(stamps_ns)

    def list_topics(self, *types: str) -> list[str]:
        """List the topics of some types that have messages, by name.

        Args:
            types: Message types, such as `sensor_msgs/msg/PointCloud2`.
        """
        topics = []
        for topic, type_name in sorted(self.type_by_topic.items()):
            if type_name in types and len(self.get_log_times_ns(topic)):
                topics.append(topic)
        return topics

    def read_messages(self, topic: str, start_ns: int | None = None, stop_ns: int | None = None) -> list[Any]:
        """Read the messages of a topic with a log time in [start_ns, stop_ns).

        Args:
            topic: Topic of the messages.
            start_ns: First log time; None for the beginning.
            stop_ns: Log time after the last one; None for the end.

        Returns:
            Messages of rosbags, ordered by log time.

        Raises:
            BadFileError: The bag is damaged.
        """
        with report_bad_file(self.path, f"a bag, in {topic}"), np.errstate(all="ignore"):
            data, ends, types = read_bag_messages(self.path, topic, start_ns, stop_ns).values()
            deserialize = _get_deserializer(is_ros1=self._is_ros1)
            messages, start = [], 0
            for end, type_name in zip(ends.tolist(), types.tolist(), strict=True):
                messages.append(deserialize(data[start:end].data, RENAMED_TYPES.get(type_name, type_name)))
                start = end
            return messages

    def read_message(self, topic: str, time_ns: int) -> Any:  # noqa: ANN401  (of a type that rosbags creates)
        """Read the message of a topic with a log time.

        Args:
            topic: Topic of the message.
            time_ns: Its log time.

        Returns:
            Message of rosbags.

        Raises:
            BadFileError: The bag is damaged, or has no such message.
        """
        messages = self.read_messages(topic, time_ns, time_ns + 1)
        if not messages:
            with report_bad_file(self.path, "a bag"):
                raise ValueError(
                    f"{topic}: the message at {time_ns} is in the index only; {find_repair_command(self.path)}"
                )
        return messages[0]


@cache
def _get_deserializer(*, is_ros1: bool) -> Callable[[memoryview, str], Any]:
    """Get the function that deserializes bytes of a standard type."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # installed, since a bag was read

    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        # The standard definitions of ROS 1 lack this type.
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPE))
    deserialize: Callable[[memoryview, str], Any] = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    return deserialize


@guard_reader("a bag")
def check_suffix(path: Path) -> None:
    """Check that a file has the suffix of a bag.

    Args:
        path: File.

    Raises:
        BadFileError: The suffix is another one.
    """
    if path.suffix not in SUFFIXES.values():
        suffixes = ", ".join((*SUFFIXES.values(), ROS1_SUFFIX))
        raise ValueError(f"a folder with {METADATA}, or a file of {suffixes} is needed")


@guard_reader("a bag")
def check_storage(path: Path) -> None:
    """Check that a file of a bag is a regular file that SQLite can read alone.

    A database has changes in a separate journal if its recorder was killed or is still running.

    Args:
        path: File of a bag.

    Raises:
        BadFileError: SQLite would misread the path, or part of the messages is in a journal.
    """
    if path.suffix == SUFFIXES["sqlite3"] and not set("%?#").isdisjoint(str(path.absolute())):
        raise ValueError("SQLite takes %, ? and # in a path for parts of an address; rename the file, or its folder")
    for ending in ("-wal", "-journal"):
        journal = path.with_name(path.name + ending)
        if journal.exists() and journal.stat().st_size:
            raise ValueError(
                f"some of its messages are in {journal.name} only, since its recorder did not end: copy both "
                f"files to a folder where you may write, and run `sqlite3 {path.name} 'PRAGMA quick_check'`"
            )


@guard_reader("the metadata of a bag")
def check_metadata(path: Path) -> None:
    """Check that the files named in `metadata.yaml` exist and can be read message by message.

    Args:
        path: `metadata.yaml` of a ROS 2 bag.

    Raises:
        FileNotFoundError: A file is missing.
        BadFileError: The content is invalid, files are in other folders, or files are compressed as a whole.
    """
    content = parse_yaml(read_short_text(path))
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    names = information.get("relative_file_paths") if isinstance(information, dict) else None
    has_names = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not isinstance(information, dict) or not isinstance(names, list) or not has_names:
        raise ValueError("rosbag2_bagfile_information with relative_file_paths is needed")
    storage, compression = information.get("storage_identifier"), information.get("compression_mode")
    suffix = SUFFIXES.get(str(storage))
    if str(information.get("compression_mode", "")).lower() == "file" or suffix is None:
        raise ValueError(
            f"files of {' or '.join(SUFFIXES)} that are not compressed as a whole are needed; got "
            f"{storage!r}, compression {compression!r}: use `ros2 bag convert`"
        )
    for name in names:
        if Path(name).name != name or Path(name).suffix != suffix:
            raise ValueError(f"names of {suffix} files in its folder are needed; got {name!r}")
        if not (path.parent / name).exists():
            raise FileNotFoundError(f"{path.parent / name}: no such file; {path} names it")


# Data types of `sensor_msgs/msg/PointField` by number.
FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Nanoseconds in each unit of point times.
UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
# Point times that are shares of the scan period, from 0 to 1.
SCAN_SHARE = "scan_share"
POINT_TIME_UNITS = (*UNITS_NS, SCAN_SHARE, "none")


@dataclass(frozen=True)
class PointTimeParams:
    """Parameters that decide on the unit of point times.

    Args:
        min_period_share: Points of one scan cover at least this share of the scan period; a sector scanner, or a
            recording of every other scan, covers less, which is reported.
        max_period_share: Points of one scan cover at most this share of the scan period.
        min_plausible_period_share: No unit is plausible below this share of the scan period.
        default_period_s: Scan period of most LiDARs, for recordings with one scan.
        max_offset_s: Largest difference between a point time and the stamp of its message; no LiDAR takes longer.
        min_absolute_ns: Larger times count from 1970.
    """

    min_period_share: float = 0.4
    max_period_share: float = 1.5
    min_plausible_period_share: float = 0.02
    default_period_s: float = 0.1
    max_offset_s: float = 1.0
    min_absolute_ns: float = 1e15


POINT_TIME_PARAMS = PointTimeParams()


class PointTimes(NamedTuple):
    """Storage of the point times of a sensor.

    Args:
        unit: One of `POINT_TIME_UNITS`.
        period_s: Scan period.
    """

    unit: str
    period_s: float


class CloudMessage(NamedTuple):
    """Cloud of a message.

    Args:
        points_m: (N, 3) points in the sensor frame, including points that are not finite.
        stamp_ns: Stamp of the message; 0 if its sender gave none.
        offsets_s: (N,) measurement time of each point minus the stamp; None if unknown.
        rings: (N,) channel of each point; None if unknown.
    """

    points_m: Points
    stamp_ns: int
    offsets_s: Float64 | None
    rings: NDArray[np.integer] | None


def parse_cloud(
    message: Any,  # noqa: ANN401  (of a type that rosbags creates)
    point_times: PointTimes,
) -> CloudMessage:
    """Parse coordinates, point times and rings of a cloud.

    Args:
        message: `sensor_msgs/msg/PointCloud2`.
        point_times: Result of `choose_point_times` for its sensor.

    Returns:
        The cloud.

    Raises:
        ValueError: The cloud is inconsistent, or point times are far from its stamp.
    """
    time_field = _find_time_field(message) if point_times.unit != "none" else None
    axes = _find_axes(message)
    if len(axes) < 3 or any(field.datatype not in (7, 8) for field in axes):
        names = [f"{field.name} ({FIELD_TYPES.get(field.datatype, field.datatype)})" for field in message.fields]
        raise ValueError(f"fields x, y, z of float32 or float64 are needed; got {', '.join(names) or 'none'}")
    ring_field = _find_field(message, ("ring", "channel", "laser_number", "laser_id", "line"))
    optional_fields = [field for field in (time_field, ring_field) if field is not None]
    table = _read_fields(message, [*axes, *optional_fields])
    has_rings = ring_field is not None and ring_field.datatype < 7
    rings = table[ring_field.name].astype(np.int64) if has_rings else None
    points_m: Points = np.column_stack((table["x"], table["y"], table["z"]))
    if points_m.dtype.byteorder == ">":
        points_m = points_m.astype(points_m.dtype.newbyteorder("="))
    stamp_ns = get_stamp_ns(message.header)
    if time_field is None:
        return CloudMessage(points_m, stamp_ns, None, rings)
    offsets_s = _compute_offsets_s(table[time_field.name], stamp_ns, point_times)
    limit_s = POINT_TIME_PARAMS.max_offset_s
    finite_s = offsets_s[np.isfinite(points_m).all(axis=1)]
    is_near = np.abs(finite_s) <= limit_s
    if not is_near.all():
        raise ValueError(
            f"{time_field.name}: point times within {limit_s:g} s of the cloud are needed; got "
            f"{finite_s[np.argmin(is_near)]:g} s"
        )
    # Other points get times within the limits.
    offsets_s = np.nan_to_num(offsets_s, nan=0.0, posinf=0.0, neginf=0.0).clip(-limit_s, limit_s)
    return CloudMessage(points_m, stamp_ns, offsets_s, rings)


def choose_point_times(message: Any, period_s: float | None) -> tuple[PointTimes | None, str]:  # noqa: ANN401
    """Choose the unit of point times by the scan period.

    By convention integers are nanoseconds and other numbers seconds. Another unit is chosen if only with that unit the
    points of a scan cover about one scan period.

    Args:
        message: Scan of the sensor.
        period_s: Scan period; None if the recording has one scan.

    Returns:
        The choice, None if no unit fits, and a note if the choice is not the convention or uncertain.

    Raises:
        ValueError: The cloud is inconsistent.
    """
    params = POINT_TIME_PARAMS
    field, period_s = _find_time_field(message), period_s or params.default_period_s
    if field is None:
        return PointTimes("none", period_s), ""
    axes = _find_axes(message)
    table = _read_fields(message, [field, *axes])
    points_m = np.stack([table[axis.name] for axis in axes], axis=1)
    is_measured = np.isfinite(points_m).all(axis=1) & (np.abs(points_m) > NO_RETURN_M).any(axis=1)
    stored, stamp_ns = table[field.name][is_measured & np.isfinite(table[field.name])], get_stamp_ns(message.header)
    is_integer = stored.dtype.kind in "iu"
    default = "ns" if is_integer or np.abs(stored).max(initial=0) > params.min_absolute_ns else "s"
    units = list(dict.fromkeys([default, *UNITS_NS]))
    if stored.dtype.kind == "f":
        units.append(SCAN_SHARE)
    shares = {}
    for unit in units:
        offsets_s = _compute_offsets_s(stored, stamp_ns, PointTimes(unit, period_s))
        is_near = bool((np.abs(offsets_s) <= params.max_offset_s).all())
        shares[unit] = float(np.ptp(offsets_s)) / period_s if len(offsets_s) and is_near else np.inf * len(offsets_s)
    if shares[default] == 0 or np.isnan(shares[default]):  # no points, or all at one time
        return PointTimes(default, period_s), ""
    fitting = [unit for unit in units if params.min_period_share <= shares[unit] <= params.max_period_share]
    span = f"the point times in {field.name!r} ({FIELD_TYPES[field.datatype]}) span {float(np.ptp(stored)):g}"
    if fitting:
        unit_name = "shares of the scan period" if fitting[0] == SCAN_SHARE else fitting[0]
        note = f"{span} where scans are {period_s:.3g} s apart: they are read as {unit_name}"
        return PointTimes(fitting[0], period_s), note if fitting[0] != default else ""
    if params.min_plausible_period_share <= shares[default] < params.min_period_share:
        share = f"{shares[default]:.0%} of the {period_s:.3g} s between scans"
        return PointTimes(default, period_s), f"{span} {default}, {share}; they are read as {default}"
    return None, (
        f"{span} where scans are {period_s:.3g} s apart, or are far from the stamp of the cloud: no unit of "
        f"{', '.join(UNITS_NS)} and no share of the scan period fits; choose one by --set "
        f"recording.point_time_unit=UNIT ({', '.join(POINT_TIME_UNITS)})"
    )


def _find_field(message: Any, names: Sequence[str]) -> Any:  # noqa: ANN401
    """Find the first of some fields that a cloud has; None if it has none of them."""
    fields = {field.name: field for field in message.fields}
    return next((fields[name] for name in names if name in fields), None)


def _find_axes(message: Any) -> list[Any]:  # noqa: ANN401
    """Find the fields x, y and z that a cloud has."""
    fields = {field.name: field for field in message.fields}
    return [fields[axis] for axis in "xyz" if axis in fields]


def _find_time_field(message: Any) -> Any:  # noqa: ANN401
    """Find the field of point times under the names that drivers use."""
    return _find_field(message, ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset"))


def get_stamp_ns(header: Any) -> int:  # noqa: ANN401
    """Get the stamp of a `std_msgs/Header` in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _read_fields(message: Any, fields: list[Any]) -> NDArray[Any]:  # noqa: ANN401
    """Read the (N,) points with some fields, without padding between points and rows."""
    width, height = int(message.width), int(message.height)
    point_bytes, row_bytes = int(message.point_step), int(message.row_step)
    data = np.asarray(message.data)
    if len(data) == width * height * point_bytes:  # without padding some senders leave row_step 0 or outdated
        row_bytes = width * point_bytes
    if row_bytes * height != len(data) or width * point_bytes > row_bytes:
        raise ValueError(
            f"{height} rows of {row_bytes} bytes ({width} points of {point_bytes}) do not fit the {len(data)} bytes of "
            "the cloud"
        )
    byte_order = ">" if message.is_bigendian else "<"
    names, types, offsets, end = [], [], [], 0
    for field in fields:
        type_code = byte_order + FIELD_TYPES.get(field.datatype, "V1")
        names.append(field.name)
        types.append(type_code)
        offsets.append(int(field.offset))
        end = max(end, offsets[-1] + np.dtype(type_code).itemsize)
    if end > point_bytes or "V" in "".join(types):
        raise ValueError(f"fields within the {point_bytes} bytes of a point are needed; one ends at byte {end}")
    layout = np.dtype({"names": names, "formats": types, "offsets": offsets, "itemsize": point_bytes})
    grid = np.ndarray((height, width), layout, data, strides=(row_bytes, point_bytes))
    return grid.reshape(-1)


def _compute_offsets_s(stored: NDArray[Any], stamp_ns: int, point_times: PointTimes) -> Float64:
    """Compute the (N,) seconds between the stamp and the stored point times."""
    if point_times.unit == SCAN_SHARE:
        return stored.astype(np.float64) * point_times.period_s
    unit_ns = UNITS_NS[point_times.unit]
    is_absolute = (
        float(np.abs(stored[np.isfinite(stored)]).max(initial=0)) * unit_ns > POINT_TIME_PARAMS.min_absolute_ns
    )
    # Integer units are subtracted first, since float64 rounds nanoseconds since 1970 to 0.2 us.
    stamp_units, remainder_ns = divmod(stamp_ns, unit_ns) if is_absolute else (0, 0)
    number_type = np.int64 if stored.dtype.kind in "iu" else np.float64
    units_since_stamp = stored.astype(number_type) - stamp_units
    return np.asarray(units_since_stamp * (unit_ns * 1e-9) - remainder_ns * 1e-9, dtype=np.float64)
