"""Worker processes that make frames: their tasks, their errors and their end."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import groupby, islice
from multiprocessing import active_children
from traceback import format_exc
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info

from torchcover.evaluation.cpu_cores import count_cores, get_start_method, warn_about_spinning
from torchcover.files import is_stopped, report_stopped_processes
from torchcover.frames import BadFrameError

# Frames of one task of a worker, at most: all of them wait in memory until the task is done.
MAX_FRAMES_PER_TASK = 16


@contextmanager
def limit_threads(num_workers: int) -> Iterator[None]:
    """Leave the cores of the workers to them while the block runs."""
    num_threads = torch.get_num_threads()
    if num_workers:
        torch.set_num_threads(max(1, min(num_threads, count_cores() - num_workers)))
    warn_about_spinning(torch.get_num_threads())
    try:
        yield
    finally:
        torch.set_num_threads(num_threads)


def find_killed_worker(error: BaseException, num_workers: int, num_frames: int) -> ChildProcessError | None:
    """Recognize the errors that torch raises when a worker was killed.

    Args:
        error: Error of the run.
        num_workers: Number of worker processes.
        num_frames: Number of finished frames, for the message.

    Returns:
        Error with advice for the user; None for any other error.
    """
    is_reported = isinstance(error, RuntimeError) and str(error).startswith("DataLoader worker (pid")
    # The connection may also end while a frame is received. Errors of a worker itself start with "Caught ".
    is_cut_off = isinstance(error, EOFError | ConnectionError) and not str(error).startswith("Caught ")
    if not (is_reported or (num_workers > 0 and is_cut_off)):
        return None
    causes = "for want of memory"
    if get_start_method() != "fork":  # the worker imports the main module, which must not start workers in turn
        causes += ', or of `if __name__ == "__main__":` around what the program runs'
    return ChildProcessError(
        f"a worker was killed after frame {num_frames:,}, perhaps {causes}; use fewer workers ({error!r})"
    )


def group_by_scene(indices: Iterable[int], get_scene_id: Callable[[int], int]) -> Iterator[list[int]]:
    """Group consecutive frames of one scene, so that only one worker builds it.

    Args:
        indices: Indices of frames.
        get_scene_id: Function from the index of a frame to its scene.

    Returns:
        Iterator over groups of at most 16 indices.
    """
    for _, scene_indices in groupby(indices, get_scene_id):
        while group := list(islice(scene_indices, MAX_FRAMES_PER_TASK)):
            yield group


class FramesOrErrors(Dataset[Any]):
    """Dataset that returns the error of a bad frame in its place, so that other frames of a task are not lost.

    Args:
        frames: Source of the frames.
    """

    def __init__(self, frames: Dataset[Any]) -> None:
        self.frames = frames

    def __getitem__(self, index: int) -> Any:  # noqa: ANN401  (a frame, or an error)
        """Return a frame, or the error of a bad one; an error in a worker has its traceback as a note."""
        try:
            return self.frames[index]
        except ValueError as error:
            if get_worker_info() is None:
                return error
            # Only these classes are known to survive pickling; the traceback becomes a note.
            error_class = BadFrameError if isinstance(error, BadFrameError) else ValueError
            copy = error_class(str(error))
            copy.add_note(format_exc())
            return copy


def iterate_batches(loader: DataLoader[Any]) -> Iterator[Any]:
    """Iterate over the batches of a loader and warn about workers that are stopped.

    If the loop ends early, stopped workers are killed, because the end of the program would wait for them.

    Args:
        loader: The loader.

    Returns:
        Iterator over the batches.
    """
    with torch.device("cpu"):  # the loader samples its seed as a tensor on the default device
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
        for pid in workers:
            if is_stopped(pid):
                os.kill(pid, signal.SIGKILL)
        raise
