"""Do two scans agree once the poses move them? If not: would they, were the poses or clouds read another way?

A scan is made a map of small Gaussians, one a voxel, as in the normal distributions transform (Biber and Strasser, IROS
2003): points of another scan fit it if they lie where surfaces are. Ground, on which any motion fits, is left out.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert, rigid, rotation_from_euler, transform
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.corrections import Corrections
from torchcover.recordings.in_vehicle import in_vehicle
from torchcover.recordings.recording import Recording, Scan
from torchcover.recordings.sweeps import voxels

WITHIN_M, CELL_M, LEAST_POINTS, THICK_M, QUERIES = 40.0, 1.0, 6, 0.1, 1500
# A surface lies flat if its normal is so upright, and it is so much thinner than wide.
UPRIGHT, THIN = 0.8, 0.25
# Poses that are looked at, in so many stretches of instants in a row.
STRETCHES, IN_A_ROW = 8, 25
# Two scans are a pair if the vehicle has moved so far between them, or is so much farther on in time.
WAY_M, TURN_DEG, APART_S, LONGEST_S, PAIRS = 1.5, 3.0, 0.3, 1.5, 3
STANDS_M, FASTEST_MPS = 0.1, 40.0
# Poses are held if such a share of them is that of the instant before, for no more than so many instants.
REPEATED, LONGEST_RUN = 0.2, 3
# What agrees so much better is right.
MORE, TIMES = 0.15, 1.4
LAGS_S = np.arange(-12, 13) * 0.025
MORE_BY_LAG, LEAST_LAG_S, RAGGED = 0.06, 0.04, 0.015
TURNS_DEG, FEWER = [turn / 2 for turn in range(-8, 9)], 3
OTHERWISE = (
    Corrections(quaternions="xyzw"),
    Corrections(poses="inverse"),
    Corrections(poses="yx"),
    Corrections(axes="yxz"),
)
SAYS = {
    "quaternions": "as if rotations were stored x, y, z, w",
    "poses inverse": "as if poses were vehicle_T_world",
    "poses yx": "as if x and y of its places were exchanged",
    "axes": "as if x and y of its clouds were exchanged",
}


class Surfaces:
    """What (N, 3) points of a scan lie on.

    Example:
        >>> y, z = np.random.default_rng(0).uniform(0, 9, (2, 4000))
        >>> wall = Surfaces(np.stack([np.full(4000, 5.1), y, z], axis=1))
        >>> moved_m = np.array([[0.0, 0.2, 0.1], [0.5, 0.0, 0.0]])
        >>> [round(wall.agreement(wall.points_m + each_m), 1) for each_m in moved_m]
        [1.0, 0.0]
    """

    def __init__(self, points_m: NDArray[np.floating]) -> None:
        points_m = points_m[np.linalg.norm(points_m, axis=1) < WITHIN_M].astype(np.float64)
        numbers, of_point, count = np.unique(voxels(points_m, CELL_M), return_inverse=True, return_counts=True)
        sums = [np.bincount(of_point, along_m, len(count)) for along_m in points_m.T]
        middle_m = np.stack(sums, axis=1) / count[:, None]
        off_m, spread = points_m - middle_m[of_point], np.empty((len(count), 3, 3))
        for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            spread[:, a, b] = spread[:, b, a] = np.bincount(of_point, off_m[:, a] * off_m[:, b], len(count)) / count
        enough = count >= LEAST_POINTS
        squares, axes = np.linalg.eigh(spread[enough])
        flat = (np.abs(axes[:, 2, 0]) > UPRIGHT) & (squares[:, 0] < THIN * squares[:, 1])
        self._numbers, self._middle_m = numbers[enough], middle_m[enough]
        self._inverse = (axes / np.maximum(squares, THICK_M**2)[:, None]) @ axes.swapaxes(1, 2)
        stands = np.zeros(len(count), np.bool_)
        stands[enough] = ~flat
        standing_m = points_m[stands[of_point]]
        self.points_m = np.random.default_rng(0).permutation(standing_m)[:QUERIES]
        self._own = self._fit(self.points_m) if len(self.points_m) else 1.0

    def _fit(self, points_m: Matrix) -> float:
        """The mean of exp(-d^2 / 2) over points, d the Mahalanobis distance to the surface in their voxel."""
        numbers = voxels(points_m, CELL_M)
        at = np.searchsorted(self._numbers, numbers).clip(max=len(self._numbers) - 1)
        hit = np.flatnonzero(self._numbers[at] == numbers)
        off_m = points_m[hit] - self._middle_m[at[hit]]
        squared = np.einsum("ni,nij,nj->n", off_m, self._inverse[at[hit]], off_m)
        return float(np.exp(-squared / 2).sum() / len(points_m))

    def agreement(self, points_m: Matrix) -> float:
        """How well other points fit: 0 not at all, about 1 as well as its own."""
        return self._fit(points_m) / self._own


@dataclass
class Pair:
    """Two scans of a sensor, and the poses around them.

    Args:
        times_s: (N,) of a stretch of instants.
        poses: (N, 4, 4) `world_T_vehicle` there, as they were read.
        one: Which of them the one is.
        other: Which the other.
        scans: Both, as they were stored.
        surfaces: Both, in the vehicle frame.
    """

    times_s: NDArray[np.float64]
    poses: Matrix
    one: int
    other: int
    scans: tuple[Scan, Scan]
    surfaces: tuple[Surfaces, Surfaces]

    def motion(self, corrections: Corrections = Corrections()) -> Matrix:  # noqa: B008  (it is frozen)
        """From the vehicle frame of the other to that of the one."""
        return motion(corrections.of_poses(self.poses, self.times_s), self.one, self.other)

    def agreement(self, moved: Matrix, every: int = 1) -> float:
        """How well the other, moved, fits the one; by every so many of its points."""
        return self.surfaces[0].agreement(transform(moved, self.surfaces[1].points_m[::every]))

    def otherwise(self, corrections: Corrections) -> float:
        """How well they fit if they are read another way."""
        moved = self.motion(corrections)
        if corrections.axes == "yxz":  # both clouds are mirrored, each in the frame of its sensor
            mirror, mount = np.eye(4)[[1, 0, 2, 3]], self.scans[0].vehicle_T_sensor
            mount = np.eye(4) if mount is None else mount
            mirror = mount @ mirror @ invert(mount)
            moved = mirror @ moved @ mirror
        return self.agreement(moved)


def motion(poses: Matrix, one: int, other: int) -> Matrix:
    """(4, 4) from the vehicle frame of another instant to that of one."""
    return np.asarray(invert(poses[one]) @ poses[other])


class _Found(NamedTuple):
    times_s: NDArray[np.float64]
    poses: Matrix
    first: int
    one: int
    other: int
    way_m: float
    by_lag_m: float


def disagreement(recording: Recording, sensor: str, many: int) -> list[str]:
    """What is wrong with the poses or the axes of a recording, by scans of a sensor.

    Args:
        recording: The recording.
        sensor: Name of the sensor that sees most.
        many: How many of its frames are looked at, from the first on.
    """
    stretches = list(_stretches(recording, many))
    doubts = [doubt for doubt in (_held([poses for _, poses, _ in stretches]),) if doubt is not None]
    pairs = [pair for found in _chosen(stretches) if (pair := _read(recording, sensor, found)) is not None]
    if not pairs or doubts:
        return doubts
    moving = [pair.scans for pair in pairs if np.linalg.norm(pair.motion()[:3, 3]) > STANDS_M]
    if moving and all(np.array_equal(one.points_m, other.points_m, equal_nan=True) for one, other in moving):
        return [f"{sensor} gives the same cloud again and again, while the vehicle moves by its poses: leave it out"]
    given = _mean(pairs, lambda pair: pair.agreement(pair.motion()))
    doubt = _read_otherwise(pairs, given) or _late(pairs, given) or _stuck(pairs, given)
    return [] if doubt is None else [f"two scans of {sensor} agree to {given:.0%} once its poses move them; {doubt}"]


def _read_otherwise(pairs: Sequence[Pair], given: float) -> str | None:
    each = {other: _mean(pairs, lambda pair, other=other: pair.otherwise(other)) for other in OTHERWISE}
    best = max(each, key=lambda other: each[other])
    if each[best] < max(given + MORE, TIMES * given):
        return None
    says = next(words for key, words in SAYS.items() if best.words.startswith(f"--{key}"))
    return f"{says}, to {each[best]:.0%} ({best.words})"


def _late(pairs: Sequence[Pair], given: float) -> str | None:
    by_lag = np.mean(
        [[pair.agreement(pair.motion(Corrections(lag_s=lag_s))) for lag_s in LAGS_S.tolist()] for pair in pairs], axis=0
    )
    best = int(by_lag.argmax())
    rises = np.diff(by_lag) * np.where(np.arange(len(LAGS_S) - 1) < best, 1, -1)
    # Noise of poses has many peaks.
    if abs(LAGS_S[best]) < LEAST_LAG_S or by_lag[best] < given + MORE_BY_LAG or rises.min() < -RAGGED:
        return None
    late = "late" if LAGS_S[best] > 0 else "early"
    return f"as if the poses were {abs(LAGS_S[best]):.2f} s {late}, to {by_lag[best]:.0%} (--lag {LAGS_S[best]:.2f})"


def _stuck(pairs: Sequence[Pair], given: float) -> str | None:
    moved = [pair.motion() for pair in pairs]
    if max(float(np.linalg.norm(each[:3, 3])) for each in moved) > STANDS_M:
        return None
    ways_m, agreed = [], []
    for pair, each in zip(pairs, moved, strict=True):
        farthest_m = FASTEST_MPS * (pair.times_s[pair.other] - pair.times_s[pair.one])
        tried = [
            (way_m, each @ rigid(rotation_from_euler(turn_deg, 0, 0), [way_m, 0, 0]))
            for way_m in np.arange(-farthest_m / 4, farthest_m, CELL_M / 4).tolist()
            for turn_deg in TURNS_DEG
        ]
        best = max(tried, key=lambda one, pair=pair: pair.agreement(one[1], FEWER))  # type: ignore[misc]
        ways_m.append(best[0])
        agreed.append(pair.agreement(best[1]))
    if np.mean(agreed) < max(given + MORE, TIMES * given) or np.median(np.abs(ways_m)) < STANDS_M:
        return None
    return (
        f"it stands by its poses, and drives by its clouds, which agree to {np.mean(agreed):.0%} if it has moved "
        f"{np.median(ways_m):+.1f} m: give the real poses"
    )


def _held(stretches: Sequence[Matrix]) -> str | None:
    """Whether poses are repeated between steps."""
    repeated = steps = 0
    for poses in stretches:
        stood = (np.diff(poses, axis=0) == 0).all(axis=(1, 2))
        moved = np.flatnonzero(~stood)
        runs = np.diff(np.concatenate([[-1], moved, [len(stood)]])) - 1
        if runs[1:-1].any():
            repeated += int(runs[runs <= LONGEST_RUN].sum())
            steps += len(stood)
    if repeated < max(2, REPEATED * steps):
        return None
    return (
        f"{repeated} of {steps} poses are those of the instant before while the vehicle drives: give a pose for each "
        "instant, or have them interpolated (--poses held)"
    )


def _stretches(recording: Recording, many: int) -> Iterator[tuple[NDArray[np.float64], Matrix, int]]:
    """Times and poses of instants in a row, and the number of the first."""
    frames, times_s = recording.frames, recording.times_s
    if times_s is None or not many:
        return
    # What is around the last is in its window.
    start, stop = frames[0], min(frames[many - 1] + IN_A_ROW, len(recording.names))
    if stop - start <= STRETCHES * IN_A_ROW:
        firsts, length = [start], stop - start
    else:
        firsts, length = np.linspace(start, stop - IN_A_ROW, STRETCHES).astype(int).tolist(), IN_A_ROW
    for first in firsts:
        poses = [recording.world_T_vehicle(instant) for instant in range(first, first + length)]
        known = [pose for pose in poses if pose is not None]
        if len(known) == len(poses):
            yield times_s[first : first + length], np.array(known), first


def _chosen(stretches: Sequence[tuple[NDArray[np.float64], Matrix, int]]) -> list[_Found]:
    """Pairs of instants, spread over the recording; and those whose motion a lag would change most."""
    found = []
    for times_s, poses, first in stretches:
        early, late = (Corrections(lag_s=lag_s).of_poses(poses, times_s) for lag_s in (-0.1, 0.1))
        for one in range(len(times_s) - 1):
            for other in range(one + 1, len(times_s)):
                moved, apart_s = motion(poses, one, other), float(times_s[other] - times_s[one])
                if apart_s > LONGEST_S:
                    break
                turned = np.rad2deg(np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1, 1)))
                way_m = float(np.linalg.norm(moved[:3, 3]))
                if way_m > WAY_M or turned > TURN_DEG or apart_s > APART_S - 1e-6 or other == len(times_s) - 1:
                    by_lag = motion(late, one, other) - motion(early, one, other)
                    by_lag_m = float(np.linalg.norm(by_lag[:3, 3]) + WITHIN_M / 2 * np.linalg.norm(by_lag[:3, :3]))
                    found.append(_Found(times_s, poses, first, one, other, way_m, by_lag_m))
                    break
    spread = [found[at] for at in np.unique(np.linspace(0, len(found) - 1, PAIRS).astype(int))] if found else []
    sensitive = sorted(found, key=lambda each: -each.by_lag_m)[:PAIRS]
    return list({(each.first, each.one, each.other): each for each in (*spread, *sensitive)}.values())


def _read(recording: Recording, sensor: str, found: _Found) -> Pair | None:
    try:
        scans = [recording.scan(sensor, found.first + place) for place in (found.one, found.other)]
        surfaces = [Surfaces(in_vehicle(scan, recording.body).points_m) for scan in scans]
    except (OSError, ValueError):
        return None
    if min(len(each.points_m) for each in surfaces) < QUERIES // 10:
        return None
    return Pair(found.times_s, found.poses, found.one, found.other, (scans[0], scans[1]), (surfaces[0], surfaces[1]))


def _mean(pairs: Sequence[Pair], value: Callable[[Pair], float]) -> float:
    return float(np.mean([value(pair) for pair in pairs]))
