"""Heartbeats of the ranks of a distributed run; stopped and dead ranks are reported."""

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Event, Thread

from torch.distributed.distributed_c10d import Store


@dataclass(frozen=True)
class HeartbeatParams:
    """Times of the heartbeats.

    Args:
        interval_s: Time between two heartbeats of a rank.
        timeout_s: Silence after which a rank is reported; longer than any call that holds the interpreter lock.
    """

    interval_s: float = 3.0
    timeout_s: float = 20.0


class Heartbeat:
    """Heartbeats of one rank, and the last heartbeats of all others.

    Args:
        store: Store of the ranks, in the process of rank 0.
        rank: This rank.
        num_ranks: Number of ranks.
        params: Times.
    """

    def __init__(self, store: Store, rank: int, num_ranks: int, params: HeartbeatParams) -> None:
        self._store, self._rank, self._params = store, rank, params
        self._heartbeats = {peer: b"" for peer in range(num_ranks) if peer != rank}
        now_s = time.monotonic()
        self._changed_s = dict.fromkeys(self._heartbeats, now_s)
        self._exchanged_s = now_s
        self._reported: set[int] = set()
        self._ended = Event()

    def exchange_heartbeats(self) -> None:
        """Exchange heartbeats with the other ranks until this rank leaves; the last heartbeat is "left"."""
        with suppress(RuntimeError):  # the store has closed
            count = 0
            while not self._ended.wait(self._params.interval_s):
                count += 1
                self._store.set(f"alive {self._rank}", str(count))
                for peer, previous in self._heartbeats.items():
                    heartbeat = self._store.get(f"alive {peer}") if self._store.check([f"alive {peer}"]) else b""
                    # A rank that has left is not silent.
                    if heartbeat != previous or heartbeat == b"left":
                        self._heartbeats[peer] = heartbeat
                        self._changed_s[peer] = time.monotonic()
                        self._reported.discard(peer)
                self._exchanged_s = time.monotonic()
            self._store.set(f"alive {self._rank}", "left")

    def watch(self) -> None:
        """Warn about silent ranks until this rank leaves."""
        checked_s = time.monotonic()
        while not self._ended.wait(self._params.interval_s):
            now_s = time.monotonic()
            if now_s - checked_s > 2 * self._params.interval_s:  # this process itself was stopped
                self._exchanged_s, self._changed_s = now_s, dict.fromkeys(self._heartbeats, now_s)
            checked_s = now_s
            for peer in self.find_silent(now_s):
                self._reported.add(peer)
                warnings.warn(
                    f"rank {peer} has been silent for {self._params.timeout_s:g} s, and the others wait for it: it is "
                    "stopped or dead; continue it, or end all ranks",
                    RuntimeWarning,
                    stacklevel=2,
                )

    def find_silent(self, now_s: float) -> list[int]:
        """Find the silent ranks that were not reported; rank 0 if the store does not answer.

        Args:
            now_s: Time on the monotonic clock.

        Returns:
            Their numbers.
        """
        latest_s = now_s - self._params.timeout_s
        # Without the store, which is in rank 0, nothing is known about the other ranks.
        if self._exchanged_s < latest_s:
            return [] if self._rank == 0 or 0 in self._reported else [0]
        silent = [peer for peer, changed_s in self._changed_s.items() if changed_s < latest_s]
        return [peer for peer in silent if peer not in self._reported]

    def stop(self) -> None:
        """End both loops."""
        self._ended.set()


@contextmanager
def report_silent_ranks(
    store: Store, rank: int, num_ranks: int, params: HeartbeatParams | None = None
) -> Iterator[None]:
    """Send heartbeats to the other ranks within a block, and warn about silent ranks.

    Args:
        store: Store of the ranks, in the process of rank 0.
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
