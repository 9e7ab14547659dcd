"""Base class of sources of frames: simulations, recordings and other formats."""

import operator
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, SupportsIndex, TypeVar, overload

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


@dataclass(frozen=True, eq=False)
class FrameMetadata:
    """Rigs and origin of the frames of a source, and the data that all of its frames have.

    Args:
        rigs: Names of the rigs, the keys of `Frame.clouds`.
        description: Origin of the frames, for `summary.json`: `scenario`, `vehicle`, `seed` or `frames`; other keys are
            None.
        has_area_weights: True if all frames have `Frame.reference_weights`; False if none has.
        has_boxes: True if frames have `Frame.boxes`.
        sensors: Name of each rig with known sensors -> its sensors, for plots.
        sensor_names: Name of each rig for which `Frame.sensor_point_counts` is known -> names of its sensors.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in the vehicle frame in meters; None if unknown.
        ego_mesh: Mesh of the ego vehicle in the vehicle frame; None if unknown.
    """

    rigs: Sequence[str]
    description: Mapping[str, object]
    has_area_weights: bool = False
    has_boxes: bool = False
    sensors: Mapping[str, "Sequence[Sensor]"] = field(default_factory=dict)
    sensor_names: Mapping[str, Sequence[str]] = field(default_factory=dict)
    ego_outline_m: NDArray[np.float64] | None = None
    ego_mesh: "Mesh | None" = None


def build_scene_lookup(frames: object) -> Callable[[int], int]:
    """Return the function `FrameDataset.get_scene_id` for any map-style dataset or list of frames.

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
        "scene; define get_scene_id(index), see FrameDataset, or use a single process"
    )


class FrameDataset(Dataset[Frame]):
    """Base class of sources of frames: a map-style torch dataset that a `for` loop iterates in order.

    A source defines `metadata`, `__len__` and `make_frame`, and the other methods only where it has information.

    Example:
        >>> import torch
        >>> class ConstantFrames(FrameDataset):
        ...     metadata = FrameMetadata(rigs=("roof",), description={"frames": "constant"})
        ...
        ...     def __len__(self):
        ...         return 2
        ...
        ...     def make_frame(self, index):
        ...         return Frame({"roof": torch.zeros(1, 3)}, torch.ones(1, 3), index, f"frame {index}")
        >>> [frame.name for frame in ConstantFrames()]
        ['frame 0', 'frame 1']
    """

    @property
    @abstractmethod
    def metadata(self) -> FrameMetadata:
        """Rigs and origin of the frames; a class attribute if they are always the same."""
        raise NotImplementedError

    def get_scene_id(self, index: int) -> int:
        """Return the number of the scene of a frame.

        One process makes all frames of a scene, so that the scene is built once. Sources that build no scenes return
        the index, the default, so that any process may make any frame.

        Args:
            index: Index of the frame.

        Returns:
            Any number that is equal for frames of one scene.
        """
        return index

    def get_block_index(self, index: int) -> int:
        """Return `Frame.block_index` of a frame without making the frame; the default is that of independent frames.

        Args:
            index: Index of the frame; a simulation accepts indices beyond its last frame.

        Returns:
            Block index.

        Raises:
            IndexError: The frame does not exist.
        """
        return range(len(self))[index]

    def has_heights(self) -> bool:
        """Return whether frames have `Frame.reference_heights_m`, the condition for height bands above ground."""
        return False

    def describe_reference(self) -> Mapping[str, object] | None:
        """Describe the origin of the reference points, for `summary.json`.

        Returns:
            `sensor`, its settings and `notes`, sentences that the reader of the numbers needs; for simulated frames
            also `frame_interval_s`. None if unknown, the default.
        """
        return None

    def collect_content(self) -> Mapping[str, object]:
        """Collect the inputs that determine the frames; runs with a checkpoint or several ranks need them.

        Returns:
            JSON values that change if, and only if, a frame may change; large inputs may be hashed. The keys appear in
            messages.

        Raises:
            NotImplementedError: The source does not define them.
        """
        raise NotImplementedError(
            f"frames: {type(self).__name__} does not define collect_content(), by which checkpoints and ranks "
            "recognize equal frames; define it, or run in one process without a checkpoint"
        )

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
        return self.make_frame(position % len(self))

    @abstractmethod
    def make_frame(self, index: int) -> Frame:
        """Make one frame.

        Args:
            index: Index from 0 to `len(self) - 1`.

        Raises:
            BadFrameError: The frame cannot be used; other frames can.
        """
        raise NotImplementedError

    def __iter__(self) -> Iterator[Frame]:
        """Iterate over the frames in order."""
        return (self[index] for index in range(len(self)))


class RigSubset(FrameDataset):
    """Frames of another source with the clouds of selected rigs under new names.

    Args:
        frames: Source of the frames.
        source_rigs: New name of each rig -> its name in the source, in the desired order.

    Raises:
        ValueError: The source has no such rig.
    """

    def __init__(self, frames: FrameDataset, source_rigs: Mapping[str, str]) -> None:
        metadata = frames.metadata
        if unknown := [name for name in source_rigs.values() if name not in metadata.rigs]:
            raise ValueError(f"no clouds of the rig {', '.join(unknown)}; the frames have {', '.join(metadata.rigs)}")
        self.frames = frames
        self.source_rigs = dict(source_rigs)
        self._metadata = replace(
            metadata,
            rigs=tuple(source_rigs),
            sensors=self._rename_rigs(metadata.sensors),
            sensor_names=self._rename_rigs(metadata.sensor_names),
        )

    @property
    def metadata(self) -> FrameMetadata:
        """Metadata of the source with the selected rigs only."""
        return self._metadata

    def get_scene_id(self, index: int) -> int:
        """Return the scene number from the source; see `FrameDataset.get_scene_id`."""
        return self.frames.get_scene_id(index)

    def get_block_index(self, index: int) -> int:
        """Return the block index from the source; see `FrameDataset.get_block_index`."""
        return self.frames.get_block_index(index)

    def has_heights(self) -> bool:
        """Return whether frames of the source have heights above ground."""
        return self.frames.has_heights()

    def describe_reference(self) -> Mapping[str, object] | None:
        """Describe the reference of the source."""
        return self.frames.describe_reference()

    def collect_content(self) -> Mapping[str, object]:
        """Collect the content of the source and the selected rigs."""
        return {**self.frames.collect_content(), "rigs of the recording": self.source_rigs}

    def __len__(self) -> int:
        return len(self.frames)

    def make_frame(self, index: int) -> Frame:
        """Make a frame of the source and select its rigs."""
        frame = self.frames[index]
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
