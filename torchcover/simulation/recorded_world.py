"""Scenarios of recorded drives: observed ground, static cells, and moving objects on their tracks."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from torchcover.files import AtomicOutput, format_csv, to_yaml
from torchcover.geometry import BoundingBox, HeightField, convert_rotation_to_euler, invert, transform_points
from torchcover.geometry.arrays import Float64, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.accumulated_reference import DEFAULT_EGO_BOX, AccumulatedReference, AccumulationParams
from torchcover.recordings.formats.tracks import BOX_COLUMNS, TRAJECTORY_COLUMNS
from torchcover.recordings.recording import Recording
from torchcover.recordings.sweep_window import compute_voxel_indices, find_first_occurrences
from torchcover.recordings.vehicle_cloud import find_points_in_box
from torchcover.simulation.cell_mesh import CELL_M, build_cell_mesh
from torchcover.simulation.height_field import GroundHeightField
from torchcover.simulation.recorded_tracks import (
    DynamicScan,
    MappedDrive,
    ObjectTracker,
    TableRow,
    build_row_box,
    list_labeled_tracks,
)
from torchcover.simulation.shapes import Mesh


@dataclass(frozen=True)
class SceneMappingParams:
    """Parameters of the scene of a recorded drive.

    Args:
        window_s: Scans within this time are compared to separate static points from dynamic ones.
        max_image_interval_s: Longest interval of the range images that carve free space.
        time_step_s: Time step of the scenario.
        ground_cell_m: Side of a cell of the ground.
        ground_margin_m: Distance from the path up to which ground is mapped: the range of sensors.
        max_ground_cells: Limit of the cells of the ground.
        max_hole_m: Holes of a column of cells up to this height are filled, such as those between two rows of a LiDAR
            on a wall.
        max_foot_m: Columns that begin below this height above ground are extended to the ground.
        margin_m: Points this close to the vehicle or a moving object are not static.
        accumulation: Parameters of the separation of static and dynamic points.
    """

    window_s: float = 5.0
    max_image_interval_s: float = 1.0
    time_step_s: float = 0.1
    ground_cell_m: float = 1.0
    ground_margin_m: float = 160.0
    max_ground_cells: int = 30_000_000
    max_hole_m: float = 1.0
    max_foot_m: float = 0.6
    margin_m: float = 0.4
    accumulation: AccumulationParams = AccumulationParams()


def write_scenario(
    recording: Recording,
    folder: Path,
    *,
    num_frames: int | None = None,
    params: SceneMappingParams = SceneMappingParams(),
) -> str:
    """Write the scenario of a drive: `scenario.yaml` in a folder, and the files that it names.

    The ground is a height field through the observed ground. Static objects are cells of 0.2 m with points that no two
    scans contradict. Labeled objects have the tracks of their labels; without labels, moving objects have tracks that
    are found in the points. The scenario does not contain anything that was not observed.

    Args:
        recording: Recording with times and poses.
        folder: Output folder; created if it does not exist.
        num_frames: Number of key frames, from the first on; all if None.
        params: Parameters of the scene.

    Returns:
        Summary of the scenario.

    Raises:
        OSError: A file is missing, or cannot be written.
        ValueError: Times or poses are missing, poses jump, there is a gap in time, or no ground is observed.
    """
    reference = AccumulatedReference(params.window_s)
    reference.check(recording, ())
    times_s = select_times_s(recording, num_frames, params)
    poses = np.array(
        [reference.sweep_window.compute_local_T_vehicle(recording, index) for index in range(len(times_s))]
    )
    ego_box = recording.ego_box or DEFAULT_EGO_BOX
    # Mirrors and antennas reach beyond the box; the ground below it remains.
    margin_m = np.array([params.margin_m, params.margin_m, 0.0])
    excluded_box = BoundingBox.from_points(np.array([ego_box.lower_m - margin_m, ego_box.upper_m + margin_m]))
    mapped = map_drive(recording, reference, times_s, poses, excluded_box, params)
    ego_trajectory = Trajectory.from_poses(times_s, poses)
    # Labels are exact; tracks from points are the fallback.
    is_labeled = recording.read_boxes(recording.key_frames[0]) is not None
    if is_labeled:
        track_rows = list(list_labeled_tracks(recording, float(times_s[-1]), params.time_step_s))
    else:
        track_rows = list(ObjectTracker(mapped, ego_trajectory, params.accumulation).list_rows())
    # Static cells on the path of a vehicle are remains of it in some scans.
    occupied_boxes = [(pose, ego_box) for pose in poses]
    occupied_boxes += [build_row_box(row, params.margin_m) for row in track_rows]
    cells = find_static_cells(mapped, occupied_boxes, params)
    meshes = {"ground": mapped.ground.build_mesh()}
    if len(cells):
        meshes["static"] = build_cell_mesh(cells)
    ground_m2 = mapped.ground.cell_mask.sum() * params.ground_cell_m**2
    summary = (
        f"{times_s[-1]:.1f} s; ground of {ground_m2:,.0f} m2, {len(cells):,} static cells of {CELL_M:g} m, "
        f"{len({row[1] for row in track_rows})} moving objects ({'from labels' if is_labeled else 'from points'})"
    )
    write_scenario_files(recording, folder, summary, meshes, ego_trajectory, track_rows, params)
    return summary


def select_times_s(recording: Recording, num_frames: int | None, params: SceneMappingParams) -> Float64:
    """Select the frames of a scenario.

    Args:
        recording: Recording with times.
        num_frames: Number of key frames, from the first on; all if None.
        params: Longest interval of two frames.

    Returns:
        (T,) times of all frames up to the last key frame, relative to the first.

    Raises:
        ValueError: The recording has no times, or a gap.
    """
    if recording.times_s is None:
        raise ValueError(f"{recording.path}: no times; a scene needs them")
    # Frames between key frames are used, too, but the scenario ends at a key frame.
    key_frames = recording.key_frames if num_frames is None else recording.key_frames[:num_frames]
    times_s = recording.times_s[: key_frames[-1] + 1] - recording.times_s[0]
    intervals_s = np.diff(times_s)
    gaps = np.flatnonzero(intervals_s > params.window_s)
    if len(gaps):
        num_frames_before = sum(frame <= gaps[0] for frame in recording.key_frames)
        raise ValueError(
            f"{recording.path}: nothing is recorded for {intervals_s[gaps[0]]:,.1f} s after "
            f"{recording.frame_names[gaps[0]]}, and a scene needs a frame at least every {params.window_s:g} s; record "
            f"more often, or make a scene of the frames before (--num-frames {num_frames_before})"
        )
    return np.asarray(times_s)


def map_drive(
    recording: Recording,
    reference: AccumulatedReference,
    times_s: Float64,
    poses: Matrix,
    excluded_box: BoundingBox,
    params: SceneMappingParams,
) -> MappedDrive:
    """Map all scans of a drive, window by window.

    Args:
        recording: The recording.
        reference: Reference that separates static from dynamic points.
        times_s: (T,) times of the frames.
        poses: (T, 4, 4) poses of the vehicle.
        excluded_box: Box of the vehicle with a margin, in the vehicle frame; points in it are ignored.
        params: Parameters of the scene.

    Returns:
        The mapped drive.

    Raises:
        ValueError: The poses jump, the drive is too large, or no ground is observed.
    """
    ground_map, sweeps = GroundMap(poses[:, :2, 3], params), reference.sweep_window
    static_points_m = np.empty((0, 3))
    dynamic_scans, range_images = [], []
    image_times_s = dict.fromkeys(recording.sensors, -np.inf)
    # Short drives need images more often to carve free space.
    image_interval_s = min(params.max_image_interval_s, times_s[-1] / 20)
    last_frame = -1
    # Windows overlap by a tenth, so that every frame is in one.
    for center_s in np.arange(0.45, times_s[-1] / params.window_s + 0.9, 0.9) * params.window_s:
        index = int(np.abs(times_s - center_s).argmin())
        if num_skipped := sweeps.count_skipped_frames(recording, index):
            raise ValueError(
                f"{recording.path}: the poses jump within {params.window_s / 2:g} s of "
                f"{recording.frame_names[index]}, which excludes {num_skipped} frames; repair the poses, or make a "
                "scene of fewer frames (--num-frames)"
            )
        point_parts_m = [static_points_m]
        for (sensor, frame), (points_m, point_class) in sorted(reference.classify_points(recording, index).items()):
            # Frames of the overlap with the previous window are done.
            if not last_frame < frame < len(times_s):
                continue
            is_outside = np.ones(len(points_m), np.bool_)
            is_outside[find_points_in_box(transform_points(invert(poses[frame]), points_m), excluded_box)] = False
            is_dynamic = is_outside & (point_class > 0)
            point_parts_m.append(points_m[is_outside & (point_class == 0)])
            dynamic_scans.append(DynamicScan(float(times_s[frame]), points_m[is_dynamic], point_class[is_dynamic] == 2))
            image = sweeps.get_thinned_scan(recording, sensor, frame).range_image
            if image is not None and times_s[frame] - image_times_s[sensor] > image_interval_s - 1e-6:
                range_images.append(image)
                image_times_s[sensor] = times_s[frame]
        # A single point per cell bounds the memory on long drives.
        static_points_m = np.concatenate(point_parts_m)
        static_points_m = static_points_m[find_first_occurrences(compute_voxel_indices(static_points_m, CELL_M))]
        ground_map.add(recording, reference, index, poses[index])
        last_frame = max(sweeps.find_frames_in_window(recording, index))
    dynamic_scans.sort(key=attrgetter("time_s"))
    return MappedDrive(ground_map.build_height_field(recording), static_points_m, dynamic_scans, range_images)


class GroundMap:
    """Ground around a path; each position has the height of the ground model whose center is nearest.

    Args:
        path_m: (T, 2) positions of the vehicle.
        params: Size of the cells and margin around the path.

    Raises:
        ValueError: The path is too long.
    """

    def __init__(self, path_m: Float64, params: SceneMappingParams) -> None:
        self._params = params
        cell_m, margin_m = params.ground_cell_m, params.ground_margin_m
        self._lower_m = np.floor(path_m.min(axis=0) - margin_m)
        columns, rows = (np.ceil(path_m.max(axis=0) + margin_m - self._lower_m) / cell_m).astype(int) + 1
        if rows * columns > params.max_ground_cells:
            raise ValueError(
                f"the drive covers {columns * cell_m / 1000:.1f} x {rows * cell_m / 1000:.1f} km, too much for one "
                "scene; make a scene of fewer frames (--num-frames)"
            )
        self._heights_m = np.full((rows, columns), np.nan)
        self._distance_m = np.full((rows, columns), np.inf)

    def add(self, recording: Recording, reference: AccumulatedReference, index: int, pose: Matrix) -> None:
        """Add the ground model around a frame.

        Args:
            recording: The recording.
            reference: Reference with the ground models.
            index: The frame.
            pose: (4, 4) pose of the vehicle.
        """
        model = reference.sweep_window.get_ground_model(recording, index)
        if model is None:
            return
        cell_m, margin_m = self._params.ground_cell_m, self._params.ground_margin_m
        first = np.maximum(((pose[:2, 3] - margin_m - self._lower_m) / cell_m).astype(int), 0)
        part = tuple(slice(start, start + int(2 * margin_m / cell_m)) for start in first[::-1])
        # The part is smaller at the border of the map.
        rows, columns = self._heights_m[part].shape
        positions_m = self._lower_m + cell_m * (first + np.indices((rows, columns))[::-1].reshape(2, -1).T)
        # The ground lies below z = 0 by the height of z = 0 above it.
        heights_m = -model.compute_heights_m(np.column_stack([positions_m, np.zeros(len(positions_m))]))
        heights_m = heights_m.reshape(rows, columns)
        distance_m = np.linalg.norm(positions_m - pose[:2, 3], axis=1).reshape(rows, columns)
        is_nearer = np.isfinite(heights_m) & (distance_m < self._distance_m[part])
        self._heights_m[part][is_nearer], self._distance_m[part][is_nearer] = (
            heights_m[is_nearer],
            distance_m[is_nearer],
        )

    def build_height_field(self, recording: Recording) -> GroundHeightField:
        """Build the ground of all cells whose corners have heights.

        Args:
            recording: The recording, for messages.

        Returns:
            The ground.

        Raises:
            ValueError: No cell has four corners.
        """
        is_observed = np.isfinite(self._heights_m)
        # A cell needs the heights of its four corners.
        cell_mask = is_observed[1:, 1:] & is_observed[1:, :-1] & is_observed[:-1, 1:] & is_observed[:-1, :-1]
        if not cell_mask.any():
            raise ValueError(
                f"{recording.path}: no ground is observed around the vehicle; is z up, and 0 on the ground?"
            )
        return GroundHeightField(self._lower_m, self._heights_m, cell_mask, self._params.ground_cell_m)


def find_static_cells(
    mapped: MappedDrive, occupied_boxes: Sequence[tuple[Matrix, BoundingBox]], params: SceneMappingParams
) -> Int64:
    """Find the cells that static objects occupy.

    Args:
        mapped: The drive.
        occupied_boxes: Poses and boxes of the vehicle and of moving objects; cells in them are free.
        params: Sizes of holes that are filled.

    Returns:
        (N, 3) cells in multiples of `CELL_M`.
    """
    height_field = HeightField(mapped.ground.origin_m, mapped.ground.corner_heights_m, params.ground_cell_m)
    height_m = mapped.static_points_m[:, 2] - height_field.compute_heights_m(mapped.static_points_m[:, :2])
    is_above_ground = ~(height_m < params.accumulation.max_ground_height_m)  # also without ground
    points_m, height_m = mapped.static_points_m[is_above_ground], height_m[is_above_ground]
    cells = np.floor(points_m / CELL_M).astype(np.int64)
    order = np.lexsort(cells.T[::-1])  # by column, then upwards
    points_m, height_m, cells = points_m[order], height_m[order], cells[order]
    is_same_column = np.append(False, (cells[1:, :2] == cells[:-1, :2]).all(axis=1))
    # Fill small holes between two cells of a column, and below its lowest cell if it is near the ground.
    num_filled = np.where(is_same_column, np.diff(cells[:, 2], prepend=0) - 1, 0)
    num_filled[num_filled > params.max_hole_m / CELL_M] = 0
    is_foot = ~is_same_column & (height_m < params.max_foot_m)
    num_filled[is_foot] = np.ceil(height_m[is_foot] / CELL_M)
    upper = np.repeat(np.arange(len(cells)), num_filled)
    steps_down = np.arange(len(upper)) - np.repeat(np.cumsum(num_filled) - num_filled, num_filled) + 1
    filled_cells = cells[upper] - steps_down[:, None] * np.array([0, 0, 1])
    cells = np.concatenate([cells, filled_cells])
    points_m = np.concatenate([points_m, (filled_cells + 0.5) * CELL_M])
    # Filled cells are tested as well: rays may pass through the holes.
    votes = np.zeros(len(cells), np.int16)
    for image in mapped.range_images:
        image.add_votes(points_m, votes)
    cells = cells[votes < params.accumulation.min_votes]
    # Sorted by x, the cells near a box are found by bisection.
    cells = cells[np.argsort(cells[:, 0], kind="stable")]
    is_static = np.ones(len(cells), np.bool_)
    for pose, box in occupied_boxes:
        radius_m = float(np.linalg.norm(box.corners_m[:, :2], axis=1).max())
        first, end = np.searchsorted(cells[:, 0], (pose[0, 3] + np.array([-radius_m, radius_m])) / CELL_M)
        y_m = (cells[first:end, 1] + 0.5) * CELL_M
        nearby = first + np.flatnonzero(np.abs(y_m - pose[1, 3]) < radius_m)
        centers_m = transform_points(invert(pose), (cells[nearby] + 0.5) * CELL_M)
        is_static[nearby[find_points_in_box(centers_m, box)]] = False
    static_cells: Int64 = np.unique(cells[is_static], axis=0)
    return static_cells


def write_scenario_files(
    recording: Recording,
    folder: Path,
    summary: str,
    meshes: dict[str, Mesh],
    ego_trajectory: Trajectory,
    track_rows: Sequence[TableRow],
    params: SceneMappingParams,
) -> None:
    """Write `scenario.yaml`, its meshes, `ego.csv` and `moving_objects.csv`.

    Args:
        recording: The recording, for names.
        folder: Output folder.
        summary: Summary of the scenario.
        meshes: Meshes by the name of the body.
        ego_trajectory: Trajectory of the vehicle from time 0 on.
        track_rows: Rows of moving objects.
        params: Time step.

    Raises:
        OSError: A file cannot be written.
    """
    # The small number keeps the last time step in spite of rounding.
    num_steps = int(ego_trajectory.times_s[-1] / params.time_step_s + 1e-6)
    times_s: Float64 = params.time_step_s * np.arange(num_steps + 1.0)
    poses = ego_trajectory.interpolate_many(times_s)
    angles_deg = convert_rotation_to_euler(poses[:, :3, :3])[:, ::-1]
    ego_rows = np.column_stack([times_s, poses[:, :3, 3], angles_deg]).tolist()
    bodies = []
    for name in meshes:
        bodies.append({"name": name, "shape": {"type": "mesh", "path": f"{name}.ply"}, "ground": name == "ground"})
    scenario: dict[str, Any] = {
        "name": re.sub(r"\W+", "_", recording.path.resolve().stem).strip("_") or "recording",
        "description": f"Drive of the recording {recording.path}: {summary}. Contains only what a sensor observed.",
        "ego": {"trajectory": "ego.csv"},
        "bodies": bodies,
    }
    texts = {"ego.csv": format_csv([TRAJECTORY_COLUMNS, *ego_rows])}
    if track_rows:
        scenario["boxes"] = "moving_objects.csv"
        header = ("t", "id", "category", *BOX_COLUMNS[1:])
        texts["moving_objects.csv"] = format_csv([header, *track_rows])
    scenario |= {"time_step_s": params.time_step_s, "duration_s": round(float(times_s[-1]), 6)}
    texts["scenario.yaml"] = to_yaml(scenario)
    with AtomicOutput(folder) as files:
        for name, mesh in meshes.items():
            files.add(f"{name}.ply", partial(export_ply, mesh))
        for name, text in texts.items():
            files.add_text(name, text)
        files.publish({"recording": str(recording.path), "summary": summary})


def export_ply(mesh: Mesh, path: Path) -> None:
    """Export a mesh as a PLY file."""
    import trimesh

    trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).export(path, file_type="ply")
