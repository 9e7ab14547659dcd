"""Cameras with real lenses: pixels to rays, depth images to points, and points to pixels."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchcover.cameras import calibration
from torchcover.cameras.calibration import Calibration
from torchcover.cameras.depth import (
    DepthKind,
    PixelSelection,
    check_depth,
    count_unusable_depths,
    mask_usable_depths,
    scale_rays,
    select_pixels,
)
from torchcover.cameras.inverse import ANSWERED
from torchcover.cameras.lens import Scalar, to_vector
from torchcover.cameras.models import check_image, check_model
from torchcover.cameras.optics import Optics, RayTable
from torchcover.devices import run_with_float64
from torchcover.geometry import check_rigid, invert, transform_points_tensor
from torchcover.geometry.rigid import Matrix


class Camera:
    """Camera with its lens and extrinsics; it cannot be changed.

    Camera frame: x right, y down, z forward, in meters. Pixel centers are at integers, so the image covers
    [-0.5, width - 0.5) x [-0.5, height - 0.5).

    Args:
        width: Columns of the image.
        height: Rows of the image.
        fx: Focal length in pixels along x. It may be a tensor with gradients, like the next three.
        fy: Focal length in pixels along y.
        cx: Column of the optical axis; it may lie outside the image.
        cy: Row of the optical axis.
        model: "pinhole", "brown_conrady", "kannala_brandt", "theta_polynomial", "mei", "eucm" or "double_sphere".
        coefficients: Coefficients of the model, numbers or a 1-d tensor, which may have gradients. Brown-Conrady takes
            4, 5, 8, 12 or 14 in the order of OpenCV.
        vehicle_T_camera: (4, 4) extrinsics; None is the identity.
        name: Name for messages.

    Raises:
        ValueError: A size or focal length that is not positive, a value that is not finite, an unknown model, a
            number of coefficients that the model does not take, or a transform that is not rigid.

    Example:
        >>> camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, "brown_conrady", [-0.3, 0.1, 0.0, 0.0])
        >>> rays, valid = camera.rays()
        >>> rays.shape, bool(valid.all())
        (torch.Size([480, 640, 3]), True)
        >>> pixels, visible = camera.project(10.0 * rays[:2, 0].double())
        >>> pixels.round(decimals=3).abs().tolist()
        [[0.0, 0.0], [0.0, 1.0]]
    """

    def __init__(
        self,
        width: int,
        height: int,
        fx: Scalar,
        fy: Scalar,
        cx: Scalar,
        cy: Scalar,
        model: str = "pinhole",
        coefficients: Sequence[Scalar] | Tensor = (),
        vehicle_T_camera: ArrayLike | None = None,
        name: str = "camera",
    ) -> None:
        self.width, self.height, self.model, self.name = width, height, model, name
        self.intrinsics = to_vector([fx, fy, cx, cy])
        self.coefficients = to_vector(list(coefficients))
        check_image(name, width, height, self.intrinsics)
        check_model(model, self.coefficients.tolist())
        pose = np.eye(4) if vehicle_T_camera is None else vehicle_T_camera
        self.vehicle_T_camera: Matrix = check_rigid(pose, f"{name}: vehicle_T_camera")
        self._optics = Optics(self.intrinsics, model, self.coefficients)
        self._table = RayTable(self._optics, width, height)

    @classmethod
    def from_calibration(cls, source: Calibration) -> "Camera":
        """Create a camera from a calibration.

        Args:
            source: The calibration, whose fields are the arguments of the constructor.
        """
        return cls(**vars(source))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike, width: int, height: int, **options: Any) -> "Camera":  # noqa: ANN401
        """Create a camera from its matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].

        Args:
            matrix: (3, 3) camera matrix for pixel centers at integers, as in OpenCV and ROS.
            width: Columns of the image.
            height: Rows of the image.
            **options: `model`, `coefficients`, `vehicle_T_camera`, `name`.

        Raises:
            ValueError: The matrix has another shape, a skew, or another last row.
        """
        fx, fy, cx, cy = calibration.split_matrix(matrix, str(options.get("name", "camera")))
        return cls(width, height, fx, fy, cx, cy, **options)

    @classmethod
    def from_fov(cls, width: int, height: int, fov_deg: float, **options: Any) -> "Camera":  # noqa: ANN401
        """Create a pinhole camera with square pixels and the axis in the middle of the image, as in CARLA.

        Args:
            width: Columns of the image.
            height: Rows of the image.
            fov_deg: Horizontal field of view from the left edge of the first pixel to the right edge of the last.
            **options: `vehicle_T_camera` (see `convert_carla_pose`), `name`.

        Returns:
            The camera, with its axis at (width - 1) / 2; the matrix of CARLA has width / 2, because it counts from the
            corner of the first pixel and not from its center.

        Raises:
            ValueError: The field of view is not between 0 and 180 degrees.

        Example:
            >>> Camera.from_fov(500, 420, 90.0)
            Camera('camera', 500x420, pinhole, fx=250, fy=250, cx=249.5, cy=209.5)
        """
        if not 0.0 < fov_deg < 180.0:
            raise ValueError(f"the field of view of a pinhole lies between 0 and 180 degrees; got {fov_deg}")
        focal = float(width / (2.0 * np.tan(np.deg2rad(fov_deg) / 2.0)))
        return cls(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0, **options)

    @classmethod
    def from_ros(cls, path: str | Path) -> "Camera":
        """Create a camera from a ROS `camera_info` YAML file.

        Args:
            path: The file; see `calibration.read_ros`.
        """
        return cls.from_calibration(calibration.read_ros(path))

    @classmethod
    def from_opencv(cls, path: str | Path, **options: Any) -> "Camera":  # noqa: ANN401
        """Create a camera from an OpenCV FileStorage YAML file.

        Args:
            path: The file.
            **options: Arguments of `calibration.read_opencv`.
        """
        return cls.from_calibration(calibration.read_opencv(path, **options))

    @classmethod
    def from_kitti(cls, path: str | Path, camera: int, **options: Any) -> "Camera":  # noqa: ANN401
        """Create a camera from a KITTI calibration file.

        Args:
            path: The file.
            camera: Number of the camera, 0 to 3.
            **options: Arguments of `calibration.read_kitti`.
        """
        return cls.from_calibration(calibration.read_kitti(path, camera, **options))

    @classmethod
    def from_nuscenes(cls, folder: str | Path, channel: str, **options: Any) -> "Camera":  # noqa: ANN401
        """Create a camera from the tables of nuScenes.

        Args:
            folder: Folder of the tables.
            channel: Name of the camera, such as "CAM_FRONT".
            **options: Arguments of `calibration.read_nuscenes`.
        """
        return cls.from_calibration(calibration.read_nuscenes(folder, channel, **options))

    def __repr__(self) -> str:
        fx, fy, cx, cy = self.intrinsics.tolist()
        size = f"{self.width}x{self.height}"
        return f"Camera({self.name!r}, {size}, {self.model}, fx={fx:g}, fy={fy:g}, cx={cx:g}, cy={cy:g})"

    def rays(
        self, pixels: Tensor | None = None, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
    ) -> tuple[Tensor, Tensor]:
        """Compute the rays of pixels.

        Args:
            pixels: (..., 2) columns and rows, also between pixel centers; None is the whole image.
            device: Device of the table of the whole image, which is computed once; ignored with pixels.
            dtype: float32 or float64 of that table. The lens is solved in float64 in any case.

        Returns:
            Unit directions (H, W, 3) or (..., 3), and a mask (H, W) or (...) of the pixels that have one. The others
            are NaN: outside the valid region of the lens, or not converged (see `count_pixels`).
        """
        if pixels is None:
            return self._table.get_points(str(torch.device(device)), dtype, "distance")
        if not pixels.is_floating_point() or pixels.shape[-1:] != (2,):
            raise ValueError(f"{self.name}: pixels are floats (..., 2); got {pixels.dtype} {tuple(pixels.shape)}")
        return self._compute_rays(pixels)

    @run_with_float64
    def _compute_rays(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        directions, status = self._optics.unproject(pixels.reshape(-1, 2).double())
        shape = pixels.shape[:-1]
        return directions.to(pixels.dtype).reshape(*shape, 3), (status == ANSWERED).reshape(shape)

    def count_pixels(self) -> dict[str, int]:
        """Count the pixels of the image with a ray, and those without by reason.

        Returns:
            `pixels_valid`, `pixels_outside` (no direction in the valid region has this image) and
            `pixels_unconverged` (the solver did not converge); they add up to width * height.
        """
        return self._table.count_pixels()

    @run_with_float64
    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points to pixels.

        Args:
            points: (N, 3) float points in the camera frame, in meters.

        Returns:
            (N, 2) columns and rows, NaN for points that the lens cannot show (behind it, beyond its fold, not
            finite), and (N,) bool: visible, that is, shown and inside the image. Occlusion is ignored.

        Raises:
            ValueError: The points are not (N, 3) floats.
        """
        if not points.is_floating_point() or points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"{self.name}: points are floats (N, 3); got {points.dtype} {tuple(points.shape)}")
        pixels, shown = self._optics.project(points.double())
        size = pixels.new_tensor([self.width, self.height])
        inside = ((pixels >= -0.5) & (pixels < size - 0.5)).all(dim=1)
        return pixels.to(points.dtype), shown & inside

    def unproject(
        self,
        depth: Tensor,
        depth_kind: DepthKind = "z",
        *,
        stride: int = 1,
        valid_mask: Tensor | None = None,
        max_depth_m: float = float("inf"),
    ) -> Tensor | list[Tensor]:
        """Compute the points of a depth image.

        Args:
            depth: (H, W) or (B, H, W) float depth in meters. Zero, negative, NaN and infinite values and those beyond
                `max_depth_m` do not become points; `count_excluded` counts them.
            depth_kind: "z", along the optical axis (CARLA, most renderers), or "distance", along the ray. At 90 degrees
                and more off the axis only the distance exists.
            stride: Use every stride-th row and column, beginning with the first.
            valid_mask: (H, W) or (B, H, W) bool; False for pixels to exclude.
            max_depth_m: Largest depth that is a measurement, of the same kind as the depth.

        Returns:
            (N, 3) points in the camera frame, row by row, in the type of the depth (float32 for half precision); for
            (B, H, W) a list of B such clouds.

        Raises:
            TypeError: The depth has integers, whose unit is unknown.
            ValueError: Depth or mask have another size than the camera, the kind is unknown, or the stride below 1.

        Example:
            >>> Camera.from_fov(3, 1, 90.0).unproject(torch.tensor([[2.0, 0.0, 2.0]]))
            tensor([[-1.3333,  0.0000,  2.0000],
                    [ 1.3333,  0.0000,  2.0000]])
        """
        pixels = self._select_pixels(depth, depth_kind, stride, valid_mask)
        mask = pixels.mask & mask_usable_depths(pixels.depth, max_depth_m)
        if pixels.depth.ndim == 2:
            return scale_rays(pixels.rays, pixels.depth, mask)
        return [scale_rays(pixels.rays, *image) for image in zip(pixels.depth, mask, strict=True)]

    def count_excluded(
        self,
        depth: Tensor,
        depth_kind: DepthKind = "z",
        *,
        stride: int = 1,
        valid_mask: Tensor | None = None,
        max_depth_m: float = float("inf"),
    ) -> dict[str, int]:
        """Count the pixels of a depth image that do not become points, by reason.

        Args:
            depth: Depth image or batch; see `unproject`, as for the other arguments.
            depth_kind: "z" or "distance".
            stride: Use every stride-th row and column.
            valid_mask: False for pixels to exclude.
            max_depth_m: Largest depth that is a measurement.

        Returns:
            `no_ray` (no ray, or no z depth in that direction), `masked` (by `valid_mask`), then `depth_zero`,
            `depth_negative`, `depth_nan`, `depth_infinite`, `depth_beyond_range`. Every pixel is counted once, under
            the first reason that applies.
        """
        pixels = self._select_pixels(depth, depth_kind, stride, valid_mask)
        has_ray = pixels.has_ray.expand(pixels.depth.shape)
        mask = pixels.mask.expand(pixels.depth.shape)
        counts = {"no_ray": int((~has_ray).sum()), "masked": int((has_ray & ~mask).sum())}
        return counts | count_unusable_depths(pixels.depth[mask], max_depth_m)

    def _select_pixels(
        self, depth: Tensor, depth_kind: DepthKind, stride: int, valid_mask: Tensor | None
    ) -> PixelSelection:
        depth = check_depth(depth, depth_kind, stride, valid_mask, (self.height, self.width), self.name)
        rays, has_ray = self._table.get_points(str(depth.device), depth.dtype, depth_kind)
        return select_pixels(rays, has_ray, depth, stride, valid_mask)

    @run_with_float64
    def convert_z_to_distance(self, depth: Tensor) -> Tensor:
        """Convert depth along the axis to distance along the ray.

        Args:
            depth: (H, W) or (B, H, W) depth in meters.

        Returns:
            Distances of the same shape, NaN where a pixel has no z depth.
        """
        depth = check_depth(depth, "z", 1, None, (self.height, self.width), self.name)
        forward = self._compute_axis_cosines(depth.device)
        return (depth.double() / torch.where(forward > 0, forward, torch.nan)).to(depth.dtype)

    @run_with_float64
    def convert_distance_to_z(self, depth: Tensor) -> Tensor:
        """Convert distance along the ray to depth along the axis.

        Args:
            depth: (H, W) or (B, H, W) distance in meters.

        Returns:
            Depth of the same shape, NaN where a pixel has no ray.

        Example:
            >>> camera = Camera.from_fov(2, 1, 90.0)
            >>> camera.convert_distance_to_z(camera.convert_z_to_distance(torch.tensor([[3.0, 5.0]])))
            tensor([[3., 5.]])
        """
        depth = check_depth(depth, "distance", 1, None, (self.height, self.width), self.name)
        return (depth.double() * self._compute_axis_cosines(depth.device)).to(depth.dtype)

    def _compute_axis_cosines(self, device: torch.device) -> Tensor:
        """Compute the float64 cosine of the angle between the ray of each pixel and the axis."""
        rays, _ = self._table.get_points(str(device), torch.float64, "distance")
        return rays[..., 2]

    def to_vehicle(self, points: Tensor) -> Tensor:
        """Transform points from the camera frame to the vehicle frame.

        Args:
            points: (N, 3) points.
        """
        return transform_points_tensor(self.vehicle_T_camera, points)

    def to_camera(self, points: Tensor) -> Tensor:
        """Transform points from the vehicle frame to the camera frame.

        Args:
            points: (N, 3) points.
        """
        return transform_points_tensor(invert(self.vehicle_T_camera), points)
