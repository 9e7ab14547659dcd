"""Poses in a bag: static transforms between frames, and interpolated poses of the vehicle from odometry or tf."""

import warnings
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from torchcover.files import report_bad_file
from torchcover.geometry import (
    build_transform,
    convert_quaternion_to_rotation,
    convert_rotation_to_quaternion,
    interpolate_quaternions,
    invert,
)
from torchcover.geometry.arrays import Bools, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.bag import TF_TYPE, Bag, get_stamp_ns

Edge = tuple[str, str]  # parent frame, child frame
# Entries of two equal 4x4 transforms differ by rounding only.
MOUNT_TOLERANCE = 1e-3
# Message types with poses of the vehicle, besides transforms.
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSE_TYPE = "geometry_msgs/msg/PoseStamped"
# Messages are logged at most this long after they were stamped.
WINDOW_NS = 1_000_000_000


@dataclass(frozen=True)
class PoseSeriesParams:
    """Parameters of the interpolation of poses.

    Args:
        max_gap_s: Poses further apart in time are not interpolated.
        max_extrapolation_s: Poses are extrapolated this long before the first and after the last.
        min_zigzag_m: Distance from the middle of the neighboring poses that a vehicle cannot have.
        min_zigzag_share: Share of such poses from which two senders are assumed.
    """

    max_gap_s: float = 1.0
    max_extrapolation_s: float = 0.15
    min_zigzag_m: float = 0.1
    min_zigzag_share: float = 0.2


class FrameTree:
    """Graph of static transforms from parent to child frames.

    A child may have several parents, which tf2 forbids but bags contain: the path with the fewest transforms counts,
    and the later transform of the same edge.

    Args:
        transforms: Messages `geometry_msgs/msg/TransformStamped`.
    """

    def __init__(self, transforms: Iterable[Any]) -> None:
        self._mounts: dict[Edge, Matrix] = {}
        self._edges_by_frame: dict[str, dict[Edge, None]] = {}
        self._replaced: dict[Edge, Matrix] = {}
        for transform in transforms:
            edge, parent_T_child = parse_edge(transform)
            earlier = self._mounts.pop(edge, parent_T_child)
            if np.abs(earlier - parent_T_child).max() > MOUNT_TOLERANCE:
                self._replaced[edge] = earlier
            self._insert(edge, parent_T_child)
        check_transform_count(self._mounts)

    def _insert(self, edge: Edge, parent_T_child: Matrix) -> None:
        """Insert a transform as the latest one."""
        self._mounts[edge] = parent_T_child
        for frame in edge:
            edges = self._edges_by_frame.setdefault(frame, {})
            edges.pop(edge, None)
            edges[edge] = None

    def add(self, parent: str, child: str, parent_T_child: Matrix) -> None:
        """Add a transform unless both frames are already connected.

        Args:
            parent: Parent frame.
            child: Child frame.
            parent_T_child: (4, 4) transform.
        """
        if child not in self.find_transforms(parent):
            self._insert((parent, child), parent_T_child)

    def remove_edges(self, edges: Container[Edge]) -> "FrameTree":
        """Return a tree without some of the transforms.

        Args:
            edges: Edges to remove.
        """
        tree = FrameTree(())
        for edge, mount in self._mounts.items():
            if edge not in edges:
                tree._insert(edge, mount)
        return tree

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return set[str]().union(*self._mounts)

    def list_neighbors(self, frame: str) -> Iterator[tuple[str, Matrix]]:
        """List the frames that one transform connects to a frame, the latest transforms first.

        Args:
            frame: Name of the frame.

        Yields:
            Neighbor and `frame_T_neighbor`.
        """
        for parent, child in reversed(self._edges_by_frame.get(frame, {})):
            parent_T_child = self._mounts[parent, child]
            if parent == frame:
                yield child, parent_T_child
            else:
                yield parent, invert(parent_T_child)

    def find_transforms(self, frame: str) -> dict[str, Matrix]:
        """Find the frames that are connected to a frame, including itself, by breadth-first search.

        Args:
            frame: Name of the frame.

        Returns:
            Name of each frame and the (4, 4) `frame_T_other`.
        """
        transforms = {frame: np.eye(4)}
        queue = [frame]
        for current in queue:
            for neighbor, current_T_neighbor in self.list_neighbors(current):
                if neighbor not in transforms:
                    transforms[neighbor] = transforms[current] @ current_T_neighbor
                    queue.append(neighbor)
        return transforms

    def find_clashes(self, frame: str) -> list[str]:
        """Find transforms that contradict the used paths to a frame.

        Args:
            frame: Name of the frame.

        Returns:
            Sentences about the first three of them.
        """
        clashes = []
        for (parent, child), earlier in self._replaced.items():
            difference = _format_difference(earlier, self._mounts[parent, child])
            clashes.append(f"{parent} -> {child} is sent with two values, {difference} apart: the later one is used")
        transforms = self.find_transforms(frame)
        for (parent, child), mount in self._mounts.items():
            if len(clashes) >= 3:
                break
            if parent not in transforms or child not in transforms:
                continue
            used = invert(transforms[parent]) @ transforms[child]
            if np.abs(used - mount).max() > MOUNT_TOLERANCE:
                used_edges = []
                for other_parent, other_child in self._mounts:
                    if other_child == child and other_parent != parent:
                        used_edges.append(f"{other_parent} -> {child}")
                used_path = " and ".join(used_edges) or f"the other transforms from {frame} on"
                difference = _format_difference(used, mount)
                clashes.append(f"{parent} -> {child} is not used: it is {difference} off {used_path}")
        return clashes[:3]


def check_transform_count(edges: Sized) -> None:
    """Check the number of transforms, because the search of paths takes quadratic time and memory.

    Args:
        edges: Different pairs of parent and child.

    Raises:
        ValueError: There are too many.
    """
    max_transforms = 5000  # robots have tens to hundreds of frames
    if len(edges) > max_transforms:
        raise ValueError(f"{len(edges):,} transforms between different frames; at most {max_transforms:,} are read")


def normalize_frame_id(frame_id: str) -> str:
    """Remove the leading slash of a frame name, which older tools write.

    Args:
        frame_id: Name in a message.
    """
    return str(frame_id).removeprefix("/")


def parse_edge(message: Any, source: str = "") -> tuple[Edge, Matrix]:  # noqa: ANN401  (of a type that rosbags creates)
    """Parse a message `TransformStamped`.

    Args:
        message: Message of rosbags.
        source: Prefix of messages.

    Returns:
        Parent and child frame, and the (4, 4) `parent_T_child`.

    Raises:
        ValueError: Coordinates are not finite, or the quaternion is 0.
    """
    parent, child = normalize_frame_id(message.header.frame_id), normalize_frame_id(message.child_frame_id)
    return (parent, child), parse_pose(message.transform.translation, message.transform.rotation, f"{source}{child}")


def parse_pose(translation: Any, rotation: Any, name: str) -> Matrix:  # noqa: ANN401  (of types that rosbags creates)
    """Parse a position and a quaternion.

    Args:
        translation: Message with x, y and z.
        rotation: Message with x, y, z and w.
        name: Frame or topic, for messages.

    Returns:
        (4, 4) transform.

    Raises:
        ValueError: Coordinates are not finite, or the quaternion is 0.
    """
    position_m = np.array([translation.x, translation.y, translation.z], dtype=np.float64)
    if not np.isfinite(position_m).all():
        raise ValueError(f"{name}: three finite coordinates are needed; got {position_m.tolist()}")
    try:
        return build_transform(
            convert_quaternion_to_rotation([rotation.w, rotation.x, rotation.y, rotation.z]), position_m
        )
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _format_difference(first: Matrix, second: Matrix) -> str:
    """Format distance and angle between two transforms."""
    first_T_second = invert(first) @ second
    angle_deg = np.rad2deg(np.arccos(np.clip((np.trace(first_T_second[:3, :3]) - 1) / 2, -1, 1)))
    return f"{np.linalg.norm(first_T_second[:3, 3]):.3g} m and {angle_deg:.3g} degrees"


class PoseSeries(NamedTuple):
    """Poses at ascending times.

    Args:
        times_ns: (K,) stamps.
        positions_m: (K, 3) positions.
        wxyz: (K, 4) unit quaternions.
        max_disagreement_m: Largest distance between poses of the same time.
        params: Limits of interpolation.
    """

    times_ns: Int64
    positions_m: Matrix
    wxyz: Matrix
    max_disagreement_m: float = 0.0
    params: PoseSeriesParams = PoseSeriesParams()

    def interpolate(self, times_ns: Int64, name: str) -> Matrix:
        """Interpolate positions linearly and rotations by slerp.

        Args:
            times_ns: (N,) times of the result.
            name: Topic, for messages.

        Returns:
            (N, 4, 4) poses.

        Raises:
            ValueError: A time lies in a gap, or too far before the first or after the last pose.
        """
        max_gap_s = self.params.max_gap_s
        if len(self.times_ns) < 2:
            raise ValueError(f"{name}: poses on both sides of the time {int(times_ns[0])} ns are needed; got fewer")
        after = np.searchsorted(self.times_ns, times_ns).clip(1, len(self.times_ns) - 1)
        start_ns, gap_ns = self.times_ns[after - 1], np.diff(self.times_ns)[after - 1]
        since_s, gap_s = (times_ns - start_ns) * 1e-9, gap_ns * 1e-9
        is_in_gap = (gap_s > max_gap_s) & (since_s > 0) & (since_s < gap_s)
        if is_in_gap.any():
            raise ValueError(
                f"{name}: the poses before and after the time {int(times_ns[is_in_gap][0])} ns are "
                f"{gap_s[is_in_gap].max():.3g} s apart; poses are interpolated over at most {max_gap_s:g} s: record "
                "more often, or give poses of all times"
            )
        is_too_far = np.maximum(-since_s, since_s - gap_s) > self.params.max_extrapolation_s
        if is_too_far.any():
            distance_s = np.minimum(np.abs(since_s), np.abs(since_s - gap_s))[is_too_far].max()
            raise ValueError(
                f"{name}: the pose nearest to the time {int(times_ns[is_too_far][0])} ns is {distance_s:.3f} s off; do "
                "the clocks of the sensors match?"
            )
        share = (since_s / gap_s)[:, None]
        first_m, second_m = self.positions_m[after - 1], self.positions_m[after]
        rotations = convert_quaternion_to_rotation(
            interpolate_quaternions(self.wxyz[after - 1], self.wxyz[after], share)
        )
        return build_transform(rotations, first_m + share * (second_m - first_m))

    def estimate_zigzag_m(self) -> float:
        """Estimate how far poses jump to and fro in meters; 0 if a vehicle can move like that."""
        first_ns, middle_ns, last_ns = self.times_ns[:-2], self.times_ns[1:-1], self.times_ns[2:]
        share = ((middle_ns - first_ns) / (last_ns - first_ns))[:, None]
        expected_m = self.positions_m[:-2] + share * (self.positions_m[2:] - self.positions_m[:-2])
        deviations_m = np.linalg.norm(self.positions_m[1:-1] - expected_m, axis=1)
        is_near = last_ns - first_ns < self.params.max_gap_s * 1e9
        jumps_m = deviations_m[(deviations_m > self.params.min_zigzag_m) & is_near]
        has_zigzag = len(jumps_m) > self.params.min_zigzag_share * len(deviations_m)
        return float(np.median(jumps_m)) if has_zigzag else 0.0


class VehiclePoses:
    """Poses of the vehicle frame from a topic of a bag.

    Args:
        bag: Bag.
        topic: Topic of odometry, transforms or poses.
        links: Transforms from the world to the vehicle: keys of `build_pose_series`, or static (4, 4) transforms.
        source: Description of the topic, for messages.
    """

    def __init__(self, bag: Bag, topic: str, links: Sequence[Edge | Matrix], source: str) -> None:
        self.source = source
        self._bag, self._topic, self._links = bag, topic, links
        log_times_ns = bag.get_log_times_ns(topic)
        self._window_ns = WINDOW_NS
        self._cached: tuple[int, Mapping[Edge, PoseSeries]] = (-1, {})  # log time, series around it
        first, last = self._read_series(int(log_times_ns[0])), self._read_series(int(log_times_ns[-1]))
        starts_ns, stops_ns, self.max_disagreement_m = list[int](), list[int](), 0.0
        for link in links:
            if isinstance(link, tuple):
                starts_ns.append(int(first[link].times_ns[0]))
                stops_ns.append(int(last[link].times_ns[-1]) if link in last else 0)
                for series in (first[link], last.get(link, first[link])):
                    disagreement_m = max(series.max_disagreement_m, series.estimate_zigzag_m())
                    self.max_disagreement_m = max(self.max_disagreement_m, disagreement_m)
        start_ns, stop_ns = max(starts_ns), min(stops_ns)
        self._span_ns = (start_ns, stop_ns)
        # A bag that was recorded while another one was replayed slowly needs longer windows of its log times. Bags are
        # replayed at least at a hundredth of real time.
        slowness = (log_times_ns[-1] - log_times_ns[0]) / max(stop_ns - start_ns, 1)
        self._window_ns = round(WINDOW_NS * np.clip(slowness, 1.0, 100.0))

    def mask_covered_times(self, times_ns: Int64, margin_s: float = 0.0) -> Bools:
        """Mask the times for which a pose can be interpolated or extrapolated.

        Args:
            times_ns: (N,) times.
            margin_s: Part of the extrapolation that is not used.

        Returns:
            (N,) mask.
        """
        margin_ns = (PoseSeriesParams().max_extrapolation_s - margin_s) * 1e9
        return (self._span_ns[0] - margin_ns <= times_ns) & (times_ns <= self._span_ns[1] + margin_ns)

    def interpolate(self, times_ns: Int64, log_time_ns: int) -> Matrix:
        """Interpolate the poses of the vehicle.

        Args:
            times_ns: (N,) times of the result.
            log_time_ns: Log time of messages with about these times.

        Returns:
            (N, 4, 4) `world_T_vehicle`.

        Raises:
            BadFileError: Poses are missing or invalid.
        """
        with report_bad_file(self._bag.path, "a bag"):
            series = self._read_series(log_time_ns)
            world_T_current = np.broadcast_to(np.eye(4), (len(times_ns), 4, 4))
            for link in self._links:
                if isinstance(link, tuple):
                    if link not in series:
                        raise ValueError(f"{self._topic}: no pose within 1 s of {log_time_ns}")
                    world_T_current = world_T_current @ series[link].interpolate(times_ns, self._topic)
                else:
                    world_T_current = world_T_current @ link
            return world_T_current

    def _read_series(self, log_time_ns: int) -> Mapping[Edge, PoseSeries]:
        """Read the poses around a log time; the last result is cached."""
        if self._cached[0] != log_time_ns:
            start_ns, stop_ns = log_time_ns - self._window_ns, log_time_ns + self._window_ns
            messages = self._bag.read_messages(self._topic, start_ns, stop_ns)
            series = build_pose_series(messages, self._bag.type_by_topic[self._topic], self._topic)
            self._cached = (log_time_ns, series)
        return self._cached[1]


def build_pose_series(messages: Sequence[Any], message_type: str, name: str) -> dict[Edge, PoseSeries]:
    """Build the poses of each transform in messages.

    Args:
        messages: Messages of one topic.
        message_type: Type of the messages: odometry, transforms or poses.
        name: Topic, for error messages.

    Returns:
        Parent and child frame of each transform and its poses; `Odometry` and `PoseStamped` have the key (type, "").

    Raises:
        ValueError: Coordinates are not finite, or a quaternion is 0.
    """
    poses_by_edge: dict[Edge, list[tuple[int, Matrix]]] = {}
    for message in messages:
        if message_type == TF_TYPE:
            for transform in message.transforms:
                edge, pose = parse_edge(transform, f"{name}: ")
                poses_by_edge.setdefault(edge, []).append((get_stamp_ns(transform.header), pose))
        else:
            content = message.pose.pose if message_type == ODOMETRY_TYPE else message.pose
            pose = parse_pose(content.position, content.orientation, name)
            poses_by_edge.setdefault((message_type, ""), []).append((get_stamp_ns(message.header), pose))
    return {edge: _sort_poses(poses) for edge, poses in poses_by_edge.items()}


def read_static_transforms(bag: Bag) -> list[Any]:
    """Read the transforms of tf_static and the constant ones of tf.

    Args:
        bag: Bag.

    Returns:
        Messages `TransformStamped`; edges that move in tf are excluded.

    Warns:
        UserWarning: A transform is sent as static and as moving.
    """
    static: list[Any] = []
    sampled: dict[Edge, list[Any]] = {}
    for topic in bag.list_topics(TF_TYPE):
        if topic.endswith("tf_static"):
            for message in bag.read_messages(topic):
                static.extend(message.transforms)
        else:
            _sample_transforms(bag, topic, sampled)
    moving, transforms_at_rest = set[Edge](), list[Any]()
    for edge, transforms in sampled.items():
        if not _are_constant(transforms):
            moving.add(edge)
        elif len(transforms) > 1:
            transforms_at_rest.append(transforms[0])
    ambiguous = set[Edge]()
    for transform in static:
        edge = parse_edge(transform)[0]
        if edge in moving:
            ambiguous.add(edge)
        else:
            transforms_at_rest.append(transform)
    if ambiguous:
        names = ", ".join(_format_edges(ambiguous))
        warnings.warn(
            f"{bag.path}: {names}: sent as static and as moving transforms; those that move are used", stacklevel=2
        )
    return transforms_at_rest


def _format_edges(edges: Iterable[Edge]) -> list[str]:
    """Format transforms by their frames, sorted."""
    return sorted(" -> ".join(edge) for edge in edges)


def _sample_transforms(bag: Bag, topic: str, sampled: dict[Edge, list[Any]]) -> None:
    """Add the messages `TransformStamped` at the beginning, in the middle and at the end of a topic to `sampled`."""
    log_times_ns, stop_ns = bag.get_log_times_ns(topic), 0
    for center_ns in (log_times_ns[0], log_times_ns[len(log_times_ns) // 2], log_times_ns[-1]):
        start_ns, stop_ns = max(int(center_ns) - WINDOW_NS, stop_ns), int(center_ns) + WINDOW_NS
        for message in bag.read_messages(topic, start_ns, stop_ns):
            for transform in message.transforms:
                edge = normalize_frame_id(transform.header.frame_id), normalize_frame_id(transform.child_frame_id)
                sampled.setdefault(edge, []).append(transform)
    check_transform_count(sampled)


def _are_constant(transforms: Sequence[Any]) -> bool:
    """Test whether all transforms of an edge are equal up to rounding."""
    matrices = np.array([parse_edge(transform)[1] for transform in transforms])
    tolerance = 1e-6  # repeated static transforms differ by rounding only
    return bool(np.abs(matrices - matrices[0]).max() < tolerance)


def find_vehicle_poses(bag: Bag, tree: FrameTree, vehicle_frame: str) -> list[VehiclePoses]:
    """Find the topics with poses of the vehicle.

    Args:
        bag: Bag.
        tree: Static transforms.
        vehicle_frame: Frame of the vehicle.

    Returns:
        Sources of poses in the order odometry, transforms, poses.

    Raises:
        ValueError: Odometry exists, but its frame is not connected to the vehicle frame.
    """
    sources, unconnected = [], []
    for topic in sorted(bag.list_topics(ODOMETRY_TYPE), key=lambda topic: -len(bag.get_log_times_ns(topic))):
        message = bag.read_message(topic, int(bag.get_log_times_ns(topic)[0]))
        child = normalize_frame_id(message.child_frame_id) or vehicle_frame
        child_T_vehicle = tree.find_transforms(child).get(vehicle_frame)
        if child_T_vehicle is None:
            unconnected.append(f"{topic} ({child})")
        else:
            links = ((ODOMETRY_TYPE, ""), child_T_vehicle)
            sources.append(VehiclePoses(bag, topic, links, f"{topic} (odometry of {child})"))
    for topic in bag.list_topics(TF_TYPE):
        if not topic.endswith("tf_static"):
            sources += _find_tree_poses(bag, topic, tree, vehicle_frame)
    for topic in bag.list_topics(POSE_TYPE):
        sources.append(VehiclePoses(bag, topic, ((POSE_TYPE, ""),), f"{topic} (poses)"))
    if unconnected and not sources:
        names = ", ".join(unconnected)
        raise ValueError(f"no static transform links to {vehicle_frame} the frame of the odometry {names}")
    return sources


def _find_tree_poses(bag: Bag, topic: str, tree: FrameTree, vehicle_frame: str) -> list[VehiclePoses]:
    """Find poses of the vehicle in each world frame of a topic of transforms, the best first."""
    sampled: dict[Edge, list[Any]] = {}
    _sample_transforms(bag, topic, sampled)
    counts = {edge: len(transforms) for edge, transforms in sampled.items()}
    moving = {edge: count for edge, count in counts.items() if not _are_constant(sampled[edge])}
    # If the vehicle never moves, all transforms look static.
    static_tree = tree.remove_edges(counts)
    paths = _find_world_paths(moving, tree, vehicle_frame) or _find_world_paths(counts, static_tree, vehicle_frame)
    mounted = static_tree.find_transforms(vehicle_frame)
    parents = [f"{parent} -> {child}" for parent, child in counts if child in mounted]
    if parents and not paths:
        raise ValueError(f"{topic}: {', '.join(parents)}: the transforms from {vehicle_frame} upward are a loop")
    unused = _list_unused_edges(moving, tree, list(paths.values()))
    if unused:
        warnings.warn(
            f"{bag.path}: {topic}: {', '.join(unused)}: not used, since poses are read along another path",
            stacklevel=2,
        )
    return [VehiclePoses(bag, topic, path, f"{topic} ({vehicle_frame} in {world})") for world, path in paths.items()]


def _list_unused_edges(
    moving: Mapping[Edge, int], tree: FrameTree, paths: Sequence[Sequence[Edge | Matrix]]
) -> list[str]:
    """List the transforms that move frames of the best path and are on no path."""
    used, passed_frames = set[Edge](), set[str]()
    for path in paths:
        for link in path:
            if isinstance(link, tuple):
                used.add(link)
                if path is paths[0] and link[1] not in passed_frames:
                    passed_frames.update(tree.find_transforms(link[1]))
    return _format_edges(edge for edge in moving if edge[1] in passed_frames and edge not in used)


def _find_world_paths(
    moving: Mapping[Edge, int], tree: FrameTree, vehicle_frame: str
) -> dict[str, list[Edge | Matrix]]:
    """Find the links from each world frame to the vehicle; `odom` first, then the frame with most messages.

    A world frame moves in no other frame. Moving transforms are followed from child to parent, static ones in both
    directions; every frame is reached by the fewest transforms.
    """
    paths: dict[str, list[Edge | Matrix]] = {vehicle_frame: []}
    ranks: dict[str, tuple[bool, int]] = {}
    mounted_by_frame: dict[str, set[str]] = {}
    queue = [vehicle_frame]
    for frame in queue:
        path = paths[frame]
        if frame not in mounted_by_frame:
            mounted_frames = set(tree.find_transforms(frame))
            mounted_by_frame.update(dict.fromkeys(mounted_frames, mounted_frames))
        mounted = mounted_by_frame[frame]
        is_odom = frame == "odom"  # this frame never jumps (REP-105)
        is_world = is_odom or not any(child in mounted for _, child in moving)
        if path and isinstance(path[0], tuple) and is_world:
            ranks[frame] = is_odom, min(moving[link] for link in path if isinstance(link, tuple))
            continue
        neighbors: list[tuple[str, Edge | Matrix]] = []
        for edge in moving:
            if edge[1] == frame:
                neighbors.append((edge[0], edge))
        for neighbor, frame_T_neighbor in tree.list_neighbors(frame):
            neighbors.append((neighbor, invert(frame_T_neighbor)))
        for neighbor, link in neighbors:
            if neighbor not in paths:
                paths[neighbor] = [link, *path]
                queue.append(neighbor)
    return {world: paths[world] for world in sorted(ranks, key=ranks.__getitem__, reverse=True)}


def _sort_poses(stamped_poses: Sequence[tuple[int, Matrix]]) -> PoseSeries:
    """Sort poses by stamp; the last pose of a stamp counts."""
    poses: dict[int, Matrix] = {}
    max_disagreement_m = 0.0
    for stamp_ns, pose in stamped_poses:
        distance_m = float(np.linalg.norm(poses.get(stamp_ns, pose)[:3, 3] - pose[:3, 3]))
        max_disagreement_m = max(max_disagreement_m, distance_m)
        poses[stamp_ns] = pose
    times_ns, sorted_poses, wxyz = sorted(poses), [], []
    for stamp_ns in times_ns:
        sorted_poses.append(poses[stamp_ns])
        wxyz.append(convert_rotation_to_quaternion(poses[stamp_ns][:3, :3]))
    positions_m = np.array(sorted_poses)[:, :3, 3]
    return PoseSeries(np.array(times_ns, dtype=np.int64), positions_m, np.array(wxyz), max_disagreement_m)
