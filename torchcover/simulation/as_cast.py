"""The rays of a LiDAR as they were cast: its scans, without what was done to make up for the motion of the vehicle."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert, quaternion_from_rotation, transform
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.ros_poses import PoseSeries
from torchcover.recordings.in_vehicle import within
from torchcover.recordings.recording import NO_RETURN_M, Recording
from torchcover.simulation.scan_estimate import Lasers, lasers_in_order, spread_deg

# Points are moved together if they were measured within so short a time.
TICK_NS = 100_000
# Of a turn: what may be measured at the instant, how much may come before it; and steps by which both are made finer.
AT_DEG, BEFORE, FINER = np.arange(-180.0, 180.0, 45.0).tolist(), (0.0, 0.25, 0.5, 0.75, 1.0), 0.5 ** np.arange(1, 7)
# So many points are looked at to find out, of a vehicle that moves so far in a turn; they have to lie so much closer.
# So much of a turn is left out at its ends.
LOOKED_AT, MOVES_M, CLOSER, SEAM = 8_000, 0.05, 0.8, 0.035
# No LiDAR turns more slowly: of frames that are farther apart, how long a turn takes is not known.
LONGEST_TURN_S = 0.25


class Turn(NamedTuple):
    """When the directions of a turn were measured: the one at the instant, its sense, its share before the instant."""

    at_deg: float
    sense: int
    before: float

    @property
    def begin_deg(self) -> float:
        """The azimuth that is measured first."""
        return (self.at_deg - self.sense * 360.0 * self.before + 180.0) % 360.0 - 180.0

    def times(self, points_m: Matrix) -> NDArray[np.float64]:
        """(N,) when points were measured, in turns after the instant."""
        azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
        return np.mod(self.sense * (azimuth_deg - self.begin_deg), 360.0) / 360.0 - self.before

    def apart(self, points_m: Matrix) -> NDArray[np.bool_]:
        """(N,) which points are not where a turn begins and ends."""
        share = self.times(points_m) + self.before
        return (share > SEAM) & (share < 1 - SEAM)


class _Scan(NamedTuple):
    """(N, 3) points in the frame of the LiDAR at the instant, what is known of them, and where it was around then."""

    points_m: Matrix
    rows: NDArray[np.integer] | None
    offsets_s: NDArray[np.float64] | None
    way: PoseSeries | None
    turn_s: float

    def back(self, offsets_s: NDArray[np.float64], points_m: Matrix) -> Matrix:
        """Points in the frame of the LiDAR when each was measured."""
        assert self.way is not None
        tick, of_point = np.unique(np.rint(offsets_s * (1e9 / TICK_NS)).astype(np.int64), return_inverse=True)
        world_T_then = self.way.at(tick * TICK_NS, "the LiDAR")
        then_T_now = (np.linalg.inv(world_T_then) @ self.way.at(np.zeros(1, np.int64), "the LiDAR"))[of_point]
        return np.asarray(np.einsum("nij,nj->ni", then_T_now[:, :3, :3], points_m) + then_T_now[:, :3, 3])

    def undone(self, turn: Turn, points_m: Matrix) -> Matrix:
        """The same, by what the turn says of their directions then."""
        cast_m = points_m
        for _ in range(2):
            cast_m = self.back(turn.times(cast_m) * self.turn_s, points_m)
        return cast_m


def as_cast(
    recording: Recording, sensor: str, instants: Sequence[int], vehicle_T_sensor: Matrix
) -> tuple[list[Matrix], Lasers, str]:
    """Scans in the frame of a LiDAR at the time of each ray, the lasers of their points, and what was undone.

    Where the times of points are not known, and the vehicle moves, they are those of even turns for which points lie
    closest to rows; if they lie so best as they are, nothing was done to them.
    """
    scans = [_read(recording, sensor, index, vehicle_T_sensor) for index in instants]
    lasers = [lasers_in_order(scan.points_m) if scan.rows is None else scan.rows for scan in scans]
    rows = None if any(of is None for of in lasers) else [of for of in lasers if of is not None]
    as_they_are = [scan.points_m for scan in scans]
    moving = [scan.way is not None and _way_m(scan.way) > MOVES_M for scan in scans]
    if all(scan.offsets_s is not None for scan in scans):
        cast = [
            scan.points_m if scan.way is None or scan.offsets_s is None else scan.back(scan.offsets_s, scan.points_m)
            for scan in scans
        ]
        return cast, rows, "each ray at its own time"
    if not all(moving) or not scans:
        return as_they_are, rows, ""
    if (apart_s := max(scan.turn_s for scan in scans)) > LONGEST_TURN_S:
        needed = f"at most {LONGEST_TURN_S:g} s are needed, or times of the points, or a standing vehicle"
        return as_they_are, rows, f"motion within a turn not undone, for frames are {apart_s:g} s apart ({needed})"
    some = [slice(None, None, max(1, len(scan.points_m) * len(scans) // LOOKED_AT)) for scan in scans]
    few = None if rows is None else [of[which] for of, which in zip(rows, some, strict=True)]

    def blur(turn: Turn | None) -> float:
        looked_at = [scan.points_m[which] for scan, which in zip(scans, some, strict=True)]
        if turn is not None:
            looked_at = [scan.undone(turn, points_m) for scan, points_m in zip(scans, looked_at, strict=True)]
        return spread_deg(looked_at, few)

    turn, found = _best_turn(blur)
    if found > CLOSER * blur(None):
        return as_they_are, rows, ""
    cast = [scan.undone(turn, scan.points_m) for scan in scans]
    # Where a turn begins and ends, a degree decides which of the two it is.
    inside = [turn.apart(scan.points_m) & turn.apart(points_m) for scan, points_m in zip(scans, cast, strict=True)]
    cast = [points_m[which] for points_m, which in zip(cast, inside, strict=True)]
    rows = None if rows is None else [of[which] for of, which in zip(rows, inside, strict=True)]
    return (
        cast,
        rows,
        f"motion undone (turns {'counter-' * (turn.sense > 0)}clockwise from {turn.begin_deg:.0f} degrees)",
    )


def _best_turn(blur: Callable[[Turn | None], float]) -> tuple[Turn, float]:
    tried = {
        turn: blur(turn) for turn in (Turn(at_deg, sense, b) for at_deg in AT_DEG for sense in (-1, 1) for b in BEFORE)
    }
    best = min(tried, key=lambda turn: tried[turn])
    for share in FINER:
        for at_deg, before in ((45.0, 0.0), (-45.0, 0.0), (0.0, 0.25), (0.0, -0.25)):
            turn = Turn(best.at_deg + share * at_deg, best.sense, best.before + share * before)
            tried[turn] = tried.get(turn) or blur(turn)
            best = min(best, turn, key=lambda turn: tried[turn])
    return best, tried[best]


def _read(recording: Recording, sensor: str, index: int, vehicle_T_sensor: Matrix) -> _Scan:
    scan = recording.scan(sensor, index)
    points_m = scan.points_m.astype(np.float64)
    came = np.asarray(np.isfinite(points_m).all(axis=1) & (np.abs(points_m) > NO_RETURN_M).any(axis=1))
    in_vehicle_m = points_m if scan.vehicle_T_sensor is None else transform(scan.vehicle_T_sensor, points_m)
    if recording.body is not None:
        came[within(in_vehicle_m, recording.body)] = False
    rows = None if scan.rows is None else scan.rows[came]
    offsets_s = None if scan.offsets_s is None else scan.offsets_s[came]
    way, turn_s = None, 0.0
    near = range(max(index - 1, 0), min(index + 2, len(recording.names)))
    poses = [recording.world_T_vehicle(at) for at in near]
    if recording.times_s is not None and len(poses) > 1 and all(pose is not None for pose in poses):
        world_T_sensor = np.stack([pose for pose in poses if pose is not None]) @ vehicle_T_sensor
        times_s = recording.times_s[near.start : near.stop] - recording.times_s[index]
        times_ns = np.rint(times_s * 1e9).astype(np.int64)
        wxyz = np.array([quaternion_from_rotation(pose[:3, :3]) for pose in world_T_sensor])
        way, turn_s = PoseSeries(times_ns, world_T_sensor[:, :3, 3], wxyz), float(np.diff(times_ns).min() * 1e-9)
    return _Scan(transform(invert(vehicle_T_sensor), in_vehicle_m[came]), rows, offsets_s, way, turn_s)


def _way_m(way: PoseSeries) -> float:
    return float(np.linalg.norm(np.diff(way.places_m, axis=0), axis=1).min())
