"""Where a body is at a time."""

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

# Of pitch.
STEEP_DEG = 60.0


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses at times: (K,) ascending times, (K, 3) places and (K, 3) yaw, pitch and roll as of `convert_euler_to_rotation`.

    In between it moves on a straight line, and yaw, pitch and roll each turn the shorter way; beyond a pitch of 60
    degrees, where angles say little, it turns about one axis. Places are float64: they may be of UTM size. Before and
    after it rests; who is `is_transient`, as in a recording that it enters and leaves, is not there then.
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
        late = self.times_s[1:] <= self.times_s[:-1]
        if late.any():
            at = int(np.argmax(late))
            raise ValueError(
                f"the times of a trajectory must ascend; pose {at + 1} is at {self.times_s[at + 1]:g} s, "
                f"after {self.times_s[at]:g} s"
            )

    @classmethod
    def from_arrays(cls, times_s: ArrayLike, positions_m: ArrayLike, angles_deg: ArrayLike) -> "Trajectory":
        """From anything that NumPy takes."""
        times, positions, angles = (np.array(a, dtype=np.float64) for a in (times_s, positions_m, angles_deg))
        return cls(times, positions, angles)

    @classmethod
    def create_static(cls, position_m: ArrayLike, angles_deg: ArrayLike = (0.0, 0.0, 0.0)) -> "Trajectory":
        """A body that stays where it is."""
        return cls.from_arrays([0.0], np.array([position_m]), np.array([angles_deg]))

    @classmethod
    def from_poses(cls, times_s: ArrayLike, world_T_body: Matrix) -> "Trajectory":
        """From (K, 4, 4) rigid transforms."""
        return cls.from_arrays(times_s, world_T_body[:, :3, 3], convert_rotation_to_euler(world_T_body[:, :3, :3]))

    def shift_time(self, start_s: float) -> "Trajectory":
        """The same poses, with times that count from another instant.

        Args:
            start_s: Its time on the clock of this trajectory, in seconds.
        """
        return Trajectory(self.times_s - start_s, self.positions_m, self.angles_deg, self.is_transient)

    @property
    def is_moving(self) -> bool:
        """Whether the body ever changes its pose, enters or leaves."""
        if self.is_transient or len(self.times_s) == 1:
            return self.is_transient
        # Most of those that move end elsewhere.
        return any((poses[at] != poses[0]).any() for at in (slice(-1, None), slice(None)) for poses in self._poses)

    @property
    def _poses(self) -> tuple[Matrix, Matrix]:
        return self.positions_m, self.angles_deg

    @property
    def num_bytes(self) -> int:
        """How much memory its poses take."""
        return self.positions_m.nbytes + self.angles_deg.nbytes

    def interpolate(self, time_s: float) -> Matrix:
        """The (4, 4) pose `world_T_body` at a time."""
        before, after, share = _moment(self.times_s, time_s)
        places_m, angles_deg = self.positions_m, self.angles_deg
        return _between(places_m[before], places_m[after], angles_deg[before], angles_deg[after], share)

    def interpolate_many(self, times_s: Matrix) -> Matrix:
        """(T, 4, 4) poses at (T,) times, as `at` has them but for rounding."""
        after = np.clip(self.times_s.searchsorted(times_s, side="right"), 0, len(self.times_s) - 1)
        before = np.maximum(after - (times_s < self.times_s[after]), 0)
        taken_s = self.times_s[after] - self.times_s[before]
        share = np.where(taken_s > 0, times_s - self.times_s[before], 0.0) / np.where(taken_s > 0, taken_s, 1.0)
        places_m, angles_deg = self.positions_m, self.angles_deg
        return _between(places_m[before], places_m[after], angles_deg[before], angles_deg[after], share[:, None])

    def interpolate_positions_m(self, times_s: Matrix) -> Matrix:
        """(T, 3) positions at (T,) times; NaN where the body is not there."""
        if np.array_equal(times_s, self.times_s[: len(times_s)]):
            return self.positions_m[: len(times_s)]
        if len(self.times_s) == 1 and not self.is_transient:
            return np.repeat(self.positions_m, len(times_s), axis=0)
        outside = np.nan if self.is_transient else None
        tracks = [np.interp(times_s, self.times_s, axis, outside, outside) for axis in self.positions_m.T]
        return np.stack(tracks, axis=1)

    def compute_velocity_mps(self, time_s: float) -> Matrix:
        """(3,) velocity in the world frame in m/s; where it changes, the mean of before and after; 0 at rest."""
        # The segments that touch the time: one, or two if a pose is given for it.
        first = max(int(np.searchsorted(self.times_s, time_s, side="left")) - 1, 0)
        end = min(int(np.searchsorted(self.times_s, time_s, side="right")), len(self.times_s) - 1)
        if first >= end or not self.times_s[0] <= time_s <= self.times_s[-1]:
            return np.zeros(3)
        way, taken = np.diff(self.positions_m[first : end + 1], axis=0), np.diff(self.times_s[first : end + 1])
        return np.asarray((way / taken[:, None]).mean(axis=0))


def interpolate_poses(trajectories: Sequence[Trajectory], time_s: float) -> Matrix:
    """(P, 4, 4) poses `world_T_body` of P bodies at one time; see `Trajectory.at`."""
    # Bodies of one world share their times, or have views of them: they are looked up once.
    moments, ends, shares = dict[int, tuple[int, int, float]](), [], []
    for each in trajectories:
        times_s = each.times_s if each.times_s.base is None else each.times_s.base
        times_s = times_s if np.shape(times_s) == each.times_s.shape else each.times_s  # all of them ascend
        if id(times_s) not in moments:
            moments[id(times_s)] = _moment(times_s, time_s)
        before, after, share = moments[id(times_s)]
        ends += [each.positions_m[before], each.positions_m[after], each.angles_deg[before], each.angles_deg[after]]
        shares.append(share)
    from_m, to_m, from_deg, to_deg = np.array(ends).reshape(-1, 4, 3).swapaxes(0, 1)
    return _between(from_m, to_m, from_deg, to_deg, np.array(shares)[:, None])


def _moment(times_s: Matrix, time_s: float) -> tuple[int, int, float]:
    """The poses before and after a time, and how far it is from the one to the other; at rest before and after all."""
    after = int(times_s.searchsorted(time_s, side="right"))
    if after == 0 or after == len(times_s):
        return max(after - 1, 0), max(after - 1, 0), 0.0
    return after - 1, after, float((time_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1]))


def _between(from_m: Matrix, to_m: Matrix, from_deg: Matrix, to_deg: Matrix, share: float | Matrix) -> Matrix:
    """(..., 4, 4) poses at shares of the way from one to the other, of (..., 3) places and angles."""
    turn_deg = (to_deg - from_deg + 180.0) % 360.0 - 180.0
    rotation = convert_euler_to_rotation(*(from_deg + share * turn_deg).T)
    steep = np.maximum(np.abs(from_deg[..., 1]), np.abs(to_deg[..., 1])) > STEEP_DEG
    if steep.any():
        ends = [np.reshape([convert_rotation_to_quaternion(convert_euler_to_rotation(*each)) for each in np.reshape(ends, (-1, 3))],
                           (-1, 4)) for ends in (from_deg[steep], to_deg[steep])]  # fmt: skip
        shares = np.broadcast_to(share, (*steep.shape, 1))[steep].reshape(-1, 1)
        rotation[steep] = convert_quaternion_to_rotation(interpolate_quaternions(ends[0], ends[1], shares)).reshape(
            rotation[steep].shape
        )
    return build_transform(rotation, from_m + share * (to_m - from_m))
