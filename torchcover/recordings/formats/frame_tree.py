"""Frames of ROS that are mounted on each other: static transforms, which may contradict each other."""

from collections.abc import Container, Iterable, Iterator
from typing import Any

import numpy as np

from torchcover.geometry import invert, rigid, rotation_from_quaternion
from torchcover.geometry.rigid import Matrix

# A transform from a parent frame to a child frame.
Edge = tuple[str, str]
# Numbers of two 4x4 transforms that are no farther apart are the same but for rounding.
SAME = 1e-3
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
            edge, parent_T_child = edge_of(transform)
            before = self._mounts.pop(edge, parent_T_child)
            if np.abs(before - parent_T_child).max() > SAME:
                self._repeated[edge] = before
            self._mounts[edge] = parent_T_child

    def add(self, parent: str, frame: str, parent_T_frame: Matrix) -> None:
        """Mount a frame, with all that it is mounted together with, if it is not mounted with this one yet."""
        if self.between(parent, frame) is None:
            self._mounts[parent, frame] = parent_T_frame

    def without(self, edges: Container[Edge]) -> "FrameTree":
        """The same without some of the transforms."""
        tree = FrameTree(())
        tree._mounts = {edge: mount for edge, mount in self._mounts.items() if edge not in edges}
        return tree

    def mounted_with(self, frame: str) -> set[str]:
        """The frame, and all that are mounted together with it."""
        return set(self._reached(frame))

    @property
    def frames(self) -> set[str]:
        """All frames that are named."""
        return {frame for edge in self._mounts for frame in edge}

    def neighbors(self, frame: str) -> Iterator[tuple[str, Matrix]]:
        """Yield each frame that one transform links to this one, and `this_T_that`; the later transforms first."""
        for (parent, child), parent_T_child in reversed(self._mounts.items()):
            if parent == frame:
                yield child, parent_T_child
            elif child == frame:
                yield parent, invert(parent_T_child)

    def between(self, destination: str, source: str) -> Matrix | None:
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
            if np.abs(used - mount).max() > SAME:
                others = [f"{one} -> {child}" for one, other in self._mounts if other == child and one != parent]
                named = " and ".join(others) or f"the other transforms from {frame} on"
                clashes.append(f"{parent} -> {child} is not used: it is {_difference(used, mount)} off {named}")
        return clashes[:MAX_NAMED]

    def _reached(self, frame: str) -> dict[str, Matrix]:
        """Each frame that is mounted together with this one, the nearest first -> `this_T_that`."""
        reached = {frame: np.eye(4)}
        for here, frame_T_here in _growing(reached):
            for there, here_T_there in self.neighbors(here):
                reached.setdefault(there, frame_T_here @ here_T_there)
        return reached


def _growing(reached: dict[str, Matrix]) -> Iterator[tuple[str, Matrix]]:
    """Yield the entries of a dict to which others are added meanwhile."""
    done = 0
    while done < len(reached):
        for frame in list(reached)[done:]:
            done += 1
            yield frame, reached[frame]


def frame_name(stored: str) -> str:
    """Return the name of a frame; older tools begin it with a slash."""
    return str(stored).removeprefix("/")


def edge_of(transform: Any) -> tuple[Edge, Matrix]:  # noqa: ANN401  (of a type that rosbags has made)
    """Return the parent and the child of a message `TransformStamped`, and `parent_T_child`."""
    parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
    return (parent, child), pose_of(transform.transform.translation, transform.transform.rotation, child)


def pose_of(place: Any, rotation: Any, name: str) -> Matrix:  # noqa: ANN401  (of types that rosbags has made)
    """(4, 4) of a place (or translation) and a quaternion."""
    place_m = np.array([place.x, place.y, place.z], dtype=np.float64)
    if not np.isfinite(place_m).all():
        raise ValueError(f"{name}: three finite coordinates are needed; got {place_m.tolist()}")
    try:
        return rigid(rotation_from_quaternion([rotation.w, rotation.x, rotation.y, rotation.z]), place_m)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _difference(first: Matrix, second: Matrix) -> str:
    apart = invert(first) @ second
    turn_deg = np.rad2deg(np.arccos(np.clip((np.trace(apart[:3, :3]) - 1) / 2, -1, 1)))
    return f"{np.linalg.norm(apart[:3, 3]):.3g} m and {turn_deg:.3g} degrees"
