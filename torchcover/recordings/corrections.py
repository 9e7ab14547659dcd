"""What a user knows to be wrong about a recording, put right: nothing is, unless it is asked for."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # which the command line's help would wait for
    from torchcover.geometry.rigid import Matrix
    from torchcover.recordings.recording import Recording, Scan

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# A lag is undone by going on as between the two nearest poses, beyond the first and the last, too.
LONGEST_LAG_S = 1.0


@dataclass(frozen=True)
class Corrections:
    """How a recording is to be read other than its format says.

    Raises:
        ValueError: A lag of more than a second.
    """

    quaternions: Annotated[
        Literal["wxyz", "xyzw"], "Order in which the recording has the numbers of its rotations."
    ] = "wxyz"
    poses: Annotated[
        Literal["given", "inverse", "yx", "held"],
        "What its poses are: vehicle_T_world (`inverse`), x and y of places exchanged (`yx`), or each repeated until "
        "the next one came (`held`; they are interpolated then).",
    ] = "given"
    axes: Annotated[Literal["xyz", "yxz"], "What the columns of its clouds are."] = "xyz"
    units: Annotated[Literal["m", "cm", "mm"], "What its clouds are in."] = "m"
    lag_s: Annotated[float, "Seconds by which its poses are late: a scan's own is stamped so much after it."] = 0.0

    def __post_init__(self) -> None:
        if not abs(self.lag_s) <= LONGEST_LAG_S:
            raise ValueError(f"lag: at most {LONGEST_LAG_S:g} s are undone; got {self.lag_s:g}; mend the times instead")

    @property
    def words(self) -> str:
        """As options of the command line; empty without any.

        Example:
            >>> Corrections(units="mm", lag_s=0.1).words
            '--units mm --lag 0.1'
        """
        told = {each.name.removesuffix("_s"): getattr(self, each.name) for each in fields(self)}
        usual = (each.default for each in fields(self))
        pairs = zip(told.items(), usual, strict=True)
        return " ".join(f"--{name} {value}" for (name, value), default in pairs if value != default)

    def of_poses(self, world_T_vehicle: "Matrix", times_s: NDArray[np.float64]) -> "Matrix":
        """(N, 4, 4) poses of N instants in a row, put right."""
        from torchcover.geometry import (  # torch, which the help has no need of
            euler_from_rotation,
            invert,
            quaternion_from_rotation,
            rigid,
            rotation_from_euler,
            rotation_from_quaternion,
        )

        poses = world_T_vehicle.copy()
        if self.quaternions == "xyzw":  # what was read as w, x, y, z
            wxyz = np.roll([quaternion_from_rotation(rotation) for rotation in poses[:, :3, :3]], 1, axis=1)
            poses[:, :3, :3] = rotation_from_quaternion(wxyz)
        if self.poses == "inverse":
            poses = invert(poses)
        elif self.poses == "yx":
            poses[:, :3, 3] = poses[:, [1, 0, 2], 3]
        if self.poses != "held" and not self.lag_s:
            return poses
        new = np.append(True, (np.diff(poses, axis=0) != 0).any(axis=(1, 2)) | (self.poses != "held"))
        known, known_s = poses[new], times_s[new]
        if len(known) < 2:
            return poses
        after = np.searchsorted(known_s, times_s + self.lag_s, side="right").clip(1, len(known) - 1)
        before = after - 1
        share = ((times_s + self.lag_s - known_s[before]) / (known_s[after] - known_s[before]))[:, None]
        angles_deg, places_m = euler_from_rotation(known[:, :3, :3]), known[:, :3, 3]
        turns_deg = (angles_deg[after] - angles_deg[before] + 180) % 360 - 180
        rotations = rotation_from_euler(*(angles_deg[before] + share * turns_deg).T)
        return rigid(rotations, places_m[before] + share * (places_m[after] - places_m[before]))

    def of_scan(self, scan: "Scan") -> "Scan":
        """A scan, put right."""
        points_m = scan.points_m[:, [1, 0, 2]] if self.axes == "yxz" else scan.points_m
        return replace(scan, points_m=points_m if self.units == "m" else points_m * METRES[self.units])


class Corrected:
    """A recording with corrections; all else is as it is there."""

    def __init__(self, recording: "Recording", corrections: Corrections) -> None:
        self.recording, self.corrections = recording, corrections

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (what the recording has)
        if name == "recording":  # while it is made from a pickle
            raise AttributeError(name)
        return getattr(self.recording, name)

    def scan(self, sensor: str, index: int) -> "Scan":
        """What the recording has, put right."""
        return self.corrections.of_scan(self.recording.scan(sensor, index))

    def world_T_vehicle(self, index: int) -> "Matrix | None":
        """Where the vehicle was, put right."""
        return None if self._poses is None else self._poses[index]

    @cached_property
    def _poses(self) -> "Matrix | None":
        poses = [self.recording.world_T_vehicle(instant) for instant in range(len(self.recording.names))]
        known = [pose for pose in poses if pose is not None]
        if len(known) < len(poses):
            return None
        times_s = self.recording.times_s
        if times_s is None and (self.corrections.lag_s or self.corrections.poses == "held"):
            raise ValueError(f"{self.recording.path}: {self.corrections.words} needs the times of its instants")
        return self.corrections.of_poses(np.array(known), np.empty(len(poses)) if times_s is None else times_s)


def corrected(recording: "Recording", corrections: Corrections) -> "Recording":
    """A recording as its user says that it is to be read."""
    return cast("Recording", Corrected(recording, corrections)) if corrections.words else recording
