"""Depth camera: the pixels of a camera model as rays."""

from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, PositiveInt, model_validator
from torch import Tensor

from torchcover.cameras import Camera
from torchcover.geometry import build_transform
from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Document, Pose
from torchcover.simulation.sensor import RangeSensor, ScanTimes

# The camera frame is x right, y down, z forward; the frame of the mount is x forward, y left, z up.
MOUNT_T_CAMERA = build_transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))

# The limit is ten times the side of the largest images.
PixelCount = Annotated[int, Field(gt=0, le=200_000)]


class Stereo(Document):
    """Depth error of a stereo camera: R^2 / (f B) per pixel of disparity, with the focal length f in pixels.

    Args:
        baseline_m: Distance B between both cameras.
        subpixel_px: Standard deviation of the disparity.
    """

    baseline_m: PositiveFloat
    subpixel_px: PositiveFloat


class CameraSensor(RangeSensor):
    """Camera as a depth sensor: each pixel with a ray measures the point that the ray hits.

    The variance of the measured range is the sum of the squares of `range_noise_m`, of `range_noise_share` times the
    range, and of the error of `stereo`. Points farther away than the range at which this error reaches the threshold
    hardly count as detections.

    Args:
        name: Name in maps and messages.
        mount: Pose in the vehicle frame; at yaw, pitch and roll 0 the camera looks forward and is upright.
        width: Columns of the image.
        height: Rows of the image.
        fov_deg: Horizontal field of view of a pinhole camera with square pixels and a centered principal point.
        fx, fy, cx, cy: Intrinsics in pixels, in place of `fov_deg`; pixel centers are integers.
        lens: Camera model that the intrinsics belong to, see `torchcover.Camera`.
        coefficients: Distortion coefficients of the camera model.
        stride: Use every stride-th row and column; point counts still count pixels of the full image.
        stereo: Depth error of a stereo camera; None for none.
        range_noise_share: Standard deviation of the measured range as a share of the range.
        scan: Times of the rows of a rolling shutter; None if all rays are cast at once.
        min_range_m, max_range_m, range_noise_m, dropout: See `RangeSensor`; ranges are along the ray, not depths.

    Example:
        >>> camera = CameraSensor(name="front", width=64, height=48, fov_deg=90, max_range_m=100)
        >>> camera.compute_directions().shape
        (3, 48, 64)
    """

    type: Literal["camera"] = "camera"
    name: str
    mount: Pose = Pose()
    width: PixelCount
    height: PixelCount
    fov_deg: Annotated[float, Field(gt=0.0, lt=180.0)] | None = None
    fx: PositiveFloat | None = None
    fy: PositiveFloat | None = None
    cx: float | None = None
    cy: float | None = None
    lens: str = "pinhole"
    coefficients: tuple[float, ...] = ()
    stride: PositiveInt = 1
    stereo: Stereo | None = None
    range_noise_share: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    scan: ScanTimes | None = None

    @model_validator(mode="after")
    def _check_lens(self) -> Self:
        is_given = [value is not None for value in (self.fx, self.fy, self.cx, self.cy)]
        if self.fov_deg is None and not all(is_given):
            raise ValueError("the intrinsics are missing: give fx, fy, cx and cy, or fov_deg")
        if self.fov_deg is not None and (any(is_given) or self.lens != "pinhole"):
            raise ValueError("fov_deg is for a pinhole without fx, fy, cx, cy; give one or the other")
        self.build_camera()
        return self

    def compute_noise_std_m(self, range_m: NDArray[np.floating]) -> float | NDArray[np.floating]:
        """Compute the standard deviation of measured ranges.

        Args:
            range_m: (N,) true ranges.

        Returns:
            (N,) standard deviations in meters, or one number for all ranges; 0 if ranges are exact.
        """
        if self.stereo is None and not self.range_noise_share:
            return self.range_noise_m
        variance_m2 = self.range_noise_m**2 + (self.range_noise_share * range_m) ** 2
        if self.stereo is not None:
            focal_px = float(self.build_camera().intrinsics[0])
            error_per_m2 = self.stereo.subpixel_px / (focal_px * self.stereo.baseline_m)
            variance_m2 = variance_m2 + (error_per_m2 * range_m**2) ** 2
        return np.asarray(np.sqrt(variance_m2))

    @property
    def pixels_per_sample(self) -> int:
        """Number of pixels of the full image that each used pixel represents."""
        return self.stride**2

    @property
    def num_rays(self) -> int:
        """Number of used pixels, pixels without a ray included."""
        return -(-self.width // self.stride) * -(-self.height // self.stride)

    @property
    def horizontal_fov_deg(self) -> float:
        """Azimuth range of the rays of the middle row; the width of the pixel if there is one column, NaN if no ray."""
        columns = torch.arange(0, self.width, self.stride, dtype=torch.float64, device="cpu")
        if len(columns) == 1:
            columns = torch.tensor([-0.5, 0.5], dtype=torch.float64, device="cpu")
        row = self.height // self.stride // 2 * self.stride
        forward, left, _ = self._unproject(torch.stack([columns, torch.full_like(columns, row)], dim=1)[None])
        azimuth_deg = np.rad2deg(np.arctan2(left, forward))
        azimuth_deg = azimuth_deg[~np.isnan(azimuth_deg)]
        return float(np.ptp(azimuth_deg)) if len(azimuth_deg) else np.nan

    def build_camera(self) -> Camera:
        """Build the camera model with its extrinsics.

        Raises:
            ValueError: The camera model is unknown or takes another number of coefficients.
        """
        options: dict[str, Any] = {"vehicle_T_camera": self.mount.to_matrix() @ MOUNT_T_CAMERA, "name": self.name}
        if self.fov_deg is not None:
            return Camera.from_fov(self.width, self.height, self.fov_deg, **options)
        options |= {key: getattr(self, key) for key in ("fx", "fy", "cx", "cy", "coefficients")}
        return Camera(self.width, self.height, model=self.lens, **options)

    def compute_directions(self) -> Float64:
        """Compute (3, rows, columns) unit directions in the frame of the mount; NaN where a pixel has no ray."""
        rows = torch.arange(0, self.height, self.stride, dtype=torch.float64, device="cpu")
        columns = torch.arange(0, self.width, self.stride, dtype=torch.float64, device="cpu")
        return self._unproject(torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=2))

    def compute_ray_times_s(self) -> Float64 | None:
        """Compute (rows, columns) times of the rays relative to the frame; None if all rays are cast at that time."""
        if self.scan is None:
            return None
        row_times_s = self.scan.compute_times_s(self.height)[:: self.stride]
        return np.repeat(row_times_s[:, None], -(-self.width // self.stride), axis=1)

    def _unproject(self, pixels: Tensor, rows_per_call: int = 64) -> Float64:
        """Compute (3, rows, columns) unit directions of (rows, columns, 2) pixels in the frame of the mount."""
        camera = self.build_camera()
        # The solver for the distortion needs many times the memory of its pixels, so rows are processed in chunks.
        rays = torch.cat([camera.rays(chunk)[0] for chunk in torch.split(pixels, rows_per_call)])
        right, down, forward = np.moveaxis(rays.numpy(), 2, 0)
        return np.stack([forward, -right, -down])
