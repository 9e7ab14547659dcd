"""Poses of a bag: frames that are mounted on each other, and the vehicle between two poses of odometry or tf."""

import warnings
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import report_bad_file
from torchcover.geometry import (
    build_transform,
    convert_quaternion_to_rotation,
    convert_rotation_to_quaternion,
    interpolate_quaternions,
    invert,
)
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.bag import Bag, get_stamp_ns

# A transform from a parent frame to a child frame.
Edge = tuple[str, str]
# Numbers of two 4x4 transforms that are no farther apart are the same but for rounding.
MOUNT_TOLERANCE = 1e-3
MAX_NAMED = 3


class FrameTree:
    """Static transforms, each from its parent frame to its child frame.

    A child may have several parents, which tf2 does not allow and bags have nevertheless: the way of the fewest
    transforms counts, of two for the same edge the later one.

    Args:
        transforms: Messages `geometry_msgs/msg/TransformStamped`.
    """

    def __init__(self, transforms: Iterable[Any]) -> None:
        self._mounts: dict[Edge, Matrix] = {}
        self._repeated: dict[Edge, Matrix] = {}
        for transform in transforms:
            edge, parent_T_child = parse_edge(transform)
            before = self._mounts.pop(edge, parent_T_child)
            if np.abs(before - parent_T_child).max() > MOUNT_TOLERANCE:
                self._repeated[edge] = before
            self._mounts[edge] = parent_T_child

    def add(self, parent: str, child: str, parent_T_child: Matrix) -> None:
        """Mount a frame, with all that it is mounted together with, if it is not mounted with this one yet."""
        if self.lookup_transform(parent, child) is None:
            self._mounts[parent, child] = parent_T_child

    def remove_edges(self, edges: Container[Edge]) -> "FrameTree":
        """The same without some of the transforms."""
        tree = FrameTree(())
        tree._mounts = {edge: mount for edge, mount in self._mounts.items() if edge not in edges}
        return tree

    def find_mounted_frames(self, frame: str) -> set[str]:
        """The frame, and all that are mounted together with it."""
        return set(self._reached(frame))

    @property
    def frames(self) -> set[str]:
        """All frames that are named."""
        return {frame for edge in self._mounts for frame in edge}

    def list_neighbors(self, frame: str) -> Iterator[tuple[str, Matrix]]:
        """Yield each frame that one transform links to this one, and `this_T_that`; the later transforms first."""
        for (parent, child), parent_T_child in reversed(self._mounts.items()):
            if parent == frame:
                yield child, parent_T_child
            elif child == frame:
                yield parent, invert(parent_T_child)

    def lookup_transform(self, destination: str, source: str) -> Matrix | None:
        """(4, 4) `destination_T_source`; None if the one is not mounted on what the other is."""
        return self._reached(destination).get(source)

    def find_clashes(self, frame: str) -> list[str]:
        """Name the transforms that contradict the way by which frames are mounted together with this one."""
        clashes = []
        for (parent, child), before in self._repeated.items():
            difference = _difference(before, self._mounts[parent, child])
            clashes.append(f"{parent} -> {child} is sent with two values, {difference} apart: the later one is used")
        reached = self._reached(frame)
        for (parent, child), mount in self._mounts.items():
            if parent not in reached or child not in reached:
                continue
            used = invert(reached[parent]) @ reached[child]
            if np.abs(used - mount).max() > MOUNT_TOLERANCE:
                others = [f"{one} -> {child}" for one, other in self._mounts if other == child and one != parent]
                named = " and ".join(others) or f"the other transforms from {frame} on"
                clashes.append(f"{parent} -> {child} is not used: it is {_difference(used, mount)} off {named}")
        return clashes[:MAX_NAMED]

    def _reached(self, frame: str) -> dict[str, Matrix]:
        """Each frame that is mounted together with this one, the nearest first -> `this_T_that`."""
        reached = {frame: np.eye(4)}
        for here, frame_T_here in _growing(reached):
            for there, here_T_there in self.list_neighbors(here):
                reached.setdefault(there, frame_T_here @ here_T_there)
        return reached


def _growing(reached: dict[str, Matrix]) -> Iterator[tuple[str, Matrix]]:
    """Yield the entries of a dict to which others are added meanwhile."""
    done = 0
    while done < len(reached):
        for frame in list(reached)[done:]:
            done += 1
            yield frame, reached[frame]


def normalize_frame_id(frame_id: str) -> str:
    """Return the name of a frame; older tools begin it with a slash."""
    return str(frame_id).removeprefix("/")


def parse_edge(message: Any) -> tuple[Edge, Matrix]:  # noqa: ANN401  (of a type that rosbags has made)
    """Return the parent and the child of a message `TransformStamped`, and `parent_T_child`."""
    parent, child = normalize_frame_id(message.header.frame_id), normalize_frame_id(message.child_frame_id)
    return (parent, child), parse_pose(message.transform.translation, message.transform.rotation, child)


def parse_pose(translation: Any, rotation: Any, name: str) -> Matrix:  # noqa: ANN401  (of types that rosbags has made)
    """(4, 4) of a place (or translation) and a quaternion."""
    place_m = np.array([translation.x, translation.y, translation.z], dtype=np.float64)
    if not np.isfinite(place_m).all():
        raise ValueError(f"{name}: three finite coordinates are needed; got {place_m.tolist()}")
    try:
        return build_transform(
            convert_quaternion_to_rotation([rotation.w, rotation.x, rotation.y, rotation.z]), place_m
        )
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _difference(first: Matrix, second: Matrix) -> str:
    apart = invert(first) @ second
    turn_deg = np.rad2deg(np.arccos(np.clip((np.trace(apart[:3, :3]) - 1) / 2, -1, 1)))
    return f"{np.linalg.norm(apart[:3, 3]):.3g} m and {turn_deg:.3g} degrees"


ODOMETRY, TF, POSE = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped"
# Of a tree the frame that never jumps, where it has one; else its root.
WORLD = "odom"
# Messages are recorded at most so long after they were stamped.
WINDOW_NS = 1_000_000_000
# Where the vehicle was is unknown between two poses that are farther apart; before the first and after the last
# it goes on as before for a little.
LONGEST_GAP_S, EDGE_S = 1.0, 0.15
# What is mounted is written down again and again, to rounding.
STATIC_TOLERANCE = 1e-6
# A vehicle cannot be so far off the middle between the poses before and after; two senders of one transform can, in
# such a share of its poses.
ZIGZAG_M = 0.1
ZIGZAG_SHARE = 0.2
# Bags are recorded no slower than at this multiple of real time.
SLOWEST = 100.0


class PoseSeries(NamedTuple):
    """Poses at ascending times. `times_ns`: (K,); `positions_m`: (K, 3); `wxyz`: (K, 4) unit quaternions.

    `max_disagreement_m`: how far poses of the same time are apart.
    """

    times_ns: NDArray[np.int64]
    positions_m: Matrix
    wxyz: Matrix
    max_disagreement_m: float = 0.0

    def interpolate(self, times_ns: NDArray[np.int64], name: str) -> Matrix:
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
        first_m, second_m = self.positions_m[after - 1], self.positions_m[after]
        rotations = convert_quaternion_to_rotation(
            interpolate_quaternions(self.wxyz[after - 1], self.wxyz[after], share)
        )
        return build_transform(rotations, first_m + share * (second_m - first_m))

    def estimate_zigzag_m(self) -> float:
        """How far poses jump to and fro, in metres; 0 if a vehicle can move like that."""
        first_ns, middle_ns, last_ns = self.times_ns[:-2], self.times_ns[1:-1], self.times_ns[2:]
        share = ((middle_ns - first_ns) / (last_ns - first_ns))[:, None]
        expected_m = self.positions_m[:-2] + share * (self.positions_m[2:] - self.positions_m[:-2])
        off_m = np.linalg.norm(self.positions_m[1:-1] - expected_m, axis=1)
        jumps_m = off_m[(off_m > ZIGZAG_M) & (last_ns - first_ns < LONGEST_GAP_S * 1e9)]
        return float(np.median(jumps_m)) if len(jumps_m) > ZIGZAG_SHARE * len(off_m) else 0.0


class VehiclePoses:
    """Poses of the vehicle's frame, from a topic of the bag.

    Args:
        bag: The bag.
        topic: The topic.
        links: From the world to the vehicle: keys of the poses that are read, see `build_pose_series`, and what is mounted, as
            (4, 4).
        source: What was taken, for messages.
    """

    def __init__(self, bag: Bag, topic: str, links: Sequence[Edge | Matrix], source: str) -> None:
        self.source = source
        self._bag, self._topic, self._links = bag, topic, links
        logged_ns = bag.get_log_times_ns(topic)
        self._window_ns = WINDOW_NS
        self._last: tuple[int, Mapping[Edge, PoseSeries]] = (-1, {})
        ends = [self._around(int(logged_ns[end])) for end in (0, -1)]
        moving = [link for link in links if isinstance(link, tuple)]
        self._span_ns = (
            max(int(ends[0][link].times_ns[0]) for link in moving),
            min(int(ends[1][link].times_ns[-1]) if link in ends[1] else 0 for link in moving),
        )
        # A bag that was recorded while another one played slowly is read in longer windows of its own clock.
        slowness = (logged_ns[-1] - logged_ns[0]) / max(self._span_ns[1] - self._span_ns[0], 1)
        self._window_ns = round(WINDOW_NS * np.clip(slowness, 1.0, SLOWEST))
        self.max_disagreement_m = max(
            max(end[link].max_disagreement_m, end[link].estimate_zigzag_m())
            for end in ends
            for link in moving
            if link in end
        )

    def mask_covered_times(self, times_ns: NDArray[np.int64], margin_s: float = 0.0) -> NDArray[np.bool_]:
        """(N,) whether times lie between the first pose and the last, or nearly."""
        edge_ns = (EDGE_S - margin_s) * 1e9
        return (self._span_ns[0] - edge_ns <= times_ns) & (times_ns <= self._span_ns[1] + edge_ns)

    def interpolate(self, times_ns: NDArray[np.int64], log_time_ns: int) -> Matrix:
        """(N, 4, 4) `world_T_vehicle`. `times_ns`: (N,) when; `log_time_ns`: about when such messages were recorded."""
        with report_bad_file(self._bag.path, "a bag"):
            series = self._around(log_time_ns)
            world_T_here = np.broadcast_to(np.eye(4), (len(times_ns), 4, 4))
            for link in self._links:
                if isinstance(link, tuple):
                    if link not in series:
                        raise ValueError(f"{self._topic}: no pose within 1 s of {log_time_ns}")
                    world_T_here = world_T_here @ series[link].interpolate(times_ns, self._topic)
                else:
                    world_T_here = world_T_here @ link
            return world_T_here

    def _around(self, logged_ns: int) -> Mapping[Edge, PoseSeries]:
        if self._last[0] != logged_ns:
            messages = self._bag.read_messages(self._topic, logged_ns - self._window_ns, logged_ns + self._window_ns)
            self._last = (logged_ns, build_pose_series(messages, self._bag.type_by_topic[self._topic], self._topic))
        return self._last[1]


def build_pose_series(messages: Sequence[Any], kind: str, name: str) -> dict[Edge, PoseSeries]:
    """Parent and child of each transform -> its poses; those of `Odometry` and `PoseStamped` are under (type, "")."""
    stamped: dict[Edge, list[tuple[int, Matrix]]] = {}
    for message in messages:
        if kind == TF:
            for transform in message.transforms:
                edge, pose = _named_edge_of(transform, name)
                stamped.setdefault(edge, []).append((get_stamp_ns(transform.header), pose))
        else:
            pose = message.pose.pose if kind == ODOMETRY else message.pose
            placed = get_stamp_ns(message.header), parse_pose(pose.position, pose.orientation, name)
            stamped.setdefault((kind, ""), []).append(placed)
    return {edge: _series(poses) for edge, poses in stamped.items()}


def _named_edge_of(transform: Any, name: str) -> tuple[Edge, Matrix]:  # noqa: ANN401
    try:
        return parse_edge(transform)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def read_static_transforms(bag: Bag) -> list[Any]:
    """Messages `TransformStamped` of what is mounted: those of tf that never change, and those of tf_static."""
    statics, sampled = [], dict[Edge, list[Any]]()
    for topic in bag.list_topics(TF):
        if topic.endswith("tf_static"):
            statics += [one for message in bag.read_messages(topic) for one in message.transforms]
        else:
            for edge, transforms in _sampled_transforms(bag, topic).items():
                sampled.setdefault(edge, []).extend(transforms)
    moving = {edge for edge, transforms in sampled.items() if not _never_changes(transforms)}
    if both := sorted(f"{parent} -> {child}" for parent, child in {parse_edge(one)[0] for one in statics} & moving):
        warnings.warn(
            f"{bag.path}: {', '.join(both)}: sent as static and as moving transforms; those that move are used",
            stacklevel=2,
        )
    constants = [transforms[0] for edge, transforms in sampled.items() if len(transforms) > 1 and edge not in moving]
    return [*constants, *(transform for transform in statics if parse_edge(transform)[0] not in moving)]


def _sampled_transforms(bag: Bag, topic: str) -> dict[Edge, list[Any]]:
    """The messages `TransformStamped` of a topic, at its beginning, in its middle and at its end."""
    sampled: dict[Edge, list[Any]] = {}
    logged_ns, read_ns = bag.get_log_times_ns(topic), 0
    for about_ns in (logged_ns[0], logged_ns[len(logged_ns) // 2], logged_ns[-1]):
        start_ns, read_ns = max(int(about_ns) - WINDOW_NS, read_ns), int(about_ns) + WINDOW_NS
        for message in bag.read_messages(topic, start_ns, read_ns):
            for transform in message.transforms:
                edge = normalize_frame_id(transform.header.frame_id), normalize_frame_id(transform.child_frame_id)
                sampled.setdefault(edge, []).append(transform)
    return sampled


def _never_changes(transforms: Sequence[Any]) -> bool:
    mounts = np.array([parse_edge(transform)[1] for transform in transforms])
    return bool(np.abs(mounts - mounts[0]).max() < STATIC_TOLERANCE)


def find_vehicle_poses(bag: Bag, tree: FrameTree, vehicle_frame: str) -> list[VehiclePoses]:
    """What says where the vehicle was, the best first: odometry, then a tree of frames, then poses."""
    found, lost = [], []
    for topic in sorted(bag.list_topics(ODOMETRY), key=lambda topic: -len(bag.get_log_times_ns(topic))):
        child = (
            normalize_frame_id(bag.read_message(topic, int(bag.get_log_times_ns(topic)[0])).child_frame_id)
            or vehicle_frame
        )
        child_T_vehicle = tree.lookup_transform(child, vehicle_frame)
        if child_T_vehicle is None:
            lost.append(f"{topic} ({child})")
        else:
            found.append(VehiclePoses(bag, topic, ((ODOMETRY, ""), child_T_vehicle), f"{topic} (odometry of {child})"))
    for topic in bag.list_topics(TF):
        if not topic.endswith("tf_static"):
            found += _of_tree(bag, topic, tree, vehicle_frame)
    found += [VehiclePoses(bag, topic, ((POSE, ""),), f"{topic} (poses)") for topic in bag.list_topics(POSE)]
    if lost and not found:
        raise ValueError(f"no static transform links to {vehicle_frame} the frame of the odometry {', '.join(lost)}")
    return found


def _of_tree(bag: Bag, topic: str, tree: FrameTree, vehicle_frame: str) -> list[VehiclePoses]:
    """Poses from a topic of transforms, in each frame that they lead to from the vehicle; the best first."""
    sampled = _sampled_transforms(bag, topic)
    counts = {edge: len(transforms) for edge, transforms in sampled.items()}
    moving = {edge: count for edge, count in counts.items() if not _never_changes(sampled[edge])}
    # Of a vehicle that stood still all the time, all transforms look as if they were mounts.
    still = tree.remove_edges(counts)
    ways = _ways_to_worlds(moving, tree, vehicle_frame) or _ways_to_worlds(counts, still, vehicle_frame)
    above = [f"{parent} -> {child}" for parent, child in counts if child in still.find_mounted_frames(vehicle_frame)]
    if above and not ways:
        raise ValueError(f"{topic}: {', '.join(above)}: the transforms from {vehicle_frame} upward are a loop")
    if unused := _unused_edges(moving, tree, list(ways.values())):
        warnings.warn(
            f"{bag.path}: {topic}: {', '.join(unused)}: not used, since poses are taken on another way", stacklevel=2
        )
    return [VehiclePoses(bag, topic, way, f"{topic} ({vehicle_frame} in {world})") for world, way in ways.items()]


def _unused_edges(moving: Mapping[Edge, int], tree: FrameTree, ways: Sequence[Sequence[Edge | Matrix]]) -> list[str]:
    """Name the transforms that move what the best way passes, and that are on no way."""
    edges = [{link for link in way if isinstance(link, tuple)} for way in ways]
    passed = set[str]().union(*(tree.find_mounted_frames(child) for _, child in (edges[0] if edges else ())))
    used = set[Edge]().union(*edges)
    return sorted(f"{parent} -> {child}" for parent, child in moving if child in passed and (parent, child) not in used)


def _ways_to_worlds(moving: Mapping[Edge, int], tree: FrameTree, vehicle_frame: str) -> dict[str, list[Edge | Matrix]]:
    """Each frame that moves in no other -> links from it to the vehicle; `odom` first, then that of most messages.

    Transforms that move are followed from child to parent, mounts both ways; every frame is reached by the fewest.
    """
    ways: dict[str, list[Edge | Matrix]] = {vehicle_frame: []}
    rates: dict[str, tuple[bool, int]] = {}
    queue = [vehicle_frame]
    for frame in queue:
        way = ways[frame]
        here = tree.find_mounted_frames(frame)
        is_world = frame == WORLD or not any(child in here for _, child in moving)
        if way and isinstance(way[0], tuple) and is_world:
            rates[frame] = frame == WORLD, min(moving[link] for link in way if isinstance(link, tuple))
            continue
        onward: list[tuple[str, Edge | Matrix]] = [(edge[0], edge) for edge in moving if edge[1] == frame]
        onward += [(there, invert(here_T_there)) for there, here_T_there in tree.list_neighbors(frame)]
        for there, link in onward:
            if there not in ways:
                ways[there] = [link, *way]
                queue.append(there)
    return {world: ways[world] for world in sorted(rates, key=lambda world: rates[world], reverse=True)}


def _series(stamped: Sequence[tuple[int, Matrix]]) -> PoseSeries:
    poses, apart_m = dict[int, Matrix](), 0.0
    for time_ns, pose in stamped:
        apart_m = max(apart_m, float(np.linalg.norm(poses.get(time_ns, pose)[:3, 3] - pose[:3, 3])))
        poses[time_ns] = pose
    times_ns = np.array(sorted(poses), dtype=np.int64)
    sorted_poses = np.array([poses[int(time_ns)] for time_ns in times_ns])
    wxyz = np.array([convert_rotation_to_quaternion(pose[:3, :3]) for pose in sorted_poses])
    return PoseSeries(times_ns, sorted_poses[:, :3, 3], wxyz, apart_m)
