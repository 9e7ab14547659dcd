"""A drive as a world: the ground that was seen, what stands as cells, and what moves on its tracks."""

import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchcover.files import AtomicOutput, format_csv, to_yaml
from torchcover.geometry import (
    BoundingBox,
    HeightField,
    build_transform,
    convert_euler_to_rotation,
    convert_rotation_to_euler,
    invert,
    transform_points,
)
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.accumulated_reference import DEFAULT_EGO_BOX, AccumulatedReference, AccumulationParams
from torchcover.recordings.formats.tracks import BOX_COLUMNS, TRAJECTORY_COLUMNS
from torchcover.recordings.free_space import RangeImage
from torchcover.recordings.moving_clusters import MovingCluster, find_moving_clusters
from torchcover.recordings.objects import extract_objects
from torchcover.recordings.recording import Recording
from torchcover.recordings.sweep_window import compute_voxel_indices, find_first_occurrences
from torchcover.recordings.vehicle_cloud import find_points_in_box
from torchcover.simulation.height_field import GroundHeightField
from torchcover.simulation.recorded.excerpt import split_at_gaps
from torchcover.simulation.shapes import Mesh

# Parameters of the reference that separates static points from moving ones.
ACCUMULATION = AccumulationParams()
# Scans so near in time tell together what stands; those so far apart look at all of it once more.
WINDOW_S, LOOK_EVERY_S = 5.0, 1.0
# Instants of the world, and of those that movers are looked for at; how long one may be unseen.
STEP_S, FOUND_EVERY_S, GAP_S = 0.1, 0.2, 1.0
# Squares of the ground, as far around the way as sensors see; so many at most.
SQUARE_M, AROUND_M, MOST_SQUARES = 1.0, 160.0, 30_000_000
# What stands is made of such cells. A hole in a column that is no higher is filled, as between two rows of a LiDAR on a
# wall; and what begins so low stands on the ground.
CELL_M, HOLE_M, FOOT_M = 0.2, 1.0, 0.6
# A mover is found again within so much of where it was to be. It has to be found so often, and to get so far.
AGAIN_M, LEAST_TIMES, LEAST_WAY_M = 2.0, 3, 2.0
# What is so wide is at least as long as a car, though only its end be seen.
CAR_M = (4.5, 1.4)
# What it is called by its length and width.
CALLED = (((1.3, 1.3), "pedestrian"), ((2.6, 1.3), "bicycle"), ((6.5, np.inf), "car"), ((np.inf, np.inf), "truck"))
# Of what moves, such a share is seen past; of a wall that comes into sight, and so seems to, none is.
PAST = 0.3
# So near to a mover, what seems to stand is its own; as is what seems to move so near to the vehicle, as its mirrors.
BESIDE_M = 0.4
# As large as nine in ten times; and no larger or smaller than that.
USUALLY, LARGEST_M, SMALLEST_M = 0.9, (25.0, 4.0, 5.0), 0.3
# Columns of the faces of a cell, and its corners around each, from outside.
SIDES = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])
AROUND_SIDES = np.array(
    [
        [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]],
        [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]],
        [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
        [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]],
        [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]],
        [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    ]
)

TableRow = tuple[float | str, ...]


class MappedDrive(NamedTuple):
    """What a drive has seen, in the world from its first place: the ground, where it is known, and what is on it.

    `static_points_m` (N, 3) is a place in each cell in which something stands or lies; `dynamic_scans` has of each scan when it was,
    (N, 3) what does not stand, and whether each is seen past; `range_images` say how far some of them saw.
    """

    ground: GroundHeightField
    static_points_m: Float64
    dynamic_scans: list[tuple[float, Float64, Bools]]
    range_images: list[RangeImage]


def write_scenario(recording: Recording, folder: Path, *, num_frames: int | None = None) -> str:
    """Make a scenario of a drive: `scenario.yaml` in a folder, and the files that it names.

    The ground is a height field through what was seen of it. What stands is what no two scans have seen past, as cells
    of 0.2 m. What is labelled has the tracks of its labels; without labels, what moves has those that are found by
    rays. What nobody saw is not there.

    Args:
        recording: With times and poses.
        folder: Where to; made if it does not exist.
        num_frames: How many of its frames, from the first on; all if not given.

    Returns:
        What was made, in words.

    Raises:
        OSError: A file is missing, or cannot be written.
        ValueError: No times or poses, poses that jump or a gap in time; no ground around the vehicle.
    """
    reference = AccumulatedReference(WINDOW_S)
    reference.check(recording, ())
    assert recording.times_s is not None  # as checked
    last = recording.key_frames[
        (len(recording.key_frames) if num_frames is None else min(num_frames, len(recording.key_frames))) - 1
    ]
    times_s = recording.times_s[: last + 1] - recording.times_s[0]
    gaps = np.flatnonzero(np.diff(times_s) > WINDOW_S)
    if len(gaps):
        before = sum(frame <= gaps[0] for frame in recording.key_frames)
        raise ValueError(
            f"{recording.path}: nothing is recorded for {np.diff(times_s)[gaps[0]]:,.1f} s after "
            f"{recording.frame_names[gaps[0]]}, and a world needs a frame at least every {WINDOW_S:g} s; record more often, "
            f"or make a world of the frames before (--num-frames {before})"
        )
    poses = np.array(
        [reference.sweep_window.compute_local_T_vehicle(recording, instant) for instant in range(last + 1)]
    )
    body = recording.ego_box or DEFAULT_EGO_BOX
    beside_m = np.array([BESIDE_M, BESIDE_M, 0.0])
    own = BoundingBox.from_points(np.array([body.lower_m - beside_m, body.upper_m + beside_m]))
    seen = _seen(recording, reference, times_s, poses, own)
    drive = Trajectory.from_poses(times_s, poses)
    labelled = recording.read_boxes(recording.key_frames[0]) is not None
    rows = list(_labelled(recording, float(times_s[-1])) if labelled else _found(seen, drive))
    driven = [(pose, body) for pose in poses] + [_around(row) for row in rows]
    cells = _cells(seen, driven)
    instants_s: Float64 = STEP_S * np.arange(int(times_s[-1] / STEP_S + 1e-6) + 1.0)
    placed = drive.interpolate_many(instants_s)
    way = np.column_stack([instants_s, placed[:, :3, 3], convert_rotation_to_euler(placed[:, :3, :3])[:, ::-1]])
    told = (
        f"{times_s[-1]:.1f} s; ground of {seen.ground.cell_mask.sum() * SQUARE_M**2:,.0f} m2, {len(cells):,} cells of "
        f"{CELL_M:g} m that stand, {len({row[1] for row in rows})} movers "
        f"({'of its labels' if labelled else 'found by rays'})"
    )
    bodies = {"ground": seen.ground.build_mesh(), **({"standing": build_cell_mesh(cells)} if len(cells) else {})}
    scenario = {
        "name": re.sub(r"\W+", "_", recording.path.resolve().stem).strip("_") or "recording",
        "description": f"The drive of the recording {recording.path}: {told}. What no sensor saw is not there.",
        "ego": {"trajectory": "ego.csv"},
        "bodies": [
            {"name": name, "shape": {"type": "mesh", "path": f"{name}.ply"}, "ground": name == "ground"}
            for name in bodies
        ],
        **({"boxes": "movers.csv"} if rows else {}),
        "time_step_s": STEP_S,
        "duration_s": round(float(instants_s[-1]), 6),
    }
    tables: dict[str, list[TableRow]] = {"ego": [TRAJECTORY_COLUMNS, *map(tuple, way.tolist())]}
    if rows:
        tables["movers"] = [("t", "id", "category", *BOX_COLUMNS[1:]), *rows]
    texts = {f"{name}.csv": format_csv(table) for name, table in tables.items()} | {"scenario.yaml": to_yaml(scenario)}
    with AtomicOutput(folder) as files:
        for name, mesh in bodies.items():
            files.add(f"{name}.ply", partial(_export, mesh))
        for name, text in texts.items():
            files.add_text(name, text)
        files.publish({"recording": str(recording.path), "found": told})
    return told


def _seen(
    recording: Recording, reference: AccumulatedReference, times_s: Float64, poses: Matrix, own: BoundingBox
) -> MappedDrive:
    """What all windows of a drive have seen, one after the other; nothing where the vehicle itself is."""
    field, sweeps = _Field(poses[:, :2, 3]), reference.sweep_window
    standing_m, loose, images = np.empty((0, 3)), [], []
    looked_s, look_every_s, done = dict.fromkeys(recording.sensors, -np.inf), min(LOOK_EVERY_S, times_s[-1] / 20), -1
    for middle_s in np.arange(0.45, times_s[-1] / WINDOW_S + 0.9, 0.9) * WINDOW_S:
        index = int(np.abs(times_s - middle_s).argmin())
        if skipped := sweeps.count_skipped_frames(recording, index):
            raise ValueError(
                f"{recording.path}: the poses jump within {WINDOW_S / 2:g} s of {recording.frame_names[index]}, by which "
                f"{skipped} instants are lost, and a world does not; mend them, or make one of fewer frames (--num-frames)"
            )
        parts = [standing_m]
        for (sensor, instant), (points_m, told) in sorted(reference.classify_points(recording, index).items()):
            if not done < instant < len(times_s):
                continue
            free = np.ones(len(points_m), np.bool_)
            free[find_points_in_box(transform_points(invert(poses[instant]), points_m), own)] = False
            parts.append(points_m[free & (told == 0)])
            loose.append((float(times_s[instant]), points_m[free & (told > 0)], told[free & (told > 0)] == 2))
            image = sweeps.get_thinned_scan(recording, sensor, instant).range_image
            if image is not None and times_s[instant] - looked_s[sensor] > look_every_s - 1e-6:
                images.append(image)
                looked_s[sensor] = times_s[instant]
        standing_m = np.concatenate(parts)
        standing_m = standing_m[find_first_occurrences(compute_voxel_indices(standing_m, CELL_M))]
        field.add(recording, reference, index, poses[index])
        done = max(sweeps.find_frames_in_window(recording, index))
    return MappedDrive(field.slopes(recording), standing_m, sorted(loose, key=lambda scan: scan[0]), images)


class _Field:
    """The ground around a way: each place has the height that was found from nearest to it."""

    def __init__(self, way_m: Float64) -> None:
        self._lower_m = np.floor(way_m.min(axis=0) - AROUND_M)
        columns, rows = (np.ceil(way_m.max(axis=0) + AROUND_M - self._lower_m) / SQUARE_M).astype(int) + 1
        if rows * columns > MOST_SQUARES:
            raise ValueError(
                f"the drive covers {columns * SQUARE_M / 1000:.1f} x {rows * SQUARE_M / 1000:.1f} km, too much for one "
                "world; make one of fewer frames (--num-frames)"
            )
        self._heights_m, self._away_m = np.full((2, rows, columns), np.nan)
        self._away_m[:] = np.inf

    def add(self, recording: Recording, reference: AccumulatedReference, index: int, pose: Matrix) -> None:
        """What is known around an instant."""
        model = reference.sweep_window.get_ground_model(recording, index)
        if model is None:
            return
        first = np.maximum(((pose[:2, 3] - AROUND_M - self._lower_m) / SQUARE_M).astype(int), 0)
        part = tuple(slice(start, start + int(2 * AROUND_M / SQUARE_M)) for start in first[::-1])
        rows, columns = self._heights_m[part].shape
        places_m = self._lower_m + SQUARE_M * (first + np.indices((rows, columns))[::-1].reshape(2, -1).T)
        heights_m = -model.compute_heights_m(np.column_stack([places_m, np.zeros(len(places_m))])).reshape(
            rows, columns
        )
        away_m = np.linalg.norm(places_m - pose[:2, 3], axis=1).reshape(rows, columns)
        better = np.isfinite(heights_m) & (away_m < self._away_m[part])
        self._heights_m[part][better], self._away_m[part][better] = heights_m[better], away_m[better]

    def slopes(self, recording: Recording) -> GroundHeightField:
        """All of it."""
        known = np.isfinite(self._heights_m)
        wanted = known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]
        if not wanted.any():
            raise ValueError(f"{recording.path}: no ground is seen around the vehicle; is z up, and 0 on the ground?")
        return GroundHeightField(self._lower_m, self._heights_m, wanted, SQUARE_M)


def _cells(seen: MappedDrive, driven: Sequence[tuple[Matrix, BoundingBox]]) -> Int64:
    """(N, 3) the cells, in steps of `CELL_M`, that something fills; none of where anything drives."""
    field = HeightField(seen.ground.origin_m, seen.ground.corner_heights_m, SQUARE_M)
    above_m = seen.static_points_m[:, 2] - field.compute_heights_m(seen.static_points_m[:, :2])
    stands = ~(above_m < ACCUMULATION.max_ground_height_m)
    places_m, above_m = seen.static_points_m[stands], above_m[stands]
    cells = np.floor(places_m / CELL_M).astype(np.int64)
    order = np.lexsort(cells.T[::-1])
    places_m, above_m, cells = places_m[order], above_m[order], cells[order]
    again = np.append(False, (cells[1:, :2] == cells[:-1, :2]).all(axis=1))
    below = np.where(again, np.diff(cells[:, 2], prepend=0) - 1, 0)
    below[below > HOLE_M / CELL_M] = 0
    foot = ~again & (above_m < FOOT_M)
    below[foot] = np.ceil(above_m[foot] / CELL_M)
    own = np.repeat(np.arange(len(cells)), below)
    down = np.arange(len(own)) - np.repeat(np.cumsum(below) - below, below) + 1
    filled = cells[own] - down[:, None] * np.array([0, 0, 1])
    cells, places_m = np.concatenate([cells, filled]), np.concatenate([places_m, (filled + 0.5) * CELL_M])
    votes = np.zeros(len(cells), np.int16)
    for image in seen.range_images:
        image.add_votes(places_m, votes)
    cells = cells[votes < ACCUMULATION.min_votes]
    cells = cells[np.argsort(cells[:, 0], kind="stable")]
    free = np.ones(len(cells), np.bool_)
    for pose, box in driven:
        reach_m = float(np.linalg.norm(box.corners_m[:, :2], axis=1).max())
        first, end = np.searchsorted(cells[:, 0], (pose[0, 3] + np.array([-reach_m, reach_m])) / CELL_M)
        near = first + np.flatnonzero(np.abs((cells[first:end, 1] + 0.5) * CELL_M - pose[1, 3]) < reach_m)
        free[near[find_points_in_box(transform_points(invert(pose), (cells[near] + 0.5) * CELL_M), box)]] = False
    filling: Int64 = np.unique(cells[free], axis=0)
    return filling


def _around(row: TableRow) -> tuple[Matrix, BoundingBox]:
    """Where a mover is, with the points beside it that were not seen past."""
    x, y, z, *size_m, yaw_deg = (float(number) for number in row[3:])
    length, width, height = np.array(size_m) / 2 + BESIDE_M
    box = BoundingBox((-length, -width, -height), (length, width, 2 * height))
    return build_transform(convert_euler_to_rotation(yaw_deg, 0.0, 0.0), [x, y, z]), box


def build_cell_mesh(cell_indices: Int64) -> Mesh:
    """The sides of (N, 3) cells, each once, in steps of `CELL_M`, that no other of them touches.

    Example:
        >>> mesh = build_cell_mesh(np.array([[0, 0, 0], [0, 0, 1]]))
        >>> mesh.faces.shape, mesh.vertices_m.max(axis=0).tolist()
        ((20, 3), [0.2, 0.2, 0.4])
    """
    from_m = cell_indices.min(axis=0) - 1
    size = cell_indices.max(axis=0) - from_m + 3

    def numbered(places: Int64) -> Int64:
        return np.asarray(np.ravel_multi_index(tuple((places - from_m).T), tuple(size)))

    numbers, corners = np.sort(numbered(cell_indices)), []
    for side, around in zip(SIDES, AROUND_SIDES, strict=True):
        beside = numbered(cell_indices + side)
        at = np.searchsorted(numbers, beside).clip(max=len(numbers) - 1)
        bare = cell_indices[numbers[at] != beside]
        corners.append((bare[:, None] + around).reshape(-1, 3))
    used, of_side = np.unique(numbered(np.concatenate(corners)), return_inverse=True)
    of_side = of_side.reshape(-1, 4)
    vertices = np.stack(np.unravel_index(used, tuple(size)), axis=1) + from_m
    return Mesh(vertices * CELL_M, np.concatenate([of_side[:, [0, 1, 2]], of_side[:, [0, 2, 3]]]))


def _labelled(recording: Recording, last_s: float) -> Iterator[TableRow]:
    """Rows of `movers.csv` of labelled objects."""
    pose = recording.get_world_T_vehicle(0)
    assert pose is not None  # as checked
    first_m = pose[:3, 3]
    for track in extract_objects(recording).tracks:
        for number, piece in enumerate(split_at_gaps(track.trajectory, GAP_S)):
            name = track.name if not number else f"{track.name} #{number + 1}"
            times_s = np.append(np.arange(piece.times_s[0], piece.times_s[-1] - 1e-6, STEP_S), piece.times_s[-1])
            times_s = times_s[times_s <= last_s]
            placed = piece.interpolate_many(times_s)
            yaw_deg = convert_rotation_to_euler(placed[:, :3, :3])[:, :1]
            for row in np.column_stack([times_s, placed[:, :3, 3] - first_m, yaw_deg]).tolist():
                yield (row[0], name, track.category, *row[1:4], *track.size_m, row[4])


def _found(seen: MappedDrive, drive: Trajectory) -> Iterator[TableRow]:
    """Rows of `movers.csv` of what rays tell to move, from one instant to the next."""
    scan_s = np.array([time_s for time_s, *_ in seen.dynamic_scans])
    tracks: list[list[tuple[float, Float64, MovingCluster]]] = []
    before_s = -np.inf
    for time_s in np.unique(scan_s):
        if time_s - before_s < FOUND_EVERY_S - 1e-6:
            continue
        before_s, ego_m = time_s, drive.interpolate_positions_m(np.array([time_s]))[0]
        near = np.flatnonzero(np.abs(scan_s - time_s) <= ACCUMULATION.clusters.max_compared_s)
        scans_m = [seen.dynamic_scans[scan][1] for scan in near]
        max_range_m = ACCUMULATION.clusters.max_range_m
        scans_m = [of_m[np.linalg.norm(of_m[:, :2] - ego_m[:2], axis=1) < max_range_m] for of_m in scans_m]
        _go_on(tracks, time_s, find_moving_clusters(scans_m, scan_s[near] - time_s))
    number = 0
    for track in tracks:
        way_m = track[-1][1] - track[0][1]
        if len(track) < LEAST_TIMES or np.linalg.norm(way_m) < LEAST_WAY_M:
            continue
        if max(len(moved.points_m) for *_, moved in track) < ACCUMULATION.min_cluster_points:
            continue
        boxes = _boxes(track, drive, seen.ground)
        if _seen_past(seen, scan_s, [time_s for time_s, *_ in track], boxes) < PAST:
            continue
        number += 1
        fits = (boxes[0, 3:5] <= sizes_m for sizes_m, _ in CALLED)
        called = next(name for fit, (_, name) in zip(fits, CALLED, strict=True) if fit.all())
        for (time_s, *_), box in zip(track, boxes, strict=True):
            yield (time_s, f"found_{number}", called, *box.tolist())


def _seen_past(seen: MappedDrive, scan_s: Float64, times_s: Sequence[float], boxes: Float64) -> float:
    """The share that is seen past of what lies in the boxes of a track; what only comes into sight never is."""
    inside = past = 0
    for time_s, box in zip(times_s, boxes, strict=True):
        pose, room = _around(("", "", "", *box.tolist()))
        for scan in np.flatnonzero(scan_s == time_s):
            _, points_m, is_past = seen.dynamic_scans[scan]
            rows = find_points_in_box(transform_points(invert(pose), points_m), room)
            inside, past = inside + len(rows), past + int(is_past[rows].sum())
    return past / max(inside, 1)


def _go_on(
    tracks: list[list[tuple[float, Float64, MovingCluster]]], time_s: float, found: Sequence[MovingCluster]
) -> None:
    """Append what is found to the track of whatever was to be there, else begin another."""
    middles_m = [moved.points_m[:, :2].mean(axis=0) for moved in found]
    going = [track for track in tracks if time_s - track[-1][0] <= GAP_S / 2]
    apart_m = sorted(
        (float(np.linalg.norm(last_m + (time_s - last_s) * moved.velocity_mps - middle_m)), number, which)
        for number, track in enumerate(going)
        for last_s, last_m, moved in track[-1:]
        for which, middle_m in enumerate(middles_m)
    )
    left, open_ = set(range(len(found))), set(range(len(going)))
    for off_m, number, which in apart_m:
        if off_m <= AGAIN_M and which in left and number in open_:
            going[number].append((time_s, middles_m[which], found[which]))
            left.remove(which)
            open_.remove(number)
    tracks += [[(time_s, middles_m[which], found[which])] for which in sorted(left)]


def _boxes(
    track: Sequence[tuple[float, Float64, MovingCluster]], drive: Trajectory, ground: GroundHeightField
) -> Float64:
    """(K, 7) x, y, z of the bottom, length, width, height and yaw of what was found at each time of a track.

    Of a body the sides are seen that face the vehicle; there its box ends.
    """
    times_s = np.array([time_s for time_s, *_ in track])
    middles_m = np.array([middle_m for _, middle_m, _ in track])
    way = _steadied(np.array([moved.velocity_mps for *_, moved in track]))
    goes = np.linalg.norm(way, axis=1) > ACCUMULATION.sweeps.min_object_speed_mps
    if not goes.any():
        way[:], goes[:] = middles_m[-1] - middles_m[0], True
    # Who stands looks where it went, or will go.
    way = way[np.maximum.accumulate(np.where(goes, np.arange(len(track)), goes.argmax()))]
    yaw = np.arctan2(way[:, 1], way[:, 0])
    axes = np.stack([np.stack([np.cos(yaw), np.sin(yaw)], 1), np.stack([-np.sin(yaw), np.cos(yaw)], 1)], axis=1)
    ends = np.array([[np.quantile(moved.points_m[:, :2] @ axis.T, share, axis=0) for share in (0.02, 0.98)]
                     for axis, (*_, moved) in zip(axes, track, strict=True)])  # fmt: skip
    under_m = HeightField(ground.origin_m, ground.corner_heights_m, ground.cell_m).compute_heights_m(middles_m)
    lowest_m, highest_m = np.array([np.quantile(moved.points_m[:, 2], (0.02, 0.98)) for *_, moved in track]).T
    under_m = np.where(np.isfinite(under_m), under_m, lowest_m)
    seen_m = np.column_stack([ends[:, 1] - ends[:, 0], highest_m - under_m])
    size_m = np.clip(np.quantile(seen_m, USUALLY, axis=0), SMALLEST_M, LARGEST_M)
    if size_m[1] > CAR_M[1]:
        size_m[0] = max(size_m[0], CAR_M[0])
    ego = np.einsum("kij,kj->ki", axes, drive.interpolate_positions_m(times_s)[:, :2])
    far = np.where(ego < ends[:, 0], 1, np.where(ego > ends[:, 1], -1, 0))
    near = np.where(far > 0, ends[:, 0], ends[:, 1])
    middle = np.where(far == 0, ends.mean(axis=1), near + far * size_m[:2] / 2)
    placed_m = _steadied(np.einsum("kij,ki->kj", axes, middle))
    return np.column_stack([placed_m, under_m, np.tile(size_m, (len(track), 1)), np.rad2deg(yaw)])


def _steadied(values: Float64) -> Float64:
    """(K, 2) values at even times, each the mean of as many before as after it, at most two."""
    around = [min(2, at, len(values) - 1 - at) for at in range(len(values))]
    return np.array([values[at - step : at + step + 1].mean(axis=0) for at, step in enumerate(around)])


def _export(mesh: Mesh, path: Path) -> None:
    import trimesh

    trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).export(path, file_type="ply")
