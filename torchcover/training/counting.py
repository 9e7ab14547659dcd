"""Deduplication of frames: each frame of an epoch counts once over all processes."""

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch.utils.data.distributed import DistributedSampler

from torchcover.frames import Frame
from torchcover.training.batches import UNKNOWN_INDEX


class Shard(NamedTuple):
    """Distribution of samples over processes: sample k of a process has the number `k * num_processes + process_index`.

    Args:
        process_index: Rank of this process.
        num_processes: Number of processes.
        num_samples: Number of different samples; later numbers repeat the first samples. None if not yet known.
    """

    process_index: int
    num_processes: int
    num_samples: int | None

    def is_padding(self, position: int) -> bool:
        """Return whether a sample of this process repeats one of the first samples.

        Args:
            position: Position of the sample in this process.

        Returns:
            True for padding; False while the number of samples is unknown.
        """
        return self.num_samples is not None and position * self.num_processes + self.process_index >= self.num_samples


class FrameDeduplicator:
    """Filter that removes repeated frames within and between processes, without communication.

    A `torch.utils.data.DistributedSampler` gives every process the same number of samples and repeats the first samples
    to fill the last round. The overall position of a sample identifies repetitions in any order of samples: positions
    from `len(dataset)` on. Other samplers with this scheme, those of Lightning, MMEngine and OpenPCDet, are covered as
    well. If the number of samples is known only at the end, as in MMEngine, the last frame of each process, the only
    possible repetition, is held back until then. Batches must be in order (`DataLoader(in_order=True)`, the default),
    with one frame per sample.

    Within a process, a repeated frame is recognized by its index, name and numbers of points, and counted once; a frame
    with neither index nor name is new. This covers samplers that repeat samples on purpose, and resumed epochs. A frame
    that a sampler of another kind gives to two processes is counted twice.

    Memory is one integer per counted frame.

    Example:
        >>> import torch
        >>> frames = [Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=k, name="a") for k in (0, 1, 0)]
        >>> deduplicator = FrameDeduplicator()
        >>> [frame.index for frame in deduplicator.select_new(frames)]
        [0, 1]
        >>> deduplicator.start_epoch()
        >>> shard = Shard(process_index=1, num_processes=2, num_samples=3)
        >>> [frame.index for frame in deduplicator.select_new(frames[:2], shard)]
        [0]
    """

    def __init__(self) -> None:
        self.start_epoch()

    def start_epoch(self, *, clear_history: bool = True) -> None:
        """Reset the positions of all loaders.

        Args:
            clear_history: Count frames of earlier epochs again.
        """
        if clear_history:
            self._counted: set[int] = set()
        self._position: dict[int, int] = {}
        self._held_back: dict[int, Sequence[Frame]] = {}

    def select_new(self, frames: Sequence[Frame], shard: Shard | None = None, loader_index: int = 0) -> list[Frame]:
        """Select the frames of the next batch that count.

        Args:
            frames: Frame of each sample of the batch, in order.
            shard: Distribution of the samples of the loader, see `find_shard`; None if this process gets all samples.
                While their number is unknown, the last frame is held back until the next call; a call without frames
                and with the number releases it.
            loader_index: Index of the loader; equal frames of two loaders are different frames.

        Returns:
            Frames that count, in order.
        """
        frames = [*self._held_back.pop(loader_index, ()), *frames]
        if shard is not None and shard.num_samples is None:
            frames, self._held_back[loader_index] = frames[:-1], frames[-1:]
        start = self._position.get(loader_index, 0)
        self._position[loader_index] = start + len(frames)
        new_frames = []
        for position, frame in enumerate(frames, start):
            is_padding = shard is not None and shard.is_padding(position)
            if not is_padding and self._is_new(frame, loader_index):
                new_frames.append(frame)
        return new_frames

    def _is_new(self, frame: Frame, loader_index: int) -> bool:
        """Return whether a frame has not been counted yet, and remember it."""
        if frame.index == UNKNOWN_INDEX and not frame.name:
            return True
        frame_hash = _hash_frame(frame, loader_index)
        is_counted = frame_hash in self._counted
        self._counted.add(frame_hash)
        return not is_counted

    def state_dict(self) -> dict[str, Any]:
        """Return the frames that all processes have counted, as plain numbers for `load_state_dict`.

        With `torch.distributed` in use, every process must call it.
        """
        counted = self._counted
        if is_distributed():
            counted_by_process: list[set[int]] = [set()] * torch.distributed.get_world_size()
            torch.distributed.all_gather_object(counted_by_process, self._counted)
            counted = set().union(*counted_by_process)
        return {"counted": sorted(counted), "position": dict(self._position)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue within an epoch.

        Args:
            state: Result of `state_dict`.
        """
        self._counted, self._position = set(state["counted"]), dict(state["position"])


def find_shard(loader: object) -> Shard | None:
    """Find how a DataLoader distributes its samples over processes.

    Args:
        loader: DataLoader, or another iterable of batches.

    Returns:
        None without a `DistributedSampler`.

    Example:
        >>> from torch.utils.data import DataLoader
        >>> sampler = DistributedSampler(range(5), num_replicas=2, rank=1)
        >>> find_shard(DataLoader(range(5), sampler=sampler))
        Shard(process_index=1, num_processes=2, num_samples=5)
    """
    sampler = getattr(getattr(loader, "batch_sampler", None), "sampler", None) or getattr(loader, "sampler", None)
    if not isinstance(sampler, DistributedSampler):
        return None
    return Shard(sampler.rank, sampler.num_replicas, len(sampler.dataset))  # type: ignore[arg-type]  # a sampler needs it


def is_distributed() -> bool:
    """Return whether `torch.distributed` is initialized."""
    return torch.distributed.is_available() and torch.distributed.is_initialized()


def _hash_frame(frame: Frame, loader_index: int) -> int:
    # Concatenated datasets have frames with equal indices, and with equal names if only the seeds differ. Augmentation
    # by flips and rotations changes coordinates, but not the numbers of points.
    point_counts = [len(frame.reference), *(len(cloud) for cloud in frame.clouds.values())]
    text = repr((loader_index, frame.index, frame.name, point_counts))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=7).digest(), "big")
