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
    """Filter of frames that this or another process already counts, without communication between processes.

    A `torch.utils.data.DistributedSampler` deals out the same number of samples to every process and fills the last
    round with the first samples again. The position of a sample in the whole deal tells, whatever the order of the
    samples: from `len(dataset)` on it is a repetition. This covers samplers that deal out in the same way: those that
    Lightning, MMEngine and OpenPCDet put in. Where the number of samples is told at the end only, as by MMEngine, the
    last frame of a process is held back until then: no other can be a repetition. It needs batches in order
    (`DataLoader(in_order=True)`, the default) with one frame for each sample.

    Within a process a frame that comes again before all are forgotten is recognised by its index, name and numbers of
    points, and counted once; one with neither index nor name is a new one. That covers samplers that repeat samples on
    purpose, and epochs that were resumed. A frame that a sampler of another kind gives to two processes is counted
    twice.

    The memory is one number for each frame that was counted.

    Example:
        >>> import torch
        >>> frames = [Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=k, name="a") for k in (0, 1, 0)]
        >>> once = FrameDeduplicator()
        >>> [frame.index for frame in once.select_new(frames)]
        [0, 1]
        >>> once.start_epoch()
        >>> [frame.index for frame in once.select_new(frames[:2], Shard(process_index=1, num_processes=2, num_samples=3))]
        [0]
    """

    def __init__(self) -> None:
        self.start_epoch()

    def start_epoch(self, *, clear_history: bool = True) -> None:
        """Begin with the first positions of the loaders again.

        Args:
            clear_history: Whether frames that were counted in earlier epochs are to be counted again.
        """
        if clear_history:
            self._counted: set[int] = set()
        self._position: dict[int, int] = {}
        self._held_back: dict[int, Sequence[Frame]] = {}

    def select_new(self, frames: Sequence[Frame], shard: Shard | None = None, loader_index: int = 0) -> list[Frame]:
        """Select the frames of the next batch that count.

        Args:
            frames: One for each sample of the batch, in order.
            shard: How the loader's samples are dealt out, see `find_shard`; None if this process gets all of them. As
                long as their number is not known, the last frame waits for the next call; a call without frames, but
                with the number, gives it back.
            loader_index: Number of the loader, if there are several: equal frames of two loaders are different ones.

        Returns:
            Some or all of the frames, in order.
        """
        frames = [*self._held_back.pop(loader_index, ()), *frames]
        if shard is not None and shard.num_samples is None:
            frames, self._held_back[loader_index] = frames[:-1], frames[-1:]
        first = self._position.get(loader_index, 0)
        self._position[loader_index] = first + len(frames)
        dealt = [frame for position, frame in enumerate(frames, first) if not (shard and shard.is_padding(position))]
        return [frame for frame in dealt if self._is_new(frame, loader_index)]

    def _is_new(self, frame: Frame, loader: int) -> bool:
        if frame.index == UNKNOWN_INDEX and not frame.name:
            return True
        identity = _hash_frame(frame, loader)
        seen = identity in self._counted
        self._counted.add(identity)
        return not seen

    def state_dict(self) -> dict[str, Any]:
        """Return the frames that all processes have counted, as plain numbers for `load_state_dict`.

        With `torch.distributed` in use, every process must call it.
        """
        counted = self._counted
        if is_distributed():
            of_process: list[set[int]] = [set()] * torch.distributed.get_world_size()
            torch.distributed.all_gather_object(of_process, self._counted)
            counted = set().union(*of_process)
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


def _hash_frame(frame: Frame, loader: int) -> int:
    # Two datasets side by side have frames of the same index, and of the same name if only their seed differs. Flips
    # and rotations change coordinates, but no number of points.
    sizes = [len(frame.reference), *(len(cloud) for cloud in frame.clouds.values())]
    text = repr((loader, frame.index, frame.name, sizes))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=7).digest(), "big")
