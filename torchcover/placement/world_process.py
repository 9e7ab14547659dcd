"""Who holds worlds: this process, or others."""

import multiprocessing
import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any, Protocol
from weakref import finalize

import torch

from torchcover.placement.held_worlds import HeldWorlds, Look
from torchcover.placement.sites import HeldInstant, Site
from torchcover.simulation import Rig


class Holder(Protocol):
    """Holds worlds. What is asked is answered in turn; the first answer is the references by number of the instant."""

    def ask(self, rig: Rig, numbers: Sequence[int]) -> None:
        """Have a rig looked at; `answer` has what `HeldWorlds.look` gave."""
        ...

    def answer(self) -> Any:  # noqa: ANN401  (what was asked for)
        """What it says: the references at first, then what was asked for.

        Raises:
            Exception: What was raised on the way.
        """
        ...

    def close(self) -> None:
        """There will be no more questions."""
        ...


class WorldsHere:
    """`HeldWorlds` in this process.

    Args:
        sites: As in `HeldWorlds`.
        instants: Likewise.
        budget_bytes: Likewise.
    """

    def __init__(self, sites: Sequence[Site], instants: Sequence[HeldInstant], budget_bytes: float) -> None:
        self._held = HeldWorlds(sites, instants, budget_bytes)
        self._asked: tuple[Rig, Sequence[int]] | None = None

    def ask(self, rig: Rig, numbers: Sequence[int]) -> None:
        """See `Holder`."""
        self._asked = rig, numbers

    def answer(self) -> Any:  # noqa: ANN401
        """See `Holder`."""
        return self._held.references if self._asked is None else self._held.look(*self._asked)

    def close(self) -> None:
        """See `Holder`."""


class WorldProcess:
    """`HeldWorlds` in another process, which lives as long as this object. What is asked is answered in turn.

    Args:
        sites: As in `HeldWorlds`.
        instants: Likewise.
        budget_bytes: Likewise.
    """

    def __init__(self, sites: Sequence[Site], instants: Sequence[HeldInstant], budget_bytes: float) -> None:
        self._ours, theirs = multiprocessing.Pipe()
        arguments = (self._ours, theirs, sites, instants, budget_bytes)
        self.process = multiprocessing.Process(target=_serve, args=arguments, daemon=True)
        self.process.start()
        theirs.close()
        # At the end of the pipe the process ends by itself.
        self._end = finalize(self, self._ours.close)

    def ask(self, rig: Rig, numbers: Sequence[int]) -> None:
        """See `Holder`."""
        try:
            self._ours.send((rig, list(numbers)))
        except OSError as error:
            raise _killed() from error

    def answer(self) -> Any:  # noqa: ANN401
        """See `Holder`; a ChildProcessError if the process is gone."""
        try:
            said = self._ours.recv()
        except (EOFError, OSError) as error:
            raise _killed() from error
        if isinstance(said, Exception):
            raise said
        return said

    def close(self) -> None:
        """See `Holder`."""
        self._end()


def answers(holders: Sequence[Holder]) -> list[Any]:
    """The answer of each, all of which were asked.

    Raises:
        Exception: The first that was raised there, once all have answered: none is left behind in a pipe.
    """
    said: list[Any] = []
    for holder in holders:
        try:
            said.append(holder.answer())
        except Exception as error:
            said.append(error)
    for one in said:
        if isinstance(one, Exception):
            raise one
    return said


def _killed() -> ChildProcessError:
    return ChildProcessError("a process that holds worlds was killed, perhaps for want of memory; use fewer worlds")


def _serve(
    ours: Connection, theirs: Connection, sites: Sequence[Site], instants: Sequence[HeldInstant], budget_bytes: float
) -> None:
    ours.close()  # or the pipe would never end
    # Ctrl-C is for the process that asks, and so is what that makes of the end by a scheduler.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)
    try:
        held = HeldWorlds(sites, instants, budget_bytes)
    except Exception as error:
        theirs.send(error)
        return
    theirs.send(held.references)
    while True:
        try:
            rig, numbers = theirs.recv()
        except EOFError:
            return
        theirs.send(_looks(held, rig, numbers))


def _looks(held: HeldWorlds, rig: Rig, numbers: Sequence[int]) -> list[Look] | Exception:
    try:
        return held.look(rig, numbers)
    except Exception as error:
        return error
