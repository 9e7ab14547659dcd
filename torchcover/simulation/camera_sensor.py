"""A camera that measures depth: the pixels of a lens as rays."""

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

# The camera frame is x right, y down, z forward; a mount looks along its x, with y left and z up.
MOUNT_T_CAMERA = build_transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
ROWS_AT_ONCE = 64
# Ten times the sides of the largest images that there are.
MAX_PIXELS = 200_000

PixelCount = Annotated[int, Field(gt=0, le=MAX_PIXELS)]


class Stereo(Document):
    """How a pair of cameras errs in depth: by R^2 / (f B) for each pixel of disparity, f their focal length in pixels.

    Args:
        baseline_m: B, the distance between the two.
        subpixel_px: Standard deviation of the disparity.
    """

    baseline_m: PositiveFloat
    subpixel_px: PositiveFloat


class CameraSensor(RangeSensor):
    """A camera as a depth sensor: every pixel that has a ray gives the point that it sees.

    What it takes for the range has a standard deviation of `range_noise_m`, `range_noise_share` of the range, and that
    of `stereo`, together: beyond the range at which that is as large as the threshold, its points stop counting.

    Args:
        name: What maps and messages call it.
        mount: Its pose in the vehicle frame. At yaw, pitch and roll 0 it looks forward, upright.
        width: Columns of the image.
        height: Rows of the image.
        fov_deg: Horizontal field of view of a pinhole with square pixels and its axis in the middle.
        fx, fy, cx, cy: Intrinsics in pixels instead; pixel centres lie at integers.
        lens: Lens model, with the intrinsics; see `torchcover.Camera`.
        coefficients: Of the lens.
        stride: Use every stride-th row and column. Points on a body are counted as pixels of the full image all the
            same.
        stereo: Its error in depth as that of a pair of cameras; none if not given.
        range_noise_share: Standard deviation of measured ranges, as a share of the range.
        scan: When its rows are cast, as by a rolling shutter; all at once if not given.
        min_range_m, max_range_m, range_noise_m, dropout: As in `Ranging`; ranges are along the ray.

    Example:
        >>> camera = CameraSensor(name="front", width=64, height=48, fov_deg=90, max_range_m=100)
        >>> camera.directions().shape
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
        given = [value is not None for value in (self.fx, self.fy, self.cx, self.cy)]
        if self.fov_deg is None and not all(given):
            raise ValueError("the intrinsics are missing: give fx, fy, cx and cy, or fov_deg")
        if self.fov_deg is not None and (any(given) or self.lens != "pinhole"):
            raise ValueError("fov_deg is for a pinhole without fx, fy, cx, cy; give one or the other")
        self.build_camera()
        return self

    def compute_noise_std_m(self, range_m: NDArray[np.floating]) -> float | NDArray[np.floating]:
        """Standard deviation of measured ranges, of each of (N,) or of all; 0 if they are exact."""
        if self.stereo is None and not self.range_noise_share:
            return self.range_noise_m
        squared = self.range_noise_m**2 + (self.range_noise_share * range_m) ** 2
        if self.stereo is not None:
            focal_px = float(self.build_camera().intrinsics[0])
            per_m2 = self.stereo.subpixel_px / (focal_px * self.stereo.baseline_m)
            squared = squared + (per_m2 * range_m**2) ** 2
        return np.asarray(np.sqrt(squared))

    @property
    def pixels_per_sample(self) -> int:
        """The pixels of the full image that each one in use stands for."""
        return self.stride**2

    @property
    def num_rays(self) -> int:
        """How many pixels are used, those without a ray included."""
        return -(-self.width // self.stride) * -(-self.height // self.stride)

    @property
    def horizontal_fov_deg(self) -> float:
        """Angle between the outermost rays of the middle row, seen from above; NaN if none of them has a ray.

        A single column is as wide as its pixel.
        """
        columns = torch.arange(0, self.width, self.stride, dtype=torch.float64, device="cpu")
        if len(columns) == 1:
            columns = torch.tensor([-0.5, 0.5], dtype=torch.float64, device="cpu")
        row = self.height // self.stride // 2 * self.stride
        forward, left, _ = self._directions(torch.stack([columns, torch.full_like(columns, row)], dim=1)[None])
        angle = np.rad2deg(np.arctan2(left, forward))
        angle = angle[~np.isnan(angle)]
        return float(np.ptp(angle)) if len(angle) else np.nan

    def build_camera(self) -> Camera:
        """The camera with its lens, at its place on the vehicle.

        Raises:
            ValueError: The lens model is unknown or takes another number of coefficients.
        """
        own: dict[str, Any] = {"vehicle_T_camera": self.mount.to_matrix() @ MOUNT_T_CAMERA, "name": self.name}
        if self.fov_deg is not None:
            return Camera.from_fov(self.width, self.height, self.fov_deg, **own)
        own |= {key: getattr(self, key) for key in ("fx", "fy", "cx", "cy", "coefficients")}
        return Camera(self.width, self.height, model=self.lens, **own)

    def compute_directions(self) -> Float64:
        """(3, rows, columns) unit directions in the frame of the mount; NaN where a pixel has no ray."""
        rows, columns = (
            torch.arange(0, size, self.stride, dtype=torch.float64, device="cpu") for size in (self.height, self.width)
        )
        return self._directions(torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=2))

    def compute_ray_times_s(self) -> Float64 | None:
        """(rows, columns) when each ray is cast, after the time of the frame; None if all are at that time."""
        if self.scan is None:
            return None
        of_rows_s = self.scan.compute_times_s(self.height)[:: self.stride]
        return np.repeat(of_rows_s[:, None], -(-self.width // self.stride), axis=1)

    def _directions(self, pixels: Tensor) -> Float64:
        """(3, rows, columns) of (rows, columns, 2) pixels."""
        camera = self.build_camera()
        # Only the pixels that are used, and not all at once: the solver needs many times their memory.
        rays = torch.cat([camera.rays(band)[0] for band in torch.split(pixels, ROWS_AT_ONCE)])
        right, down, forward = np.moveaxis(rays.numpy(), 2, 0)
        return np.stack([forward, -right, -down])
