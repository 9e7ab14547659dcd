"""The run that `evaluate` and `compare` share: frames in, one metric for each rig fed from the same frames."""

import os
import signal
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from torch.utils.data import DataLoader, Dataset

from torchcover.cli.stopping import TargetWatch
from torchcover.coverage import BevGrid, CoverageMetric
from torchcover.data import BadFrameError, Frame, FrameBatch, collate_frames
from torchcover.geometry import BoundingBox
from torchcover.report import SensorView
from torchcover.simulation import Rig
from torchcover.simulation.rig import Sensor

DEFAULT_SCENARIO = "courtyard"
# For standard errors: at least half as many are in use at the end of a long run.
BLOCKS = 16
# Holds the paper's regions, and the space beside and behind the vehicle.
GRID_X_M = (-40.0, 160.0)
GRID_Y_M = (-40.0, 40.0)


@dataclass
class Progression:
    """How a run went: sums of the frames' counts, what was skipped, and the error that ended it, if one did."""

    counts: Counter[str] = field(default_factory=Counter)
    skipped: list[str] = field(default_factory=list)
    failure: BadFrameError | None = None
    interrupted: bool = False
    seconds: float = 0.0

    @property
    def complete(self) -> bool:
        """Whether nothing but the end of the frames, or a target error that was reached, ended it."""
        return self.failure is None and not self.interrupted

    def raise_failure(self) -> None:
        """End as the run ended, once what was computed is written."""
        if self.failure is not None:
            raise self.failure
        if self.interrupted:
            raise KeyboardInterrupt


def device_called(name: str) -> torch.device:
    """The device of `--device`.

    Raises:
        ValueError: It cannot be used here.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device {name}: cannot be used here ({str(error).splitlines()[0]}); try cpu") from error
    return device


def check_out(folder: Path) -> None:
    """Find out before the run, not after it, whether its results can be written.

    Raises:
        ValueError: The folder, or the first of its parents that exists, is a file or may not be written to.
    """
    nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not nearest.is_dir():
        raise ValueError(f"--out {folder}: {nearest} is a file, not a folder")
    if not os.access(nearest, os.W_OK):
        raise ValueError(f"--out {folder}: {nearest} may not be written to; choose another folder")


def new_metric(
    cell: float, thresholds: tuple[float, ...], device: torch.device, *, blocks: int = BLOCKS
) -> CoverageMetric:
    """An empty metric over the command line's grid, with standard errors unless there is one block only.

    Raises:
        ValueError: A cell or a threshold that makes no sense, or more cells than the memory has room for.
    """
    grid = BevGrid(x=GRID_X_M, y=GRID_Y_M, cell=cell)
    try:
        return CoverageMetric(grid, thresholds, max_radius=grid.diagonal_m, blocks=blocks).to(device)
    except RuntimeError as error:  # what torch raises when there is no memory left
        raise ValueError(
            f"--cell {cell:g}: there is not enough memory for the sums of {grid.cells:,} cells in {blocks} blocks; "
            "use larger cells"
        ) from error


def accumulate(
    frames: Dataset[Frame],
    metrics: Sequence[CoverageMetric],
    device: torch.device,
    *,
    workers: int,
    skip_bad_frames: bool = False,
    watch: TargetWatch | None = None,
) -> Progression:
    """Feed every frame to the metrics, or as many as the target error needs.

    Args:
        frames: A map-style dataset.
        metrics: One for each rig of the frames, in their order. However the run ends, all have seen the same steps.
        device: Where the metrics are.
        workers: Processes that make frames.
        skip_bad_frames: Skip and note frames that cannot be read, instead of stopping at the first.
        watch: Ends the run when its target error is reached.

    Returns:
        How it went; a bad frame or Ctrl-C after the first step is noted there, not raised.

    Raises:
        ValueError: Not a single frame could be used.
    """
    progression = Progression()
    start = time.perf_counter()
    with _progress_bar() as bar:
        most: int = len(frames)  # type: ignore[arg-type]  # map-style: has a length
        task = bar.add_task("steps", total=most, rate="", error="")
        try:
            for batch in _batches(frames, workers, skip_bad_frames, progression):
                (frame,) = batch.to(device).frames
                with _to_the_end():
                    for metric, sensor in zip(metrics, frame.clouds.values(), strict=True):
                        metric.update(sensor, frame.reference, weights=frame.reference_weights, index=frame.index)
                    progression.counts.update(frame.counts)
                _advance(bar, task)
                if watch is not None:
                    reached = watch.is_reached(steps := int(metrics[0].steps))
                    error = watch.worst.words if watch.worst else ""
                    bar.update(task, total=steps if reached else watch.expected_steps(most), error=error)
                    if reached:
                        break
        except KeyboardInterrupt:
            progression.interrupted = True
    progression.seconds = time.perf_counter() - start
    if not int(metrics[0].steps):
        raise progression.failure or ValueError("no frame could be used; nothing is written")
    return progression


def outline_m(box: BoundingBox) -> NDArray[np.float64]:
    """(4, 2) corners x, y of a box seen from above, counter-clockwise."""
    (x0, y0, _), (x1, y1, _) = box.lower_m, box.upper_m
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def sensor_views(rig: Rig) -> list[SensorView]:
    """The sensors of a rig as pictures show them."""
    return [_sensor_view(sensor) for sensor in rig.sensors]


def _sensor_view(sensor: Sensor) -> SensorView:
    x, y, z = sensor.directions()
    middle = x.shape[1] // 2
    elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))[:, middle]
    return SensorView(
        name=sensor.name,
        vehicle_T_sensor=sensor.mount.matrix(),
        horizontal_fov_deg=sensor.horizontal_fov_deg,
        vertical_fov_deg=(float(np.nanmin(elevation_deg)), float(np.nanmax(elevation_deg))),
        range_m=sensor.max_range_m,
    )


def _batches(
    frames: Dataset[Frame], workers: int, skip_bad_frames: bool, progression: Progression
) -> Iterator[FrameBatch]:
    """One frame at a time; notes bad ones in `progression`, and ends at the first unless they are to be skipped."""
    loader = DataLoader(frames, batch_size=1, collate_fn=collate_frames, num_workers=workers)
    iterator = iter(loader)
    while True:
        try:
            yield next(iterator)
        except StopIteration:
            return
        except BadFrameError as error:
            if not skip_bad_frames:
                progression.failure = error
                return
            progression.skipped.append(str(error))


@contextmanager
def _to_the_end() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done: no step may count for some rigs, or some sums, only."""
    pressed = False

    def press(*_: Any) -> None:  # noqa: ANN401
        nonlocal pressed
        pressed = True

    before = signal.signal(signal.SIGINT, press)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        signal.raise_signal(signal.SIGINT)  # what it would have done: nothing, where it is ignored


def _progress_bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[error]}"),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=Console(stderr=True),
    )


def _advance(bar: Progress, task: TaskID) -> None:
    bar.advance(task)
    speed = bar.tasks[0].speed
    bar.update(task, rate=f"{speed:.2f} steps/s" if speed else "")
