"""Recording of a run for the Rerun viewer: points and boxes of each frame, and maps of the result."""

from collections.abc import Mapping
from dataclasses import dataclass
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
from torchcover.evaluation.result_page import build_sensor_views
from torchcover.files import reject_links, write_atomically
from torchcover.files.atomic import TEMPORARY
from torchcover.frames import Frame
from torchcover.neighbors import blind_spot_radius
from torchcover.report import ColorScale, SensorView, build_color_scale

if TYPE_CHECKING:
    from torchcover.evaluation.result import Result


@dataclass(frozen=True)
class RerunParams:
    """Parameters of the recording.

    Args:
        max_points: Maximum number of points per cloud; the viewer keeps all frames in memory.
        max_radius_m: Blind spot radius of the last color of reference points.
        frustum_range_m: Maximum length of plotted fields of view; with the full range they would hide the scene.
        rim_points: Number of points of each rim of a field of view.
    """

    max_points: int = 50_000
    max_radius_m: float = 3.0
    frustum_range_m: float = 4.0
    rim_points: int = 33


class RerunLog:
    """Observer that writes frames to a file: pass it to `evaluate(..., observers={"rerun": log})`, then call `finish`.

    Args:
        path: Path of the file; its suffix is `.rrd`.
        params: Sizes and colors.

    Raises:
        ImportError: rerun-sdk is not installed.
        ValueError: The path has another suffix, or is a link.
    """

    def __init__(self, path: str | Path, params: RerunParams = RerunParams()) -> None:
        self._path = Path(path)
        self._params = params
        if self._path.suffix != ".rrd":
            raise ValueError(f"rerun: a file that ends in .rrd is needed; got {path}")
        try:
            import rerun as rr
        except ImportError as error:
            raise ImportError(f"{path}: rerun-sdk is needed: pip install 'torchcover[rerun]'") from error
        reject_links(self._path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        # The file gets its name in `finish`: until then an earlier file stays.
        folder = Path(mkdtemp(prefix=TEMPORARY, dir=self._path.parent))
        self._unfinished = folder / self._path.name
        self._clean_up = finalize(self, rmtree, folder, ignore_errors=True)
        self._stream: Any = rr.RecordingStream("torchcover")  # untyped, since the package is optional
        self._stream.save(self._unfinished)
        self._stream.log("", rr.ViewCoordinates.FLU, static=True)

    def update(self, frame: Frame) -> None:
        """Write the measured points, the reference points colored by blind spot radius, and the boxes of a frame.

        Args:
            frame: Frame of any number of rigs.
        """
        import rerun as rr

        params = self._params
        self._stream.set_time("frame", sequence=frame.index)
        for rig, cloud in frame.clouds.items():
            points = self._subsample(frame.get_measured_points(rig))
            self._stream.log([rig, "points"], rr.Points3D(points, colors=[70, 120, 190]))
            radius = blind_spot_radius(cloud, frame.reference, max_radius=params.max_radius_m)
            scale = ColorScale("radius", "m", "viridis_r", 0.0, params.max_radius_m)
            colors = apply_colormap(self._subsample(radius), scale)
            reference = rr.Points3D(self._subsample(frame.reference), colors=colors)
            self._stream.log([rig, "reference by radius"], reference)
        if frame.boxes is not None:
            self._stream.log("boxes", _build_boxes(frame.boxes))

    def compute(self) -> None:
        """Return nothing: the frames are in the file."""

    def merge_state(self, _: "RerunLog") -> None:
        """Reject the merge.

        Raises:
            ValueError: Always, since several processes cannot write one file.
        """
        raise ValueError("rerun: several processes cannot write one file; run it without torchrun")

    def state_dict(self) -> dict[str, Any]:
        """Return no state: a resumed run only writes its own frames."""
        return {}

    def load_state_dict(self, _: Mapping[str, Any]) -> None:
        """Load no state."""

    def finish(self, result: "Result") -> None:
        """Write the sensors and the maps of the blind spot radius, and close the file.

        Args:
            result: Result of the run.
        """
        import rerun as rr

        outline_m = result.ego_outline_m
        if outline_m is not None:
            closed_m = _add_zero_height(np.vstack([outline_m, outline_m[:1]]))
            self._stream.log("ego", rr.LineStrips3D([closed_m]), static=True)
        for rig, sensors in result.sensors.items():
            for view in build_sensor_views(sensors):
                lines = compute_frustum_lines(view, self._params)
                self._stream.log([rig, "sensors", view.name], rr.LineStrips3D(lines), static=True)
        key = (make_area_quantity(RADIUS) if result.table.average == "area" else RADIUS).key
        for rig, coverage in result.coverages.items():
            layer, grid = coverage.layers[key], coverage.grid
            scale = build_color_scale(layer.quantity, layer.values)
            for band, values in zip(grid.heights, layer.values.cpu().numpy(), strict=True):
                self._stream.log([rig, "radius", band], _build_cells(values, grid, scale), static=True)
        self._stream.disconnect()
        write_atomically(self._path, self._unfinished.replace)
        self._clean_up()

    def _subsample(self, values: Tensor) -> NDArray[Any]:
        """Take every k-th value, with the smallest k that gives at most `max_points` values."""
        stride = -(-len(values) // self._params.max_points) or 1
        return values[::stride].cpu().numpy()


def compute_frustum_lines(view: SensorView, params: RerunParams = RerunParams()) -> list[NDArray[np.float64]]:
    """Compute the lines of a field of view: its lower and upper rim, and its edges unless it is a full turn.

    Args:
        view: Pose and field of view of the sensor.
        params: Length of the field of view, and number of points.

    Returns:
        Lines of (K, 3) points in the vehicle frame in meters.

    Example:
        >>> view = SensorView("roof", np.eye(4), 360.0, (-10.0, 10.0), 50.0)
        >>> [line.shape for line in compute_frustum_lines(view)]
        [(33, 3), (33, 3)]
    """
    azimuth_rad = np.deg2rad(np.linspace(-view.horizontal_fov_deg / 2, view.horizontal_fov_deg / 2, params.rim_points))
    range_m = min(params.frustum_range_m, view.range_m)
    lines = []
    for elevation_rad in np.deg2rad(view.vertical_fov_deg):
        x, y = np.cos(elevation_rad) * np.cos(azimuth_rad), np.cos(elevation_rad) * np.sin(azimuth_rad)
        directions = np.stack([x, y, np.full(params.rim_points, np.sin(elevation_rad))], axis=1)
        lines.append(view.position_m + range_m * directions @ view.vehicle_T_sensor[:3, :3].T)
    if view.horizontal_fov_deg >= 360:
        return lines
    edges = [np.stack([view.position_m, rim[end]]) for rim in lines for end in (0, -1)]
    return lines + edges


def _build_cells(values: NDArray[Any], grid: BevGrid, scale: ColorScale) -> Any:  # noqa: ANN401
    """Build the mesh of the observed cells of a (Y, X) map: two triangles for each cell."""
    import rerun as rr

    row, column = np.nonzero(~np.isnan(values))
    lower_m = np.array([grid.x_m[0], grid.y_m[0]]) + grid.cell_m * np.stack([column, row], axis=1)
    corner_offsets = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    corners_m = (lower_m[:, None] + grid.cell_m * corner_offsets).reshape(-1, 2)
    two_triangles = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(len(row))[:, None, None] + two_triangles).reshape(-1, 3)
    colors = apply_colormap(values[row, column], scale).repeat(4, axis=0)
    return rr.Mesh3D(vertex_positions=_add_zero_height(corners_m), triangle_indices=faces, vertex_colors=colors)


def apply_colormap(values: NDArray[Any], scale: ColorScale) -> NDArray[np.uint8]:
    """Compute the colors of values.

    Args:
        values: (N,) values in the unit of the scale.
        scale: Linear color scale.

    Returns:
        (N, 3) red, green and blue from 0 to 255.
    """
    share = np.clip((np.minimum(values, scale.high) - scale.low) / (scale.high - scale.low), 0.0, 1.0)
    return np.asarray(colormaps[scale.colormap](share, bytes=True)[:, :3])


def _build_boxes(boxes: Boxes) -> Any:  # noqa: ANN401
    """Build the ground-truth boxes of a frame."""
    import rerun as rr

    half_yaw_rad = boxes.yaw_rad.cpu().numpy() / 2
    zero = 0 * half_yaw_rad
    return rr.Boxes3D(
        centers=boxes.center_m.cpu().numpy(),
        half_sizes=boxes.size_m.cpu().numpy() / 2,
        quaternions=np.stack([zero, zero, np.sin(half_yaw_rad), np.cos(half_yaw_rad)], axis=1),  # x, y, z, w
        labels=boxes.categories,
    )


def _add_zero_height(points_m: NDArray[Any]) -> NDArray[np.float64]:
    """Append z = 0 to (N, 2) points."""
    return np.column_stack([points_m, np.zeros(len(points_m))])
