"""Bags of ROS 1 and 2: which messages there are and when, single ones of them, and clouds made of these."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import naming, parse_yaml, read_short_text, reads
from torchcover.recordings.clouds.arrays import Points
from torchcover.recordings.isolated_readers import (
    METADATA,
    ROS1_SUFFIX,
    find_ros1_files,
    name_remedy,
    read_bag_index,
    read_bag_messages,
    read_header_stamps,
)
from torchcover.recordings.recording import NO_RETURN_M

# Of so many messages the stamps are read, if those were recorded equally late to this time, and so regularly.
SAMPLED = 65
STEADY_NS = 2_000_000
IRREGULAR = 0.5
SUFFIXES = {"sqlite3": ".db3", "mcap": ".mcap"}
# What the standard definitions of ROS 1 lack, and what it was called before.
TREE = "tf2_msgs/msg/TFMessage"
RENAMED = {"tf/msg/tfMessage": TREE}


class Bag:
    """A folder with `metadata.yaml` and `.db3` or `.mcap` files or with `.bag` files of ROS 1, or one such file.

    Needs `torchcover[ros]`. Opening reads the index only. Messages are read as what the standard definitions say of
    their types; those that are in the bag, of which code would be made, are left aside.

    FileNotFoundError: a file is missing. BadFileError: what is no bag, or a part of one; files that are compressed as a
    whole or have no index. ImportError: rosbags is not installed.
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
        elif not files:
            check_suffix(path)
        within = [file for suffix in SUFFIXES.values() for file in path.glob(f"*{suffix}")] if path.is_dir() else [path]
        for file in files or within:
            check_storage(file)
        with naming(path, "a bag"):
            index = read_bag_index(path)
        topics, types = index["topics"].tolist(), index["types"].tolist()
        times_ns = np.split(index["times_ns"], np.cumsum(index["counts"]))
        self.types = {topic: RENAMED.get(name, name) for topic, name in zip(topics, types, strict=True)}
        self._times_ns: dict[str, NDArray[np.int64]] = dict(zip(topics, times_ns, strict=False))

    def times_ns(self, topic: str) -> NDArray[np.int64]:
        """(M,) when the messages of a topic were recorded, ascending."""
        return self._times_ns.get(topic, np.empty(0, np.int64))

    def stamps_ns(self, topic: str) -> NDArray[np.int64]:
        """(M,) when the messages of a topic were made, by their headers, in the order of their recording.

        In a long bag a sample is read; if all of it was recorded equally late, to `STEADY_NS`, so was the rest.
        """
        times_ns = self.times_ns(topic)
        count, steps_ns = len(times_ns), np.diff(times_ns)
        if count > SAMPLED:
            sample_ns = times_ns[np.unique(np.linspace(0, count - 1, SAMPLED).astype(int))]
            late_ns = sample_ns - self._read_stamps(topic, sample_ns)
            is_regular = (np.abs(steps_ns - np.median(steps_ns)) < IRREGULAR * np.median(steps_ns)).all()
            if is_regular and np.ptp(late_ns) <= STEADY_NS:
                return np.asarray(times_ns - np.int64(np.median(late_ns)))
        return self._read_stamps(topic, None)

    def _read_stamps(self, topic: str, times_ns: NDArray[np.int64] | None) -> NDArray[np.int64]:
        with naming(self.path, f"a bag, in {topic}"):
            wanted = None if times_ns is None else times_ns.tolist()
            stamps_ns = read_header_stamps(self.path, topic, wanted)["stamps_ns"]
            recorded = len(self.times_ns(topic) if times_ns is None else times_ns)
            if len(stamps_ns) != recorded:
                raise ValueError(
                    f"{recorded} messages are in the index, {len(stamps_ns)} are there; {name_remedy(self.path)}"
                )
            return np.asarray(stamps_ns)

    def topics(self, *types: str) -> list[str]:
        """Topics of these types that have messages, by name."""
        return sorted(topic for topic, kind in self.types.items() if kind in types and len(self.times_ns(topic)))

    def messages(self, topic: str, start_ns: int | None = None, stop_ns: int | None = None) -> list[Any]:
        """The messages of a topic that were recorded from a time on, until before another."""
        with naming(self.path, f"a bag, in {topic}"), np.errstate(all="ignore"):
            data, ends, types = read_bag_messages(self.path, topic, start_ns, stop_ns).values()
            deserialize = _deserializer(is_ros1=self._is_ros1)
            starts = [0, *ends.tolist()]
            return [
                deserialize(data[start:end].data, RENAMED.get(name, name))
                for start, end, name in zip(starts, ends.tolist(), types.tolist(), strict=False)
            ]

    def message(self, topic: str, time_ns: int) -> Any:  # noqa: ANN401  (of a type that rosbags has made)
        """The message of a topic that was recorded at a time."""
        found = self.messages(topic, time_ns, time_ns + 1)
        if not found:
            with naming(self.path, "a bag"):
                raise ValueError(f"{topic}: the message at {time_ns} is in the index only; {name_remedy(self.path)}")
        return found[0]


@cache
def _deserializer(*, is_ros1: bool) -> Callable[[memoryview, str], Any]:
    """Return the function that makes a message of its bytes and the name of its standard type."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # installed, or no bag would have been read

    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TREE))
    deserialize: Callable[[memoryview, str], Any] = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    return deserialize


@reads("a bag")
def check_suffix(path: Path) -> None:
    """Whether a file is called as bags are."""
    if path.suffix not in SUFFIXES.values():
        suffixes = ", ".join((*SUFFIXES.values(), ROS1_SUFFIX))
        raise ValueError(f"a folder with {METADATA}, or a file of {suffixes} is needed")


@reads("a bag")
def check_storage(path: Path) -> None:
    """Refuse a file of a bag that is no regular one, or a database that SQLite would not read by its name alone.

    A database may have changes in a file beside it, where its recorder was killed or still runs.
    """
    if path.suffix == SUFFIXES["sqlite3"] and not set("%?#").isdisjoint(str(path.absolute())):
        raise ValueError("SQLite takes %, ? and # in a path for parts of an address; rename the file, or its folder")
    for ending in ("-wal", "-journal"):
        journal = path.with_name(path.name + ending)
        if journal.exists() and journal.stat().st_size:
            raise ValueError(
                f"some of its messages are in {journal.name} only, since its recorder did not end: copy the files "
                f"beside each other to where you may write, and run `sqlite3 {path.name} 'PRAGMA quick_check'`"
            )


@reads("the metadata of a bag")
def check_metadata(path: Path) -> None:
    """Whether the files that `metadata.yaml` names can be read one message at a time.

    FileNotFoundError: one is missing. BadFileError: other content, files elsewhere, files that are compressed as a
    whole.
    """
    content = parse_yaml(read_short_text(path))
    told = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    names = told.get("relative_file_paths") if isinstance(told, dict) else None
    if not isinstance(told, dict) or not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("rosbag2_bagfile_information with relative_file_paths is needed")
    suffix = SUFFIXES.get(str(told.get("storage_identifier")))
    if str(told.get("compression_mode", "")).lower() == "file" or suffix is None:
        raise ValueError(
            f"files of {' or '.join(SUFFIXES)} that are not compressed as a whole are needed; got "
            f"{told.get('storage_identifier')!r}, compression {told.get('compression_mode')!r}: use `ros2 bag convert`"
        )
    for name in names:
        if Path(name).name != name or Path(name).suffix != suffix:
            raise ValueError(f"names of {suffix} files beside it are needed; got {name!r}")
        if not (path.parent / name).exists():
            raise FileNotFoundError(f"{path.parent / name}: no such file; {path} names it")


# The data types of fields, by their numbers.
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Names that drivers give the time of a point, since the time of the message or since 1970, and the number of its laser.
TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset")
ROW_FIELDS = ("ring", "channel", "laser_number", "laser_id", "line")
# Units of these times: nanoseconds in each. A turn is the share of the scan period from 0 to 1.
UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
TURN = "turn"
# Settings for the times of points: a unit, or to leave them aside.
POINT_TIMES = (*UNITS_NS, TURN, "none")


@dataclass(frozen=True)
class PointTimeParams:
    """How the unit of times of points is recognized.

    Args:
        min_share: Points of one scan are measured over at least this share of the scan period; a scanner that looks at
            a sector, or a recording of every other scan, has less, which is reported.
        max_share: Points of one scan are measured over at most this share of the scan period.
        least_share: Below this share of the scan period no unit is plausible.
        usual_period_s: Scan period where a recording has one scan: that of most LiDARs.
        longest_s: Times of points are at most this far from the stamp of their message; no LiDAR takes longer.
        absolute_ns: Larger times count from 1970.
    """

    min_share: float = 0.4
    max_share: float = 1.5
    least_share: float = 0.02
    usual_period_s: float = 0.1
    longest_s: float = 1.0
    absolute_ns: float = 1e15


PARAMS = PointTimeParams()


class PointTimes(NamedTuple):
    """How the times of the points of a sensor are stored: a unit of `POINT_TIMES`, and the period of its scans."""

    unit: str
    period_s: float


class CloudMessage(NamedTuple):
    """A cloud: (N, 3) points in the frame of the sensor, also those that are not finite, and (N,) the laser of each.

    `stamp_ns` is the time of the message, 0 if its sender gave none, `offsets_s` (N,) when each was measured since
    then.
    """

    points_m: Points
    stamp_ns: int
    offsets_s: NDArray[np.float64] | None
    rows: NDArray[np.integer] | None


def cloud_of(message: Any, times: PointTimes) -> CloudMessage:  # noqa: ANN401  (of a type that rosbags has made)
    """Read the fields x, y, z, and the time of each point if there is one.

    Args:
        message: A `sensor_msgs/msg/PointCloud2`.
        times: As `choose_point_times` chose them for its sensor.

    Raises:
        ValueError: A cloud that contradicts itself, or times far from its stamp.
    """
    fields = {field.name: field for field in message.fields}
    time_field = _time_field(message) if times.unit != "none" else None
    wanted = [fields[axis] for axis in "xyz" if axis in fields]
    if len(wanted) < 3 or any(field.datatype not in (7, 8) for field in wanted):
        told = ", ".join(f"{field.name} ({TYPES.get(field.datatype, field.datatype)})" for field in message.fields)
        raise ValueError(f"fields x, y, z of float32 or float64 are needed; got {told or 'none'}")
    ring = next((fields[name] for name in ROW_FIELDS if name in fields), None)
    table = _table(message, [*wanted, *(field for field in (time_field, ring) if field is not None)])
    rows = table[ring.name].astype(np.int64) if ring is not None and ring.datatype < 7 else None
    points_m: Points = np.stack([table[axis] for axis in "xyz"], axis=1)
    if points_m.dtype.byteorder == ">":
        points_m = points_m.astype(points_m.dtype.newbyteorder("="))
    stamp_ns = stamp_of(message.header)
    if time_field is None:
        return CloudMessage(points_m, stamp_ns, None, rows)
    offsets_s = _checked(_offsets_s(table[time_field.name], stamp_ns, times), points_m, time_field.name)
    return CloudMessage(points_m, stamp_ns, offsets_s, rows)


def choose_point_times(message: Any, period_s: float | None) -> tuple[PointTimes | None, str]:  # noqa: ANN401
    """Choose the unit of the times of points by the time that one scan takes.

    By convention whole numbers are nanoseconds and others seconds; another unit is chosen if with it, and not with
    that one, the points of a scan are measured over about the scan period.

    Args:
        message: A scan.
        period_s: The time from one scan to the next; None if there is one.

    Returns:
        The choice, None if no unit fits, and a sentence about it if it is not the convention, or not certain.

    Raises:
        ValueError: A cloud that contradicts itself.
    """
    field, period_s = _time_field(message), period_s or PARAMS.usual_period_s
    if field is None:
        return PointTimes("none", period_s), ""
    axes = {axis.name: axis for axis in message.fields if axis.name in ("x", "y", "z")}
    table = _table(message, [field, *axes.values()])
    points_m = np.stack([table[axis] for axis in "xyz" if axis in axes], axis=1)
    measured = np.isfinite(points_m).all(axis=1) & (np.abs(points_m) > NO_RETURN_M).any(axis=1)
    stored, stamp_ns = table[field.name][measured & np.isfinite(table[field.name])], stamp_of(message.header)
    usual = "ns" if stored.dtype.kind in "iu" or np.abs(stored).max(initial=0) > PARAMS.absolute_ns else "s"
    units = [usual, *(unit for unit in UNITS_NS if unit != usual), *([TURN] if stored.dtype.kind == "f" else [])]
    shares = {}
    for unit in units:
        offsets_s = _offsets_s(stored, stamp_ns, PointTimes(unit, period_s))
        is_near = bool((np.abs(offsets_s) <= PARAMS.longest_s).all())
        shares[unit] = float(np.ptp(offsets_s)) / period_s if len(offsets_s) and is_near else np.inf * len(offsets_s)
    if shares[usual] == 0 or np.isnan(shares[usual]):  # no point, or all at one time
        return PointTimes(usual, period_s), ""
    fitting = [unit for unit in units if PARAMS.min_share <= shares[unit] <= PARAMS.max_share]
    span = f"the times of points in {field.name!r} ({TYPES[field.datatype]}) span {float(np.ptp(stored)):g}"
    if fitting:
        words = "shares of the scan period" if fitting[0] == TURN else fitting[0]
        note = f"{span} where scans are {period_s:.3g} s apart: they are read as {words}" if fitting[0] != usual else ""
        return PointTimes(fitting[0], period_s), note
    if PARAMS.least_share <= shares[usual] < PARAMS.min_share:
        note = f"{span} {usual}, {shares[usual]:.0%} of the {period_s:.3g} s between scans; they are read as {usual}"
        return PointTimes(usual, period_s), note
    return None, (
        f"{span} where scans are {period_s:.3g} s apart, or are far from the stamp of the cloud: no unit of "
        f"{', '.join(UNITS_NS)} and no share of a turn fits; choose one by --set "
        f"recording.point_times=UNIT ({', '.join(POINT_TIMES)})"
    )


def _time_field(message: Any) -> Any:  # noqa: ANN401
    fields = {field.name: field for field in message.fields}
    return next((fields[name] for name in TIME_FIELDS if name in fields), None)


def stamp_of(header: Any) -> int:  # noqa: ANN401
    """The time of a message in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _table(message: Any, fields: list[Any]) -> NDArray[Any]:  # noqa: ANN401
    """(N,) the points with these fields, without what lies between points and rows."""
    width, height, step, row = (int(getattr(message, name)) for name in ("width", "height", "point_step", "row_step"))
    data = np.asarray(message.data)
    if len(data) == width * height * step:  # without gaps; some senders leave row_step 0, or stale
        row = width * step
    if row * height != len(data) or width * step > row:
        raise ValueError(
            f"{height} rows of {row} bytes ({width} points of {step}) do not fit the {len(data)} bytes of the cloud"
        )
    types = [(">" if message.is_bigendian else "<") + TYPES.get(field.datatype, "V1") for field in fields]
    ends = [field.offset + np.dtype(kind).itemsize for field, kind in zip(fields, types, strict=True)]
    if max(ends) > step or any("V" in kind for kind in types):
        raise ValueError(f"fields within the {step} bytes of a point are needed; one ends at byte {max(ends)}")
    layout = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": types,
            "offsets": [int(field.offset) for field in fields],
            "itemsize": step,
        }
    )
    grid = np.ndarray((height, width), layout, data, strides=(row, step))
    return grid.reshape(-1)


def _offsets_s(stored: NDArray[Any], stamp_ns: int, times: PointTimes) -> NDArray[np.float64]:
    """(N,) seconds after the stamp."""
    if times.unit == TURN:
        return stored.astype(np.float64) * times.period_s
    unit_ns = UNITS_NS[times.unit]
    is_absolute = float(np.abs(stored[np.isfinite(stored)]).max(initial=0)) * unit_ns > PARAMS.absolute_ns
    # The whole units first: a float64 of both together would be off by 0.2 us.
    whole, rest_ns = divmod(stamp_ns, unit_ns) if is_absolute else (0, 0)
    since = stored.astype(np.int64) - whole if stored.dtype.kind in "iu" else stored.astype(np.float64) - whole
    return np.asarray(since * (unit_ns * 1e-9) - rest_ns * 1e-9, dtype=np.float64)


def _checked(offsets_s: NDArray[np.float64], points_m: Points, name: str) -> NDArray[np.float64]:
    of_points = offsets_s[np.isfinite(points_m).all(axis=1)]
    is_near = np.abs(of_points) <= PARAMS.longest_s
    if not is_near.all():
        raise ValueError(
            f"{name}: times of points within {PARAMS.longest_s:g} s of the cloud are needed; got "
            f"{of_points[np.argmin(is_near)]:g} s"
        )
    return np.nan_to_num(offsets_s, nan=0.0, posinf=0.0, neginf=0.0).clip(-PARAMS.longest_s, PARAMS.longest_s)
