"""Bags of ROS 1 and 2: clouds of all LiDARs, where they are mounted, where the vehicle was."""

import os
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchcover.files import naming
from torchcover.geometry import invert
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.bag_files import METADATA, find_ros1_files
from torchcover.recordings.formats.bag import SUFFIXES, Bag
from torchcover.recordings.formats.frame_tree import FrameTree, frame_name
from torchcover.recordings.formats.point_cloud2 import CloudMessage, cloud_of
from torchcover.recordings.formats.ros_poses import WINDOW_NS, VehiclePoses, mounted_transforms, vehicle_poses
from torchcover.recordings.recording import NO_RETURN_M, Layout, Scan, SensorCalibrations, check_times

CLOUD = "sensor_msgs/msg/PointCloud2"
# The first lies on the ground; robots have the second a wheel's radius above it.
VEHICLE_FRAMES = ("base_footprint", "base_link")
# Clouds that come so much more rarely than those of the fastest sensor are maps and the like.
RAREST = 0.25
# Scans of one instant: none is farther from the first sensor's than this share of the time from one to the next.
FARTHEST_SCAN = 0.75
# Points of so short a time are moved together: 0.4 mm at 40 m/s.
TICK_S = 1e-5


class RosBag(Layout):
    """A bag: a folder with `metadata.yaml` and `.db3` or `.mcap` files, or with `.bag` files; or one such file.

    The sensors are the topics of `PointCloud2`, named without the first slash, whose frame is mounted on the vehicle's,
    by tf_static or by transforms of tf that never change; an instant is a scan of the one that has fewest, with the
    nearest of each other. Times are those of recording, poses belong to the stamps of the clouds. Points with a time of
    their own (a field `t`, `time`, `timestamp`, `time_stamp`, `offset_time` or `time_offset`) are taken as measured and
    moved to the stamp of their instant; those without as one, too. Scans beyond the first and last pose are left out.
    Needs `torchcover[ros]`.

    Args:
        path: The folder or the file.
        vehicle_frame: The frame that is the vehicle's: x forward, y left, z up, on the ground. If not given it is
            `base_footprint`, or else `base_link`.
        mounts: Name of a sensor -> (4, 4) `vehicle_T_sensor`, where the bag does not say it, or something else.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A damaged bag; no cloud, none with a mount; frames in a loop; poses that are none.
        ImportError: rosbags is not installed.

    Warns:
        UserWarning: What was chosen where there was a choice, and clouds that were left out.
    """

    layout: ClassVar[str] = "metadata.yaml and *.db3 or *.mcap, *.bag, or such a file, with topics of PointCloud2"

    def __init__(
        self, path: str | os.PathLike[str], vehicle_frame: str | None = None, mounts: Mapping[str, Matrix] | None = None
    ) -> None:
        self.path = Path(path)
        self.told = {
            "vehicle_frame": vehicle_frame,
            "mounts": {name: np.asarray(of).tolist() for name, of in (mounts or {}).items()},
        }
        self._bag = Bag(self.path)
        with naming(self.path, "a bag"):
            frames = self._frames_of_clouds()
            tree = FrameTree(mounted_transforms(self._bag))
            self.vehicle_frame = vehicle_frame or _vehicle_frame({*tree.frames, *frames.values()}, mounts or {})
            self._mounts = self._mounted(frames, tree, mounts or {})
            self.sensors = tuple(self._mounts)
            self.rigs = {"ros": self.sensors}
            found = vehicle_poses(self._bag, tree, self.vehicle_frame)
            self._poses = found[0] if found else None
            # Sensor -> when its scan of each instant was recorded.
            times = {sensor: self._bag.times_ns(self._topic(sensor)) for sensor in self.sensors}
            first_ns = times[self.sensors[0]]
            self._logged_ns = {sensor: times_ns[nearest_of(times_ns, first_ns)] for sensor, times_ns in times.items()}
            self._stamps_ns: dict[int, int] = {}
            self._leave_out_ends()
            if vehicle_frame is None and {*VEHICLE_FRAMES} <= tree.frames:
                self._warn(f"{self.vehicle_frame} is taken for the vehicle's frame, not {VEHICLE_FRAMES[1]}")
            if len(found) > 1:
                others = ", ".join(poses.source for poses in found[1:])
                self._warn(f"poses are taken from {found[0].source}, not from {others}")
            logged_ns = self._logged_ns[self.sensors[0]]
            self.names = tuple(map(str, logged_ns))
            self.times_s = check_times(
                np.asarray((logged_ns - logged_ns[0]) * 1e-9), len(self.names), "recorded clouds"
            )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether it is such a folder or file."""
        if find_ros1_files(path):
            return True
        if path.is_dir():
            return (path / METADATA).exists() and any(any(path.glob(f"*{suffix}*")) for suffix in SUFFIXES.values())
        return path.suffix in SUFFIXES.values()

    def scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud; where the vehicle's poses are known, it is moved to the instant."""
        cloud, stamp_ns = self._cloud(sensor, index)
        source, mount = f"{self.path}: {sensor} at {self._logged_ns[sensor][index]}", self._mounts[sensor]
        if self._poses is None:
            return Scan(cloud.points_m, mount, source, rows=cloud.rows)
        vehicle_T_world = invert(self._world_T_vehicle(self._poses, index))
        logged_ns = int(self._logged_ns[sensor][index])
        if cloud.offsets_s is None:
            world_T_then = self._poses.at(np.array([stamp_ns]), logged_ns)[0]
            return Scan(cloud.points_m, vehicle_T_world @ world_T_then @ mount, source, rows=cloud.rows)
        # Only what came back: zeros stay zeros, which say that nothing did.
        came = np.flatnonzero((np.abs(cloud.points_m) > NO_RETURN_M).any(axis=1))
        tick, of_point = np.unique(np.rint(cloud.offsets_s[came] / TICK_S).astype(np.int64), return_inverse=True)
        times_ns = stamp_ns + np.rint(tick * TICK_S * 1e9).astype(np.int64)
        sensor_T_then = (invert(mount) @ vehicle_T_world @ self._poses.at(times_ns, logged_ns) @ mount)[of_point]
        points_m = cloud.points_m.astype(np.float64)
        points_m[came] = np.einsum("nij,nj->ni", sensor_T_then[:, :3, :3], points_m[came]) + sensor_T_then[:, :3, 3]
        offsets_s = cloud.offsets_s + (stamp_ns - self._stamp_ns(index)) * 1e-9
        return Scan(points_m, mount, source, rows=cloud.rows, offsets_s=offsets_s)

    def world_T_vehicle(self, index: int) -> Matrix | None:
        """Where the vehicle was at the stamp of the instant; None in a bag without poses."""
        return None if self._poses is None else self._world_T_vehicle(self._poses, index)

    def calibrations(self) -> SensorCalibrations:
        """The mounts."""
        return SensorCalibrations(f"transforms to {self.vehicle_frame}", self._mounts)

    def boxes(self, index: int) -> None:
        """None: there are no labels."""

    def _frames_of_clouds(self) -> dict[str, str]:
        """Topic of each cloud that comes often -> its frame."""
        topics = self._bag.topics(CLOUD)
        if not topics:
            told = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self._bag.types.items()))
            raise ValueError(f"a topic of {CLOUD} with messages is needed; there are {told or 'none'}")
        counts = {topic: len(self._bag.times_ns(topic)) for topic in topics}
        rare = [topic for topic, count in counts.items() if count < RAREST * max(counts.values())]
        if rare:
            self._warn(f"left out, for they come so rarely: {', '.join(rare)}")
        often = sorted((topic for topic in topics if topic not in rare), key=lambda topic: (counts[topic], topic))
        return {
            topic: frame_name(self._bag.message(topic, int(self._bag.times_ns(topic)[0])).header.frame_id)
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
        found = {topic: tree.between(self.vehicle_frame, frame) for topic, frame in frames.items()}
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

    def _leave_out_ends(self) -> None:
        """Keep the instants between the first pose and the last."""
        if self._poses is None:
            return
        first_ns, logged_ns = self._logged_ns[self.sensors[0]], self._poses.logged_ns
        inside = (first_ns >= logged_ns[0] - WINDOW_NS) & (first_ns <= logged_ns[-1] + WINDOW_NS)
        # Scans are recorded a little after their stamp: the few at the ends are asked for it.
        at_ends = inside & ((first_ns < logged_ns[0] + WINDOW_NS) | (first_ns > logged_ns[-1] - WINDOW_NS))
        for index in np.flatnonzero(at_ends):
            inside[index] = self._poses.covers(self._stamp_ns(int(index)))
        if not inside.any():
            raise ValueError(
                f"no scan lies between the first and the last pose of {self._poses.source}; do the clocks match?"
            )
        self._logged_ns = {sensor: times_ns[inside] for sensor, times_ns in self._logged_ns.items()}
        self._stamps_ns = {}

    def _warn(self, what: str) -> None:
        warnings.warn(f"{self.path}: {what}", stacklevel=5)

    def _topic(self, sensor: str) -> str:
        return sensor if sensor in self._bag.types else f"/{sensor}"

    def _world_T_vehicle(self, poses: VehiclePoses, index: int) -> Matrix:
        logged_ns = int(self._logged_ns[self.sensors[0]][index])
        return np.asarray(poses.at(np.array([self._stamp_ns(index)]), logged_ns)[0])

    def _stamp_ns(self, index: int) -> int:
        """When the first sensor's scan was made, which is the time of the instant."""
        if index not in self._stamps_ns:
            self._cloud(self.sensors[0], index)
        return self._stamps_ns[index]

    def _cloud(self, sensor: str, index: int) -> tuple[CloudMessage, int]:
        logged_ns, first_ns = int(self._logged_ns[sensor][index]), self._logged_ns[self.sensors[0]]
        apart_s = abs(logged_ns - int(first_ns[index])) * 1e-9
        every_s = float(np.median(np.diff(first_ns))) * 1e-9 if len(first_ns) > 1 else np.inf
        with naming(self.path, f"a cloud of {sensor}"):
            if apart_s > FARTHEST_SCAN * every_s:
                raise ValueError(f"the scan of {sensor} nearest to {first_ns[index]} is {apart_s:.3f} s off")
            cloud = cloud_of(self._bag.message(self._topic(sensor), logged_ns))
        stamp_ns = cloud.stamp_ns or logged_ns
        if sensor == self.sensors[0]:
            self._stamps_ns[index] = stamp_ns
        return cloud, stamp_ns


def nearest_of(times_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """For each wanted time the number of the nearest, of ascending ones.

    Example:
        >>> nearest_of(np.array([0, 10, 20]), np.array([-5, 4, 6, 99]))
        array([0, 0, 1, 2])
    """
    after = np.searchsorted(times_ns, wanted_ns).clip(1, max(len(times_ns) - 1, 1)).clip(max=len(times_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted_ns - times_ns[before] <= times_ns[after] - wanted_ns, before, after)


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
