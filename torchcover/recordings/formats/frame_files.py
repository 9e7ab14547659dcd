"""Files of frames in a folder, one a frame in natural order, and tables of poses and boxes beside them."""

import os
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection.boxes import Boxes
from torchcover.files import format_csv, read_csv, report_bad_file
from torchcover.geometry import build_transform, convert_quaternion_to_rotation
from torchcover.geometry.rigid import RIGID_TOLERANCE, Matrix
from torchcover.recordings.clouds import READERS, split_name

MAX_NAMES_SHOWN = 5
CLOUDS = f"a cloud; allowed are files ending in {', '.join(READERS)}"


def find_frame_files(
    folder: Path,
    expected_names: Sequence[str] | None = None,
    ignored_files: Collection[str] = (),
    *,
    is_depth: bool = False,
) -> dict[str, Path]:
    """The clouds, or depth images in PNG, by the names of their frames in natural order (frame2 before frame10).

    There have to be those of `expected_names`, and no others; files `ignored_files` them are no clouds. ValueError: a file that is no
    cloud, two files of one name, no files, or other names than `expected_names`.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; clouds are needed in it, one a frame")
    clouds: dict[str, Path] = {}
    with os.scandir(folder) as entries:
        found = sorted((entry.name, entry.is_dir()) for entry in entries)
    for file, is_folder in found:
        if file in ignored_files or file.startswith("."):  # what file managers and version control leave behind
            continue
        name, suffix = split_name(file, (".png",)) if is_depth else split_name(file)
        if not suffix or is_folder:
            wanted = "a depth image; allowed are files ending in .png" if is_depth else CLOUDS
            raise ValueError(f"{folder / file}: not {wanted}")
        if name in clouds:
            raise ValueError(f"{folder}: two files for the frame {name}: {clouds[name].name} and {file}")
        clouds[name] = folder / file
    if expected_names is not None:
        check_same_names(folder.parent, {folder.name: clouds, "the others": dict.fromkeys(expected_names)})
    numbers = all(map(str.isdecimal, clouds))  # which need not be taken apart
    return {name: clouds[name] for name in sorted(clouds, key=_number if numbers else make_natural_sort_key)}


def check_same_names(folder: Path, files_by_folder: Mapping[str, Mapping[str, object]]) -> None:
    """Whether all places have the same frames."""
    places = " and ".join(f"{place}/" for place in files_by_folder)
    anywhere = set[str]().union(*files_by_folder.values())
    if not anywhere:
        raise ValueError(f"{folder}: no frames; {places} are empty")
    complaints = [
        f"{len(gaps)} missing in {place}/ ({format_names(gaps)})"
        for place, clouds in files_by_folder.items()
        if (gaps := sorted(anywhere - clouds.keys(), key=make_natural_sort_key))
    ]
    if complaints:
        raise ValueError(f"{folder}: every frame needs a file in {places}; {' and '.join(complaints)}")


def find_frame_rows(table_frames: Sequence[str], frame_names: Sequence[str]) -> list[int]:
    """Which row of a table belongs to each frame."""
    there, wanted = set(table_frames), set(frame_names)
    doubled = [frame for frame, count in Counter(table_frames).items() if count > 1]
    missing, unknown = [name for name in frame_names if name not in there], sorted(there - wanted)
    for what, which in (("missing", missing), ("doubled", doubled), ("unknown", unknown)):
        if which:
            raise ValueError(f"one row for every frame is needed; {len(which)} {what} ({format_names(which)})")
    row_of = {frame: row for row, frame in enumerate(table_frames)}
    return [row_of[name] for name in frame_names]


def make_natural_sort_key(name: str) -> tuple[list[str | int], str]:
    """A key to sort names by, numbers in them by their values."""
    # Text and number alternate, starting with text, so that two keys always compare; the name itself breaks a tie.
    parts = re.split(r"(\d+)", name)
    return [int(part) if position % 2 else part for position, part in enumerate(parts)], name


def _number(name: str) -> tuple[int, str]:
    return int(name), name


def format_names(names: Sequence[str]) -> str:
    """The first of many names, for a message."""
    return ", ".join([*names[:MAX_NAMES_SHOWN], *["..."] * (len(names) > MAX_NAMES_SHOWN)])


PLACE, ROTATION = ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
BOX = (*PLACE, "length_m", "width_m", "height_m", "yaw_rad")
VELOCITY, DRAWN, BOTTOM = ("vx_mps", "vy_mps"), "drawn_points", "bottom_height_m"
NAMES = ("id", "category")


class PoseTable:
    """A pose for every frame, in their order, and where the table says so, its time.

    Its columns are `frame, x_m, y_m, z_m, qw, qx, qy, qz`, and `time_s` if it is `timed`; `instant` may be there too, a
    whole number that frames share which are no news to each other (`Frame.block_index`).
    """

    def __init__(self, path: Path, frame_names: Sequence[str], *, has_times: bool) -> None:
        optional = ("instant",) if has_times else ()
        table = read_csv(path, (*("time_s",) * has_times, *PLACE, *ROTATION), ("frame",), optional)
        with report_bad_file(path, "a table of poses"):
            order = find_frame_rows(table.texts["frame"], frame_names)
            columns = {name: values[order] for name, values in table.numbers.items()}
            self._place_m = np.column_stack([columns[name] for name in PLACE])
            self._wxyz = np.column_stack([columns[name] for name in ROTATION])
            self._check_norms(frame_names)
            self.block_indices = _whole_numbers("instant", columns["instant"]) if "instant" in columns else None
        self.times_s: NDArray[np.float64] | None = columns.get("time_s")

    def __getitem__(self, index: int) -> Matrix:
        """(4, 4) the pose of a frame."""
        return build_transform(convert_quaternion_to_rotation(self._wxyz[index]), self._place_m[index])

    def _check_norms(self, names: Sequence[str]) -> None:
        norms = np.linalg.norm(self._wxyz, axis=1)
        bad = np.flatnonzero(~(np.abs(norms - 1) <= RIGID_TOLERANCE))
        if len(bad):
            raise ValueError(
                f"frame {names[bad[0]]}: qw, qx, qy, qz: the norm of a rotation's quaternion is 1; got "
                f"{norms[bad[0]]:.6g}, and so in {len(bad)} of {len(names)} frames"
            )


def read_boxes(path: Path) -> Boxes:
    """Read the objects of a frame.

    The columns are `x_m, y_m, z_m, length_m, width_m, height_m, yaw_rad, id, category`: the centre, half-way up, in the
    vehicle frame; `id` and `category` may be empty. `vx_mps, vy_mps` may be there too, the velocity over ground along
    the vehicle's x and y, and `drawn_points` and `bottom_height_m`, see `Boxes`.
    """
    table = read_csv(path, BOX, NAMES, (*VELOCITY, DRAWN, BOTTOM))
    numbers, ids = table.numbers, table.texts["id"]
    with report_bad_file(path, "a table of boxes"):
        doubled = [name for name, count in Counter(ids).items() if name and count > 1]
        if doubled:
            raise ValueError(f"id: every object has its own; {format_names(doubled)}: there twice")
        known: dict[str, object] = {"ids": tuple(ids), "categories": tuple(table.texts["category"])}
        if set(VELOCITY) & numbers.keys():
            unknown = np.full(len(ids), np.nan)
            velocity_mps = np.column_stack([numbers.get(name, unknown) for name in VELOCITY])
            known["velocity_mps"] = torch.from_numpy(velocity_mps).float()
        if DRAWN in numbers:
            known["drawn_points"] = torch.tensor(_whole_numbers(DRAWN, numbers[DRAWN]), device="cpu")
        if BOTTOM in numbers:
            known["bottom_heights_m"] = torch.from_numpy(numbers[BOTTOM]).float()
        return Boxes.from_rows(torch.from_numpy(np.column_stack([numbers[name] for name in BOX])).float(), **known)


def write_boxes(path: Path, boxes: Boxes) -> None:
    """Write the objects of a frame as `read_boxes` reads them; velocities, if that of each is known."""
    columns = dict(zip(BOX, boxes.rows.T.tolist(), strict=True))
    if boxes.velocity_mps.isfinite().all():
        columns |= dict(zip(VELOCITY, boxes.velocity_mps.T.tolist(), strict=True))
    if boxes.bottom_heights_m.isfinite().all():
        columns[BOTTOM] = boxes.bottom_heights_m.tolist()
    columns |= {DRAWN: boxes.sampled_points.tolist(), "id": boxes.ids, "category": boxes.categories}
    path.write_text(format_csv([list(columns), *zip(*columns.values(), strict=True)]), encoding="utf-8")


def _whole_numbers(name: str, values: NDArray[np.float64]) -> list[int]:
    if not np.array_equal(values, np.round(values)):
        raise ValueError(f"{name}: whole numbers are needed; got {values[values != np.round(values)][0]:g}")
    numbers: list[int] = values.astype(np.int64).tolist()
    return numbers
