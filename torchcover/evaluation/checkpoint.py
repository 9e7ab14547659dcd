"""No run is lost: what it knows is written to a file now and then, and it goes on from there."""

import io
import time
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torchcover.evaluation.checkpoint_file import RUN_KEYS, read_header, read_state, write_checkpoint, write_states
from torchcover.evaluation.observers import CoverageObserver, Stateful
from torchcover.evaluation.run_identity import differences

EVERY_S = 60.0
# Writing takes at most this share of the time, though it may take seconds.
MOST_TIME = 0.05


class Progressing(Protocol):
    """What a checkpoint keeps of a run itself; a `Run`."""

    steps: int
    counts: Counter[str]
    skipped: list[str]
    seconds: float


@dataclass(frozen=True)
class Checkpoint:
    """A file that a run is saved to every minute and at its end, and from which it goes on after whatever ended it.

    The file stays when the run is complete: with more steps it goes on from there, too.

    Args:
        path: The file, in a folder that no other run writes to.
        resume: Whether to go on from it, if it is there; else the run starts with its first step, and replaces it.
    """

    path: Path
    resume: bool = True


AnyCheckpoint = Checkpoint | str | Path


class Journal:
    """Keeps the checkpoint of one run.

    Args:
        checkpoint: Where.
        identity: What defines the run; see `run_identity`.
        states: All that learns from frames, by name.

    Raises:
        TypeError: Something whose state cannot be kept.
    """

    def __init__(self, checkpoint: Checkpoint, identity: Mapping[str, str], states: Mapping[str, object]) -> None:
        self.path = checkpoint.path
        self.resume = checkpoint.resume
        self.identity = dict(identity)
        self._states: dict[str, Stateful] = {name: _checked(name, one) for name, one in states.items()}
        self._due_s = time.monotonic() + EVERY_S
        self._complained = False

    def restore(self, run: Progressing) -> None:
        """Go on from the file, if there is one and that is wanted.

        Args:
            run: Gets the steps that are done.

        Raises:
            ValueError: It is the checkpoint of another run; the message says in what. Or, as `BadFileError`, it is
                damaged.
        """
        if not self.resume or not self.path.exists():
            return
        header = read_header(self.path)
        if other := differences(self.identity, header["identity"]):
            raise ValueError(
                f"{self.path}: a checkpoint of another run: {other}; resume with the settings of that run, or choose "
                "another folder"
            )
        for name, one in self._states.items():
            one.load_state_dict(read_state(self.path, header, name))
        done = header["run"]
        run.steps, run.skipped, run.seconds = done["steps"], done["skipped"], done["seconds"]
        run.counts.update(done["counts"])

    def write_if_due(self, run: Progressing) -> None:
        """Write, if the last time is long enough ago."""
        if time.monotonic() >= self._due_s:
            self.write(run)

    def write(self, run: Progressing) -> None:
        """Write now; where there is no room, say so once, and leave the file that is there."""
        start_s = time.monotonic()
        done = {name: getattr(run, name) for name in RUN_KEYS}
        try:
            states = {name: one.state_dict() for name, one in self._states.items()}
            write_checkpoint(self.path, {"identity": self.identity, "run": done}, states)
        except (OSError, MemoryError) as error:
            if not self._complained:
                warnings.warn(f"{self.path}: no checkpoint was written ({error}); the run goes on", stacklevel=2)
            self._complained = True
        end_s = time.monotonic()
        self._due_s = end_s + max(EVERY_S, (end_s - start_s) / MOST_TIME)


def _checked(name: str, one: object) -> Stateful:
    if not isinstance(one, Stateful):
        raise TypeError(
            f"{name}: a {type(one).__name__} without state_dict and load_state_dict, which a checkpoint needs; give it "
            "both, or leave out the checkpoint"
        )
    if isinstance(one, CoverageObserver):  # whose sums are many
        return one
    try:
        write_states(io.BytesIO(), {}, {name: one.state_dict()})
    except TypeError as error:
        raise TypeError(f"{name}: its state_dict cannot be kept in a checkpoint: {error}") from error
    return one
