"""A run as a recording for the Rerun viewer: what the rig saw step by step, and what was measured."""

from collections.abc import Mapping
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any
from weakref import finalize

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.coverage.quantities import RADIUS, make_area_quantity
from torchcover.detection import Boxes
from torchcover.files import reject_links, write_atomically
from torchcover.files.atomic import TEMPORARY
from torchcover.frames import Frame
from torchcover.neighbors import blind_spot_radius
from torchcover.report import ColorScale, SensorView, build_color_scale

if TYPE_CHECKING:
    from torchcover.evaluation.result import Result

# A viewer holds all steps in memory.
MOST_POINTS = 50_000
# Colours of points, from 0 to this radius.
FAR_M = 3.0
# Fields of view are drawn so far: their ranges would hide everything.
FRUSTUM_M = 4.0
RIM_POINTS = 33


class RerunLog:
    """Writes frames as they pass: an observer, for `evaluate(..., observers={"rerun": log})`; then `finish`.

    `path`: the file, `.rrd`. ImportError: rerun-sdk is not installed. ValueError: another suffix.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        if self._path.suffix != ".rrd":
            raise ValueError(f"rerun: a file that ends in .rrd is needed; got {path}")
        try:
            import rerun as rr
        except ImportError as error:
            raise ImportError(f"{path}: rerun-sdk is needed: pip install 'torchcover[rerun]'") from error
        reject_links(self._path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(mkdtemp(prefix=TEMPORARY, dir=self._path.parent))
        self._unfinished = folder / self._path.name
        self._clean_up = finalize(self, rmtree, folder, ignore_errors=True)
        self._stream: Any = rr.RecordingStream("torchcover")  # optional, so its types are not known
        self._stream.save(self._unfinished)
        self._stream.log("", rr.ViewCoordinates.FLU, static=True)

    def update(self, frame: Frame) -> None:
        """Write the clouds of a frame as measured, the reference coloured by the radius of each rig, and the boxes."""
        import rerun as rr

        self._stream.set_time("step", sequence=frame.index)
        for rig, cloud in frame.clouds.items():
            self._stream.log([rig, "points"], rr.Points3D(_few(frame.get_measured_points(rig)), colors=[70, 120, 190]))
            radius = blind_spot_radius(cloud, frame.reference, max_radius=FAR_M)
            colours = apply_colormap(_few(radius), ColorScale("radius", "m", "viridis_r", 0.0, FAR_M))
            self._stream.log([rig, "reference by radius"], rr.Points3D(_few(frame.reference), colors=colours))
        if frame.boxes is not None:
            self._stream.log("boxes", _boxes(frame.boxes))

    def compute(self) -> None:
        """Nothing: what it knows is in the file."""

    def merge_state(self, _: "RerunLog") -> None:
        """Refuse. ValueError: always: several processes cannot write one file."""
        raise ValueError("rerun: several processes cannot write one file; run it without torchrun")

    def state_dict(self) -> dict[str, Any]:
        """Nothing: a run that goes on writes the steps that are left."""
        return {}

    def load_state_dict(self, _: Mapping[str, Any]) -> None:
        """As `state_dict`."""

    def finish(self, result: "Result") -> None:
        """Write the rigs and the maps of the radius, and close the file."""
        import rerun as rr

        from torchcover.evaluation.result_page import build_sensor_views

        if (outline_m := result.ego_outline_m) is not None:
            around = _on_ground(np.vstack([outline_m, outline_m[:1]]))
            self._stream.log("ego", rr.LineStrips3D([around]), static=True)
        for rig, sensors in result.sensors.items():
            for view in build_sensor_views(sensors):
                self._stream.log([rig, "sensors", view.name], rr.LineStrips3D(compute_frustum_lines(view)), static=True)
        coverages = result.coverages
        key = (make_area_quantity(RADIUS) if result.table.average == "area" else RADIUS).key
        for rig, coverage in coverages.items():
            layer, grid = coverage.layers[key], coverage.grid
            scale = build_color_scale(layer.quantity, layer.values)
            for name, values in zip(grid.heights, layer.values.cpu().numpy(), strict=True):
                self._stream.log([rig, "radius", name], _cells(values, grid, scale), static=True)
        self._stream.disconnect()
        write_atomically(self._path, self._unfinished.replace)
        self._clean_up()


def compute_frustum_lines(view: SensorView) -> list[NDArray[np.float64]]:
    """Lines around a field of view, in the vehicle frame: two rims, and edges from the sensor where it is no full turn.

    Example:
        >>> view = SensorView("roof", np.eye(4), 360.0, (-10.0, 10.0), 50.0)
        >>> [line.shape for line in compute_frustum_lines(view)]
        [(33, 3), (33, 3)]
    """
    azimuth = np.deg2rad(np.linspace(-view.horizontal_fov_deg / 2, view.horizontal_fov_deg / 2, RIM_POINTS))
    reach_m = min(FRUSTUM_M, view.range_m)
    rims = []
    for elevation in np.deg2rad(view.vertical_fov_deg):
        flat = np.cos(elevation)
        ahead = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.full(RIM_POINTS, np.sin(elevation))]
        rims.append(view.position_m + reach_m * np.stack(ahead, axis=1) @ view.vehicle_T_sensor[:3, :3].T)
    if view.horizontal_fov_deg >= 360:
        return rims
    return [*rims, *(np.stack([view.position_m, rim[end]]) for rim in rims for end in (0, -1))]


def _cells(values: NDArray[Any], grid: BevGrid, scale: ColorScale) -> Any:  # noqa: ANN401
    import rerun as rr

    row, column = np.nonzero(~np.isnan(values))
    low = np.array([grid.x_m[0], grid.y_m[0]]) + grid.cell_m * np.stack([column, row], axis=1)
    around = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    corners = (low[:, None] + grid.cell_m * around).reshape(-1, 2)
    two_triangles = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(len(row))[:, None, None] + two_triangles).reshape(-1, 3)
    colours = apply_colormap(values[row, column], scale).repeat(4, axis=0)
    return rr.Mesh3D(vertex_positions=_on_ground(corners), triangle_indices=faces, vertex_colors=colours)


def apply_colormap(values: NDArray[Any], scale: ColorScale) -> NDArray[np.uint8]:
    """(N, 3) colours of values."""
    share = np.clip((np.minimum(values, scale.high) - scale.low) / (scale.high - scale.low), 0.0, 1.0)
    return np.asarray(colormaps[scale.colormap](share, bytes=True)[:, :3])


def _boxes(boxes: Boxes) -> Any:  # noqa: ANN401
    import rerun as rr

    half = boxes.yaw_rad.cpu().numpy() / 2
    xyzw = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    return rr.Boxes3D(
        centers=boxes.center_m.cpu().numpy(),
        half_sizes=boxes.size_m.cpu().numpy() / 2,
        quaternions=xyzw,
        labels=boxes.categories,
    )


def _few(values: Tensor) -> NDArray[Any]:
    """Every so-manieth, so that there are not too many."""
    every = -(-len(values) // MOST_POINTS) or 1
    return values[::every].cpu().numpy()


def _on_ground(points_m: NDArray[Any]) -> NDArray[np.float64]:
    return np.column_stack([points_m, np.zeros(len(points_m))])
