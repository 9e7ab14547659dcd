"""What every source of frames says of itself, be it a simulation, a recording or another format."""

import operator
import re
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, SupportsIndex, TypeVar, overload, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset, Subset

from torchcover.frames.frame import Frame

if TYPE_CHECKING:  # what they are is no matter of frames; who draws or measures them knows
    from torchcover.simulation import Mesh, Sensor

ValueT = TypeVar("ValueT")


class BadFrameError(ValueError):
    """One frame of a recording cannot be used; the others can.

    `name` and `index` say which frame. A caller that skips bad frames catches this around `next`, with and without
    worker processes.

    Args:
        message: `NAME (frame INDEX): reason`, or a worker's traceback that ends in it: DataLoader knows no other way to
            build an exception again than from its text.

    Example:
        >>> error = BadFrameError("night_7 (frame 6): the reference cloud has no points")
        >>> error.name, error.index
        ('night_7', 6)
    """

    def __init__(self, message: str) -> None:
        super().__init__(message.rpartition("BadFrameError: ")[2].strip())
        parts = re.match(r"(?P<name>.*?) \(frame (?P<index>\d+)\): ", str(self))
        self.name = parts["name"] if parts else ""
        self.index = int(parts["index"]) if parts else -1


@runtime_checkable
class FrameSource(Protocol):
    """A map-style torch Dataset of frames that knows whose they are and where they come from.

    A format of recordings is a class like this that is made from a path; see `FORMATS`.
    """

    @property
    def rigs(self) -> Collection[str]:
        """The names under which `Frame.clouds` has the rigs."""

    @property
    def sensors(self) -> Mapping[str, "Sequence[Sensor]"]:
        """The sensors of the rigs that they are known of, for drawings; may be empty."""

    @property
    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """The names of the sensors of those rigs whose `Frame.sensor_points` says which points are of which sensor."""

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """(K, 2) corners x, y of the ego in the vehicle frame in metres; None if unknown."""

    @property
    def description(self) -> Mapping[str, object]:
        """Where the frames come from, for `summary.json`: `scenario`, `vehicle` and `seed`, or `frames`; else None."""

    @property
    def has_area_weights(self) -> bool:
        """Whether all frames have `Frame.reference_weights`, the square metres of reference points; else none has."""

    @property
    def reference_record(self) -> Mapping[str, object] | None:
        """Where the reference comes from, for `summary.json`: `sensor` and its settings; None if unknown.

        It has `notes`, sentences that a reader of the numbers has to know, and if it was simulated `frame_interval_s`.
        """

    @property
    def content(self) -> Mapping[str, object]:
        """All that the frames depend on, under the names that a message calls it by; for JSON.

        A checkpoint is of frames of this content: it changes if, and only if, a frame may be another one. What is large
        may be a hash.
        """

    def get_scene_id(self, index: int, /) -> int:
        """Which world a frame is of, by any number: frames of one are made by one process, which builds it once.

        The index itself where nothing has to be built, so that any process may make any frame.
        """

    def get_block_index(self, index: int, /) -> int:
        """`Frame.block_index` of a frame, without making it; of a simulation beyond its last frame, too.

        IndexError: there is no such frame.
        """

    def has_boxes(self) -> bool:
        """Whether frames have `Frame.boxes`."""

    def has_heights(self) -> bool:
        """Whether frames have `Frame.reference_heights_m`: then height bands are over the ground by default."""

    def get_ego_mesh(self) -> "Mesh | None":
        """The body of the ego in the vehicle frame; None if unknown."""

    def check(self, num_frames: int | None, /) -> Sequence[str]:
        """What looks wrong about so many frames (None: all), a sentence each: warnings before they are measured."""

    def __len__(self) -> int:
        """Number of frames."""

    def __getitem__(self, index: int, /) -> Frame:
        """One frame. BadFrameError: it cannot be used; the others can."""


def build_scene_lookup(frames: object) -> Callable[[int], int]:
    """`FrameSource.get_scene_id` of any map-style dataset or list of frames.

    A list holds what was made before; a torch `Subset` has the worlds of what it is of.

    Raises:
        TypeError: A dataset that does not say which world a frame is of.

    Example:
        >>> build_scene_lookup(["a frame", "another one"])(1)
        1
    """
    if hasattr(frames, "get_scene_id"):
        get_scene_id: Callable[[int], int] = frames.get_scene_id
        return get_scene_id
    if isinstance(frames, Sequence):
        return int
    if hasattr(frames, "dataset") and hasattr(frames, "indices"):
        whole, indices = build_scene_lookup(frames.dataset), frames.indices
        return lambda index: whole(indices[index])
    raise TypeError(
        f"frames: {type(frames).__name__} does not say which world a frame is of, so that each process would build "
        "every world; give it get_scene_id(index), see FrameSource, or use a single process"
    )


class FrameDataset(Dataset[Frame]):
    """A map-style torch Dataset of frames that a `for` loop goes through in order.

    A `FrameSource` that is one of these has to say of the rest of itself only what there is to say.
    """

    @property
    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """Nothing: which points are of which sensor is unknown."""
        return {}

    def get_block_index(self, index: int) -> int:
        """The index: no two frames are known to be alike. IndexError: there is no such frame."""
        return range(len(self))[index]

    def has_boxes(self) -> bool:
        """None of them."""
        return False

    def has_heights(self) -> bool:
        """None of them."""
        return False

    def get_ego_mesh(self) -> "Mesh | None":
        """Unknown."""
        return None

    def check(self, num_frames: int | None) -> Sequence[str]:
        """None."""
        return ()

    @abstractmethod
    def __len__(self) -> int:
        """Number of frames."""

    @overload
    def __getitem__(self, index: SupportsIndex, /) -> Frame: ...
    @overload
    def __getitem__(self, index: slice, /) -> Subset[Frame]: ...
    def __getitem__(self, index: SupportsIndex | slice, /) -> Frame | Subset[Frame]:
        """Make one frame, counted from the end if negative; a slice gives a `Subset`, which makes none yet.

        Raises:
            IndexError: There are fewer frames.
            BadFrameError: The frame cannot be used; the others can.
        """
        if isinstance(index, slice):
            return Subset(self, range(*index.indices(len(self))))
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"frame {position} of {len(self)}")
        return self._frame_at(position % len(self))

    def _frame_at(self, position: int) -> Frame:
        """Make the frame at a position from 0 to `len(self) - 1`."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[Frame]:
        """The frames, one after the other."""
        return (self[index] for index in range(len(self)))


class RigSubset(FrameDataset):
    """The same frames with the clouds of some rigs only, each under a name of one's own: a `FrameSource` of another.

    Args:
        frames: Where the frames come from.
        source_rigs: New name of each rig -> its name there, in the order that is wanted.

    Raises:
        ValueError: The source has no such rig.
    """

    def __init__(self, frames: FrameSource, source_rigs: Mapping[str, str]) -> None:
        unknown = [name for name in source_rigs.values() if name not in frames.rigs]
        if unknown:
            raise ValueError(f"no clouds of the rig {', '.join(unknown)}; the frames have {', '.join(frames.rigs)}")
        self.frames = frames
        self.source_rigs = dict(source_rigs)

    @property
    def rigs(self) -> tuple[str, ...]:
        """The new names."""
        return tuple(self.source_rigs)

    @property
    def sensors(self) -> Mapping[str, "Sequence[Sensor]"]:
        """The sensors of these rigs that they are known of."""
        return self._chosen(self.frames.sensors)

    @property
    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """Those of these rigs, as far as they are known."""
        return self._chosen(self.frames.sensor_names)

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """As there."""
        return self.frames.ego_outline_m

    def get_scene_id(self, index: int) -> int:
        """As there."""
        return self.frames.get_scene_id(index)

    def get_block_index(self, index: int) -> int:
        """As there."""
        return self.frames.get_block_index(index)

    def has_boxes(self) -> bool:
        """As there."""
        return self.frames.has_boxes()

    def has_heights(self) -> bool:
        """As there."""
        return self.frames.has_heights()

    def get_ego_mesh(self) -> "Mesh | None":
        """As there."""
        return self.frames.get_ego_mesh()

    def check(self, num_frames: int | None) -> Sequence[str]:
        """As there."""
        return self.frames.check(num_frames)

    @property
    def description(self) -> Mapping[str, object]:
        """As there."""
        return self.frames.description

    @property
    def has_area_weights(self) -> bool:
        """As there."""
        return self.frames.has_area_weights

    @property
    def reference_record(self) -> Mapping[str, object] | None:
        """As there."""
        return self.frames.reference_record

    @property
    def content(self) -> Mapping[str, object]:
        """As there, and which rigs."""
        return {**self.frames.content, "rigs of the recording": self.source_rigs}

    def __len__(self) -> int:
        return len(self.frames)

    def _frame_at(self, position: int) -> Frame:
        frame = self.frames[position]
        boxes = (
            None if frame.boxes is None else replace(frame.boxes, points_in_box=self._chosen(frame.boxes.points_in_box))
        )
        points = None if frame.sensor_point_counts is None else self._chosen(frame.sensor_point_counts)
        clouds = {name: frame.get_cloud(of) for name, of in self.source_rigs.items()}
        measured = self._chosen(frame.measurements)
        return replace(frame, clouds=clouds, boxes=boxes, sensor_point_counts=points, measurements=measured)

    def _chosen(self, by_rig: Mapping[str, ValueT]) -> dict[str, ValueT]:
        return {name: by_rig[of] for name, of in self.source_rigs.items() if of in by_rig}
