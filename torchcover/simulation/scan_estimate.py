"""How a LiDAR scans, from what it saw: rows, columns, ranges; without what was done to make up for the motion.

`undo_motion_compensation` has the rays as they were cast.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import convert_rotation_to_quaternion, invert, transform_points
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.formats.ros_poses import PoseSeries
from torchcover.recordings.recording import NO_RETURN_M, Recording
from torchcover.recordings.vehicle_cloud import find_points_in_box

# Elevations are counted in bins of this width and blurred with one width after the other.
BIN_DEG, FINEST_DEG, COARSEST_DEG, GROWTH = 0.005, 0.01, 1.0, 1.15
# As long as a blur is wider than a row and narrower than the space between two, the number of peaks is that of rows; it
# has to stay through so many widths, which is a factor of 1.75.
SAME_THROUGH = 5
# A peak is at least of so many points, and of such a share of all: where something moved, some lie together by chance.
# There are no more rows in a LiDAR than MAX_ROWS.
PEAK_POINTS, PEAK_SHARE, MAX_ROWS = 1.5, 5e-4, 1000
# What is seen nowhere over a wider angle is beyond the field of view; over a smaller one, something is in the way.
BLIND_DEG = 40.0
# Clouds that are stored laser by laser, each in a turn: so many, of so many points at least, with so much larger steps
# of elevation from one laser to the next.
LASERS, LASER_POINTS = (8, 256), 100
STEPS = 3.0
# How closely it is looked at how far points lie from rows.
SPREAD_DEG = 0.05
# Lasers leave from one height, within so much or so, as far as their points do not say it to so many degrees; not from
# farther above or below the origin, and only if points lie so much closer to what they say then.
ORIGIN_M, LINE_DEG, HIGHEST_M, CLOSER = 0.05, 0.01, 0.3, 0.5

# The number of the laser of each point, scan by scan; None if unknown.
LaserIndices = list[NDArray[np.integer]] | None


class ScanEstimate(NamedTuple):
    """A scan pattern: (R,) elevations of the rows that returned anything, the highest first, and how many columns.

    `horizontal_fov_deg` is 360 for a full turn, `center_azimuth_deg` the azimuth of its middle; the range is that of
    the farthest return. `origin_height_m` is the height above the origin of the frame that the rays leave from, on average; 0
    if they need no other.
    """

    elevations_deg: Float64
    num_columns: int
    horizontal_fov_deg: float
    center_azimuth_deg: float
    max_range_m: float
    origin_height_m: float


def estimate_scan(scans: Sequence[Float64], laser_indices: LaserIndices = None) -> ScanEstimate | None:
    """Estimate a LiDAR's pattern from (N, 3) points of scans in its frame; None if they do not lie in rows.

    The LiDAR turns about z. A row whose rays all miss everything is not found. `laser_indices` says which laser each point is
    of; they are found by elevation if unknown.
    """
    points_m = np.concatenate([np.empty((0, 3)), *scans])
    if len(points_m) < 2:
        return None
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])))
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    origin_m = 0.0
    if laser_indices is None:
        rows_deg = estimate_row_elevations_deg(elevation_deg)
        if rows_deg is None:
            return None
        row = np.searchsorted((rows_deg[1:] + rows_deg[:-1]) / 2, elevation_deg)
    else:
        _, row = np.unique(np.concatenate(laser_indices), return_inverse=True)
    found_deg = np.array([np.median(elevation_deg[row == number]) for number in range(int(row.max()) + 1)])
    if laser_indices is not None:
        lines_deg, origins_m, off_deg = _lines(points_m, row)
        closer = np.median(np.abs(off_deg)) < CLOSER * np.median(np.abs(elevation_deg - found_deg[row]))
        if closer and np.abs(origins_m).max() < HIGHEST_M:  # on flat ground a tilt looks like an origin far below
            found_deg, origin_m = lines_deg, float(np.average(origins_m, weights=np.bincount(row)))
    scan = np.repeat(np.arange(len(scans)), [len(one) for one in scans])
    step_deg = _column_step_deg(azimuth_deg, scan * len(found_deg) + row)
    if step_deg is None:
        return None
    fov_deg, centre_deg = _field_of_view(azimuth_deg, step_deg)
    range_m = np.linalg.norm(points_m, axis=1)
    return ScanEstimate(
        np.sort(found_deg)[::-1], max(1, round(fov_deg / step_deg)), fov_deg, centre_deg, float(range_m.max()), origin_m
    )


def infer_laser_indices(points_m: Float64) -> NDArray[np.integer] | None:
    """(N,) the laser of each point of a cloud that is stored laser by laser, as KITTI's; None if it is not."""
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    jump = np.diff(azimuth, prepend=azimuth[:1])
    jump = np.where(np.abs(jump) > np.pi, 0.0, jump)  # across the back
    sense = np.sign(jump.sum())
    turned = np.mod(sense * azimuth, 2 * np.pi)
    laser = np.cumsum(np.diff(turned, prepend=turned[:1]) < -np.pi)
    sizes = np.bincount(laser)
    if not LASERS[0] <= len(sizes) <= LASERS[1] or np.median(sizes) < LASER_POINTS:
        return None
    slope = points_m[:, 2] / np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-6)
    steps = np.abs(np.diff(slope))
    return laser if np.median(steps[np.diff(laser) > 0]) > STEPS * np.median(steps) else None


def compute_row_spread_deg(scans: Sequence[Float64], laser_indices: LaserIndices) -> float:
    """How far points lie from rows: from those of their lasers, or how wide an angle all rows together take."""
    points_m = np.concatenate(scans)
    if laser_indices is not None:
        _, row = np.unique(np.concatenate(laser_indices), return_inverse=True)
        return float(np.median(np.abs(_lines(points_m, row)[2])))
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])))
    share = np.bincount(((elevation_deg + 90.0) / SPREAD_DEG).astype(np.int64)) / len(points_m)
    return SPREAD_DEG / float((share**2).sum())


def _lines(points_m: Float64, row: NDArray[np.intp]) -> tuple[Float64, Float64, Float64]:
    """Of each laser the elevation and the height of its origin, and how far off each point lies, in degrees.

    z = tan(elevation) r + origin, least squares of z / r: how far off a point is, is an angle.
    """
    r_m = np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-6)
    near, tangent = 1.0 / r_m, points_m[:, 2] / r_m
    off, kept = np.zeros(len(row)), np.ones(len(row), np.bool_)
    for _ in range(3):
        count, of_near, of_tangent, squared, product = (
            np.bincount(row, kept * of, minlength=int(row.max()) + 1)
            for of in (np.ones(len(row)), near, tangent, near**2, near * tangent)
        )
        count = np.maximum(count, 1)
        prior = count * (np.deg2rad(LINE_DEG) / ORIGIN_M) ** 2
        told, weight = product - of_near * of_tangent / count, squared - of_near**2 / count
        common_m = told.sum() / (weight + prior / 100).sum()
        origin_m = common_m + (told - common_m * weight) / (weight + prior)
        slope = (of_tangent - origin_m * of_near) / count
        off = np.rad2deg(tangent - slope[row] - origin_m[row] * near)
        kept = np.abs(off) <= 4 * np.median(np.abs(off)) + 1e-9
    return np.rad2deg(np.arctan(slope)), origin_m, off


def estimate_row_elevations_deg(elevations_deg: Float64) -> Float64 | None:
    """(R,) the elevations that points gather at, ascending, to a bin; None if that depends on how closely one looks."""
    lowest = float(elevations_deg.min()) - 4 * COARSEST_DEG
    number = ((elevations_deg - lowest) / BIN_DEG).astype(np.int64)
    size = int(number.max() + 4 * COARSEST_DEG / BIN_DEG)
    least = max(PEAK_POINTS, PEAK_SHARE * len(elevations_deg))
    spectrum = np.fft.rfft(np.bincount(number, minlength=size).astype(np.float64))
    frequency = np.fft.rfftfreq(size)
    found: list[NDArray[np.intp]] = []
    widths = np.arange(np.log(FINEST_DEG), np.log(COARSEST_DEG), np.log(GROWTH))
    for width in np.exp(widths) / BIN_DEG:
        density = np.fft.irfft(spectrum * np.exp(-2 * (np.pi * frequency * width) ** 2), size)
        peak = (density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:])
        peak &= density[1:-1] > least / (width * np.sqrt(2 * np.pi))
        found.append(np.flatnonzero(peak) + 1)
    counts = np.array([len(peaks) for peaks in found])
    starts = np.flatnonzero(np.diff(counts, prepend=-1))
    lengths = np.diff(starts, append=len(counts))
    lengths[(counts[starts] < 1) | (counts[starts] > MAX_ROWS)] = 0
    longest = int(lengths.argmax())
    if lengths[longest] < SAME_THROUGH:
        return None
    return np.asarray(lowest + BIN_DEG * (found[starts[longest] + lengths[longest] // 2] + 0.5))


def _column_step_deg(azimuth_deg: Float64, of_row: Int64) -> float | None:
    """The angle from a column to the next: most points have a neighbour in their row."""
    order = np.lexsort((azimuth_deg, of_row))
    gaps_deg = np.diff(azimuth_deg[order])[np.diff(of_row[order]) == 0]
    gaps_deg = gaps_deg[gaps_deg > 1e-4]  # two returns of one ray
    if not len(gaps_deg):
        return None
    step_deg = float(np.median(gaps_deg))
    for _ in range(3):
        step_deg = float(gaps_deg[np.rint(gaps_deg / step_deg) == 1].mean())
    return step_deg


def _field_of_view(azimuth_deg: Float64, step_deg: float) -> tuple[float, float]:
    """How wide it is and where its middle is; full turns have theirs ahead."""
    ordered = np.sort(azimuth_deg)
    gaps_deg = np.diff(ordered, append=ordered[0] + 360.0)
    widest = int(gaps_deg.argmax())
    if gaps_deg[widest] < BLIND_DEG:
        return 360.0, 0.0
    centre_deg = float(ordered[widest] + gaps_deg[widest] / 2 + 180.0)
    return min(360.0, 360.0 - float(gaps_deg[widest]) + step_deg), (centre_deg + 180.0) % 360.0 - 180.0


# Points are moved together if they were measured within so short a time.
TICK_NS = 100_000
# Of a turn: what may be measured at the instant, how much may come before it; and steps by which both are made finer.
AT_DEG, BEFORE, FINER = np.arange(-180.0, 180.0, 45.0).tolist(), (0.0, 0.25, 0.5, 0.75, 1.0), 0.5 ** np.arange(1, 7)
# So many points are looked at to find out, of a vehicle that moves so far in a turn; they have to lie so much closer.
# So much of a turn is left out at its ends.
LOOKED_AT, MOVES_M, LESS_BLURRED, SEAM = 8_000, 0.05, 0.8, 0.035
# No LiDAR turns more slowly: of frames that are farther apart, how long a turn takes is not known.
LONGEST_TURN_S = 0.25


class Revolution(NamedTuple):
    """When the directions of a turn were measured: the one at the instant, its sense, its share before the instant."""

    reference_azimuth_deg: float
    direction: int
    share_before: float

    @property
    def start_azimuth_deg(self) -> float:
        """The azimuth that is measured first."""
        return (self.reference_azimuth_deg - self.direction * 360.0 * self.share_before + 180.0) % 360.0 - 180.0

    def compute_revolutions(self, points_m: Matrix) -> Float64:
        """(N,) when points were measured, in turns after the instant."""
        azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
        return np.mod(self.direction * (azimuth_deg - self.start_azimuth_deg), 360.0) / 360.0 - self.share_before

    def mask_off_seam(self, points_m: Matrix) -> Bools:
        """(N,) which points are not where a turn begins and ends."""
        share = self.compute_revolutions(points_m) + self.share_before
        return (share > SEAM) & (share < 1 - SEAM)


class _Scan(NamedTuple):
    """(N, 3) points in the frame of the LiDAR at the instant, what is known of them, and where it was around then."""

    points_m: Matrix
    rows: NDArray[np.integer] | None
    offsets_s: Float64 | None
    way: PoseSeries | None
    turn_s: float

    def back(self, offsets_s: Float64, points_m: Matrix) -> Matrix:
        """Points in the frame of the LiDAR when each was measured."""
        assert self.way is not None
        tick, of_point = np.unique(np.rint(offsets_s * (1e9 / TICK_NS)).astype(np.int64), return_inverse=True)
        world_T_then = self.way.interpolate(tick * TICK_NS, "the LiDAR")
        then_T_now = (np.linalg.inv(world_T_then) @ self.way.interpolate(np.zeros(1, np.int64), "the LiDAR"))[of_point]
        return np.asarray(np.einsum("nij,nj->ni", then_T_now[:, :3, :3], points_m) + then_T_now[:, :3, 3])

    def undone(self, turn: Revolution, points_m: Matrix) -> Matrix:
        """The same, by what the turn says of their directions then."""
        cast_m = points_m
        for _ in range(2):
            cast_m = self.back(turn.compute_revolutions(cast_m) * self.turn_s, points_m)
        return cast_m


def undo_motion_compensation(
    recording: Recording, sensor_name: str, frame_indices: Sequence[int], vehicle_T_sensor: Matrix
) -> tuple[list[Matrix], LaserIndices, str]:
    """Scans in the frame of a LiDAR at the time of each ray, the lasers of their points, and what was undone.

    Where the times of points are not known, and the vehicle moves, they are those of even turns for which points lie
    closest to rows; if they lie so best as they are, nothing was done to them.
    """
    scans = [_read(recording, sensor_name, index, vehicle_T_sensor) for index in frame_indices]
    lasers = [infer_laser_indices(scan.points_m) if scan.rows is None else scan.rows for scan in scans]
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

    def blur(turn: Revolution | None) -> float:
        looked_at = [scan.points_m[which] for scan, which in zip(scans, some, strict=True)]
        if turn is not None:
            looked_at = [scan.undone(turn, points_m) for scan, points_m in zip(scans, looked_at, strict=True)]
        return compute_row_spread_deg(looked_at, few)

    turn, found = _best_turn(blur)
    if found > LESS_BLURRED * blur(None):
        return as_they_are, rows, ""
    cast = [scan.undone(turn, scan.points_m) for scan in scans]
    # Where a turn begins and ends, a degree decides which of the two it is.
    inside = [
        turn.mask_off_seam(scan.points_m) & turn.mask_off_seam(points_m)
        for scan, points_m in zip(scans, cast, strict=True)
    ]
    cast = [points_m[which] for points_m, which in zip(cast, inside, strict=True)]
    rows = None if rows is None else [of[which] for of, which in zip(rows, inside, strict=True)]
    return (
        cast,
        rows,
        f"motion undone (turns {'counter-' * (turn.direction > 0)}clockwise from {turn.start_azimuth_deg:.0f} degrees)",
    )


def _best_turn(blur: Callable[[Revolution | None], float]) -> tuple[Revolution, float]:
    tried = {
        turn: blur(turn)
        for turn in (Revolution(at_deg, sense, b) for at_deg in AT_DEG for sense in (-1, 1) for b in BEFORE)
    }
    best = min(tried, key=lambda turn: tried[turn])
    for share in FINER:
        for at_deg, before in ((45.0, 0.0), (-45.0, 0.0), (0.0, 0.25), (0.0, -0.25)):
            turn = Revolution(
                best.reference_azimuth_deg + share * at_deg, best.direction, best.share_before + share * before
            )
            tried[turn] = tried.get(turn) or blur(turn)
            best = min(best, turn, key=lambda turn: tried[turn])
    return best, tried[best]


def _read(recording: Recording, sensor: str, index: int, vehicle_T_sensor: Matrix) -> _Scan:
    scan = recording.read_scan(sensor, index)
    points_m = scan.points_m.astype(np.float64)
    came = np.asarray(np.isfinite(points_m).all(axis=1) & (np.abs(points_m) > NO_RETURN_M).any(axis=1))
    in_vehicle_m = points_m if scan.vehicle_T_sensor is None else transform_points(scan.vehicle_T_sensor, points_m)
    if recording.ego_box is not None:
        came[find_points_in_box(in_vehicle_m, recording.ego_box)] = False
    rows = None if scan.rings is None else scan.rings[came]
    offsets_s = None if scan.offsets_s is None else scan.offsets_s[came]
    way, turn_s = None, 0.0
    near = range(max(index - 1, 0), min(index + 2, len(recording.frame_names)))
    poses = [recording.get_world_T_vehicle(at) for at in near]
    if recording.times_s is not None and len(poses) > 1 and all(pose is not None for pose in poses):
        world_T_sensor = np.stack([pose for pose in poses if pose is not None]) @ vehicle_T_sensor
        times_s = recording.times_s[near.start : near.stop] - recording.times_s[index]
        times_ns = np.rint(times_s * 1e9).astype(np.int64)
        wxyz = np.array([convert_rotation_to_quaternion(pose[:3, :3]) for pose in world_T_sensor])
        way, turn_s = PoseSeries(times_ns, world_T_sensor[:, :3, 3], wxyz), float(np.diff(times_ns).min() * 1e-9)
    return _Scan(transform_points(invert(vehicle_T_sensor), in_vehicle_m[came]), rows, offsets_s, way, turn_s)


def _way_m(way: PoseSeries) -> float:
    return float(np.linalg.norm(np.diff(way.positions_m, axis=0), axis=1).min())
