"""Bags of ROS 1 and 2: clouds of all LiDARs, where they are mounted, where the vehicle was."""

import os
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchcover.files import report_bad_file
from torchcover.geometry import invert
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.bag import (
    PARAMS,
    POINT_TIMES,
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
from torchcover.recordings.recording import NO_RETURN_M, RecordingBase, Scan, SensorCalibrations, check_times

CLOUD = "sensor_msgs/msg/PointCloud2"
# The first lies on the ground; robots have the second a wheel's radius above it.
VEHICLE_FRAMES = ("base_footprint", "base_link")
# Clouds that come so much more rarely than those of the fastest sensor are maps and the like.
RAREST = 0.25
# Scans of one instant: none is farther from the first sensor's than this share of the time from one to the next.
FARTHEST_SCAN = 0.75
# Poses of one time that are farther apart are of two senders.
APART_M = 0.05
# Log times and stamps drift apart by latencies that are no longer.
DRIFT_S = 0.1
# Clocks of two sensors are no farther apart.
CLOCKS_S = 0.5
# Stamps that were estimated are off by less.
STAMP_MARGIN_S = 0.01
# Points of so short a time are moved together: 0.4 mm at 40 m/s.
TICK_S = 1e-5


class RosBag(RecordingBase):
    """A bag: a folder with `metadata.yaml` and `.db3` or `.mcap` files, or with `.bag` files; or one such file.

    The sensors are the topics of `PointCloud2`, named without the first slash, whose frame is mounted on the vehicle's,
    by tf_static or by transforms of tf that never change; an instant is a scan of the one that has fewest, with the
    nearest of each other. Times are the stamps of the clouds, unless all are 0. Points with a time of their own (a
    field `t`, `time`, `timestamp`, `time_stamp`, `offset_time` or `time_offset`) are taken as measured and moved to the
    stamp of their instant; those without as one, too. Scans beyond the first and last pose are left out. Needs
    `torchcover[ros]`.

    Args:
        path: The folder or the file.
        vehicle_frame: The frame that is the vehicle's: x forward, y left, z up, on the ground. If not given it is
            `base_footprint`, or else `base_link`.
        mounts: Name of a sensor -> (4, 4) `vehicle_T_sensor`, where the bag does not say it, or something else.
        point_time_unit: What the times of points count: `s`, `ms`, `us`, `ns`, `scan_share` (shares of the scan period), or
            `none` to leave them aside. If not given it is what fits the time between scans.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A damaged bag; no cloud, none with a mount; frames in a loop; poses that are none.
        ImportError: rosbags is not installed.

    Warns:
        UserWarning: What was chosen where there was a choice, and clouds that were left out.
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
        if point_time_unit not in (None, *POINT_TIMES):
            raise ValueError(f"point_time_unit: one of {', '.join(POINT_TIMES)} is needed; got {point_time_unit!r}")
        self.reader_options = {
            "vehicle_frame": vehicle_frame,
            "point_time_unit": point_time_unit,
            "mounts": {name: np.asarray(of).tolist() for name, of in (mounts or {}).items()},
        }
        self._bag = Bag(self.path)
        with report_bad_file(self.path, "a bag"):
            frames = self._frames_of_clouds()
            tree = FrameTree(read_static_transforms(self._bag))
            self.vehicle_frame = vehicle_frame or _vehicle_frame({*tree.frames, *frames.values()}, mounts or {})
            self._mounts = self._mounted(frames, tree, mounts or {})
            self.sensors = tuple(self._mounts)
            self.rigs = {"ros": self.sensors}
            found = find_vehicle_poses(self._bag, tree, self.vehicle_frame)
            self._poses = found[0] if found else None
            self._stamps_ns: dict[int, int] = {}
            self._pair_scans()
            self._point_times = {sensor: self._choose_point_times(sensor, point_time_unit) for sensor in self.sensors}
            self._leave_out_ends()
            if vehicle_frame is None and {*VEHICLE_FRAMES} <= tree.frames:
                self._warn(f"{self.vehicle_frame} is taken for the vehicle's frame, not {VEHICLE_FRAMES[1]}")
            for clash in tree.find_clashes(self.vehicle_frame):
                self._warn(clash)
            if len(found) > 1:
                others = ", ".join(poses.source for poses in found[1:])
                self._warn(f"poses are taken from {found[0].source}, not from {others}")
            if self._poses is not None and self._poses.max_disagreement_m > APART_M:
                self._warn(
                    f"poses of {self._poses.source} jump to and fro by {self._poses.max_disagreement_m:.2g} m: do two nodes "
                    "send them? Record the bag again with one of them"
                )
            self.frame_names = tuple(map(str, self._logged_ns[self.sensors[0]]))
            stamped_ns = self._stamped_ns[self.sensors[0]]
            self.times_s = check_times(
                np.asarray((stamped_ns - stamped_ns[0]) * 1e-9), len(self.frame_names), f"stamps of {self.sensors[0]}"
            )

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Whether it is such a folder or file."""
        if find_ros1_files(path):
            return True
        if path.is_dir():
            return (path / METADATA).exists() and any(any(path.glob(f"*{suffix}*")) for suffix in SUFFIXES.values())
        return path.suffix in SUFFIXES.values()

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud; where the vehicle's poses are known, it is moved to the instant."""
        cloud, stamp_ns = self._cloud(sensor, index)
        source, mount = f"{self.path}: {sensor} at {self._logged_ns[sensor][index]}", self._mounts[sensor]
        if self._poses is None:
            return Scan(cloud.points_m, mount, source, rings=cloud.rings)
        vehicle_T_world = invert(self._world_T_vehicle(self._poses, index))
        logged_ns = int(self._logged_ns[sensor][index])
        if cloud.offsets_s is None:
            world_T_then = self._poses.interpolate(np.array([stamp_ns]), logged_ns)[0]
            return Scan(cloud.points_m, vehicle_T_world @ world_T_then @ mount, source, rings=cloud.rings)
        # Only what came back: zeros stay zeros, which say that nothing did.
        came = np.flatnonzero((np.abs(cloud.points_m) > NO_RETURN_M).any(axis=1))
        tick, of_point = np.unique(np.rint(cloud.offsets_s[came] / TICK_S).astype(np.int64), return_inverse=True)
        times_ns = stamp_ns + np.rint(tick * TICK_S * 1e9).astype(np.int64)
        sensor_T_then = (invert(mount) @ vehicle_T_world @ self._poses.interpolate(times_ns, logged_ns) @ mount)[
            of_point
        ]
        points_m = cloud.points_m.astype(np.float64)
        points_m[came] = np.einsum("nij,nj->ni", sensor_T_then[:, :3, :3], points_m[came]) + sensor_T_then[:, :3, 3]
        offsets_s = cloud.offsets_s + (stamp_ns - self._stamp_ns(index)) * 1e-9
        return Scan(points_m, mount, source, rings=cloud.rings, offsets_s=offsets_s)

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Where the vehicle was at the stamp of the instant; None in a bag without poses."""
        return None if self._poses is None else self._world_T_vehicle(self._poses, index)

    def read_calibrations(self) -> SensorCalibrations:
        """The mounts."""
        return SensorCalibrations(f"transforms to {self.vehicle_frame}", self._mounts)

    def read_boxes(self, index: int) -> None:
        """None: there are no labels."""

    def _frames_of_clouds(self) -> dict[str, str]:
        """Topic of each cloud that comes often -> its frame."""
        topics = self._bag.list_topics(CLOUD)
        if not topics:
            told = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self._bag.type_by_topic.items()))
            raise ValueError(f"a topic of {CLOUD} with messages is needed; there are {told or 'none'}")
        counts = {topic: len(self._bag.get_log_times_ns(topic)) for topic in topics}
        rare = [topic for topic, count in counts.items() if count < RAREST * max(counts.values())]
        if rare:
            self._warn(f"left out, for they come so rarely: {', '.join(rare)}")
        often = sorted((topic for topic in topics if topic not in rare), key=lambda topic: (counts[topic], topic))
        return {
            topic: normalize_frame_id(
                self._bag.read_message(topic, int(self._bag.get_log_times_ns(topic)[0])).header.frame_id
            )
            for topic in often
        }

    def _mounted(self, frames: Mapping[str, str], tree: FrameTree, given: Mapping[str, Matrix]) -> dict[str, Matrix]:
        """Name of each sensor, the one of the fewest scans first -> `vehicle_T_sensor`."""
        unknown = [name for name in given if self._topic(name) not in frames]
        if unknown:
            known = ", ".join(topic.removeprefix("/") for topic in frames)
            raise ValueError(f"mount of {', '.join(unknown)}: there are clouds of {known}")
        for name, mount in given.items():
            tree.add(self.vehicle_frame, frames[self._topic(name)], mount)
        found = {topic: tree.lookup_transform(self.vehicle_frame, frame) for topic, frame in frames.items()}
        found |= {self._topic(name): mount for name, mount in given.items()}
        lost = [f"{topic} ({frames[topic]})" for topic, mount in found.items() if mount is None]
        told = f"no static transform links to {self.vehicle_frame} the frame of {', '.join(lost)}"
        if len(lost) == len(found):
            raise ValueError(
                f"{told}; static ones are of {', '.join(sorted(tree.frames)) or 'no frames'}: name the vehicle's "
                "(--set recording.vehicle_frame=NAME), or give mounts (recording.yaml)"
            )
        if lost:
            self._warn(f"left out, for {told}")
        return {topic.removeprefix("/"): mount for topic, mount in found.items() if mount is not None}

    def _pair_scans(self) -> None:
        """Find the scan of each sensor that was made nearest to each scan of the first one, by the stamps."""
        logged_ns = {sensor: self._bag.get_log_times_ns(self._topic(sensor)) for sensor in self.sensors}
        stamped_ns = {sensor: self._stamps_of(sensor, logged_ns[sensor]) for sensor in self.sensors}
        late_s = {sensor: (logged_ns[sensor] - stamped_ns[sensor]) * 1e-9 for sensor in self.sensors}
        first = self.sensors[0]
        for sensor, times_s in late_s.items():
            if np.ptp(times_s) > DRIFT_S:
                self._warn(
                    f"scans of {sensor} were recorded {times_s.min():.3g} to {times_s.max():.3g} s after their stamps, "
                    "which are used"
                )
            elif abs(np.median(times_s) - np.median(late_s[first])) > CLOCKS_S:
                self._warn(
                    f"scans of {first} were recorded {np.median(late_s[first]):.3g} s after their stamps, those of "
                    f"{sensor} {np.median(times_s):.3g} s: are their clocks apart? Scans are paired by their stamps"
                )
        self._logged_ns, self._stamped_ns = {}, {}
        for sensor in self.sensors:
            order = np.argsort(stamped_ns[sensor], kind="stable")
            chosen = order[find_nearest_times(stamped_ns[sensor][order], np.sort(stamped_ns[first]))]
            self._logged_ns[sensor] = logged_ns[sensor][chosen]
            self._stamped_ns[sensor] = stamped_ns[sensor][chosen]

    def _stamps_of(self, sensor: str, logged_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        stamped_ns = self._bag.read_stamps_ns(self._topic(sensor))
        if stamped_ns.any():
            return stamped_ns
        self._warn(f"clouds of {sensor} have no stamps: they are taken as made when they were recorded")
        return logged_ns

    def _choose_point_times(self, sensor: str, point_time_unit: str | None) -> PointTimes:
        """How the times of the points of a sensor are stored, by the scan in its middle."""
        logged_ns, stamped_ns = self._logged_ns[sensor], np.unique(self._stamped_ns[sensor])
        period_s = float(np.median(np.diff(stamped_ns))) * 1e-9 if len(stamped_ns) > 1 else None
        if point_time_unit is not None:
            return PointTimes(point_time_unit, period_s or PARAMS.default_period_s)
        message = self._bag.read_message(self._topic(sensor), int(logged_ns[len(logged_ns) // 2]))
        try:
            chosen, note = choose_point_times(message, period_s)
        except ValueError:  # whoever reads this cloud will say so; the others may be whole
            return PointTimes("ns", period_s or PARAMS.default_period_s)
        if chosen is None:
            raise ValueError(f"{sensor}: {note}")
        if note:
            self._warn(f"{sensor}: {note}; choose another by --set recording.point_time_unit=UNIT")
        return chosen

    def _leave_out_ends(self) -> None:
        """Keep the instants between the first pose and the last."""
        if self._poses is None:
            return
        inside = self._poses.mask_covered_times(self._stamped_ns[self.sensors[0]], STAMP_MARGIN_S)
        if not inside.any():
            raise ValueError(
                f"no scan lies between the first and the last pose of {self._poses.source}; do the clocks match?"
            )
        self._logged_ns = {sensor: times_ns[inside] for sensor, times_ns in self._logged_ns.items()}
        self._stamped_ns = {sensor: times_ns[inside] for sensor, times_ns in self._stamped_ns.items()}

    def _warn(self, what: str) -> None:
        warnings.warn(f"{self.path}: {what}", stacklevel=5)

    def _topic(self, sensor: str) -> str:
        return sensor if sensor in self._bag.type_by_topic else f"/{sensor}"

    def _world_T_vehicle(self, poses: VehiclePoses, index: int) -> Matrix:
        logged_ns = int(self._logged_ns[self.sensors[0]][index])
        return np.asarray(poses.interpolate(np.array([self._stamp_ns(index)]), logged_ns)[0])

    def _stamp_ns(self, index: int) -> int:
        """When the first sensor's scan was made, which is the time of the instant."""
        if index not in self._stamps_ns:
            self._cloud(self.sensors[0], index)
        return self._stamps_ns[index]

    def _cloud(self, sensor: str, index: int) -> tuple[CloudMessage, int]:
        logged_ns, first_ns = int(self._logged_ns[sensor][index]), self._stamped_ns[self.sensors[0]]
        apart_s = abs(int(self._stamped_ns[sensor][index]) - int(first_ns[index])) * 1e-9
        frame_interval_s = float(np.median(np.diff(first_ns))) * 1e-9 if len(first_ns) > 1 else np.inf
        with report_bad_file(self.path, f"a cloud of {sensor}"):
            if apart_s > FARTHEST_SCAN * frame_interval_s:
                raise ValueError(f"the scan of {sensor} nearest to {first_ns[index]} is {apart_s:.3f} s off")
            cloud = parse_cloud(self._bag.read_message(self._topic(sensor), logged_ns), self._point_times[sensor])
        stamp_ns = cloud.stamp_ns or logged_ns
        if sensor == self.sensors[0]:
            self._stamps_ns[index] = stamp_ns
        return cloud, stamp_ns


def find_nearest_times(times_ns: NDArray[np.int64], query_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """For each wanted time the number of the nearest, of ascending ones.

    Example:
        >>> find_nearest_times(np.array([0, 10, 20]), np.array([-5, 4, 6, 99]))
        array([0, 0, 1, 2])
    """
    after = np.searchsorted(times_ns, query_ns).clip(1, max(len(times_ns) - 1, 1)).clip(max=len(times_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(query_ns - times_ns[before] <= times_ns[after] - query_ns, before, after)


def _vehicle_frame(frames: Collection[str], mounts: Collection[str]) -> str:
    for frame in VEHICLE_FRAMES:
        if frame in frames:
            return frame
    if mounts:
        return VEHICLE_FRAMES[1]
    raise ValueError(
        f"the frame {' or '.join(VEHICLE_FRAMES)} of the vehicle is needed; there are {', '.join(sorted(frames))}: "
        "name one (--set recording.vehicle_frame=NAME), or give mounts (recording.yaml)"
    )
