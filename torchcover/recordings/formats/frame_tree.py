"""Frames of ROS that are mounted on each other: a tree of static transforms."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from torchcover.geometry import invert, rigid, rotation_from_quaternion
from torchcover.geometry.rigid import Matrix


class FrameTree:
    """Transforms of frames from their parents.

    `transforms`: messages `geometry_msgs/msg/TransformStamped`; of two for the same frame the later counts.
    """

    def __init__(self, transforms: Iterable[Any]) -> None:
        self._parents = {frame_name(one.child_frame_id): parent_of(one) for one in transforms}
        for frame in self._parents:
            self._way(frame)

    def add(self, parent: str, frame: str, parent_T_frame: Matrix) -> None:
        """Mount a frame, with all that it is mounted together with, if it is not mounted with this one yet."""
        if self.between(parent, frame) is None:
            root, root_T_frame = list(self._way(frame).items())[-1]
            self._parents[root] = (parent, parent_T_frame @ invert(root_T_frame))

    @property
    def frames(self) -> set[str]:
        """All that are named."""
        return set(self._parents) | {parent for parent, _ in self._parents.values()}

    def parent(self, frame: str) -> tuple[str, Matrix] | None:
        """What it is mounted on, and `that_T_frame`; None for a root."""
        return self._parents.get(frame)

    def between(self, destination: str, source: str) -> Matrix | None:
        """(4, 4) `destination_T_source`; None if the one is not mounted on what the other is."""
        from_source, from_destination = self._way(source), self._way(destination)
        common = next((frame for frame in from_source if frame in from_destination), None)
        return None if common is None else invert(from_destination[common]) @ from_source[common]

    def _way(self, frame: str) -> dict[str, Matrix]:
        """Each frame from this one to the root of its tree -> `that_T_this`."""
        way = {frame: np.eye(4)}
        this, here_T_frame = frame, np.eye(4)
        while this in self._parents:
            this, parent_T_this = self._parents[this]
            if this in way:
                raise ValueError(f"the frames {' -> '.join([*way, this])} are mounted on each other in a loop")
            here_T_frame = parent_T_this @ here_T_frame
            way[this] = here_T_frame
        return way


def frame_name(stored: str) -> str:
    """The name of a frame; older tools begin it with a slash."""
    return str(stored).removeprefix("/")


def parent_of(one: Any) -> tuple[str, Matrix]:  # noqa: ANN401  (of a type that rosbags has made)
    """What a message `TransformStamped` mounts its frame on, and `that_T_frame`."""
    child = frame_name(one.child_frame_id)
    return frame_name(one.header.frame_id), pose_of(one.transform.translation, one.transform.rotation, child)


def pose_of(place: Any, rotation: Any, name: str) -> Matrix:  # noqa: ANN401  (of types that rosbags has made)
    """(4, 4) of a place (or translation) and a quaternion."""
    place_m = np.array([place.x, place.y, place.z], dtype=np.float64)
    if not np.isfinite(place_m).all():
        raise ValueError(f"{name}: three finite coordinates are needed; got {place_m.tolist()}")
    try:
        return rigid(rotation_from_quaternion([rotation.w, rotation.x, rotation.y, rotation.z]), place_m)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
