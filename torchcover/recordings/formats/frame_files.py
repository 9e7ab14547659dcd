"""Frame files in folders (one file per frame, in natural order) and tables of poses and boxes."""

import os
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection.boxes import Boxes
from torchcover.files import format_csv, read_csv, report_bad_file
from torchcover.geometry import build_transform, convert_quaternion_to_rotation
from torchcover.geometry.rigid import RIGID_TOLERANCE, Matrix
from torchcover.recordings.clouds import READERS, split_name

# Columns of `poses.csv` and of `boxes/FRAME.csv`.
POSITION_COLUMNS = ("x_m", "y_m", "z_m")
QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
BOX_COLUMNS = (*POSITION_COLUMNS, "length_m", "width_m", "height_m", "yaw_rad")
VELOCITY_COLUMNS = ("vx_mps", "vy_mps")
# Folder with a table of objects for each frame.
BOX_FOLDER = "boxes"


def find_frame_files(
    folder: Path,
    expected_names: Sequence[str] | None = None,
    ignored_files: Collection[str] = (),
    *,
    is_depth: bool = False,
) -> dict[str, Path]:
    """Find the clouds or depth images (PNG) of a folder.

    Args:
        folder: Folder with one file per frame.
        expected_names: Names of all frames; None accepts any names.
        ignored_files: Names of files that are no clouds, such as a table of poses.
        is_depth: True for depth images, False for clouds.

    Returns:
        Name of each frame and its file, in natural order (frame2 before frame10).

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: A file is no cloud, two files have the same frame name, or names differ from `expected_names`.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; it has to hold one cloud per frame")
    files: dict[str, Path] = {}
    with os.scandir(folder) as entries:
        listing = sorted((entry.name, entry.is_dir()) for entry in entries)
    for file_name, is_folder in listing:
        if file_name in ignored_files or file_name.startswith("."):  # left by file managers and version control
            continue
        name, suffix = split_name(file_name, (".png",)) if is_depth else split_name(file_name)
        if not suffix or is_folder:
            kind, suffixes = ("depth image", ".png") if is_depth else ("cloud", ", ".join(READERS))
            raise ValueError(f"{folder / file_name}: not a {kind}; allowed are files ending in {suffixes}")
        if name in files:
            raise ValueError(f"{folder}: two files for the frame {name}: {files[name].name} and {file_name}")
        files[name] = folder / file_name
    if expected_names is not None:
        check_same_names(folder.parent, {folder.name: files, "the others": dict.fromkeys(expected_names)})
    # Natural keys are slow for many names, and plain numbers do not need them.
    are_numbers = all(name.isdecimal() for name in files)
    return {name: files[name] for name in sorted(files, key=_parse_number if are_numbers else make_natural_sort_key)}


def check_same_names(folder: Path, files_by_folder: Mapping[str, Mapping[str, object]]) -> None:
    """Check that all folders have the same frames.

    Args:
        folder: Recording, for messages.
        files_by_folder: Name of each folder and its files by frame name.

    Raises:
        ValueError: There are no frames, or a folder lacks some of them.
    """
    folders = " and ".join(f"{name}/" for name in files_by_folder)
    all_names = set[str]().union(*files_by_folder.values())
    if not all_names:
        raise ValueError(f"{folder}: no frames; {folders} are empty")
    complaints = []
    for name, files in files_by_folder.items():
        missing = sorted(all_names - files.keys(), key=make_natural_sort_key)
        if missing:
            complaints.append(f"{len(missing)} missing in {name}/ ({format_names(missing)})")
    if complaints:
        raise ValueError(f"{folder}: every frame needs a file in {folders}; {' and '.join(complaints)}")


def check_frames_with_boxes(folder: Path, files_by_folder: Mapping[str, Mapping[str, Path]]) -> bool:
    """Check that all folders of clouds, and the folder of boxes if there is one, have the same frames.

    Args:
        folder: Recording.
        files_by_folder: Name of each folder of clouds and its files by frame name.

    Returns:
        Whether there is a folder of boxes.

    Raises:
        ValueError: There are no frames, or a folder lacks some of them.
    """
    has_boxes = (folder / BOX_FOLDER).is_dir()
    box_files = {file.stem: file for file in (folder / BOX_FOLDER).glob("*.csv")}
    check_same_names(folder, {**files_by_folder, BOX_FOLDER: box_files} if has_boxes else files_by_folder)
    return has_boxes


def find_frame_rows(table_frames: Sequence[str], frame_names: Sequence[str]) -> list[int]:
    """Find the row of each frame in a table.

    Args:
        table_frames: Frame name of each row.
        frame_names: Names of the frames of the recording.

    Returns:
        Row index of each frame.

    Raises:
        ValueError: Frames are missing, repeated or unknown.
    """
    rows = {frame: row for row, frame in enumerate(table_frames)}
    faults = {
        "missing": [name for name in frame_names if name not in rows],
        "repeated": [frame for frame, count in Counter(table_frames).items() if count > 1],
        "unknown": sorted(rows.keys() - set(frame_names)),
    }
    for fault, names in faults.items():
        if names:
            raise ValueError(f"each frame needs one row; {len(names)} are {fault} ({format_names(names)})")
    return [rows[name] for name in frame_names]


def stack_columns(columns: Mapping[str, NDArray[Any]], names: Sequence[str]) -> NDArray[Any]:
    """Stack columns of a table.

    Args:
        columns: Columns of equal length by name.
        names: Names of the columns in the desired order.

    Returns:
        (rows, names) values.
    """
    return np.column_stack([columns[name] for name in names])


def make_natural_sort_key(name: str) -> tuple[list[str | int], str]:
    """Make a key that sorts names with the numbers in them by value.

    Args:
        name: Name of a frame or sensor.

    Returns:
        The parts of the name, and the name itself to break ties.
    """
    # Text and number alternate, starting with text, so that two keys are always comparable.
    parts: list[str | int] = [*re.split(r"(\d+)", name)]
    parts[1::2] = [int(part) for part in parts[1::2]]
    return parts, name


def _parse_number(name: str) -> tuple[int, str]:
    """Make a sort key of a frame number; the name breaks ties such as 7 and 007."""
    return int(name), name


def format_names(names: Sequence[str]) -> str:
    """Format the first five of many names for a message; an ellipsis stands for the others.

    Args:
        names: Names.
    """
    return ", ".join(names if len(names) <= 5 else [*names[:5], "..."])


class PoseTable:
    """Table with the pose and optionally the time of every frame.

    Columns are `frame, x_m, y_m, z_m, qw, qx, qy, qz`, and with times `time_s`; `block_index` is optional: an integer
    that frames share if they are not independent (`Frame.block_index`).

    Args:
        path: CSV file.
        frame_names: Names of the frames, in the order of the result.
        has_times: True if the table needs the column `time_s`.

    Raises:
        BadFileError: Columns or frames are missing, or a quaternion has not norm 1.
    """

    def __init__(self, path: Path, frame_names: Sequence[str], *, has_times: bool) -> None:
        time_columns = ("time_s",) if has_times else ()
        optional = ("block_index",) if has_times else ()
        table = read_csv(path, (*time_columns, *POSITION_COLUMNS, *QUATERNION_COLUMNS), ("frame",), optional)
        with report_bad_file(path, "a table of poses"):
            order = find_frame_rows(table.texts["frame"], frame_names)
            columns = {name: values[order] for name, values in table.numbers.items()}
            self._positions_m = stack_columns(columns, POSITION_COLUMNS)
            self._wxyz = stack_columns(columns, QUATERNION_COLUMNS)
            norms = np.linalg.norm(self._wxyz, axis=1)
            bad = np.flatnonzero(~(np.abs(norms - 1) <= RIGID_TOLERANCE))
            if len(bad):
                raise ValueError(
                    f"frame {frame_names[bad[0]]}: qw, qx, qy, qz: the quaternion of a rotation has norm 1; got "
                    f"{norms[bad[0]]:.6g}; {len(bad)} of {len(frame_names)} frames have such quaternions"
                )
            self.block_indices: list[int] | None = None
            if "block_index" in columns:
                self.block_indices = _to_integers("block_index", columns["block_index"])
        self.times_s: NDArray[np.float64] | None = columns.get("time_s")

    def __getitem__(self, index: int) -> Matrix:
        """Return the (4, 4) pose of a frame."""
        return build_transform(convert_quaternion_to_rotation(self._wxyz[index]), self._positions_m[index])


def read_boxes(path: Path) -> Boxes:
    """Read the objects of a frame.

    Columns are `x_m, y_m, z_m, length_m, width_m, height_m, yaw_rad, id, category`, with the center of the box in the
    vehicle frame; `id` and `category` may be empty. Optional are `vx_mps, vy_mps`, the velocity over ground along x
    and y of the vehicle, `sampled_points` and `bottom_height_m`, see `Boxes`.

    Args:
        path: CSV file.

    Returns:
        The boxes in the vehicle frame.

    Raises:
        BadFileError: Columns are missing, values are invalid, or two objects share an id.
    """
    table = read_csv(path, BOX_COLUMNS, ("id", "category"), (*VELOCITY_COLUMNS, "sampled_points", "bottom_height_m"))
    numbers, ids = table.numbers, table.texts["id"]
    with report_bad_file(path, "a table of boxes"):
        repeated = [name for name, count in Counter(ids).items() if name and count > 1]
        if repeated:
            raise ValueError(f"id: every object needs its own; {format_names(repeated)} appears more than once")
        fields: dict[str, object] = {"ids": tuple(ids), "categories": tuple(table.texts["category"])}
        if set(VELOCITY_COLUMNS) & numbers.keys():
            unknown = np.full(len(ids), np.nan)
            velocity_mps = np.column_stack([numbers.get(name, unknown) for name in VELOCITY_COLUMNS])
            fields["velocity_mps"] = torch.from_numpy(velocity_mps).float()
        if "sampled_points" in numbers:
            counts = _to_integers("sampled_points", numbers["sampled_points"])
            fields["sampled_points"] = torch.tensor(counts, device="cpu")
        if "bottom_height_m" in numbers:
            fields["bottom_heights_m"] = torch.from_numpy(numbers["bottom_height_m"]).float()
        return Boxes.from_rows(torch.from_numpy(stack_columns(numbers, BOX_COLUMNS)).float(), **fields)


def write_boxes(path: Path, boxes: Boxes) -> None:
    """Write the objects of a frame in the format of `read_boxes`.

    Args:
        path: CSV file.
        boxes: Boxes in the vehicle frame; velocities and bottom heights are written if all of them are known.
    """
    columns = dict(zip(BOX_COLUMNS, boxes.rows.T.tolist(), strict=True))
    if boxes.velocity_mps.isfinite().all():
        columns |= dict(zip(VELOCITY_COLUMNS, boxes.velocity_mps.T.tolist(), strict=True))
    if boxes.bottom_heights_m.isfinite().all():
        columns["bottom_height_m"] = boxes.bottom_heights_m.tolist()
    columns |= {"sampled_points": boxes.sampled_points.tolist(), "id": boxes.ids, "category": boxes.categories}
    path.write_text(format_csv([list(columns), *zip(*columns.values(), strict=True)]), encoding="utf-8")


def _to_integers(name: str, values: NDArray[np.float64]) -> list[int]:
    """Convert a column to integers; a fraction raises a ValueError."""
    if not np.array_equal(values, np.round(values)):
        raise ValueError(f"{name}: whole numbers are needed; got {values[values != np.round(values)][0]:g}")
    integers: list[int] = values.astype(np.int64).tolist()
    return integers
