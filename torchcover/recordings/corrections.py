"""What a user knows to be wrong about a recording, put right: nothing is, unless it is asked for."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # torch, which the command line's help has no need of
    from torchcover.geometry.rigid import Matrix
    from torchcover.recordings.recording import Recording, Scan

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# The two nearest poses say how a vehicle goes on before the first and after the last.
LONGEST_LAG_S = 1.0


@dataclass(frozen=True)
class Corrections:
    """How a recording is to be read other than its format says.

    Raises:
        ValueError: A lag of more than a second.
    """

    quaternions: Annotated[Literal["wxyz", "xyzw"], "Order of the numbers of a recording's rotations."] = "wxyz"
    poses: Annotated[
        Literal["given", "inverse", "yx", "held"],
        "What poses are: vehicle_T_world (`inverse`), with x and y exchanged (`yx`), or each repeated until the next "
        "(`held`: they are interpolated).",
    ] = "given"
    axes: Annotated[Literal["xyz", "yxz"], "What the columns of its clouds are."] = "xyz"
    units: Annotated[Literal["m", "cm", "mm"], "What its clouds are in."] = "m"
    lag_s: Annotated[float, "Seconds by which its poses are late."] = 0.0

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
        asked = {name: value for name, value in vars(self).items() if value != getattr(Corrections, name)}
        return " ".join(f"--{name.removesuffix('_s')} {value}" for name, value in asked.items())

    def of_poses(self, world_T_vehicle: "Matrix", times_s: NDArray[np.float64]) -> "Matrix":
        """(N, 4, 4) poses of N instants in a row, put right."""
        from torchcover import geometry

        poses = world_T_vehicle.copy()
        if self.quaternions == "xyzw":  # what was read as w, x, y, z
            wxyz = [geometry.quaternion_from_rotation(rotation) for rotation in poses[:, :3, :3]]
            poses[:, :3, :3] = geometry.rotation_from_quaternion(np.roll(wxyz, 1, axis=1))
        if self.poses == "inverse":
            poses = geometry.invert(poses)
        elif self.poses == "yx":
            poses[:, :3, 3] = poses[:, [1, 0, 2], 3]
        new = np.append(True, (np.diff(poses, axis=0) != 0).any(axis=(1, 2)) | (self.poses != "held"))
        if (self.poses != "held" and not self.lag_s) or new.sum() < 2:
            return poses
        known, known_s, wanted_s = poses[new], times_s[new], times_s + self.lag_s
        after = np.searchsorted(known_s, wanted_s, side="right").clip(1, len(known) - 1)
        share = ((wanted_s - known_s[after - 1]) / np.diff(known_s)[after - 1])[:, None]
        angles_deg, places_m = geometry.euler_from_rotation(known[:, :3, :3]), known[:, :3, 3]
        turns_deg = ((np.diff(angles_deg, axis=0) + 180) % 360 - 180)[after - 1]
        rotations = geometry.rotation_from_euler(*(angles_deg[after - 1] + share * turns_deg).T)
        return geometry.rigid(rotations, places_m[after - 1] + share * np.diff(places_m, axis=0)[after - 1])


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
        scan, columns = self.recording.scan(sensor, index), ["xyz".index(axis) for axis in self.corrections.axes]
        return replace(scan, points_m=scan.points_m[:, columns] * METRES[self.corrections.units])

    def world_T_vehicle(self, index: int) -> "Matrix | None":
        """Where the vehicle was, put right."""
        return None if self._poses is None else self._poses[index]

    @cached_property
    def _poses(self) -> "Matrix | None":
        poses = [self.recording.world_T_vehicle(instant) for instant in range(len(self.recording.names))]
        if any(pose is None for pose in poses):
            return None
        times_s = self.recording.times_s
        if times_s is None and (self.corrections.lag_s or self.corrections.poses == "held"):
            raise ValueError(f"{self.recording.path}: {self.corrections.words} needs the times of its instants")
        return self.corrections.of_poses(np.array(poses), np.arange(len(poses)) if times_s is None else times_s)


def corrected(recording: "Recording", corrections: Corrections) -> "Recording":
    """A recording as its user says that it is to be read."""
    read: Any = Corrected(recording, corrections)  # which has what the recording has
    return read if corrections.words else recording  # type: ignore[no-any-return]
