"""Ranks: several processes, on one machine or many, that share a run.

Each rank measures whole scenes; afterwards the observers of all ranks are merged, and every rank gets the result.
"""

import io
import json
import os
import pickle
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from itertools import groupby
from typing import Any, TypeVar

from torch import Tensor
from torch.distributed.distributed_c10d import Store
from torch.distributed.rendezvous import rendezvous

from torchcover.evaluation.checkpoint import describe_differences
from torchcover.evaluation.heartbeat import report_silent_ranks
from torchcover.evaluation.observers import AnyObserver

PayloadT = TypeVar("PayloadT")

# Keys of the store: report of a failure, after which the results so far are merged, and report of an abort.
FAILED_KEY = "failed"
ABORTED_KEY = "aborted"
SHUTDOWN_KEY = "parted"
# Receiver of a message to all ranks.
ALL_RANKS = -1


@dataclass(frozen=True)
class RanksParams:
    """Parameters of the messages between ranks.

    Args:
        max_wait_s: Longest wait for another rank, which may take as long as a run.
        poll_interval_s: Time between two queries of the store.
        shutdown_timeout_s: Time that rank 0 keeps the store open for ranks that have not read its last message.
        max_part_bytes: Messages are split into parts of this size, since a store of torch takes at most 8 MiB at once.
    """

    max_wait_s: float = 30 * 24 * 3600.0
    poll_interval_s: float = 0.05
    shutdown_timeout_s: float = 60.0
    max_part_bytes: int = 4 * 2**20


class Ranks:
    """Processes that share a run, as `torchrun` starts them; all of them make the same calls in the same order.

    Args:
        store: Key-value store through which the ranks exchange messages.
        rank: Index of this process; rank 0 keeps the store and writes the results.
        num_ranks: Number of processes.
        params: Times and sizes.
    """

    def __init__(self, store: Store, rank: int, num_ranks: int, params: RanksParams = RanksParams()) -> None:
        self.store = store
        self.rank = rank
        self.num_ranks = num_ranks
        self._params = params
        self._message_counts = Counter[tuple[int, int]]()

    def iterate_share(self, indices: Sequence[int], get_scene_id: Callable[[int], int]) -> Iterator[int]:
        """Yield the frames of this rank: whole scenes in turn, so that a longer run only adds frames to each share.

        Args:
            indices: Indices of all frames, in order.
            get_scene_id: Function that returns the scene of a frame.
        """
        for scene_number, (_, scene_indices) in enumerate(groupby(indices, get_scene_id)):
            if scene_number % self.num_ranks == self.rank:
                yield from scene_indices

    def get_device(self, name: str) -> str:
        """Return the device of this rank.

        Args:
            name: Device of the run.

        Returns:
            For "cuda" the GPU with the local rank, otherwise `name`.
        """
        return f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if name == "cuda" else name

    def check_identity(self, identity: Mapping[str, str]) -> None:
        """Check that this rank has the same settings as rank 0.

        Args:
            identity: Name of each setting that changes the result -> its value.

        Raises:
            ValueError: A setting differs; the message lists the differences.
            ChildProcessError: Another rank has aborted the run.
        """
        key = "identity"
        if self.rank == 0:
            self.store.set(key, json.dumps(dict(identity)))
            return
        self._wait_for([key])
        differences = describe_differences(identity, json.loads(self.store.get(key)))
        if differences:
            advice = "start all ranks with the same settings"
            raise ValueError(f"rank {self.rank} has other settings than rank 0: {differences}; {advice}")

    def check_failures(self) -> None:
        """Check between two frames that no rank has failed.

        Raises:
            ChildProcessError: A rank has failed; the message has its number and its error.
        """
        for key in (ABORTED_KEY, FAILED_KEY):
            if self.store.check([key]):
                raise ChildProcessError(self.store.get(key).decode())

    @property
    def failure(self) -> str | None:
        """Number and error of the rank that failed first; None if none has failed."""
        return self.store.get(FAILED_KEY).decode() if self.store.check([FAILED_KEY]) else None

    def report_failure(self, error: BaseException, *, is_abort: bool = False) -> None:
        """Report an error of this rank to the others, which then stop; only the first report is kept.

        Args:
            error: The error.
            is_abort: Whether the run has no result, not even that of the frames so far.
        """
        message = " ".join(str(error).split())
        report = f"rank {self.rank}: {type(error).__name__}"
        if message:
            report += f": {message}"
        self.store.compare_set(ABORTED_KEY if is_abort else FAILED_KEY, "", report)

    @contextmanager
    def abort_on_error(self) -> Iterator[None]:
        """Abort the run of all ranks if the block raises an error, which is raised again here."""
        try:
            yield
        except BaseException as error:
            self.report_failure(error, is_abort=True)
            raise

    def merge(self, observers: Sequence[AnyObserver]) -> list[AnyObserver]:
        """Merge the observers of all ranks in the order of the ranks.

        Args:
            observers: Observers of this rank; the other ranks have the same ones.

        Returns:
            The merged observers, equal in every rank.

        Raises:
            ValueError: Two observers measure different things.
            ChildProcessError: Another rank has aborted the run.
        """
        return [self._broadcast(self._merge_to_first_rank(observer)) for observer in observers]

    def gather(self, value: PayloadT) -> list[PayloadT]:
        """Gather a value of every rank.

        Args:
            value: Value of this rank.

        Returns:
            Values in the order of the ranks, equal in every rank.

        Raises:
            ChildProcessError: Another rank has aborted the run.
        """
        values = [value]
        if self.rank == 0:
            values += [self._receive(sender, self.rank) for sender in range(1, self.num_ranks)]
        else:
            self._send(value, 0)
        return self._broadcast(values)

    def shut_down(self) -> None:
        """Wait until rank 0 has written the results; an error of a process would end the others before that."""
        with suppress(RuntimeError):  # the store ends with the process of rank 0
            if self.rank == 0:
                self.store.set(SHUTDOWN_KEY, "")
                replies = [f"{SHUTDOWN_KEY} {rank}" for rank in range(1, self.num_ranks)]
                self._wait_for(replies, self._params.shutdown_timeout_s, raises_on_abort=False)
            else:
                self._wait_for([SHUTDOWN_KEY], raises_on_abort=False)
                self.store.set(f"{SHUTDOWN_KEY} {self.rank}", "")

    def _merge_to_first_rank(self, observer: AnyObserver) -> AnyObserver:
        """Merge pairs of neighbors, then pairs of pairs: each rank merges at most log2(num_ranks) observers."""
        distance = 1
        while distance < self.num_ranks and self.rank % (2 * distance) == 0:
            if self.rank + distance < self.num_ranks:
                observer.merge_state(self._receive(self.rank + distance, self.rank))
            distance *= 2
        if self.rank:
            self._send(observer, self.rank - distance)
        return observer

    def _wait_for(self, keys: list[str], timeout_s: float | None = None, *, raises_on_abort: bool = True) -> None:
        """Wait until all keys are in the store, or until the timeout."""
        end_s = time.monotonic() + (self._params.max_wait_s if timeout_s is None else timeout_s)
        while not self.store.check(keys) and time.monotonic() < end_s:
            if raises_on_abort and self.store.check([ABORTED_KEY]):
                raise ChildProcessError(self.store.get(ABORTED_KEY).decode())
            time.sleep(self._params.poll_interval_s)

    def _broadcast(self, value: PayloadT) -> PayloadT:
        """Return the value of rank 0 in every rank."""
        if self.rank == 0:
            self._send(value, ALL_RANKS)
            return value
        received: PayloadT = self._receive(0, ALL_RANKS)
        return received

    def _send(self, value: object, receiver: int) -> None:
        """Send a message in parts; the key of the message is set last, with its size."""
        message_key, data = self._build_message_key(self.rank, receiver), serialize(value)
        for start in range(0, len(data), self._params.max_part_bytes):
            part = data[start : start + self._params.max_part_bytes]
            self.store.set(f"{message_key} {start}", part)  # type: ignore[arg-type]  # the stub omits bytes
        self.store.set(message_key, f"{len(data)}")

    def _receive(self, sender: int, receiver: int) -> Any:  # noqa: ANN401  (value of the sender)
        """Receive the next message; its parts are deleted unless other ranks read them, too."""
        message_key = self._build_message_key(sender, receiver)
        self._wait_for([message_key])
        starts = range(0, int(self.store.get(message_key)), self._params.max_part_bytes)
        part_keys = [f"{message_key} {start}" for start in starts]
        data = b"".join([self.store.get(key) for key in part_keys])
        if receiver != ALL_RANKS:
            for key in part_keys:
                self.store.delete_key(key)
        return pickle.loads(data)  # only processes of the same run write into the store

    def _build_message_key(self, sender: int, receiver: int) -> str:
        """Build the key of the next message between two ranks."""
        self._message_counts[sender, receiver] += 1
        return f"{sender} to {receiver}: {self._message_counts[sender, receiver]}"


def serialize(value: object) -> bytes:
    """Pickle an object after its tensors are copied to the CPU.

    Args:
        value: Any object that can be pickled.
    """
    stream = io.BytesIO()
    _CpuPickler(stream, protocol=pickle.HIGHEST_PROTOCOL).dump(value)
    return stream.getvalue()


class _CpuPickler(pickle.Pickler):
    """Pickler that stores tensors of other devices as CPU tensors."""

    def reducer_override(self, value: Any) -> Any:  # noqa: ANN401  (signature of pickle)
        """Replace a tensor of another device by its copy on the CPU."""
        if type(value) is Tensor and value.device.type != "cpu":
            return value.cpu().__reduce_ex__(pickle.HIGHEST_PROTOCOL)  # type: ignore[no-untyped-call]
        return NotImplemented


def count_ranks() -> int:
    """Count the processes that `torchrun` has started, including this one.

    Returns:
        Value of the environment variable WORLD_SIZE; 1 without `torchrun`.

    Raises:
        ValueError: WORLD_SIZE is not an integer.
    """
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextmanager
def join_ranks() -> Iterator[Ranks | None]:
    """Join the processes that `torchrun` has started; the end of the block waits for rank 0 to write the results.

    Returns:
        The ranks; None if there is a single process.

    Raises:
        ValueError: An environment variable of `torchrun` is missing.
    """
    if count_ranks() < 2:
        yield None
        return
    store, rank, num_ranks = next(iter(rendezvous("env://", timeout=timedelta(minutes=5))))
    ranks = Ranks(store, rank, num_ranks)
    with report_silent_ranks(store, rank, num_ranks):
        try:
            yield ranks
        finally:
            ranks.shut_down()
