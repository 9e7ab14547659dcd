"""LOB: how many cells of an upright board the rays of a rig hit (LiDAR occupancy board, Kim and Park 2020)."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.frames import Frame
from torchcover.neighbors import check_cloud
from torchcover.published.frame_metric import FrameMetric
from torchcover.published.number import PublishedNumber
from torchcover.published.region_voxels import check_sensors, ray_count
from torchcover.simulation import Draws, RayHits, Sensor

DISTANCES_M = (10.0, 20.0, 30.0, 40.0, 50.0)


class Lob(FrameMetric):
    """Share of the cells of an upright board that any ray of the rig hits: LOB (Kim and Park 2020).

    The board is bent into a cylinder about the origin of the vehicle, so that it is as far away on every side. Its
    cells are as wide as makes their number around it whole. The original is a flat board across the way ahead, whose
    size and cells could not be found; of one, give the width.

    The distance decides what is found good: a rig that is better at 10 m may be worse at 50 m. So there is no LOB
    without a distance, and a number for each. It hangs on the rig alone: frames add nothing, and there is no error.
    The original takes cells from the board that other cars hide; here nothing hides anything.

    Args:
        sensors: Those of the rig, with mounts, rays and ranges.
        distances_m: Of the boards: over ground from the origin of the vehicle, or ahead.
        height_m: Lowest and highest z of the boards.
        cell_m: Side of a cell.
        width_m: Of flat boards ahead, in the middle; a cylinder if not given.
        rig: Whose clouds; those of the only rig if not given.
        kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: No sensor, or one that stands on the other side of a board; no distance, or one that is not
            positive; heights or a width that are no multiples of the cell.

    Example:
        >>> from torchcover.simulation import Rig
        >>> Lob(Rig.load("hu2022_center").sensors).cells_hit(10.0).shape
        (10, 314)
    """

    def __init__(
        self,
        sensors: Sequence[Sensor],
        distances_m: Sequence[float] = DISTANCES_M,
        height_m: tuple[float, float] = (0.0, 2.0),
        cell_m: float = 0.2,
        *,
        width_m: float | None = None,
        rig: str | None = None,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        check_sensors(sensors)
        _check_boards(distances_m, height_m, cell_m, width_m)
        meaning = {
            "sensors": tuple(sensors),
            "distances_m": tuple(float(distance) for distance in distances_m),
            "height_m": tuple(float(height) for height in height_m),
            "cell_m": float(cell_m),
            "width_m": None if width_m is None else float(width_m),
        }
        super().__init__(meaning, rig, **kwargs)
        self.sensors = tuple(sensors)
        self.distances_m = tuple(float(distance) for distance in distances_m)
        self.height_m = (float(height_m[0]), float(height_m[1]))
        self.cell_m = float(cell_m)
        self.width_m = None if width_m is None else float(width_m)
        self._check_sides()

    def _check_sides(self) -> None:
        for sensor in self.sensors:
            x_m, y_m, _ = sensor.mount.matrix()[:3, 3]
            away_m = math.hypot(x_m, y_m) if self.width_m is None else x_m
            if away_m >= min(self.distances_m):
                raise ValueError(
                    f"distances_m: sensor {sensor.name!r} is {away_m:g} m away, behind the board at "
                    f"{min(self.distances_m):g} m; take boards beyond the sensors"
                )

    def _add_frame(self, frame: Frame) -> None:
        check_cloud(frame.reference, "reference")

    def compute(self) -> tuple[PublishedNumber, ...]:
        """A number for each distance; frames are not needed."""
        rays = ray_count(self.sensors)
        shape = "" if self.width_m is None else f"_ahead_{self.width_m:g}m"
        numbers = []
        for distance_m in self.distances_m:
            hit = self.cells_hit(distance_m)
            numbers.append(
                PublishedNumber(
                    name=f"lob{shape}_{distance_m:g}m",
                    value=float(hit.mean()),
                    unit="share",
                    higher_is_better=True,
                    parameters={
                        "distance_m": distance_m,
                        "height_m": self.height_m,
                        "cell_m": self.cell_m,
                        "width_m": self.width_m,
                        "rays": rays,
                    },
                    count=hit.size,
                    count_of="cells",
                    warning="the distance decides the order of rigs; what hides the board is left out",
                )
            )
        return tuple(numbers)

    def resampled(self, weights: Tensor) -> Tensor:
        """(R, V) the numbers, which are the same whatever the weights (R, 16) of worlds."""
        values = torch.tensor([number.value for number in self.compute()], dtype=torch.float64, device=weights.device)
        return values.repeat(len(weights), 1)

    def cells_hit(self, distance_m: float) -> NDArray[np.bool_]:
        """(rows, columns) whether any ray hits a cell of the board: from below, and counter-clockwise from behind."""
        around_m = 2 * math.pi * distance_m if self.width_m is None else self.width_m
        columns = max(round(around_m / self.cell_m), 1)
        rows = round((self.height_m[1] - self.height_m[0]) / self.cell_m)
        hit = np.zeros((rows, columns), dtype=bool)
        for sensor in self.sensors:
            vehicle_T_sensor = sensor.mount.matrix()
            directions = sensor.directions().reshape(3, -1)
            pixel_of_ray = np.flatnonzero(~np.isnan(directions[0]))
            way = vehicle_T_sensor[:3, :3] @ directions[:, pixel_of_ray]
            origin_m = vehicle_T_sensor[:3, 3]
            range_m = self._ranges_m(origin_m, way, distance_m)
            measured = np.flatnonzero(range_m <= sensor.max_range_m)
            gives, _ = sensor.measure(RayHits(measured, range_m[measured], pixel_of_ray), Draws(None))
            measured = measured if gives is None else measured[gives]
            place_m = origin_m[:, None] + range_m[measured] * way[:, measured]
            along = place_m[1] / around_m + 0.5
            if self.width_m is None:
                along = np.arctan2(place_m[1], place_m[0]) / (2 * math.pi) + 0.5
            # Half-open, with both ends of the cylinder's seam in one cell.
            column = np.floor(along * columns).astype(np.int64)
            column = column % columns if self.width_m is None else column
            row = np.floor((place_m[2] - self.height_m[0]) / self.cell_m).astype(np.int64)
            on = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
            hit[row[on], column[on]] = True
        return hit

    def _ranges_m(
        self, origin_m: NDArray[np.float64], way: NDArray[np.float64], distance_m: float
    ) -> NDArray[np.float64]:
        """(N,) how far it is along each ray to the board from its inner side; infinite if it never hits."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.width_m is not None:
                range_m = np.where(way[0] > 0, (distance_m - origin_m[0]) / way[0], np.inf)
            else:
                # |o + t d|^2 = distance^2 over ground: of two places the one ahead.
                a, b = (way[:2] ** 2).sum(axis=0), origin_m[:2] @ way[:2]
                c = origin_m[:2] @ origin_m[:2] - distance_m**2
                range_m = np.where(a > 0, (np.sqrt(b**2 - a * c) - b) / a, np.inf)
        found: NDArray[np.float64] = np.where(np.isfinite(range_m), range_m, np.inf)
        return found


def _check_boards(
    distances_m: Sequence[float], height_m: tuple[float, float], cell_m: float, width_m: float | None
) -> None:
    if not distances_m or not all(0 < distance < math.inf for distance in distances_m):
        raise ValueError(f"distances_m: one or more positive lengths in metres are needed; got {tuple(distances_m)}")
    if not 0 < cell_m < math.inf:
        raise ValueError(f"cell_m: a positive length in metres is needed; got {cell_m}")
    low, high = height_m
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"height_m: a lower and a higher bound in metres are needed; got {height_m}")
    for name, extent in (("height_m", high - low), ("width_m", width_m)):
        cells = 1.0 if extent is None else extent / cell_m
        if not 0.5 <= cells < math.inf or abs(cells - round(cells)) > 1e-6 * cells:
            raise ValueError(f"{name}: {extent:g} m is not a multiple of the cell of {cell_m:g} m; change one of them")
