"""Recordings in ROS 1 and 2 bags: clouds of all LiDARs, their extrinsics and the poses of the vehicle."""

import os
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchcover.files import report_bad_file
from torchcover.geometry import invert
from torchcover.geometry.arrays import Int64
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.bag import (
    POINT_TIME_PARAMS,
    POINT_TIME_UNITS,
    SUFFIXES,
    Bag,
    CloudMessage,
    PointTimes,
    choose_point_times,
    parse_cloud,
)
from torchcover.recordings.formats.ros_poses import (
    FrameTree,
    VehiclePoses,
    find_vehicle_poses,
    normalize_frame_id,
    read_static_transforms,
)
from torchcover.recordings.isolated_readers import METADATA, find_ros1_files
from torchcover.recordings.recording import NO_RETURN_M, Recording, Scan, SensorCalibrations, check_times

# Topics of this type are sensors.
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
# base_footprint is on the ground; robots have base_link a wheel radius above it.
VEHICLE_FRAMES = ("base_footprint", "base_link")


@dataclass(frozen=True)
class BagParams:
    """Parameters of the selection and synchronization of scans in a bag.

    Args:
        min_rate_share: Clouds below this share of the rate of the fastest sensor are maps and similar messages.
        max_scan_gap_share: Scans of one frame are at most this share of the scan period from that of the first sensor.
        max_disagreement_m: Poses of one time that are further apart come from two senders.
        max_delay_change_s: Largest variation of the delay between stamps and log times without a warning.
        max_clock_difference_s: Largest difference between the delays of two sensors without a warning.
        stamp_margin_s: Largest error of estimated stamps.
        time_resolution_s: Points within this time are moved together, which costs 0.4 mm at 40 m/s.
    """

    min_rate_share: float = 0.25
    max_scan_gap_share: float = 0.75
    max_disagreement_m: float = 0.05
    max_delay_change_s: float = 0.1
    max_clock_difference_s: float = 0.5
    stamp_margin_s: float = 0.01
    time_resolution_s: float = 1e-5


class RosBag(Recording):
    """Recording in a ROS bag: folder with `metadata.yaml`, folder with `.bag` files, or one file of a bag.

    Sensors are the topics of `PointCloud2`, named without the leading slash, whose frame is fixed to the vehicle frame
    by tf_static or by constant transforms of tf. A frame is a scan of the sensor with the fewest scans and the nearest
    scan of every other sensor. Times are the stamps of clouds unless all of them are 0. Points with a time (a field
    `t`, `time`, `timestamp`, `time_stamp`, `offset_time` or `time_offset`) are motion-compensated to the stamp of the
    frame; clouds without point times are moved as a whole. Scans before the first and after the last pose are excluded.
    Needs `torchcover[ros]`.

    Args:
        path: Folder or file.
        vehicle_frame: Frame of the vehicle (x forward, y left, z up, on the ground). Default: `base_footprint`, else
            `base_link`.
        mounts: Name of a sensor and its (4, 4) `vehicle_T_sensor`, if the bag lacks it or is wrong.
        point_time_unit: Unit of point times: `s`, `ms`, `us`, `ns`, `scan_share` (shares of the scan period), or `none`
            to ignore them. Default: the unit that fits the scan period.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: The bag is damaged, has no clouds or no extrinsics, frames form a loop, or poses are invalid.
        ImportError: rosbags is not installed.

    Warns:
        UserWarning: Reports choices between alternatives, and excluded clouds.
    """

    layout: ClassVar[str] = "metadata.yaml and *.db3 or *.mcap, *.bag, or such a file, with topics of PointCloud2"

    def __init__(
        self,
        path: str | os.PathLike[str],
        vehicle_frame: str | None = None,
        mounts: Mapping[str, Matrix] | None = None,
        point_time_unit: str | None = None,
    ) -> None:
        self.path = Path(path)
        self._params = BagParams()
        if point_time_unit not in (None, *POINT_TIME_UNITS):
            raise ValueError(
                f"point_time_unit: one of {', '.join(POINT_TIME_UNITS)} is needed; got {point_time_unit!r}"
            )
        self.reader_options = {
            "vehicle_frame": vehicle_frame,
            "point_time_unit": point_time_unit,
            "mounts": {name: np.asarray(mount).tolist() for name, mount in (mounts or {}).items()},
        }
        self._bag = Bag(self.path)
        with report_bad_file(self.path, "a bag"):
            frames = self._find_cloud_frames()
            tree = FrameTree(read_static_transforms(self._bag))
            self.vehicle_frame = vehicle_frame or _choose_vehicle_frame({*tree.frames, *frames.values()}, mounts or {})
            self._mounts = self._find_mounts(frames, tree, mounts or {})
            self.sensors = tuple(self._mounts)
            self.rigs = {"ros": self.sensors}
            pose_sources = find_vehicle_poses(self._bag, tree, self.vehicle_frame)
            self._poses = pose_sources[0] if pose_sources else None
            self._frame_stamps_ns: dict[int, int] = {}
            self._pair_scans()
            self._point_times = {sensor: self._choose_point_times(sensor, point_time_unit) for sensor in self.sensors}
            self._exclude_frames_without_pose()
            if vehicle_frame is None and {*VEHICLE_FRAMES} <= tree.frames:
                self._warn(f"{self.vehicle_frame} is used as the vehicle frame, not {VEHICLE_FRAMES[1]}")
            for clash in tree.find_clashes(self.vehicle_frame):
                self._warn(clash)
            if len(pose_sources) > 1:
                unused = ", ".join(poses.source for poses in pose_sources[1:])
                self._warn(f"poses are read from {pose_sources[0].source}, not from {unused}")
            if self._poses is not None and self._poses.max_disagreement_m > self._params.max_disagreement_m:
                self._warn(
                    f"poses of {self._poses.source} jump to and fro by {self._poses.max_disagreement_m:.2g} m: do two "
                    "nodes send them? Record the bag again with one of them"
                )
            first = self.sensors[0]
            self.frame_names = tuple(self._log_times_ns[first].astype(str).tolist())
            times_s = np.asarray((self._stamps_ns[first] - self._stamps_ns[first][0]) * 1e-9)
            self.times_s = check_times(times_s, len(self.frame_names), f"stamps of {first}")

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Test whether a path is a bag.

        Args:
            path: Existing path.
        """
        if find_ros1_files(path):
            return True
        if not path.is_dir():
            return path.suffix in SUFFIXES.values()
        return (path / METADATA).exists() and any([*path.glob("*.db3*"), *path.glob("*.mcap*")])

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud and compensate the motion of the vehicle to the time of the frame if poses are known.

        Args:
            sensor: Name of the sensor.
            index: Index of the frame.

        Returns:
            The scan.
        """
        cloud, stamp_ns = self._read_cloud(sensor, index)
        log_time_ns, mount = int(self._log_times_ns[sensor][index]), self._mounts[sensor]
        source = f"{self.path}: {sensor} at {log_time_ns}"
        if self._poses is None:
            return Scan(cloud.points_m, mount, source, rings=cloud.rings)
        vehicle_T_world = invert(self._interpolate_pose(self._poses, index))
        if cloud.offsets_s is None:
            world_T_vehicle = self._poses.interpolate(np.array([stamp_ns]), log_time_ns)[0]
            return Scan(cloud.points_m, vehicle_T_world @ world_T_vehicle @ mount, source, rings=cloud.rings)
        # Zeros mark missing returns and stay zeros.
        returns = np.flatnonzero((np.abs(cloud.points_m) > NO_RETURN_M).any(axis=1))
        resolution_s = self._params.time_resolution_s
        ticks = np.rint(cloud.offsets_s[returns] / resolution_s).astype(np.int64)
        unique_ticks, tick_indices = np.unique(ticks, return_inverse=True)
        times_ns = stamp_ns + np.rint(unique_ticks * resolution_s * 1e9).astype(np.int64)
        world_T_vehicle = self._poses.interpolate(times_ns, log_time_ns)
        frame_T_point = (invert(mount) @ vehicle_T_world @ world_T_vehicle @ mount)[tick_indices]
        points_m = cloud.points_m.astype(np.float64)
        rotated_m = np.einsum("nij,nj->ni", frame_T_point[:, :3, :3], points_m[returns])
        points_m[returns] = rotated_m + frame_T_point[:, :3, 3]
        offsets_s = cloud.offsets_s + (stamp_ns - self._get_frame_stamp_ns(index)) * 1e-9
        return Scan(points_m, mount, source, rings=cloud.rings, offsets_s=offsets_s)

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Return the (4, 4) pose of the vehicle at the stamp of a frame; None in a bag without poses."""
        return None if self._poses is None else self._interpolate_pose(self._poses, index)

    def read_calibrations(self) -> SensorCalibrations:
        """Read the extrinsics of the sensors."""
        return SensorCalibrations(f"transforms to {self.vehicle_frame}", self._mounts)

    def _find_cloud_frames(self) -> dict[str, str]:
        """Find the topics of frequent clouds with their frames; the topic with the fewest clouds comes first."""
        topics = self._bag.list_topics(CLOUD_TYPE)
        if not topics:
            types = ", ".join(f"{topic} ({type_name})" for topic, type_name in sorted(self._bag.type_by_topic.items()))
            raise ValueError(f"a topic of {CLOUD_TYPE} with messages is needed; there are {types or 'none'}")
        counts = {topic: len(self._bag.get_log_times_ns(topic)) for topic in topics}
        min_count = self._params.min_rate_share * max(counts.values())
        rare = [topic for topic, count in counts.items() if count < min_count]
        if rare:
            self._warn(f"excluded because of few messages: {', '.join(rare)}")
        frames = {}
        for _, topic in sorted((counts[topic], topic) for topic in topics if topic not in rare):
            message = self._bag.read_message(topic, int(self._bag.get_log_times_ns(topic)[0]))
            frames[topic] = normalize_frame_id(message.header.frame_id)
        return frames

    def _find_mounts(
        self, frames: Mapping[str, str], tree: FrameTree, user_mounts: Mapping[str, Matrix]
    ) -> dict[str, Matrix]:
        """Find `vehicle_T_sensor` of each sensor; extrinsics of the user take precedence over the bag."""
        unknown = [name for name in user_mounts if self._get_topic(name) not in frames]
        if unknown:
            known = ", ".join(topic.removeprefix("/") for topic in frames)
            raise ValueError(f"mount of {', '.join(unknown)}: there are clouds of {known}")
        mounts_by_topic = {self._get_topic(name): mount for name, mount in user_mounts.items()}
        for topic, user_mount in mounts_by_topic.items():
            tree.add(self.vehicle_frame, frames[topic], user_mount)
        transforms = tree.find_transforms(self.vehicle_frame)
        mounts: dict[str, Matrix] = {}
        missing = []
        for topic, frame in frames.items():
            mount = mounts_by_topic.get(topic, transforms.get(frame))
            if mount is None:
                missing.append(f"{topic} ({frame})")
            else:
                mounts[topic.removeprefix("/")] = mount
        fault = f"no static transform links to {self.vehicle_frame} the frame of {', '.join(missing)}"
        if not mounts:
            raise ValueError(
                f"{fault}; static ones are of {', '.join(sorted(tree.frames)) or 'no frames'}: name the vehicle's "
                "(--set recording.vehicle_frame=NAME), or give mounts (recording.yaml)"
            )
        if missing:
            self._warn(f"excluded, since {fault}")
        return mounts

    def _pair_scans(self) -> None:
        """Pair each scan of the first sensor with the scan of every other sensor that is nearest by stamp."""
        log_times_ns = {sensor: self._bag.get_log_times_ns(self._get_topic(sensor)) for sensor in self.sensors}
        stamps_ns = {sensor: self._read_stamps(sensor, log_times_ns[sensor]) for sensor in self.sensors}
        first = self.sensors[0]
        first_delay_s = np.median((log_times_ns[first] - stamps_ns[first]) * 1e-9)
        for sensor in self.sensors:
            delays_s = (log_times_ns[sensor] - stamps_ns[sensor]) * 1e-9
            if np.ptp(delays_s) > self._params.max_delay_change_s:
                self._warn(
                    f"scans of {sensor} were recorded {delays_s.min():.3g} to {delays_s.max():.3g} s after their "
                    "stamps, which are used"
                )
            elif abs(np.median(delays_s) - first_delay_s) > self._params.max_clock_difference_s:
                self._warn(
                    f"scans of {first} were recorded {first_delay_s:.3g} s after their stamps, those of {sensor} "
                    f"{np.median(delays_s):.3g} s: are their clocks apart? Scans are paired by their stamps"
                )
        self._log_times_ns, self._stamps_ns = {}, {}
        for sensor in self.sensors:
            order = np.argsort(stamps_ns[sensor], kind="stable")
            rows = order[find_nearest_times(stamps_ns[sensor][order], np.sort(stamps_ns[first]))]
            self._log_times_ns[sensor] = log_times_ns[sensor][rows]
            self._stamps_ns[sensor] = stamps_ns[sensor][rows]

    def _read_stamps(self, sensor: str, log_times_ns: Int64) -> Int64:
        """Read the stamps of a sensor, or use log times if all stamps are 0."""
        stamps_ns = self._bag.read_stamps_ns(self._get_topic(sensor))
        if stamps_ns.any():
            return stamps_ns
        self._warn(f"clouds of {sensor} have no stamps: their log times are used")
        return log_times_ns

    def _choose_point_times(self, sensor: str, point_time_unit: str | None) -> PointTimes:
        """Choose the unit of the point times of a sensor by its middle scan."""
        log_times_ns, stamps_ns = self._log_times_ns[sensor], np.unique(self._stamps_ns[sensor])
        period_s = float(np.median(np.diff(stamps_ns))) * 1e-9 if len(stamps_ns) > 1 else None
        default_period_s = POINT_TIME_PARAMS.default_period_s
        if point_time_unit is not None:
            return PointTimes(point_time_unit, period_s or default_period_s)
        message = self._bag.read_message(self._get_topic(sensor), int(log_times_ns[len(log_times_ns) // 2]))
        try:
            point_times, note = choose_point_times(message, period_s)
        except ValueError:  # the error is raised when this scan is read; others may be valid
            return PointTimes("ns", period_s or default_period_s)
        if point_times is None:
            raise ValueError(f"{sensor}: {note}")
        if note:
            self._warn(f"{sensor}: {note}; choose another by --set recording.point_time_unit=UNIT")
        return point_times

    def _exclude_frames_without_pose(self) -> None:
        """Exclude the frames before the first pose and after the last."""
        if self._poses is None:
            return
        has_pose = self._poses.mask_covered_times(self._stamps_ns[self.sensors[0]], self._params.stamp_margin_s)
        if not has_pose.any():
            raise ValueError(
                f"no scan lies between the first and the last pose of {self._poses.source}; do the clocks match?"
            )
        for sensor in self.sensors:
            self._log_times_ns[sensor] = self._log_times_ns[sensor][has_pose]
            self._stamps_ns[sensor] = self._stamps_ns[sensor][has_pose]

    def _warn(self, message: str) -> None:
        """Warn with the path of the bag before the message."""
        warnings.warn(f"{self.path}: {message}", stacklevel=5)

    def _get_topic(self, sensor: str) -> str:
        """Get the topic of a sensor name, with a leading slash if the bag has one."""
        return sensor if sensor in self._bag.type_by_topic else f"/{sensor}"

    def _interpolate_pose(self, poses: VehiclePoses, index: int) -> Matrix:
        """Interpolate the vehicle pose at the time of a frame."""
        log_time_ns = int(self._log_times_ns[self.sensors[0]][index])
        return np.asarray(poses.interpolate(np.array([self._get_frame_stamp_ns(index)]), log_time_ns)[0])

    def _get_frame_stamp_ns(self, index: int) -> int:
        """Get the time of a frame, which is the stamp of the scan of the first sensor."""
        if index not in self._frame_stamps_ns:
            self._read_cloud(self.sensors[0], index)
        return self._frame_stamps_ns[index]

    def _read_cloud(self, sensor: str, index: int) -> tuple[CloudMessage, int]:
        """Read a cloud and its stamp, or its log time if it has no stamp."""
        log_time_ns, first_ns = int(self._log_times_ns[sensor][index]), self._stamps_ns[self.sensors[0]]
        gap_s = abs(int(self._stamps_ns[sensor][index]) - int(first_ns[index])) * 1e-9
        frame_interval_s = float(np.median(np.diff(first_ns))) * 1e-9 if len(first_ns) > 1 else np.inf
        with report_bad_file(self.path, f"a cloud of {sensor}"):
            if gap_s > self._params.max_scan_gap_share * frame_interval_s:
                raise ValueError(f"the scan of {sensor} nearest to {first_ns[index]} is {gap_s:.3f} s off")
            message = self._bag.read_message(self._get_topic(sensor), log_time_ns)
            cloud = parse_cloud(message, self._point_times[sensor])
        stamp_ns = cloud.stamp_ns or log_time_ns
        if sensor == self.sensors[0]:
            self._frame_stamps_ns[index] = stamp_ns
        return cloud, stamp_ns


def find_nearest_times(times_ns: Int64, query_ns: Int64) -> NDArray[np.intp]:
    """Find the nearest of ascending times.

    Args:
        times_ns: (M,) ascending times.
        query_ns: (N,) times to look up.

    Returns:
        (N,) indices into `times_ns`; the earlier one of two equally near times.

    Example:
        >>> find_nearest_times(np.array([0, 10, 20]), np.array([-5, 4, 6, 99]))
        array([0, 0, 1, 2])
    """
    after = np.searchsorted(times_ns, query_ns).clip(1, max(len(times_ns) - 1, 1)).clip(max=len(times_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(query_ns - times_ns[before] <= times_ns[after] - query_ns, before, after)


def _choose_vehicle_frame(frames: Collection[str], mounts: Collection[str]) -> str:
    """Choose base_footprint, else base_link, which user mounts may also define."""
    for frame in VEHICLE_FRAMES:
        if frame in frames:
            return frame
    if mounts:
        return VEHICLE_FRAMES[1]
    raise ValueError(
        f"the frame {' or '.join(VEHICLE_FRAMES)} of the vehicle is needed; there are {', '.join(sorted(frames))}: "
        "name one (--set recording.vehicle_frame=NAME), or give mounts (recording.yaml)"
    )
