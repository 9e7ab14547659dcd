"""The points of a message `sensor_msgs/msg/PointCloud2`."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.recordings.clouds.arrays import Points
from torchcover.recordings.recording import NO_RETURN_M

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
