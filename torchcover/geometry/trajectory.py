"""Trajectories: poses of bodies as a function of time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry import (
    build_transform,
    convert_euler_to_rotation,
    convert_quaternion_to_rotation,
    convert_rotation_to_euler,
    convert_rotation_to_quaternion,
    interpolate_quaternions,
)
from torchcover.geometry.rigid import Matrix


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a body at K times, interpolated in between.

    Positions are interpolated linearly, and yaw, pitch and roll along the shorter rotation; above a pitch of 60
    degrees, where Euler angles are nearly singular, rotations are interpolated about one axis (slerp). Before the first
    and after the last time the body stands still.

    Args:
        times_s: (K,) ascending times in seconds.
        positions_m: (K, 3) float64 positions in meters, which may be of UTM size.
        angles_deg: (K, 3) yaw, pitch and roll in degrees, as in `convert_euler_to_rotation`.
        is_transient: The body does not exist before the first and after the last time, as objects in a recording.

    Raises:
        ValueError: Shapes do not match, numbers are not finite, or times do not ascend.
    """

    times_s: Matrix
    positions_m: Matrix
    angles_deg: Matrix
    is_transient: bool = False

    def __post_init__(self) -> None:
        count = len(self.times_s)
        if count == 0 or self.positions_m.shape != (count, 3) or self.angles_deg.shape != (count, 3):
            raise ValueError(
                "a trajectory needs K >= 1 times, (K, 3) positions and (K, 3) angles; got "
                f"{self.times_s.shape}, {self.positions_m.shape} and {self.angles_deg.shape}"
            )
        if not all(np.isfinite(numbers).all() for numbers in (self.times_s, self.positions_m, self.angles_deg)):
            numbers = np.column_stack([self.times_s, self.positions_m, self.angles_deg])
            bad = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
            raise ValueError(f"a trajectory has NaN or infinite numbers in {len(bad)} of {count} poses, first {bad[0]}")
        is_late = self.times_s[1:] <= self.times_s[:-1]
        if is_late.any():
            index = int(np.argmax(is_late))
            raise ValueError(
                f"the times of a trajectory must ascend; pose {index + 1} is at {self.times_s[index + 1]:g} s, "
                f"after {self.times_s[index]:g} s"
            )

    @classmethod
    def from_arrays(cls, times_s: ArrayLike, positions_m: ArrayLike, angles_deg: ArrayLike) -> "Trajectory":
        """Create a trajectory from array-like values, which are copied to float64.

        Args:
            times_s: As in the class.
            positions_m: As in the class.
            angles_deg: As in the class.
        """
        return cls(
            np.array(times_s, dtype=np.float64),
            np.array(positions_m, dtype=np.float64),
            np.array(angles_deg, dtype=np.float64),
        )

    @classmethod
    def create_static(cls, position_m: ArrayLike, angles_deg: ArrayLike = (0.0, 0.0, 0.0)) -> "Trajectory":
        """Create the trajectory of a body that does not move.

        Args:
            position_m: (3,) position in meters.
            angles_deg: (3,) yaw, pitch and roll in degrees.
        """
        return cls.from_arrays([0.0], np.array([position_m]), np.array([angles_deg]))

    @classmethod
    def from_poses(cls, times_s: ArrayLike, world_T_body: Matrix) -> "Trajectory":
        """Create a trajectory from transforms.

        Args:
            times_s: (K,) ascending times in seconds.
            world_T_body: (K, 4, 4) rigid transforms.
        """
        return cls.from_arrays(times_s, world_T_body[:, :3, 3], convert_rotation_to_euler(world_T_body[:, :3, :3]))

    def shift_time(self, start_s: float) -> "Trajectory":
        """Return the same poses with times relative to another start.

        Args:
            start_s: New time 0 on the clock of this trajectory, in seconds.
        """
        return Trajectory(self.times_s - start_s, self.positions_m, self.angles_deg, self.is_transient)

    @property
    def is_moving(self) -> bool:
        """True if the pose changes, or the body is transient."""
        if self.is_transient or len(self.times_s) == 1:
            return self.is_transient
        for poses in (self.positions_m, self.angles_deg):
            # Most moving bodies end at another pose, so that all poses are rarely compared.
            if (poses[-1] != poses[0]).any() or (poses != poses[0]).any():
                return True
        return False

    @property
    def num_bytes(self) -> int:
        """Memory of the poses in bytes."""
        return self.positions_m.nbytes + self.angles_deg.nbytes

    def interpolate(self, time_s: float) -> Matrix:
        """Interpolate the pose at one time.

        Args:
            time_s: Time in seconds.

        Returns:
            (4, 4) `world_T_body`.
        """
        before, after, fraction = _find_segment(self.times_s, time_s)
        positions_m, angles_deg = self.positions_m, self.angles_deg
        return _interpolate_between(
            positions_m[before], positions_m[after], angles_deg[before], angles_deg[after], fraction
        )

    def interpolate_many(self, times_s: Matrix) -> Matrix:
        """Interpolate poses at several times, equal to `interpolate` up to rounding.

        Args:
            times_s: (T,) times in seconds.

        Returns:
            (T, 4, 4) `world_T_body`.
        """
        after = np.clip(self.times_s.searchsorted(times_s, side="right"), 0, len(self.times_s) - 1)
        before = np.maximum(after - (times_s < self.times_s[after]), 0)
        duration_s = self.times_s[after] - self.times_s[before]
        is_between = duration_s > 0
        fraction = np.where(is_between, times_s - self.times_s[before], 0.0) / np.where(is_between, duration_s, 1.0)
        positions_m, angles_deg = self.positions_m, self.angles_deg
        return _interpolate_between(
            positions_m[before], positions_m[after], angles_deg[before], angles_deg[after], fraction[:, None]
        )

    def interpolate_positions_m(self, times_s: Matrix) -> Matrix:
        """Interpolate positions at several times.

        Args:
            times_s: (T,) ascending times in seconds.

        Returns:
            (T, 3) positions in meters; NaN where a transient body does not exist.
        """
        if np.array_equal(times_s, self.times_s[: len(times_s)]):
            return self.positions_m[: len(times_s)]
        if len(self.times_s) == 1 and not self.is_transient:
            return np.repeat(self.positions_m, len(times_s), axis=0)
        outside = np.nan if self.is_transient else None
        columns = [np.interp(times_s, self.times_s, column, outside, outside) for column in self.positions_m.T]
        return np.stack(columns, axis=1)

    def compute_velocity_mps(self, time_s: float) -> Matrix:
        """Compute the velocity in the world frame.

        Args:
            time_s: Time in seconds.

        Returns:
            (3,) m/s; at the time of a pose, the mean of the velocities before and after it; 0 outside of all times.
        """
        # Segments that contain the time: two at the time of a pose, one otherwise.
        first = max(int(np.searchsorted(self.times_s, time_s, side="left")) - 1, 0)
        end = min(int(np.searchsorted(self.times_s, time_s, side="right")), len(self.times_s) - 1)
        if first >= end or not self.times_s[0] <= time_s <= self.times_s[-1]:
            return np.zeros(3)
        displacement_m = np.diff(self.positions_m[first : end + 1], axis=0)
        duration_s = np.diff(self.times_s[first : end + 1])
        return np.asarray((displacement_m / duration_s[:, None]).mean(axis=0))


def interpolate_poses(trajectories: Sequence[Trajectory], time_s: float) -> Matrix:
    """Interpolate the poses of P bodies at one time, as `Trajectory.interpolate`.

    Args:
        trajectories: P trajectories.
        time_s: Time in seconds.

    Returns:
        (P, 4, 4) `world_T_body`.
    """
    # Bodies of one scene share their array of times, or have views of it: each array is searched once.
    segments: dict[int, tuple[int, int, float]] = {}
    ends, fractions = [], []
    for trajectory in trajectories:
        times_s = trajectory.times_s
        if times_s.base is not None and np.shape(times_s.base) == times_s.shape:  # a full view, as times ascend
            times_s = times_s.base
        if id(times_s) not in segments:
            segments[id(times_s)] = _find_segment(times_s, time_s)
        before, after, fraction = segments[id(times_s)]
        positions_m, angles_deg = trajectory.positions_m, trajectory.angles_deg
        ends += [positions_m[before], positions_m[after], angles_deg[before], angles_deg[after]]
        fractions.append(fraction)
    from_m, to_m, from_deg, to_deg = np.array(ends).reshape(-1, 4, 3).swapaxes(0, 1)
    return _interpolate_between(from_m, to_m, from_deg, to_deg, np.array(fractions)[:, None])


def _find_segment(times_s: Matrix, time_s: float) -> tuple[int, int, float]:
    """Find the poses before and after a time, and the fraction between them; outside, the first or last pose."""
    after = int(times_s.searchsorted(time_s, side="right"))
    if after == 0 or after == len(times_s):
        return max(after - 1, 0), max(after - 1, 0), 0.0
    return after - 1, after, float((time_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1]))


def _interpolate_between(
    from_m: Matrix, to_m: Matrix, from_deg: Matrix, to_deg: Matrix, fraction: float | Matrix
) -> Matrix:
    """Interpolate (..., 4, 4) poses between (..., 3) positions and Euler angles."""
    turn_deg = (to_deg - from_deg + 180.0) % 360.0 - 180.0
    rotation = convert_euler_to_rotation(*(from_deg + fraction * turn_deg).T)
    is_steep = np.maximum(np.abs(from_deg[..., 1]), np.abs(to_deg[..., 1])) > 60.0
    if is_steep.any():
        fractions = np.broadcast_to(fraction, (*is_steep.shape, 1))[is_steep].reshape(-1, 1)
        first_wxyz, second_wxyz = _convert_to_quaternions(from_deg[is_steep]), _convert_to_quaternions(to_deg[is_steep])
        interpolated = convert_quaternion_to_rotation(interpolate_quaternions(first_wxyz, second_wxyz, fractions))
        rotation[is_steep] = interpolated.reshape(rotation[is_steep].shape)
    return build_transform(rotation, from_m + fraction * (to_m - from_m))


def _convert_to_quaternions(angles_deg: Matrix) -> Matrix:
    """Convert (..., 3) Euler angles to (N, 4) quaternions."""
    rotations = [convert_euler_to_rotation(*angles) for angles in np.reshape(angles_deg, (-1, 3))]
    return np.reshape([convert_rotation_to_quaternion(rotation) for rotation in rotations], (-1, 4))
