"""What every reader of recordings gives: scans of named sensors at instants, and where the vehicle was."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from torchcover.cameras.calibration import Calibration
from torchcover.detection.boxes import Boxes
from torchcover.files import RECORDING, WRITING, read_manifest, reads
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.arrays import Points

# A return from so near to the origin of its frame is one that never came, which drivers store as zeros.
NO_RETURN_M = 1e-3
# Steps that are longer are counts of milliseconds, microseconds or nanoseconds.
LONGEST_STEP_S = 3600.0
# Steps that are longer and shorter than these, in s and m/s, are milliseconds of somebody who moves.
LONG_STEP_S = 10.0
SLOW_MPS = 0.2
# Times may be off by this share of a step.
COARSEST = 0.01


@dataclass(frozen=True)
class Scan:
    """What a sensor recorded at one instant, as it was stored.

    Args:
        points_m: (N, 3) points in the frame of the sensor; those that are not finite or lie in the sensor itself are
            returns that never came.
        vehicle_T_sensor: (4, 4) where the sensor was; None: the points are in the vehicle frame already.
        source: Where it was read from, for messages.
        min_range_m: What is nearer to the sensor is a return that never came.
        weights: (N,) what each point of a reference counts for, positive; None if all count the same.
        heights_m: (N,) height of each point of a reference above the local ground, NaN where there is none at or below;
            None if it is unknown.
        rows: (N,) number of the laser of each point; None if it is unknown.
        offsets_s: (N,) when each point was measured, after the instant that it was moved to; None: as measured, or
            nobody says it.
    """

    points_m: Points
    vehicle_T_sensor: Matrix | None
    source: str
    min_range_m: float = 0.0
    weights: NDArray[np.float64] | None = None
    heights_m: NDArray[np.float32] | None = None
    rows: NDArray[np.integer] | None = None
    offsets_s: NDArray[np.float64] | None = None


def check_times(times_s: NDArray[np.float64], count: int, source: str) -> NDArray[np.float64]:
    """Return the times of instants in seconds, if they can be those.

    ValueError: another number of them, or two that do not follow each other.
    """
    if len(times_s) != count:
        raise ValueError(f"{source}: {len(times_s):,} times for {count:,} scans; one each is needed")
    bad = np.flatnonzero(~(np.diff(times_s) > 0))
    if len(bad):
        first = int(bad[0])
        raise ValueError(
            f"{source}: times have to ascend; {len(bad)} do not, the first after instant {first}: "
            f"{times_s[first]:.6f} s, then {times_s[first + 1]:.6f} s; leave such instants out, or correct their times"
        )
    check_seconds(times_s, f"{source}: ")
    return times_s


def check_seconds(
    times_s: NDArray[np.floating], source: str = "", positions_m: NDArray[np.floating] | None = None
) -> None:
    """Refuse ascending times that are in another unit than seconds, or too coarse.

    Args:
        times_s: (K,) times as they were stored.
        source: What begins the message.
        positions_m: (K, 3) positions at these times, whose speed tells milliseconds from seconds.

    Raises:
        ValueError: Their median step is longer than an hour, or than 10 s at a crawl, or they are float32 and as far
            apart as its digits.
    """
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    speed_mps = 0.0
    if positions_m is not None and step_s:
        speed_mps = float(np.median(np.linalg.norm(np.diff(positions_m, axis=0), axis=1) / np.diff(times_s)))
    if step_s > LONGEST_STEP_S or (step_s > LONG_STEP_S and 0.0 < speed_mps < SLOW_MPS):
        raise ValueError(
            f"{source}times in seconds are needed; the usual step of these is {step_s:g}: divide them by 1e3, 1e6 or "
            "1e9 if they count milliseconds, microseconds or nanoseconds"
        )
    digits_s = float(np.spacing(np.abs(times_s).max(initial=0.0)))
    if step_s and digits_s > COARSEST * step_s:
        raise ValueError(
            f"{source}times of {times_s.dtype} are up to {digits_s:g} s off, with a usual step of {step_s:g} s; store "
            "them as float64, or count them from the first one"
        )


class Recording(Protocol):
    """A drive as somebody recorded it. A reader of a layout is a class like this, made from a path; see `FORMATS`.

    Instants are numbered in time. What a reader opens at once is small: names, times, calibrations. Scans are read one
    by one.

    Args:
        body: The vehicle itself, in its own frame; None if unknown. Whoever knows it may say so.
    """

    body: BoundingBox | None

    @property
    def path(self) -> Path:
        """Where it is."""

    @property
    def names(self) -> Sequence[str]:
        """What a user calls the instants; so many there are."""

    @property
    def frames(self) -> Sequence[int]:
        """Numbers of the instants that are meant to be looked at, ascending; the others serve a reference only."""

    @property
    def times_s(self) -> NDArray[np.float64] | None:
        """(F,) when they were, ascending; None if unknown."""

    @property
    def sensors(self) -> Sequence[str]:
        """Names of the sensors that belong to the vehicle."""

    @property
    def rigs(self) -> Mapping[str, Sequence[str]]:
        """Name of each rig -> its sensors, unless others are asked for."""

    @property
    def reference_sensors(self) -> Sequence[str]:
        """Sensors that were recorded to be the reference; empty where there was none."""

    @property
    def square_metres(self) -> bool:
        """Whether the scans of the reference sensors have weights, the square metres that their points stand for."""

    @property
    def instants(self) -> Sequence[int] | None:
        """`Frame.place_in_time` of each instant, for standard errors; None: no two of them are known to be alike."""

    def scan(self, sensor: str, index: int, /) -> Scan:
        """Read what a sensor recorded at an instant.

        Raises:
            OSError: It is not there.
            ValueError: It is not what it is meant to be.
        """

    def world_T_vehicle(self, index: int, /) -> Matrix | None:
        """(4, 4) where the vehicle was, in a world that does not move; None if unknown."""

    def boxes(self, index: int, /) -> Boxes | None:
        """The labelled objects of an instant in the vehicle frame; None where it is not labelled."""


class Layout:
    """What most layouts have in common: every instant is looked at, and no reference was recorded."""

    names: Sequence[str]
    reference_sensors: Sequence[str] = ()
    square_metres = False
    instants: Sequence[int] | None = None
    body: BoundingBox | None = None

    @property
    def frames(self) -> range:
        """All instants."""
        return range(len(self.names))


class SensorCalibrations(NamedTuple):
    """Mounts of LiDARs, and cameras.

    `source`: where it is from, for people; `mounts`: name of a LiDAR -> (4, 4) `vehicle_T_lidar`, where its scans do
    not say it; `cameras`: with their places in the vehicle frame.
    """

    source: str
    mounts: Mapping[str, Matrix]
    cameras: tuple[Calibration, ...] = ()


@runtime_checkable
class CalibratedRecording(Protocol):
    """A recording that knows more of its sensors."""

    def calibrations(self) -> SensorCalibrations:
        """Read them; cameras are those of the images as the data set ships them.

        Raises:
            OSError: They are not there.
            ValueError: They are not what they are meant to be.
        """


@runtime_checkable
class UndistortedRecording(Protocol):
    """A recording that ships undistorted or rectified images, and knows the distortion of the lenses, too."""

    def raw_cameras(self) -> tuple[Calibration, ...]:
        """Read the cameras with their lenses as calibrated, before images were undistorted.

        Raises:
            OSError: They are not there.
            ValueError: They are not what they are meant to be.
        """


def warn_of_missing_poses(path: Path, missing: Sequence[str], count: int) -> None:
    """Warn of the sweeps that are left out because the vehicle's pose at their time is not known.

    Args:
        path: The file or folder of poses.
        missing: Names of these sweeps.
        count: Number of all sweeps.

    Raises:
        ValueError: No sweep has a pose.
    """
    if len(missing) == count:
        raise ValueError(f"{path}: none of {count:,} sweeps has a pose, the first is {missing[0]}; is it one log?")
    if missing:
        warnings.warn(
            f"{path}: {len(missing):,} of {count:,} sweeps are left out, for there is no pose at their time; the first "
            f"is {missing[0]}",
            stacklevel=3,
        )


@reads("the manifest of a recording")
def read_recording_manifest(path: Path) -> dict[str, Any]:
    """Read `recording.json`, which lists the `files` of a recording that torchcover has written, and its `frames`.

    While it is written, `writing` is true, and `steps` are those that are complete.

    Raises:
        BadFileError: Another content.
    """
    manifest = {"content": {}, "steps": [], "frames": None, **(read_manifest(path.resolve()) or {})}
    if not isinstance(manifest["steps"] if manifest.get(WRITING) else manifest["frames"], list):
        raise ValueError("a list of files with their sizes, and the names of the frames, are needed; record it again")
    return manifest


def whole_recording(folder: Path) -> dict[str, Any] | None:
    """Read the manifest of a complete recording that torchcover has written; None of any other one.

    Raises:
        BadFileError: A `recording.json` that cannot be read.
        ValueError: A part of a recording.
    """
    if not (folder / RECORDING).exists():
        return None
    manifest = read_recording_manifest(folder / RECORDING)
    if manifest.get(WRITING):
        raise ValueError(
            f"{folder}: a part of a recording, {len(manifest['steps']):,} frames: whatever wrote it was ended; go on "
            "with `torchcover record --resume`"
        )
    return manifest
