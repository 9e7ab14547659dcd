"""The one loop: frames in order, and every observer is fed with each of them."""

import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby, islice
from multiprocessing import active_children
from traceback import clear_frames, format_exc
from typing import Any, NamedTuple, Protocol

import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info

from torchcover.evaluation.checkpoint import CheckpointManager
from torchcover.evaluation.cpu_cores import count_cores, get_start_method, warn_about_spinning
from torchcover.evaluation.observers import AnyObserver, CoverageObserver
from torchcover.evaluation.progress import ENDS, Progress, defer_signals
from torchcover.evaluation.ranks import Ranks
from torchcover.files import end_with_parent, is_stopped, report_stopped_processes
from torchcover.frames import BadFrameError, Frame, FrameSource, build_scene_lookup

Frames = FrameSource | Dataset[Frame] | Sequence[Frame]

# Frames that a worker makes at a time, at most: they wait together in memory.
MOST_TOGETHER = 16


@dataclass
class Run:
    """How a run went.

    Args:
        num_frames: Frames that all observers have seen.
        counts: Sums of the frames' counts.
        skipped_frames: What was wrong with the frames that were skipped.
        is_target_reached: Whether what was waited for ended it.
        failure: What ended it before its time, if anything did: a bad frame, Ctrl-C, a worker that was killed, an error
            of an observer.
        duration_s: How long it took.
        measurement_s: That part of it that went into the observers.
    """

    num_frames: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    skipped_frames: list[str] = field(default_factory=list)
    is_target_reached: bool = False
    failure: Exception | KeyboardInterrupt | None = None
    duration_s: float = 0.0
    measurement_s: float = 0.0

    @property
    def is_complete(self) -> bool:
        """Whether nothing but the end of the frames, or of what was waited for, ended it."""
        return self.failure is None

    def raise_failure(self) -> None:
        """End as the run ended, once what was computed is safe: raise what ended it, if anything did."""
        if self.failure is not None:
            raise self.failure


class MeasuredFrame(NamedTuple):
    """What is left of a frame where it was measured: what each observer is to add, and how long that took there.

    The frame itself is there if an observer needs it; what travels between processes is small without it.
    """

    frame: Frame | None
    counts: Mapping[str, int]
    sums: Mapping[Any, Any]
    measurement_s: float


class MeasuredFrames:
    """Frames that are measured where they are made, in this process or in a worker.

    By observers with `compute_sums`, but for coverage on another device; others are fed with the frame itself.
    """

    def __init__(self, frames: Frames, observers: Sequence[AnyObserver], device: torch.device | str) -> None:
        on_the_cpu = torch.device(device).type == "cpu"
        self.frames = frames
        self._observers: dict[int, Any] = {
            number: one
            for number, one in enumerate(observers)
            if hasattr(one, "compute_sums") and (on_the_cpu or not isinstance(one, CoverageObserver))
        }
        self._needs_frame = len(self._observers) < len(observers)

    def __getitem__(self, index: int) -> MeasuredFrame:
        frame, start = self.frames[index], time.perf_counter()
        sums = {number: observer.compute_sums(frame) for number, observer in self._observers.items()}
        measuring_s = 0.0 if get_worker_info() else time.perf_counter() - start
        return MeasuredFrame(frame if self._needs_frame else None, frame.counts, sums, measuring_s)


class StoppingRule(Protocol):
    """Ends a run before its frames do; see `TargetErrorRule`."""

    def is_reached(self, num_frames: int) -> bool:
        """Whether the run may end after so many steps."""

    def estimate_num_frames(self, max_frames: int) -> int:
        """Steps that the run is thought to take, of so many at most."""

    @property
    def progress_text(self) -> str:
        """How far it is, for the progress bar."""


def observe(
    frames: Frames,
    observers: Iterable[AnyObserver],
    *,
    num_frames: int | None = None,
    num_workers: int = 0,
    device: torch.device | str = "cpu",
    skip_bad_frames: bool = False,
    stopping_rule: StoppingRule | None = None,
    show_progress: bool = False,
    title: str = "steps",
    keep_partial: bool = False,
    journal: CheckpointManager | None = None,
    ranks: Ranks | None = None,
) -> Run:
    """Feed observers with frames. Whatever ends the run, all of them have seen the same frames.

    But for an error of an observer itself: those before it have seen one frame more.

    Args:
        frames: A source of frames, or any map-style dataset or list of them.
        observers: What looks at them.
        num_frames: Only so many frames, from the first on; all if not given.
        num_workers: Processes that make frames; 0 makes them in this one.
        device: Where the observers get the frames' tensors.
        skip_bad_frames: Skip and note frames that cannot be used, instead of ending with the first.
        stopping_rule: Ends the run early.
        show_progress: Whether to show a bar.
        title: What stands before the bar.
        keep_partial: After the first step, what ends the run is noted in it and not raised: for who looks at
            `Run.complete`.
        journal: Goes on from a checkpoint, and keeps it; of these observers and this rule.
        ranks: The processes that share the frames, each of which calls this; the caller adds up what they have seen.

    Raises:
        BadFrameError: The frame that ended it.
        ValueError: Not a single frame could be used.
        TypeError: Several processes make the frames, which do not say of which worlds they are; see `build_scene_lookup`.
        ChildProcessError: A worker was killed.
        KeyboardInterrupt: Ctrl-C.

    Example:
        >>> class Names:
        ...     def __init__(self):
        ...         self.seen = []
        ...     def update(self, frame):
        ...         self.seen.append(frame.name)
        ...     def compute(self):
        ...         return self.seen
        ...     def merge_state(self, other):
        ...         self.seen += other.seen
        >>> frames = [Frame({"rig": torch.rand(9, 3)}, torch.rand(9, 3), index, f"f{index}") for index in range(3)]
        >>> names = Names()
        >>> observe(frames, [names], steps=2).steps, names.compute()
        (2, ['f0', 'f1'])
    """
    run, observers = Run(), list(observers)
    most = len(frames) if num_frames is None else min(num_frames, len(frames))  # type: ignore[arg-type]  # map-style: has one
    if journal:
        journal.restore(run)
    world_of = int if num_workers < 2 and ranks is None else build_scene_lookup(frames)
    todo = iter(range(most)) if ranks is None else ranks.iterate_share(range(most), world_of)
    todo = _left(todo, run, skip_bad_frames=skip_bad_frames)
    start = time.perf_counter() - run.duration_s
    consistent = True  # all observers and the rule know of the same frames
    run.is_target_reached = (
        stopping_rule is not None and run.num_frames > 0 and stopping_rule.is_reached(run.num_frames)
    )
    share = most if ranks is None else -(-most // ranks.num_ranks)
    try:
        with (
            _threads_beside(num_workers),
            Progress(share, title, num_done=run.num_frames, is_shown=show_progress, num_workers=num_workers) as bar,
        ):
            tasks = group_by_scene(() if run.is_target_reached else todo, world_of if num_workers > 1 else int)
            apart = MeasuredFrames(frames, observers, device)
            for seen in _each(apart, tasks, num_workers, run, skip_bad_frames=skip_bad_frames):
                if ranks:
                    ranks.check_failures()
                with defer_signals():
                    consistent = False
                    _feed(seen, observers, run, device)
                    run.is_target_reached = stopping_rule is not None and stopping_rule.is_reached(run.num_frames)
                    consistent = True
                run.duration_s = time.perf_counter() - start
                expected = (
                    share
                    if stopping_rule is None
                    else run.num_frames
                    if run.is_target_reached
                    else stopping_rule.estimate_num_frames(share)
                )
                bar.advance(expected, stopping_rule.progress_text if stopping_rule else "")
                if run.is_target_reached:
                    break
                if journal:
                    journal.write_if_due(run)
    except (Exception, KeyboardInterrupt) as error:  # hours of work are not lost to any of them
        with defer_signals() as signals:
            clear_frames(error.__traceback__)  # which would keep the workers alive
            killed = find_killed_worker(error, num_workers, run.num_frames)
            # Whoever ends workers too, as schedulers do, may have ended them first.
            run.failure = KeyboardInterrupt() if killed and not set(signals).isdisjoint(ENDS) else killed or error
            signals.clear()
    run.duration_s = time.perf_counter() - start
    if journal and run.num_frames and consistent and (run.failure or journal.keep):
        with defer_signals():
            journal.write(run)
    if not (keep_partial and (run.num_frames or ranks)):
        run.raise_failure()
    if not (run.num_frames or ranks):
        raise ValueError("no frame could be used, so there is no result")
    return run


@contextmanager
def _threads_beside(workers: int) -> Iterator[None]:
    before = torch.get_num_threads()
    if workers:
        torch.set_num_threads(max(1, min(before, count_cores() - workers)))
    warn_about_spinning(torch.get_num_threads())
    try:
        yield
    finally:
        torch.set_num_threads(before)


def find_killed_worker(error: BaseException, num_workers: int, num_frames: int) -> ChildProcessError | None:
    """What torch says, wherever this process is, when a worker dies; as an error that a user can do something about."""
    told = isinstance(error, RuntimeError) and str(error).startswith("DataLoader worker (pid")
    # Or its last frame could not be fetched; what a worker itself raises is "Caught ... in DataLoader worker process".
    cut_off = num_workers > 0 and isinstance(error, EOFError | ConnectionError) and not str(error).startswith("Caught ")
    if not (told or cut_off):
        return None
    # A process that is not forked imports the program, which then starts workers of its own, and may not.
    forked = get_start_method() == "fork"
    why = "for want of memory" + ("" if forked else ', or of `if __name__ == "__main__":` around what the program runs')
    return ChildProcessError(
        f"a worker was killed after step {num_frames:,}, perhaps {why}; use fewer workers ({error!r})"
    )


def _feed(seen: MeasuredFrame, observers: Sequence[AnyObserver], run: Run, device: torch.device | str) -> None:
    start = time.perf_counter()
    frame = None if seen.frame is None else seen.frame.to(device)
    for number, observer in enumerate(observers):
        if number in seen.sums:
            observer.add_sums(seen.sums[number])  # type: ignore[attr-defined]  # who has `compute_sums` has it
        elif frame is not None:
            observer.update(frame)
    run.measurement_s += seen.measurement_s + time.perf_counter() - start
    run.counts.update(seen.counts)
    run.num_frames += 1


def _left(indices: Iterator[int], run: Run, *, skip_bad_frames: bool) -> Iterator[int]:
    done = run.num_frames + len(run.skipped_frames)
    if (most := sum(1 for _ in islice(indices, done))) < done:
        raise ValueError(f"steps: {done} are done in the checkpoint; got {most}, which is less")
    if run.skipped_frames and not skip_bad_frames:
        raise ValueError(
            f"{len(run.skipped_frames)} bad frames were skipped before the checkpoint, such as {run.skipped_frames[0]}; go on "
            "skipping them (--set skip_bad_frames=true)"
        )
    return indices


def group_by_scene(indices: Iterable[int], get_scene_id: Callable[[int], int]) -> Iterator[list[int]]:
    """Which frames a worker makes in a row: those of one world, so that only one worker builds it."""
    for _, of_world in groupby(indices, get_scene_id):
        while together := list(islice(of_world, MOST_TOGETHER)):
            yield together


class FramesOrErrors(Dataset[Any]):
    """Frames; what is wrong with one stands in its place, so that it costs none of those that are made with it."""

    def __init__(self, frames: Frames | MeasuredFrames | Dataset[Any]) -> None:
        self.frames = frames

    def __getitem__(self, index: int) -> Any:  # noqa: ANN401  (what the frames are, or an error)
        try:
            return self.frames[index]
        except ValueError as error:
            if get_worker_info() is None:
                return error
            # Of a kind that is known to survive the way to another process; where it arose stands in a note.
            copy = (BadFrameError if isinstance(error, BadFrameError) else ValueError)(str(error))
            copy.add_note(format_exc())
            return copy


def _each(
    frames: MeasuredFrames, tasks: Iterable[list[int]], workers: int, run: Run, *, skip_bad_frames: bool
) -> Iterator[MeasuredFrame]:
    method = get_start_method()
    loader = DataLoader(
        FramesOrErrors(frames),
        batch_sampler=tasks,
        collate_fn=list,
        num_workers=workers,
        worker_init_fn=end_with_parent(),
        generator=torch.Generator("cpu"),  # the loader draws a number: not from the generator of the user
        multiprocessing_context=method if workers else None,
        prefetch_factor=1 if workers else None,  # what is made ahead waits in shared memory
    )
    for batch in iterate_batches(loader):
        for made in batch:
            if isinstance(made, MeasuredFrame):
                yield made
            elif skip_bad_frames and isinstance(made, BadFrameError):
                run.skipped_frames.append(str(made))
            else:
                raise made


def iterate_batches(loader: DataLoader[Any]) -> Iterator[Any]:
    """Iterate over the batches of a loader, with a warning about each of its workers that is stopped.

    Whatever ends the loop early kills workers that are stopped, for which the end of the program would wait.
    """
    with torch.device("cpu"):  # the number that the loader draws is a tensor of the default device
        batches = iter(loader)
    workers = [worker.pid or 0 for worker in active_children()] if loader.num_workers else []
    try:
        while True:
            with report_stopped_processes(workers, "a worker"):
                batch = next(batches, None)
            if batch is None:
                return
            yield batch
    except BaseException:
        for pid in filter(is_stopped, workers):
            os.kill(pid, signal.SIGKILL)
        raise
