"""Do two scans agree once the poses move them? If not: would they, were poses or clouds read another way?

A scan is made a map of small Gaussians, one a voxel, as in the normal distributions transform (Biber and Strasser, IROS
2003): points of another scan fit it if they lie where surfaces are. Ground, on which any motion fits, is left out.
"""

from collections.abc import Iterator, Sequence
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert, rigid, rotation_from_euler, transform
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.corrected import correct_poses
from torchcover.recordings.in_vehicle import in_vehicle
from torchcover.recordings.recording import Recording
from torchcover.recordings.settings import RecordingSettings
from torchcover.recordings.sweeps import pose_jumps, voxels

WITHIN_M, CELL_M, LEAST_POINTS, THICK_M, QUERIES = 40.0, 1.0, 6, 0.1, 1500
# A surface lies flat if its normal is so upright, and it is so much thinner than wide.
UPRIGHT, THIN = 0.8, 0.25
# Poses that are looked at, in so many stretches of instants in a row.
STRETCHES, IN_A_ROW = 8, 25
# Two scans are a pair if the vehicle has moved so far between them, or is so much farther on in time.
WAY_M, TURN_DEG, APART_S, LONGEST_S, PAIRS = 1.5, 3.0, 0.3, 1.5, 3
# Poses are held if such a share of them is that of the instant before, for no more than so many instants.
REPEATED, LONGEST_RUN = 0.2, 3
# Poses of which a larger share jumps are wrong in another way.
MOST_JUMPS = 0.1
# What agrees so much better is right; noise of poses has many lags that are better, with worse ones in between.
MORE, TIMES, MORE_BY_LAG, WELL, RAGGED = 0.15, 1.4, 0.06, 0.6, 0.03
# Two sensors are not at one time if they agree so much better at another, farther off than halves of scans are.
MORE_BY_CLOCK, OF_A_SCAN_S = 0.03, 0.03
LAGS_S = [number * 0.025 for number in range(-12, 13)]
# Where poses say that a vehicle stands: what it is moved by to see whether it does, with every so many points.
STANDS_M, FASTEST_MPS, TURNS_DEG, FEWER = 0.1, 40.0, [half / 2 for half in range(-8, 9)], 3
GIVEN = RecordingSettings()
OTHERWISE = (
    RecordingSettings(quaternions="xyzw"),
    RecordingSettings(poses="inverse"),
    RecordingSettings(poses="yx"),
    RecordingSettings(axes="yxz"),
)


class Surfaces:
    """What (N, 3) points of a scan lie on.

    Example:
        >>> y, z = np.random.default_rng(0).uniform(0, 9, (2, 4000))
        >>> wall = Surfaces(np.stack([np.full(4000, 5.1), y, z], axis=1))
        >>> [round(wall.agreement(wall.points_m + [off_m, 0.2, 0.1]), 1) for off_m in (0.0, 0.5)]
        [1.0, 0.0]
    """

    def __init__(self, points_m: NDArray[np.floating]) -> None:
        near_m: Matrix = points_m[np.linalg.norm(points_m, axis=1) < WITHIN_M].astype(np.float64)
        numbers, of_point = np.unique(voxels(near_m, CELL_M), return_inverse=True)
        count = np.bincount(of_point)
        sums = [np.bincount(of_point, along_m, len(count)) for along_m in near_m.T]
        middle_m = np.stack(sums, axis=1) / count[:, None]
        off_m, spread = near_m - middle_m[of_point], np.empty((len(count), 3, 3))
        for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            spread[:, a, b] = spread[:, b, a] = np.bincount(of_point, off_m[:, a] * off_m[:, b], len(count)) / count
        stands = count >= LEAST_POINTS
        squares, axes = np.linalg.eigh(spread[stands])
        self._numbers, self._middle_m = numbers[stands], middle_m[stands]
        self._inverse = (axes / np.maximum(squares, THICK_M**2)[:, None]) @ axes.swapaxes(1, 2)
        stands[stands] = (np.abs(axes[:, 2, 0]) <= UPRIGHT) | (squares[:, 0] >= THIN * squares[:, 1])
        self.points_m = np.random.default_rng(0).permutation(near_m[stands[of_point]])[:QUERIES]
        self._own = 1.0
        self._own = self.agreement(self.points_m) if len(self.points_m) else 1.0

    def agreement(self, points_m: Matrix) -> float:
        """How well other points fit: 0 not at all, 1 as well as its own.

        It is the mean of exp(-d^2 / 2), d the Mahalanobis distance to the Gaussian in a point's voxel.
        """
        numbers = voxels(points_m, CELL_M)
        at = np.searchsorted(self._numbers, numbers).clip(max=len(self._numbers) - 1)
        hit = np.flatnonzero(self._numbers[at] == numbers)
        off_m = points_m[hit] - self._middle_m[at[hit]]
        squared = np.einsum("ni,nij,nj->n", off_m, self._inverse[at[hit]], off_m)
        return float(np.exp(-squared / 2).sum() / len(points_m)) / self._own


class TwoSensors:
    """What two sensors see at the first of a pair of instants, between which the vehicle moves."""

    def __init__(self, recording: Recording, sensors: Sequence[str], pair: "Pair") -> None:
        scans = [in_vehicle(recording.scan(of, pair.first + pair.one), recording.body) for of in sensors]
        self._surfaces, self._pair = [Surfaces(scan.points_m) for scan in scans], pair
        self.enough = min(len(each.points_m) for each in self._surfaces) >= QUERIES // 10

    def agreement(self, corrections: RecordingSettings) -> float:
        """How well the second fits the first, if it was later by the lag."""
        return self._surfaces[0].agreement(transform(self._pair.later(corrections), self._surfaces[1].points_m))


class Pair:
    """Two of the N instants in a row from `first` on, with (N,) times and (N, 4, 4) `world_T_vehicle`."""

    def __init__(self, times_s: NDArray[np.float64], poses: Matrix, first: int, one: int, other: int) -> None:
        self.first, self.one, self.other, self._times_s, self._poses = first, one, other, times_s, poses
        self.apart_s = float(times_s[other] - times_s[one])
        self.way_m = float(np.linalg.norm(self.motion()[:3, 3]))
        self.by_lag_m = 0.0

    def motion(self, corrections: RecordingSettings = GIVEN) -> Matrix:
        """(4, 4) from the vehicle frame of the other to that of the one."""
        poses = self._poses if corrections is GIVEN else correct_poses(self._poses, self._times_s, corrections)
        return np.asarray(invert(poses[self.one]) @ poses[self.other])

    def later(self, corrections: RecordingSettings) -> Matrix:
        """(4, 4) from the vehicle frame of the one, as it is with a lag, to that without."""
        poses = correct_poses(self._poses, self._times_s, corrections)
        return np.asarray(invert(self._poses[self.one]) @ poses[self.one])

    def read(self, recording: Recording, sensor: str) -> bool:
        """Read what the sensor saw at both; whether enough stands there."""
        try:
            self.scans = [recording.scan(sensor, self.first + place) for place in (self.one, self.other)]
            self._surfaces = [Surfaces(in_vehicle(scan, recording.body).points_m) for scan in self.scans]
        except (OSError, ValueError):
            return False
        return min(len(each.points_m) for each in self._surfaces) >= QUERIES // 10

    def agreement(self, corrections: RecordingSettings = GIVEN, moved: Matrix | None = None, every: int = 1) -> float:
        """How well the other fits the one, if they are read like that, or it is moved so; by every so many points."""
        moved = self.motion(corrections) if moved is None else moved
        if corrections.axes == "yxz":  # both clouds are mirrored, each in the frame of its sensor
            mount = self.scans[0].vehicle_T_sensor
            mirror = np.eye(4)[[1, 0, 2, 3]] if mount is None else mount @ np.eye(4)[[1, 0, 2, 3]] @ invert(mount)
            moved = mirror @ moved @ mirror
        return self._surfaces[0].agreement(transform(moved, self._surfaces[1].points_m[::every]))


def disagreement(recording: Recording, sensor: str, many: int) -> str | None:
    """What is wrong with the poses or the axes of the first `many` frames, by the scans of a sensor."""
    stretches = list(_stretches(recording, many))
    if (held := _held([poses for _, poses, _ in stretches])) is not None:
        return held
    pairs = [pair for pair in _chosen(stretches) if pair.read(recording, sensor)]
    moving = [(one.points_m, other.points_m) for one, other in (pair.scans for pair in pairs if pair.way_m > STANDS_M)]
    if moving and all(np.array_equal(one_m, other_m, equal_nan=True) for one_m, other_m in moving):
        return f"{sensor} gives the same cloud again and again, while the vehicle moves by its poses: leave it out"
    if not pairs:
        return None
    given = _mean(pairs, GIVEN)
    best = max(OTHERWISE, key=lambda other: _mean(pairs, other))
    mended: str | None = f"{_mean(pairs, best):.0%} with {best.words}: ask for that, or mend it"
    if _mean(pairs, best) < max(given + MORE, TIMES * given):
        mended = _late(pairs, given) or _moved(pairs, given)
    return mended and f"two scans of {sensor} agree to {given:.0%} once its poses move them, and to {mended}"


def _mean(pairs: Sequence[Pair | TwoSensors], corrections: RecordingSettings) -> float:
    return float(np.mean([pair.agreement(corrections) for pair in pairs]))


def _late(pairs: Sequence[Pair], given: float) -> str | None:
    lag_s, agreed = _best_lag(pairs)
    if agreed < max(given + MORE_BY_LAG, WELL):
        return None
    return f"{agreed:.0%} if they are late (early, if negative): --set recording.lag_s={lag_s:.2f}"


def _best_lag(pairs: Sequence[Pair | TwoSensors]) -> tuple[float, float]:
    """The lag with which they agree best, and how well; 0 where ragged noise has many that are better."""
    by_lag = np.array([_mean(pairs, RecordingSettings(lag_s=lag_s)) for lag_s in LAGS_S])
    best = int(by_lag.argmax())
    # By how much it rises again on the way from the best.
    rises = max((side - np.minimum.accumulate(side)).max() for side in (by_lag[best::-1], by_lag[best:]))
    return (0.0, 0.0) if rises > RAGGED else (LAGS_S[best], float(by_lag[best]))


def clocks_apart(recording: Recording, sensors: Sequence[str], many: int) -> list[str]:
    """Sensors that see what the first of them does at another time than it, by the scans of the first `many` frames."""
    pairs, found = [pair for pair in _chosen(list(_stretches(recording, many))) if pair.way_m > STANDS_M], []
    for sensor in sensors[1:]:
        try:
            looks = [TwoSensors(recording, (sensors[0], sensor), pair) for pair in pairs]
        except (OSError, ValueError):
            continue  # whoever measures it will say so
        looks = [look for look in looks if look.enough]
        lag_s, agreed = _best_lag(looks) if looks else (0.0, 0.0)
        given = _mean(looks, GIVEN) if lag_s else 1.0
        if abs(lag_s) > OF_A_SCAN_S and agreed >= max(given + MORE_BY_CLOCK, WELL):
            found.append(
                f"{sensor} agrees with {sensors[0]} to {given:.0%} at the same instants, and to {agreed:.0%} if it saw "
                f"all {abs(lag_s) * 1000:.0f} ms {'later' if lag_s > 0 else 'earlier'}: are their clocks apart? Mend "
                "its times"
            )
    return found


def _moved(pairs: Sequence[Pair], given: float) -> str | None:
    """Whether the vehicle drives where it stands by its poses."""
    if max(pair.way_m for pair in pairs) > STANDS_M:
        return None
    ways_m, agreed = [], []
    for pair in pairs:
        farthest_m = FASTEST_MPS * pair.apart_s
        tried = [
            (way_m, pair.motion() @ rigid(rotation_from_euler(turn_deg, 0, 0), [way_m, 0, 0]))
            for way_m in np.arange(-farthest_m / 4, farthest_m, CELL_M / 4).tolist()
            for turn_deg in TURNS_DEG
        ]
        way_m, moved = tried[int(np.argmax([pair.agreement(moved=moved, every=FEWER) for _, moved in tried]))]
        ways_m.append(way_m)
        agreed.append(pair.agreement(moved=moved))
    if np.mean(agreed) < max(given + MORE, TIMES * given) or np.median(np.abs(ways_m)) < STANDS_M:
        return None
    return f"{np.mean(agreed):.0%} if it does not stand, but has moved {np.median(ways_m):+.1f} m: give the real poses"


def jumped(recording: Recording, many: int) -> str | None:
    """Whether poses jump."""
    names, looked = [], 0
    for times_s, poses, first in _stretches(recording, many):
        looked += len(times_s)
        names += [recording.names[first + at + 1] for at in _few_jumps(times_s, poses).tolist()]
    if not names:
        return None
    return (
        f"poses jump {len(names)} times in {looked} instants that were looked at, first at {names[0]}: no window "
        "reaches over that, so that what is around it is judged by fewer sweeps: give poses without jumps"
    )


def _few_jumps(times_s: NDArray[np.float64], poses: Matrix) -> NDArray[np.intp]:
    """Steps that are jumps; none where there are so many that it is no jump that is wrong."""
    jumps = pose_jumps(times_s, poses)
    return jumps[:0] if len(jumps) > max(2, MOST_JUMPS * len(times_s)) else jumps


def _held(stretches: Sequence[Matrix]) -> str | None:
    """Whether poses are repeated between steps."""
    repeated = steps = 0
    for poses in stretches:
        stood = (np.diff(poses, axis=0) == 0).all(axis=(1, 2))
        runs = np.diff(np.concatenate([[-1], np.flatnonzero(~stood), [len(stood)]])) - 1
        if runs[1:-1].any():
            repeated += int(runs[runs <= LONGEST_RUN].sum())
            steps += len(stood)
    if repeated < max(2, REPEATED * steps):
        return None
    return (
        f"{repeated} of {steps} poses are those of the instant before while the vehicle drives: give a pose for each "
        "instant, or have them interpolated (--set recording.poses=held)"
    )


def _stretches(recording: Recording, many: int) -> Iterator[tuple[NDArray[np.float64], Matrix, int]]:
    """Times and poses of instants in a row, and the number of the first."""
    times_s = recording.times_s
    if times_s is None or not many:
        return
    # What is around the last is in its window.
    start, stop = recording.frames[0], min(recording.frames[many - 1] + IN_A_ROW, len(recording.names))
    firsts, length = [start], stop - start
    if length > STRETCHES * IN_A_ROW:
        firsts, length = np.linspace(start, stop - IN_A_ROW, STRETCHES).astype(int).tolist(), IN_A_ROW
    for first in firsts if length > 1 else ():
        poses = [recording.world_T_vehicle(instant) for instant in range(first, first + length)]
        if all(pose is not None for pose in poses):
            yield times_s[first : first + length], np.array(poses), first


def _chosen(stretches: Sequence[tuple[NDArray[np.float64], Matrix, int]]) -> list[Pair]:
    """Pairs of instants, spread over the recording; and those whose motion a lag would change most."""
    found = []
    for times_s, poses, first in stretches:
        jumps = _few_jumps(times_s, poses)
        early, late = (correct_poses(poses, times_s, RecordingSettings(lag_s=lag_s)) for lag_s in (-0.1, 0.1))
        for one in range(len(times_s) - 1):
            for other in range(one + 1, min(jumps[jumps >= one] + 1, default=len(times_s))):
                pair = Pair(times_s, poses, first, one, other)
                turned = np.rad2deg(np.arccos(np.clip((np.trace(pair.motion()[:3, :3]) - 1) / 2, -1, 1)))
                far = pair.way_m > WAY_M or turned > TURN_DEG or pair.apart_s > APART_S - 1e-6
                if pair.apart_s <= LONGEST_S and (far or other == len(times_s) - 1):
                    by_lag = invert(late[one]) @ late[other] - invert(early[one]) @ early[other]
                    pair.by_lag_m = float(np.linalg.norm(by_lag[:3, 3]) + WITHIN_M / 2 * np.linalg.norm(by_lag[:3, :3]))
                    found.append(pair)
                if far:
                    break
    spread = [found[at] for at in np.linspace(0, len(found) - 1, PAIRS).astype(int)] if found else []
    return list(dict.fromkeys((*spread, *sorted(found, key=attrgetter("by_lag_m"), reverse=True)[:PAIRS])))
