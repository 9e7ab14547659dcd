"""Signs of life of the ranks that share a run: a rank that is stopped or dead is reported."""

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Event, Thread

from torch.distributed.distributed_c10d import Store


@dataclass(frozen=True)
class HeartbeatParams:
    """Times of the signs of life.

    Args:
        interval_s: Seconds between two signs of life of a rank.
        timeout_s: A rank without one for so long is reported; longer than the interpreter is ever held by one call.
    """

    interval_s: float = 3.0
    timeout_s: float = 20.0


class Heartbeat:
    """Signs of life of one rank, and what it knows of the others.

    Args:
        store: The store of the ranks, which rank 0 keeps.
        rank: This rank.
        size: Number of ranks.
        params: Times.
    """

    def __init__(self, store: Store, rank: int, num_ranks: int, params: HeartbeatParams) -> None:
        self._store, self._rank, self._params = store, rank, params
        self._signs = {other: b"" for other in range(num_ranks) if other != rank}
        now_s = time.monotonic()
        self._changed_s = dict.fromkeys(self._signs, now_s)
        self._exchanged_s = now_s
        self._reported: set[int] = set()
        self._ended = Event()

    def exchange_heartbeats(self) -> None:
        """Send signs of life and read those of the others, until the rank leaves; the last sign is "left"."""
        with suppress(RuntimeError):  # the store has ended
            count = 0
            while not self._ended.wait(self._params.interval_s):
                count += 1
                self._store.set(f"alive {self._rank}", str(count))
                for other, sign in self._signs.items():
                    now = self._store.get(f"alive {other}") if self._store.check([f"alive {other}"]) else b""
                    if now != sign or now == b"left":
                        self._signs[other], self._changed_s[other] = now, time.monotonic()
                        self._reported.discard(other)
                self._exchanged_s = time.monotonic()
            self._store.set(f"alive {self._rank}", "left")

    def watch(self) -> None:
        """Warn about ranks without signs of life, until the rank leaves."""
        looked_s = time.monotonic()
        while not self._ended.wait(self._params.interval_s):
            now_s = time.monotonic()
            if now_s - looked_s > 2 * self._params.interval_s:  # this process itself was stopped
                self._exchanged_s, self._changed_s = now_s, dict.fromkeys(self._signs, now_s)
            looked_s = now_s
            for other in self.find_silent(now_s):
                self._reported.add(other)
                warnings.warn(
                    f"rank {other} has been silent for {self._params.timeout_s:g} s, and the others wait for it: it is "
                    "stopped or dead; continue it, or end all ranks",
                    RuntimeWarning,
                    stacklevel=2,
                )

    def find_silent(self, now_s: float) -> list[int]:
        """Find the ranks without signs of life that were not reported; rank 0 if the store does not answer."""
        latest_s = now_s - self._params.timeout_s
        if self._exchanged_s < latest_s:
            return [] if self._rank == 0 or 0 in self._reported else [0]
        return [other for other, at_s in self._changed_s.items() if at_s < latest_s and other not in self._reported]

    def stop(self) -> None:
        """End both loops."""
        self._ended.set()


@contextmanager
def report_silent_ranks(
    store: Store, rank: int, num_ranks: int, params: HeartbeatParams | None = None
) -> Iterator[None]:
    """Send signs of life to the other ranks, and warn about those that send none.

    Args:
        store: The store of the ranks, which rank 0 keeps.
        rank: This rank.
        num_ranks: Number of ranks.
        params: Times; the defaults if not given.
    """
    heartbeat = Heartbeat(store, rank, num_ranks, params or HeartbeatParams())
    threads = [Thread(target=loop, daemon=True) for loop in (heartbeat.exchange_heartbeats, heartbeat.watch)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        heartbeat.stop()
        for thread in threads:
            thread.join(timeout=1.0)
