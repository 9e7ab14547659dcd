"""Transforms of frames: augmentation of clouds and boxes, and removal of boxes with low visibility."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchcover.detection.boxes import Boxes
from torchcover.detection.visibility import measure_box_visibility
from torchcover.devices import run_with_float64
from torchcover.frames.frame import Frame, Measurement


def flip(frame: Frame) -> Frame:
    """Mirror a frame left to right: y becomes -y.

    Args:
        frame: Frame to mirror.

    Returns:
        Mirrored copy.

    Example:
        >>> frame = Frame({"rig": torch.tensor([[5.0, 2.0, 1.0]])}, torch.zeros(1, 3), index=0, name="a")
        >>> flip(frame).sensor
        tensor([[ 5., -2.,  1.]])
    """
    return _apply_similarity(frame, torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64, device="cpu")))


def rotate(frame: Frame, yaw_rad: float) -> Frame:
    """Rotate a frame about the z axis of the vehicle frame.

    Args:
        frame: Frame to rotate.
        yaw_rad: Angle; positive turns left.

    Returns:
        Rotated copy.

    Raises:
        ValueError: The angle is not finite.

    Example:
        >>> frame = Frame({"rig": torch.tensor([[5.0, 0.0, 1.0]])}, torch.zeros(1, 3), index=0, name="a")
        >>> rotate(frame, math.pi / 2).sensor.round(decimals=4).abs()
        tensor([[0., 5., 1.]])
    """
    if not math.isfinite(yaw_rad):
        raise ValueError(f"yaw_rad: a finite angle is needed; got {yaw_rad}")
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    rotation = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return _apply_similarity(frame, torch.tensor(rotation, dtype=torch.float64, device="cpu"))


def scale(frame: Frame, factor: float) -> Frame:
    """Scale a frame about the origin of the vehicle frame: positions, sizes, velocities and area weights.

    Blind spot radii scale by the same factor.

    Args:
        frame: Frame to scale.
        factor: Scale factor of lengths, > 0.

    Returns:
        Scaled copy.

    Raises:
        ValueError: The factor is not a finite number > 0.

    Example:
        >>> frame = Frame({"rig": torch.tensor([[5.0, 0.0, 1.0]])}, torch.zeros(1, 3), index=0, name="a")
        >>> scale(frame, 2.0).sensor
        tensor([[10.,  0.,  2.]])
    """
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"factor: a finite number > 0 is needed; got {factor}")
    return _apply_similarity(frame, factor * torch.eye(3, dtype=torch.float64, device="cpu"))


@dataclass(frozen=True)
class Augmentation:
    """Random flip, rotation and scaling of a frame, in this order.

    The transformation depends only on the seed, the epoch and the index of the frame, not on workers, ranks or the
    order of access. Use it where the epoch is known: in the training step or in the collate function. Coverage metrics
    need the original frames.

    Args:
        flip_probability: Probability of a flip.
        max_yaw_rad: The rotation is uniform in [-max_yaw_rad, max_yaw_rad].
        scale_range: The scale factor is uniform between these two numbers.
        seed: Seed, >= 0.

    Raises:
        ValueError: A probability outside [0, 1], a negative angle, or factors that are not positive and ascending.

    Example:
        >>> frame = Frame({"rig": torch.rand(9, 3)}, torch.rand(9, 3), index=4, name="a")
        >>> augment = Augmentation(seed=1)
        >>> torch.equal(augment(frame, epoch=2).sensor, augment(frame, epoch=2).sensor)
        True
    """

    flip_probability: float = 0.5
    max_yaw_rad: float = math.pi / 4
    scale_range: tuple[float, float] = (0.95, 1.05)
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.flip_probability <= 1:
            raise ValueError(f"flip_probability: a probability in [0, 1] is needed; got {self.flip_probability}")
        if not 0 <= self.max_yaw_rad < math.inf:
            raise ValueError(f"max_yaw_rad: an angle >= 0 is needed; got {self.max_yaw_rad}")
        if not 0 < self.scale_range[0] <= self.scale_range[1] < math.inf:
            raise ValueError(f"scale_range: two numbers 0 < lowest <= highest are needed; got {self.scale_range}")
        if self.seed < 0:
            raise ValueError(f"seed: a number >= 0 is needed; got {self.seed}")

    def __call__(self, frame: Frame, epoch: int = 0) -> Frame:
        """Augment a frame for one epoch.

        Args:
            frame: Frame with an index >= 0.
            epoch: Number of the epoch, >= 0.

        Returns:
            Augmented copy.

        Raises:
            ValueError: The index or the epoch is negative.
        """
        if frame.index < 0 or epoch < 0:
            raise ValueError(
                f"frame {frame.name!r}, index {frame.index}, epoch {epoch}: numbers >= 0 are needed, because "
                "they seed the augmentation; use dataclasses.replace(frame, index=...)"
            )
        generator = np.random.default_rng([self.seed, epoch, frame.index])
        is_flipped = generator.random() < self.flip_probability
        yaw_rad = float(generator.uniform(-self.max_yaw_rad, self.max_yaw_rad))
        factor = float(generator.uniform(*self.scale_range))
        return scale(rotate(flip(frame) if is_flipped else frame, yaw_rad), factor)


def _apply_similarity(frame: Frame, similarity: Tensor) -> Frame:
    """Apply a (3, 3) float64 similarity that keeps z upright: a rotation about z, a mirror or a scaling."""
    weights, heights_m, factor = frame.reference_weights, frame.reference_heights_m, float(similarity[2, 2])
    measurements = {}
    for name, measurement in frame.measurements.items():
        measurements[name] = Measurement(_multiply(similarity, measurement.points), measurement.error_m * factor)
    return replace(
        frame,
        clouds={name: _multiply(similarity, cloud) for name, cloud in frame.clouds.items()},
        reference=_multiply(similarity, frame.reference),
        reference_weights=None if weights is None else weights * factor**2,
        reference_heights_m=None if heights_m is None else heights_m * factor,
        boxes=None if frame.boxes is None else _apply_similarity_to_boxes(frame.boxes, similarity),
        measurements=measurements,
    )


def _apply_similarity_to_boxes(boxes: Boxes, similarity: Tensor) -> Boxes:
    heading = _multiply(similarity[:2, :2], torch.stack([boxes.yaw_rad.cos(), boxes.yaw_rad.sin()], dim=1))
    factor = float(similarity[2, 2])
    return replace(
        boxes,
        center_m=_multiply(similarity, boxes.center_m),
        size_m=boxes.size_m * factor,
        yaw_rad=torch.atan2(heading[:, 1], heading[:, 0]).to(boxes.yaw_rad.dtype),
        velocity_mps=_multiply(similarity[:2, :2], boxes.velocity_mps),
        bottom_heights_m=boxes.bottom_heights_m * factor,
    )


@run_with_float64
def _multiply(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Multiply each of (N, D) row vectors by a (D, D) float64 matrix; the result has the dtype of the vectors."""
    return (vectors.double() @ matrix.T.to(vectors.device)).to(vectors.dtype)


class VisibleBoxes(Dataset[Frame]):
    """Frames without boxes of low or unknown visibility; the visibility of the others is stored in the boxes.

    `boxes.visibility` can weight the loss; `counts["targets_omitted"]` is the number of removed boxes. Visibility is
    computed at each access: `list(VisibleBoxes(...))` computes it once.

    Args:
        frames: Dataset or list of frames with boxes and reference points; use
            `SurfaceReference(object_points=...)` to sample points on every object.
        min_visibility: Smallest visible share of the surface of an object, see `measure_box_visibility`.
        rig_name: Name of the rig; may be omitted if there is only one.
        threshold_m: Detection threshold of `measure_box_visibility`.

    Raises:
        ValueError: `min_visibility` is outside [0, 1]; on access, the frame has no boxes or no reference points.

    Example:
        >>> import torch
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0], [30.0, 0, 1, 4, 2, 2, 0]]))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5], [28.0, 0.0, 1.0]])
        >>> frame = Frame({"rig": torch.tensor([[8.0, 0.0, 0.6]])}, reference, index=0, name="a", boxes=boxes)
        >>> (filtered,) = VisibleBoxes([frame], min_visibility=0.2)
        >>> len(filtered.boxes), filtered.boxes.visibility, filtered.counts
        (1, tensor([0.5000], dtype=torch.float64), {'targets_omitted': 1})
    """

    def __init__(
        self,
        frames: "Dataset[Frame] | Sequence[Frame]",
        min_visibility: float = 0.2,
        *,
        rig_name: str | None = None,
        threshold_m: float = 0.4,
    ) -> None:
        if not 0.0 <= min_visibility <= 1.0:
            raise ValueError(f"min_visibility: a share from 0 to 1 is needed; got {min_visibility}")
        self.frames = frames
        self.min_visibility = min_visibility
        self.rig_name = rig_name
        self.threshold_m = threshold_m

    def __len__(self) -> int:
        return len(self.frames)  # type: ignore[arg-type]  # map-style datasets have a length

    def __getitem__(self, index: int) -> Frame:
        frame = self.frames[index]
        if frame.boxes is None:
            raise ValueError(f"frame {frame.name!r} has no boxes: SimulatedFrames(..., boxes=True) makes them")
        visibility = measure_box_visibility(
            frame.get_cloud(self.rig_name),
            frame.reference,
            frame.boxes,
            self.threshold_m,
            reference_weights=frame.reference_weights,
        )
        boxes = replace(frame.boxes, visibility=visibility.share.to(frame.boxes.yaw_rad.device))
        visible_boxes = boxes.select(boxes.visibility >= self.min_visibility)
        omitted = frame.counts.get("targets_omitted", 0) + len(boxes) - len(visible_boxes)
        return replace(frame, boxes=visible_boxes, counts={**frame.counts, "targets_omitted": omitted})
