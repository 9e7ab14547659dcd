"""Several processes, on one machine or many, share a run: each makes the frames of its share, and all are added up."""

import io
import json
import os
import pickle
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from itertools import groupby
from typing import Any, TypeVar

from torch import Tensor
from torch.distributed.distributed_c10d import Store
from torch.distributed.rendezvous import rendezvous

from torchcover.evaluation.checkpoint import describe_differences
from torchcover.evaluation.heartbeat import report_silent_ranks
from torchcover.evaluation.observers import AnyObserver

Payload = TypeVar("Payload")

# A rank may wait for another as long as a run takes.
LONGEST_WAIT_S = 30 * 24 * 3600.0
LOOK_EVERY_S = 0.05
# How long rank 0, which keeps the store, lets the others read what it has sent; whoever has, says so.
PARTING_S = 60.0
# What ranks tell each other, beside what they have measured.
FAILED, ABORTED, IDENTITY, PARTED = "failed", "aborted", "identity", "parted"
# What they have measured travels through the store, too, which takes at most 8 MiB at once.
PART_BYTES = 4 * 2**20
EVERYBODY = -1


class Ranks:
    """The processes that share a run, as `torchrun` starts them: every one of them calls the same.

    Args:
        store: Through which they tell each other everything.
        rank: Which one this is.
        num_ranks: How many there are.
    """

    def __init__(self, store: Store, rank: int, num_ranks: int) -> None:
        self.store = store
        self.rank = rank
        self.num_ranks = num_ranks
        self._letters = Counter[tuple[int, int]]()

    def iterate_share(self, indices: Sequence[int], get_scene_id: Callable[[int], int]) -> Iterator[int]:
        """The frames that are this rank's: those of whole worlds, dealt in turns, so that more steps change no share.

        Args:
            indices: All frames, in order.
            get_scene_id: Which world a frame is of.
        """
        for number, (_, of_world) in enumerate(groupby(indices, get_scene_id)):
            if number % self.num_ranks == self.rank:
                yield from of_world

    def get_device(self, name: str) -> str:
        """Where this rank computes: of several GPUs, one each."""
        return f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if name == "cuda" else name

    def check_identity(self, identity: Mapping[str, str]) -> None:
        """Find out whether all ranks are about the same run.

        Raises:
            ValueError: This one is not; the message says what differs from rank 0.
        """
        if self.rank == 0:
            self.store.set(IDENTITY, json.dumps(dict(identity)))
            return
        self._wait_for([IDENTITY])
        if other := describe_differences(identity, json.loads(self.store.get(IDENTITY))):
            raise ValueError(f"rank {self.rank} is about another run than rank 0: {other}; start all with the same")

    def check_failures(self) -> None:
        """Between two frames: whether this rank is to go on.

        Raises:
            ChildProcessError: Another one has failed; the message says which, and how.
        """
        for key in (ABORTED, FAILED):
            if self.store.check([key]):
                raise ChildProcessError(self.store.get(key).decode())

    @property
    def failure(self) -> str | None:
        """Which rank has failed first, and how, in words."""
        return self.store.get(FAILED).decode() if self.store.check([FAILED]) else None

    def report_failure(self, error: BaseException, key: str = FAILED) -> None:
        """Tell the others that this rank has failed, if it is the first, so that they stop."""
        words = " ".join(str(error).split())
        said = ": ".join([f"rank {self.rank}", type(error).__name__, *[words] * bool(words)])
        self.store.compare_set(key, "", said)

    @contextmanager
    def abort_on_error(self) -> Iterator[None]:
        """Whatever leaves the block as an error ends all ranks, and nothing is added up."""
        try:
            yield
        except BaseException as error:
            self.report_failure(error, ABORTED)
            raise

    def merge(self, observers: Sequence[AnyObserver]) -> list[AnyObserver]:
        """Add up what all ranks have seen, in their order; every rank gets all of it.

        Args:
            observers: Those of this rank, which other ranks have likewise.

        Raises:
            ValueError: Observers that do not measure the same.
        """
        return [self._from_first(self._merged(one)) for one in observers]

    def gather(self, value: Payload) -> list[Payload]:
        """What each rank has, in their order; every rank gets all of it."""
        values = [value, *(self._receive(rank) for rank in range(1, self.num_ranks))] if self.rank == 0 else []
        if self.rank:
            self._send(value, 0)
        return self._from_first(values)

    def shut_down(self) -> None:
        """Wait for rank 0, which writes the results: who ends with an error is the end of all of them."""
        with suppress(RuntimeError):  # the store ends with the process that keeps it
            if self.rank == 0:
                self.store.set(PARTED, "")
                self._wait_for([f"{PARTED} {rank}" for rank in range(1, self.num_ranks)], at_most_s=PARTING_S)
            else:
                self._wait_for([PARTED])
                self.store.set(f"{PARTED} {self.rank}", "")

    def _merged(self, observer: AnyObserver) -> AnyObserver:
        """In rank 0 that of all: in pairs of neighbours, then in pairs of pairs, so that no rank merges many."""
        apart = 1
        while apart < self.num_ranks and self.rank % (2 * apart) == 0:
            if self.rank + apart < self.num_ranks:
                observer.merge_state(self._receive(self.rank + apart))
            apart *= 2
        if self.rank:
            self._send(observer, self.rank - apart)
        return observer

    def _wait_for(self, keys: list[str], at_most_s: float = LONGEST_WAIT_S) -> None:
        end_s = time.monotonic() + at_most_s
        while not self.store.check(keys) and time.monotonic() < end_s:
            if self.store.check([ABORTED]) and PARTED not in keys[0]:
                raise ChildProcessError(self.store.get(ABORTED).decode())
            time.sleep(LOOK_EVERY_S)

    def _from_first(self, value: Payload) -> Payload:
        if self.rank == 0:
            self._send(value, EVERYBODY)
            return value
        received: Payload = self._receive(0, EVERYBODY)
        return received

    def _send(self, value: object, to: int) -> None:
        letter, data = self._letter(self.rank, to), serialize(value)
        for start in range(0, len(data), PART_BYTES):
            part = data[start : start + PART_BYTES]
            self.store.set(f"{letter} {start}", part)  # type: ignore[arg-type]  # it takes bytes, too
        self.store.set(letter, f"{len(data)}")

    def _receive(self, rank: int, to: int | None = None) -> Any:  # noqa: ANN401  (what another rank has sent)
        letter = self._letter(rank, self.rank if to is None else to)
        self._wait_for([letter])
        parts = [f"{letter} {start}" for start in range(0, int(self.store.get(letter)), PART_BYTES)]
        data = b"".join(map(self.store.get, parts))
        for part in parts if to is None else ():
            self.store.delete_key(part)
        return pickle.loads(data)  # as a process of the same run has packed it; nobody else's

    def _letter(self, rank: int, to: int) -> str:
        """Its key, of the next one from one rank to another."""
        self._letters[rank, to] += 1
        return f"{rank} to {to}: {self._letters[rank, to]}"


def serialize(value: object) -> bytes:
    """Any object that can be pickled, its tensors on the CPU."""
    stream = io.BytesIO()
    _OnTheCpu(stream, protocol=pickle.HIGHEST_PROTOCOL).dump(value)
    return stream.getvalue()


class _OnTheCpu(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:  # noqa: ANN401  (as pickle has it)
        if type(value) is Tensor and value.device.type != "cpu":
            return value.cpu().__reduce_ex__(pickle.HIGHEST_PROTOCOL)  # type: ignore[no-untyped-call]
        return NotImplemented


def count_ranks() -> int:
    """How many processes `torchrun` has started, this one among them; 1 without it.

    Raises:
        ValueError: The environment says what is no number.
    """
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextmanager
def join_ranks() -> Iterator[Ranks | None]:
    """The ranks that `torchrun` has started, this process one of them; None where it has started one or none.

    Raises:
        ValueError: The environment of a rank is not whole.
    """
    if count_ranks() < 2:
        yield None
        return
    store, rank, size = next(iter(rendezvous("env://", timeout=timedelta(minutes=5))))
    ranks = Ranks(store, rank, size)
    with report_silent_ranks(store, rank, size):
        try:
            yield ranks
        finally:
            ranks.shut_down()
