"""Where the vehicle of a bag was: from odometry, a tree of frames or poses, between two of them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import naming
from torchcover.geometry import quaternion_from_rotation, rigid, rotation_from_quaternion, slerp
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.bag import Bag
from torchcover.recordings.formats.frame_tree import FrameTree, frame_name, parent_of, pose_of
from torchcover.recordings.formats.point_cloud2 import stamp_of

ODOMETRY, TF, POSE = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped"
# Of a tree the frame that never jumps, where it has one; else its root.
WORLD = "odom"
# Messages are recorded at most so long after they were stamped.
WINDOW_NS = 1_000_000_000
# Where the vehicle was is unknown between two poses that are farther apart; before the first and after the last
# it goes on as before for a little.
LONGEST_GAP_S, EDGE_S = 1.0, 0.15
# What is mounted is written down again and again, to rounding.
SAME = 1e-6


class PoseSeries(NamedTuple):
    """Poses at ascending times. `times_ns`: (K,); `places_m`: (K, 3); `wxyz`: (K, 4) unit quaternions."""

    times_ns: NDArray[np.int64]
    places_m: Matrix
    wxyz: Matrix

    def at(self, times_ns: NDArray[np.int64], name: str) -> Matrix:
        """(N, 4, 4) at other times: places evenly, rotations the shorter way at an even rate (slerp)."""
        if len(self.times_ns) < 2:
            raise ValueError(f"{name}: poses on both sides of the time {int(times_ns[0])} ns are needed; got fewer")
        after = np.searchsorted(self.times_ns, times_ns).clip(1, len(self.times_ns) - 1)
        start_ns, gap_ns = self.times_ns[after - 1], np.diff(self.times_ns)[after - 1]
        since_s, gap_s = (times_ns - start_ns) * 1e-9, gap_ns * 1e-9
        beyond_s = np.maximum(-since_s, since_s - gap_s)
        apart = (gap_s > LONGEST_GAP_S) & (since_s > 0) & (since_s < gap_s)
        if apart.any():
            raise ValueError(
                f"{name}: the poses before and after the time {int(times_ns[apart][0])} ns are "
                f"{gap_s[apart].max():.3g} s apart; where it was between is known of poses that are at most "
                f"{LONGEST_GAP_S:g} s apart: record more often, or give poses of all times"
            )
        bad = beyond_s > EDGE_S
        if bad.any():
            off_s = np.minimum(np.abs(since_s), np.abs(since_s - gap_s))[bad].max()
            raise ValueError(
                f"{name}: the pose nearest to the time {int(times_ns[bad][0])} ns is {off_s:.3f} s off; do the clocks "
                "of the sensors match?"
            )
        share = (since_s / gap_s)[:, None]
        first_m, second_m = self.places_m[after - 1], self.places_m[after]
        rotations = rotation_from_quaternion(slerp(self.wxyz[after - 1], self.wxyz[after], share))
        return rigid(rotations, first_m + share * (second_m - first_m))


class VehiclePoses:
    """Poses of the vehicle's frame, from a topic of the bag; `source` says for people what was taken.

    `links` lead from the world to the vehicle: frames whose poses are read, and what is mounted, as (4, 4).
    """

    def __init__(self, bag: Bag, topic: str, links: Sequence[str | Matrix], source: str) -> None:
        self.source = source
        self._bag, self._topic, self._links = bag, topic, links
        self.logged_ns = bag.times_ns(topic)
        self._last: tuple[int, Mapping[str, PoseSeries]] = (-1, {})
        ends = [self._around(int(self.logged_ns[end])) for end in (0, -1)]
        moving = [link for link in links if isinstance(link, str)]
        self._span_ns = (
            max(int(ends[0][link].times_ns[0]) for link in moving),
            min(int(ends[1][link].times_ns[-1]) if link in ends[1] else 0 for link in moving),
        )

    def covers(self, time_ns: int) -> bool:
        """Whether it lies between the first pose and the last, or nearly."""
        edge_ns = EDGE_S * 1e9
        return self._span_ns[0] - edge_ns <= time_ns <= self._span_ns[1] + edge_ns

    def at(self, times_ns: NDArray[np.int64], logged_ns: int) -> Matrix:
        """(N, 4, 4) `world_T_vehicle`. `times_ns`: (N,) when; `logged_ns`: about when such messages were recorded."""
        with naming(self._bag.path, "a bag"):
            series = self._around(logged_ns)
            world_T_here = np.broadcast_to(np.eye(4), (len(times_ns), 4, 4))
            for link in self._links:
                if isinstance(link, str):
                    if link not in series:
                        raise ValueError(f"{self._topic}: no pose within 1 s of {logged_ns}")
                    world_T_here = world_T_here @ series[link].at(times_ns, self._topic)
                else:
                    world_T_here = world_T_here @ link
            return world_T_here

    def _around(self, logged_ns: int) -> Mapping[str, PoseSeries]:
        if self._last[0] != logged_ns:
            messages = self._bag.messages(self._topic, logged_ns - WINDOW_NS, logged_ns + WINDOW_NS)
            self._last = (logged_ns, series_of(messages, self._bag.types[self._topic], self._topic))
        return self._last[1]


def series_of(messages: Sequence[Any], kind: str, name: str) -> dict[str, PoseSeries]:
    """Name of each frame -> its poses; those of `Odometry` and `PoseStamped` are called after their type."""
    found: dict[str, dict[int, Matrix]] = {}
    for message in messages:
        if kind == TF:
            for one in message.transforms:
                child = frame_name(one.child_frame_id)
                pose = pose_of(one.transform.translation, one.transform.rotation, f"{name}: {child}")
                found.setdefault(child, {})[stamp_of(one.header)] = pose
        else:
            pose = message.pose.pose if kind == ODOMETRY else message.pose
            found.setdefault(kind, {})[stamp_of(message.header)] = pose_of(pose.position, pose.orientation, name)
    return {child: _series(poses) for child, poses in found.items()}


def mounted_transforms(bag: Bag) -> list[Any]:
    """Messages `TransformStamped` of what is mounted: all of tf_static, and those of tf that never change."""
    statics, links = [], dict[str, list[Any]]()
    for topic in bag.topics(TF):
        if topic.endswith("tf_static"):
            statics += [one for message in bag.messages(topic) for one in message.transforms]
            continue
        logged_ns, read_ns = bag.times_ns(topic), 0
        for about_ns in (logged_ns[0], logged_ns[len(logged_ns) // 2], logged_ns[-1]):
            start_ns, read_ns = max(int(about_ns) - WINDOW_NS // 2, read_ns), int(about_ns) + WINDOW_NS // 2
            for message in bag.messages(topic, start_ns, read_ns):
                for one in message.transforms:
                    links.setdefault(frame_name(one.child_frame_id), []).append(one)
    return [*(of[0] for of in links.values() if len(of) > 1 and _never_changes(of)), *statics]


def _never_changes(transforms: Sequence[Any]) -> bool:
    (parent, mount), *others = map(parent_of, transforms)
    return all(other == parent and np.abs(pose - mount).max() < SAME for other, pose in others)


def vehicle_poses(bag: Bag, tree: FrameTree, vehicle_frame: str) -> list[VehiclePoses]:
    """What says where the vehicle was, the best first: odometry, then a tree of frames, then poses."""
    found, lost = [], []
    for topic in sorted(bag.topics(ODOMETRY), key=lambda topic: -len(bag.times_ns(topic))):
        child = frame_name(bag.message(topic, int(bag.times_ns(topic)[0])).child_frame_id) or vehicle_frame
        child_T_vehicle = tree.between(child, vehicle_frame)
        if child_T_vehicle is None:
            lost.append(f"{topic} ({child})")
        else:
            found.append(VehiclePoses(bag, topic, (ODOMETRY, child_T_vehicle), f"{topic} (odometry of {child})"))
    for topic in bag.topics(TF):
        if not topic.endswith("tf_static"):
            found += _of_tree(bag, topic, tree, vehicle_frame)
    found += [VehiclePoses(bag, topic, (POSE,), f"{topic} (poses)") for topic in bag.topics(POSE)]
    if lost and not found:
        raise ValueError(f"no static transform links to {vehicle_frame} the frame of the odometry {', '.join(lost)}")
    return found


def _of_tree(bag: Bag, topic: str, tree: FrameTree, vehicle_frame: str) -> list[VehiclePoses]:
    """Poses from a topic of transforms, if any of them leads from the vehicle to a world."""
    start_ns = int(bag.times_ns(topic)[0])
    parents = {
        frame_name(one.child_frame_id): frame_name(one.header.frame_id)
        for message in bag.messages(topic, start_ns, start_ns + 2 * WINDOW_NS)
        for one in message.transforms
    }
    links: list[str | Matrix] = []
    frame, passed = vehicle_frame, [vehicle_frame]
    while frame != WORLD:
        if frame in parents:
            links.insert(0, frame)
            frame = parents[frame]
        elif (mounted := tree.parent(frame)) is not None:
            frame, parent_T_frame = mounted
            links.insert(0, parent_T_frame)
        else:
            break
        if frame in passed:
            raise ValueError(f"{topic}: the frames {' -> '.join([*passed, frame])} are a loop")
        passed.append(frame)
    if not any(isinstance(link, str) for link in links):
        return []
    return [VehiclePoses(bag, topic, links, f"{topic} ({vehicle_frame} in {frame})")]


def _series(poses: Mapping[int, Matrix]) -> PoseSeries:
    times_ns = np.array(sorted(poses), dtype=np.int64)
    sorted_poses = np.array([poses[int(time_ns)] for time_ns in times_ns])
    wxyz = np.array([quaternion_from_rotation(pose[:3, :3]) for pose in sorted_poses])
    return PoseSeries(times_ns, sorted_poses[:, :3, 3], wxyz)
