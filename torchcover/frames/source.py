"""Interface of sources of frames: simulations, recordings and other formats."""

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

if TYPE_CHECKING:  # frames need neither class at run time
    from torchcover.simulation import Mesh, Sensor

ValueT = TypeVar("ValueT")


class BadFrameError(ValueError):
    """Error of one frame of a recording that cannot be used; other frames can.

    `name` and `index` identify the frame. A caller that skips bad frames catches this error around `next`, with and
    without worker processes.

    Args:
        message: `NAME (frame INDEX): reason`, or a worker's traceback that ends in it, since DataLoader rebuilds an
            exception from its text only.

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
    """Map-style torch dataset of frames with a description of its rigs and of its origin.

    A format of recordings is such a class that is constructed from a path; see `FORMATS`.
    """

    @property
    def rigs(self) -> Collection[str]:
        """Names of the rigs, the keys of `Frame.clouds`."""

    @property
    def sensors(self) -> Mapping[str, "Sequence[Sensor]"]:
        """Sensors of the rigs with known sensors, for plots; may be empty."""

    @property
    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """Sensor names of the rigs for which `Frame.sensor_point_counts` is known."""

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """(K, 2) corners x, y of the ego vehicle in the vehicle frame in meters; None if unknown."""

    @property
    def description(self) -> Mapping[str, object]:
        """Origin of the frames, for `summary.json`: `scenario`, `vehicle`, `seed` or `frames`; other keys are None."""

    @property
    def has_area_weights(self) -> bool:
        """True if all frames have `Frame.reference_weights`; False if none has."""

    @property
    def reference_record(self) -> Mapping[str, object] | None:
        """Origin of the reference points, for `summary.json`: `sensor` and its settings; None if unknown.

        It contains `notes`, sentences that the reader of the numbers needs, and for simulated frames
        `frame_interval_s`.
        """

    @property
    def content(self) -> Mapping[str, object]:
        """Inputs that determine the frames, as JSON values; the keys appear in messages.

        A checkpoint belongs to one content: it changes if, and only if, a frame may change. Large inputs may be hashed.
        """

    def get_scene_id(self, index: int, /) -> int:
        """Return the number of the scene of a frame.

        One process makes all frames of a scene, so that the scene is built once. Sources that build no scenes return
        the index, so that any process may make any frame.

        Args:
            index: Index of the frame.

        Returns:
            Any number that is equal for frames of one scene.
        """

    def get_block_index(self, index: int, /) -> int:
        """Return `Frame.block_index` of a frame without making the frame.

        Args:
            index: Index of the frame; a simulation accepts indices beyond its last frame.

        Returns:
            Block index.

        Raises:
            IndexError: The frame does not exist.
        """

    def has_boxes(self) -> bool:
        """Return whether frames have `Frame.boxes`."""

    def has_heights(self) -> bool:
        """Return whether frames have `Frame.reference_heights_m`, the condition for height bands above ground."""

    def get_ego_mesh(self) -> "Mesh | None":
        """Return the mesh of the ego vehicle in the vehicle frame; None if unknown."""

    def check(self, num_frames: int | None, /) -> Sequence[str]:
        """Return warnings about the frames, one sentence each, before they are evaluated.

        Args:
            num_frames: Number of frames to check, from the first; None for all.

        Returns:
            Warnings; empty if no problem is found.
        """

    def __len__(self) -> int:
        """Return the number of frames."""

    def __getitem__(self, index: int, /) -> Frame:
        """Return one frame, or raise `BadFrameError` if it cannot be used."""


def build_scene_lookup(frames: object) -> Callable[[int], int]:
    """Return the function `FrameSource.get_scene_id` for any map-style dataset or list of frames.

    Args:
        frames: Dataset with `get_scene_id`, a torch `Subset` of one, or a sequence of frames.

    Returns:
        Function from the index of a frame to the number of its scene; the index itself for a sequence.

    Raises:
        TypeError: A dataset without `get_scene_id`.

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
        get_dataset_scene_id, indices = build_scene_lookup(frames.dataset), frames.indices

        def get_subset_scene_id(index: int) -> int:
            return get_dataset_scene_id(indices[index])

        return get_subset_scene_id
    raise TypeError(
        f"frames: {type(frames).__name__} does not name the scene of a frame, so every process would build every "
        "scene; define get_scene_id(index), see FrameSource, or use a single process"
    )


class FrameDataset(Dataset[Frame]):
    """Base class of map-style torch datasets of frames that a `for` loop iterates in order.

    A `FrameSource` that derives from this class overrides only the methods for which it has information.
    """

    @property
    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """Empty: the sensor of each point is unknown."""
        return {}

    def get_block_index(self, index: int) -> int:
        """Return the index: each frame is independent; see `FrameSource.get_block_index`."""
        return range(len(self))[index]

    def has_boxes(self) -> bool:
        """Return False: frames have no boxes."""
        return False

    def has_heights(self) -> bool:
        """Return False: heights above ground are unknown."""
        return False

    def get_ego_mesh(self) -> "Mesh | None":
        """Return None: the ego vehicle is unknown."""
        return None

    def check(self, num_frames: int | None) -> Sequence[str]:
        """Return no warnings; see `FrameSource.check`."""
        return ()

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of frames."""

    @overload
    def __getitem__(self, index: SupportsIndex, /) -> Frame: ...
    @overload
    def __getitem__(self, index: slice, /) -> Subset[Frame]: ...
    def __getitem__(self, index: SupportsIndex | slice, /) -> Frame | Subset[Frame]:
        """Make one frame; negative indices count from the end; a slice returns a lazy `Subset`.

        Raises:
            IndexError: The frame does not exist.
            BadFrameError: The frame cannot be used; other frames can.
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
        """Iterate over the frames in order."""
        return (self[index] for index in range(len(self)))


class RigSubset(FrameDataset):
    """Frames of another source with the clouds of selected rigs under new names.

    Members without a description return the value of the source.

    Args:
        frames: Source of the frames.
        source_rigs: New name of each rig -> its name in the source, in the desired order.

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
        """New names of the rigs."""
        return tuple(self.source_rigs)

    @property
    def sensors(self) -> Mapping[str, "Sequence[Sensor]"]:
        """Known sensors of the selected rigs."""
        return self._rename_rigs(self.frames.sensors)

    @property
    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """Known sensor names of the selected rigs."""
        return self._rename_rigs(self.frames.sensor_names)

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """Outline from the source."""
        return self.frames.ego_outline_m

    def get_scene_id(self, index: int) -> int:
        """Return the scene number from the source; see `FrameSource.get_scene_id`."""
        return self.frames.get_scene_id(index)

    def get_block_index(self, index: int) -> int:
        """Return the block index from the source; see `FrameSource.get_block_index`."""
        return self.frames.get_block_index(index)

    def has_boxes(self) -> bool:
        """Return whether frames of the source have boxes."""
        return self.frames.has_boxes()

    def has_heights(self) -> bool:
        """Return whether frames of the source have heights above ground."""
        return self.frames.has_heights()

    def get_ego_mesh(self) -> "Mesh | None":
        """Return the ego vehicle of the source."""
        return self.frames.get_ego_mesh()

    def check(self, num_frames: int | None) -> Sequence[str]:
        """Return the warnings of the source; see `FrameSource.check`."""
        return self.frames.check(num_frames)

    @property
    def description(self) -> Mapping[str, object]:
        """Description from the source."""
        return self.frames.description

    @property
    def has_area_weights(self) -> bool:
        """True if reference points of the source have area weights."""
        return self.frames.has_area_weights

    @property
    def reference_record(self) -> Mapping[str, object] | None:
        """Record of the reference from the source."""
        return self.frames.reference_record

    @property
    def content(self) -> Mapping[str, object]:
        """Content of the source and the selected rigs."""
        return {**self.frames.content, "rigs of the recording": self.source_rigs}

    def __len__(self) -> int:
        return len(self.frames)

    def _frame_at(self, position: int) -> Frame:
        frame = self.frames[position]
        boxes, point_counts = frame.boxes, frame.sensor_point_counts
        if boxes is not None:
            boxes = replace(boxes, points_in_box=self._rename_rigs(boxes.points_in_box))
        return replace(
            frame,
            clouds={name: frame.get_cloud(source_rig) for name, source_rig in self.source_rigs.items()},
            boxes=boxes,
            sensor_point_counts=None if point_counts is None else self._rename_rigs(point_counts),
            measurements=self._rename_rigs(frame.measurements),
        )

    def _rename_rigs(self, by_rig: Mapping[str, ValueT]) -> dict[str, ValueT]:
        """Select values of the source by rig, under the new names; rigs without a value are omitted."""
        return {name: by_rig[source_rig] for name, source_rig in self.source_rigs.items() if source_rig in by_rig}
