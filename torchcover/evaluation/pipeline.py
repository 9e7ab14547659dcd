"""Observation loop: make the frames in order and pass each of them to all observers."""

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from traceback import clear_frames
from typing import Any, NamedTuple, Protocol

import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info

from torchcover.evaluation.checkpoint import CheckpointManager
from torchcover.evaluation.cpu_cores import get_start_method
from torchcover.evaluation.frame_workers import (
    FramesOrErrors,
    find_killed_worker,
    group_by_scene,
    iterate_batches,
    limit_threads,
)
from torchcover.evaluation.observers import AnyObserver, CoverageObserver
from torchcover.evaluation.progress import END_SIGNALS, Progress, defer_signals
from torchcover.evaluation.ranks import Ranks
from torchcover.files import end_with_parent
from torchcover.frames import BadFrameError, Frame, build_scene_lookup

Frames = Dataset[Frame] | Sequence[Frame]


@dataclass
class Run:
    """Outcome of a run.

    Args:
        num_frames: Frames that all observers have received.
        counts: Sums of the counts of all frames.
        skipped_frames: Reason for each frame that was skipped.
        is_target_reached: Whether the stopping rule ended the run.
        failure: Error that ended the run early: a bad frame, Ctrl-C, a worker that was killed, an error of an observer.
        duration_s: Duration of the run.
        measurement_s: Time in the observers in this process.
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
        """True if the run ended with its last frame or by its stopping rule."""
        return self.failure is None

    def raise_failure(self) -> None:
        """Raise the error that ended the run early, if there is one; call it once the results are saved."""
        if self.failure is not None:
            raise self.failure


class MeasuredFrame(NamedTuple):
    """Result of a frame in the process that made it; it is small to send if it contains no frame.

    Args:
        frame: The frame, if an observer needs it.
        counts: Counts of the frame.
        sums: Index of each observer that measures where frames are made -> the sums to add.
        measurement_s: Time for the sums, 0 in a worker.
    """

    frame: Frame | None
    counts: Mapping[str, int]
    sums: Mapping[Any, Any]
    measurement_s: float


class MeasuredFrames(Dataset[MeasuredFrame]):
    """Map-style dataset that measures frames where they are made, in this process or in a worker.

    Observers with `compute_sums` measure there, except coverage on another device; other observers need the frame.

    Args:
        frames: Source of the frames.
        observers: All observers of the run.
        device: Device of the observers.
    """

    def __init__(self, frames: Frames, observers: Sequence[AnyObserver], device: torch.device | str) -> None:
        is_on_cpu = torch.device(device).type == "cpu"
        self.frames = frames
        self._observers: dict[int, Any] = {}
        for index, observer in enumerate(observers):
            needs_device = isinstance(observer, CoverageObserver) and not is_on_cpu
            if hasattr(observer, "compute_sums") and not needs_device:
                self._observers[index] = observer
        self._needs_frame = len(self._observers) < len(observers)

    def __getitem__(self, index: int) -> MeasuredFrame:
        """Make a frame and measure it; the frame itself is only returned if an observer needs it."""
        frame, start = self.frames[index], time.perf_counter()
        sums = {number: observer.compute_sums(frame) for number, observer in self._observers.items()}
        measurement_s = 0.0 if get_worker_info() else time.perf_counter() - start
        return MeasuredFrame(frame if self._needs_frame else None, frame.counts, sums, measurement_s)


class StoppingRule(Protocol):
    """Rule that ends a run before its last frame; see `TargetErrorRule`."""

    def is_reached(self, num_frames: int) -> bool:
        """Test whether the run may end after this number of frames."""

    def estimate_num_frames(self, max_frames: int) -> int:
        """Estimate the number of frames of the whole run, at most `max_frames`."""

    @property
    def progress_text(self) -> str:
        """Status for the progress bar."""


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
    title: str = "frames",
    keep_partial: bool = False,
    journal: CheckpointManager | None = None,
    ranks: Ranks | None = None,
) -> Run:
    """Pass frames to observers. All observers have received the same frames, however the run ends.

    The only exception is an error in an observer: the observers before it have received one more frame.

    Args:
        frames: Source of frames, or any map-style dataset or list of frames.
        observers: Observers that receive each frame.
        num_frames: Number of frames, starting with the first; all if not given.
        num_workers: Number of processes that make frames; 0 makes them in this process.
        device: Device of the tensors that observers receive.
        skip_bad_frames: Skip and record bad frames; otherwise the first bad frame ends the run.
        stopping_rule: Rule that ends the run early.
        show_progress: Whether to show a progress bar.
        title: Title of the progress bar.
        keep_partial: After the first frame, an error is stored in `Run.failure` instead of raised; check
            `Run.is_complete`.
        journal: Checkpoint of these observers and this rule; the run continues from it and is saved to it.
        ranks: Processes that share the frames; each of them calls this function, and the caller merges the results.

    Returns:
        Outcome of the run.

    Raises:
        BadFrameError: Bad frame that ended the run.
        ValueError: No frame could be used.
        TypeError: Several processes make frames, and the frames do not provide scene ids; see `build_scene_lookup`.
        ChildProcessError: A worker was killed.
        KeyboardInterrupt: Ctrl-C.

    Example:
        >>> class Names:
        ...     def __init__(self):
        ...         self.names = []
        ...     def update(self, frame):
        ...         self.names.append(frame.name)
        ...     def compute(self):
        ...         return self.names
        ...     def merge_state(self, other):
        ...         self.names += other.names
        >>> frames = [Frame({"rig": torch.rand(9, 3)}, torch.rand(9, 3), index, f"f{index}") for index in range(3)]
        >>> names = Names()
        >>> observe(frames, [names], num_frames=2).num_frames, names.compute()
        (2, ['f0', 'f1'])
    """
    run = Run()
    total = len(frames)  # type: ignore[arg-type]  # map-style datasets have a length
    max_frames = total if num_frames is None else min(num_frames, total)
    if journal:
        journal.restore(run)
    loop = _ObservationLoop(
        frames, list(observers), run, num_workers, device, skip_bad_frames, stopping_rule, journal, ranks
    )
    tasks = loop.plan_tasks(max_frames)
    # The largest share of a rank, which the progress bar shows.
    num_expected = max_frames if ranks is None else -(-max_frames // ranks.num_ranks)
    start_s = time.perf_counter() - run.duration_s
    try:
        with (
            limit_threads(num_workers),
            Progress(
                num_expected, title, num_done=run.num_frames, is_shown=show_progress, num_workers=num_workers
            ) as bar,
        ):
            loop.process(tasks, bar, num_expected, start_s)
    except (Exception, KeyboardInterrupt) as error:  # the results of hours must survive any error
        run.failure = loop.find_failure(error)
    run.duration_s = time.perf_counter() - start_s
    if journal and run.num_frames and loop.is_consistent and (run.failure or journal.keep):
        with defer_signals():
            journal.write(run)
    if not (keep_partial and (run.num_frames or ranks)):
        run.raise_failure()
    if not (run.num_frames or ranks):
        raise ValueError("no frame could be used, so there is no result")
    return run


@dataclass
class _ObservationLoop:
    """State of one call of `observe`, whose arguments these are.

    Args:
        is_consistent: Whether all observers and the stopping rule have received the same frames.
    """

    frames: Frames
    observers: Sequence[AnyObserver]
    run: Run
    num_workers: int
    device: torch.device | str
    skip_bad_frames: bool
    stopping_rule: StoppingRule | None
    journal: CheckpointManager | None
    ranks: Ranks | None
    is_consistent: bool = True

    def plan_tasks(self, max_frames: int) -> Iterator[list[int]]:
        """Plan which frames are made together: the remaining frames of this rank, grouped by scene.

        Args:
            max_frames: Number of frames of all ranks.
        """
        needs_scene_ids = self.num_workers > 1 or self.ranks is not None
        get_scene_id = build_scene_lookup(self.frames) if needs_scene_ids else int
        indices = iter(range(max_frames))
        if self.ranks is not None:
            indices = self.ranks.iterate_share(range(max_frames), get_scene_id)
        self._skip_finished(indices)
        self._update_stopping_rule(is_first=True)
        return group_by_scene(
            () if self.run.is_target_reached else indices, get_scene_id if self.num_workers > 1 else int
        )

    def process(self, tasks: Iterable[list[int]], bar: Progress, num_expected: int, start_s: float) -> None:
        """Make, measure and add all frames of the tasks, until the stopping rule ends the run.

        Args:
            tasks: Indices of frames that are made together.
            bar: Progress bar.
            num_expected: Expected number of frames without a stopping rule.
            start_s: Start of the run on the clock `time.perf_counter`.
        """
        run, rule = self.run, self.stopping_rule
        measured_frames = MeasuredFrames(self.frames, self.observers, self.device)
        for measured in self._iterate_measured(measured_frames, tasks):
            if self.ranks:
                self.ranks.check_failures()
            with defer_signals():  # a signal must not separate the observers
                self.is_consistent = False
                self._add_frame(measured)
                self._update_stopping_rule()
                self.is_consistent = True
            run.duration_s = time.perf_counter() - start_s
            if run.is_target_reached:
                bar.advance(run.num_frames, rule.progress_text if rule else "")
                break
            bar.advance(
                rule.estimate_num_frames(num_expected) if rule else num_expected, rule.progress_text if rule else ""
            )
            if self.journal:
                self.journal.write_if_due(run)

    def find_failure(self, error: Exception | KeyboardInterrupt) -> Exception | KeyboardInterrupt:
        """Find the cause of an error: Ctrl-C, a worker that was killed, or the error itself.

        Args:
            error: Error that ended the loop.
        """
        with defer_signals() as signals:
            clear_frames(error.__traceback__)  # its references would keep the workers alive
            killed = find_killed_worker(error, self.num_workers, self.run.num_frames)
            # Schedulers end the workers together with this process, and perhaps first.
            is_ended_from_outside = killed and not set(signals).isdisjoint(END_SIGNALS)
            signals.clear()
            return KeyboardInterrupt() if is_ended_from_outside else killed or error

    def _skip_finished(self, indices: Iterator[int]) -> None:
        """Skip the frames that the checkpoint contains."""
        run = self.run
        num_done = run.num_frames + len(run.skipped_frames)
        num_skipped = sum(1 for _ in islice(indices, num_done))
        if num_skipped < num_done:
            raise ValueError(f"num_frames: {num_done} are done in the checkpoint; got {num_skipped}, which is less")
        if run.skipped_frames and not self.skip_bad_frames:
            raise ValueError(
                f"{len(run.skipped_frames)} bad frames were skipped before the checkpoint, such as "
                f"{run.skipped_frames[0]}; continue to skip them (--set skip_bad_frames=true)"
            )

    def _update_stopping_rule(self, *, is_first: bool = False) -> None:
        """Ask the stopping rule whether the run may end; before the first frame, it may not."""
        rule, num_frames = self.stopping_rule, self.run.num_frames
        self.run.is_target_reached = (
            rule is not None and (num_frames > 0 or not is_first) and rule.is_reached(num_frames)
        )

    def _add_frame(self, measured: MeasuredFrame) -> None:
        """Add a frame to all observers and to the counts of the run."""
        start = time.perf_counter()
        frame = None if measured.frame is None else measured.frame.to(self.device)
        for index, observer in enumerate(self.observers):
            if index in measured.sums:
                observer.add_sums(measured.sums[index])  # type: ignore[attr-defined]  # exists with `compute_sums`
            elif frame is not None:
                observer.update(frame)
        self.run.measurement_s += measured.measurement_s + time.perf_counter() - start
        self.run.counts.update(measured.counts)
        self.run.num_frames += 1

    def _iterate_measured(self, frames: MeasuredFrames, tasks: Iterable[list[int]]) -> Iterator[MeasuredFrame]:
        """Make the frames of all tasks, in this process or in workers; bad ones are recorded or raised."""
        start_method = get_start_method()
        loader = DataLoader(
            FramesOrErrors(frames),
            batch_sampler=tasks,
            collate_fn=list,
            num_workers=self.num_workers,
            worker_init_fn=end_with_parent(),
            generator=torch.Generator("cpu"),  # the loader samples a seed, which must not use the user's generator
            multiprocessing_context=start_method if self.num_workers else None,
            prefetch_factor=1 if self.num_workers else None,  # prefetched frames occupy shared memory
        )
        for batch in iterate_batches(loader):
            for result in batch:
                if isinstance(result, MeasuredFrame):
                    yield result
                elif self.skip_bad_frames and isinstance(result, BadFrameError):
                    self.run.skipped_frames.append(str(result))
                else:
                    raise result
