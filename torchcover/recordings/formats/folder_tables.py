"""The tables of a plain folder: `poses.csv`, of the vehicle or of a sensor, and `boxes/FRAME.csv`."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection.boxes import Boxes
from torchcover.files import csv_text, naming, read_csv
from torchcover.geometry import rigid, rotation_from_quaternion
from torchcover.geometry.rigid import RIGID_TOLERANCE, Matrix
from torchcover.recordings.formats.file_names import check_frames, some_of

PLACE, ROTATION = ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
BOX = (*PLACE, "length_m", "width_m", "height_m", "yaw_rad")
VELOCITY, DRAWN, BOTTOM = ("vx_mps", "vy_mps"), "drawn_points", "bottom_height_m"
NAMES = ("id", "category")


class PoseTable:
    """A pose for every frame, in their order, and where the table says so, its time.

    Its columns are `frame, x_m, y_m, z_m, qw, qx, qy, qz`, and `time_s` if it is `timed`; `instant` may be there too, a
    whole number that frames share which are no news to each other (`Frame.place_in_time`).
    """

    def __init__(self, path: Path, names: Sequence[str], *, timed: bool) -> None:
        optional = ("instant",) if timed else ()
        table = read_csv(path, (*("time_s",) * timed, *PLACE, *ROTATION), ("frame",), optional)
        with naming(path, "a table of poses"):
            order = check_frames(table.words["frame"], names)
            columns = {name: values[order] for name, values in table.numbers.items()}
            self._place_m = np.column_stack([columns[name] for name in PLACE])
            self._wxyz = np.column_stack([columns[name] for name in ROTATION])
            self._check_norms(names)
            self.instants = _whole_numbers("instant", columns["instant"]) if "instant" in columns else None
        self.times_s: NDArray[np.float64] | None = columns.get("time_s")

    def __getitem__(self, index: int) -> Matrix:
        """(4, 4) the pose of a frame."""
        return rigid(rotation_from_quaternion(self._wxyz[index]), self._place_m[index])

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
    numbers, ids = table.numbers, table.words["id"]
    with naming(path, "a table of boxes"):
        doubled = [name for name, count in Counter(ids).items() if name and count > 1]
        if doubled:
            raise ValueError(f"id: every object has its own; {some_of(doubled)}: there twice")
        known: dict[str, object] = {"ids": tuple(ids), "categories": tuple(table.words["category"])}
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
    columns |= {DRAWN: boxes.drawn_points.tolist(), "id": boxes.ids, "category": boxes.categories}
    path.write_text(csv_text([list(columns), *zip(*columns.values(), strict=True)]), encoding="utf-8")


def _whole_numbers(name: str, values: NDArray[np.float64]) -> list[int]:
    if not np.array_equal(values, np.round(values)):
        raise ValueError(f"{name}: whole numbers are needed; got {values[values != np.round(values)][0]:g}")
    numbers: list[int] = values.astype(np.int64).tolist()
    return numbers
