"""Frames: the sensor points of rigs and the reference points of one time step."""

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.grid import BandFrame
from torchcover.detection.boxes import Boxes
from torchcover.devices import move_tensor
from torchcover.notebooks import format_short_repr


class Measurement(NamedTuple):
    """Points of a rig as sensors with measurement errors report them.

    Args:
        points: (N, 3) float32 measured positions in the vehicle frame in meters.
        error_m: (N,) float32 range error of each point along its ray.
    """

    points: Tensor
    error_m: Tensor


@dataclass(frozen=True, repr=False)
class Frame:
    """Clouds of one time step in the vehicle frame (x forward, y left, z up, meters).

    Coverage is computed from the true hit points: a point that noise moves into a gap does not cover the gap.

    Args:
        clouds: Name of each rig -> (N, 3) float32 true hit points of all its sensors. A recording has no true hit
            points; its measured points take their place.
        reference: (M, 3) float32 points of the reference sensor.
        index: Index in the dataset.
        name: Name for users: a file stem, or scenario and frame number.
        counts: Number of points or objects that were excluded, by reason (`sensor_self_hits`,
            `reference_nonfinite`, ...).
        reference_weights: (M,) float32 visible area in square meters that each reference point represents (see
            `SurfaceReference`); None if unknown: all points then weigh the same.
        boxes: Objects of the frame; None if unknown, which differs from an empty list of boxes.
        block_index: Number of the content of the frame, for standard errors: frames that share it (a repeated frame,
            the same city) are not independent. Default: `index`, each frame is independent.
        sensor_point_counts: Name of each rig -> name of each sensor -> number of its points; `clouds` holds the points
            in this order. None if unknown.
        reference_heights_m: (M,) float32 heights of the reference points above local ground, NaN without ground at or
            below; None if unknown: height bands are then intervals of z in the vehicle frame.
        measurements: Name of a rig -> its measured points, if its sensors have measurement errors. Other rigs measure
            the true hit points.

    Raises:
        ValueError: Clouds and measurements of a rig differ in length.
    """

    clouds: Mapping[str, Tensor]
    reference: Tensor
    index: int
    name: str
    counts: Mapping[str, int] = field(default_factory=dict)
    reference_weights: Tensor | None = None
    boxes: Boxes | None = None
    block_index: int = None  # type: ignore[assignment]  # set in __post_init__
    sensor_point_counts: Mapping[str, Mapping[str, int]] | None = None
    reference_heights_m: Tensor | None = None
    measurements: Mapping[str, Measurement] = field(default_factory=dict)

    __repr__ = format_short_repr

    def __post_init__(self) -> None:
        # NumPy integers have another text and do not load with `weights_only=True`, hence plain integers.
        for name in ("index", "block_index"):
            number = getattr(self, name)
            object.__setattr__(self, name, self.index if number is None else operator.index(number))
        for rig_name in self.measurements.keys() & self.clouds.keys():
            measurement = self.measurements[rig_name]
            sizes = (len(self.clouds[rig_name]), len(measurement.points), len(measurement.error_m))
            if len(set(sizes)) > 1:
                raise ValueError(
                    f"frame {self.name!r}: {rig_name!r} has {sizes[0]} points, {sizes[1]} measured points and "
                    f"{sizes[2]} errors; set `clouds` and `measurements` together"
                )

    @property
    def sensor(self) -> Tensor:
        """(N, 3) true hit points of the only rig.

        Raises:
            ValueError: The frame has several rigs; use `frame.get_cloud(rig_name)`.
        """
        return self.get_cloud()

    def get_cloud(self, rig_name: str | None = None, *, max_error_m: float = math.inf) -> Tensor:
        """Return the true hit points of one rig.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.
            max_error_m: Points with a larger measurement error are excluded.

        Returns:
            (N, 3) points in the vehicle frame.

        Raises:
            ValueError: The frame has no such rig, or several rigs and `rig_name` is None.
        """
        rig_name = self._resolve_rig_name(rig_name)
        cloud = self.clouds[rig_name]
        if rig_name not in self.measurements or max_error_m == math.inf:
            return cloud
        return cloud[self._is_accurate(rig_name, max_error_m)]

    def get_errors_m(self, rig_name: str | None = None) -> Tensor | None:
        """Return the measurement errors of the points of one rig.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.

        Returns:
            (N,) range error of each point along its ray; None if the sensors measure the true hit points.

        Raises:
            ValueError: Same conditions as `get_cloud`.
        """
        rig_name = self._resolve_rig_name(rig_name)
        return self.measurements[rig_name].error_m if rig_name in self.measurements else None

    def get_measured_points(self, rig_name: str | None = None) -> Tensor:
        """Return the points of one rig with measurement errors, the input of a network or the content of a file.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.

        Returns:
            (N, 3) points in the vehicle frame.

        Raises:
            ValueError: Same conditions as `get_cloud`.

        Example:
            >>> hits, measured = torch.tensor([[5.0, 0.0, 0.0]]), torch.tensor([[5.1, 0.0, 0.0]])
            >>> measurements = {"rig": Measurement(measured, torch.tensor([0.1]))}
            >>> frame = Frame({"rig": hits}, torch.zeros(1, 3), index=0, name="a", measurements=measurements)
            >>> frame.get_measured_points() is measured, frame.get_cloud(), len(frame.get_cloud(max_error_m=0.05))
            (True, tensor([[5., 0., 0.]]), 0)
        """
        rig_name = self._resolve_rig_name(rig_name)
        return self.measurements[rig_name].points if rig_name in self.measurements else self.clouds[rig_name]

    def _resolve_rig_name(self, rig_name: str | None) -> str:
        """Return the name of an existing rig; the only rig if the name is None."""
        if rig_name is None and len(self.clouds) != 1:
            raise ValueError(f"the frame has clouds of {len(self.clouds)} rigs ({', '.join(self.clouds)}): name one")
        if rig_name is not None and rig_name not in self.clouds:
            raise ValueError(f"frame {self.name!r} has no rig {rig_name!r}; it has {', '.join(self.clouds)}")
        return next(iter(self.clouds)) if rig_name is None else rig_name

    def _is_accurate(self, rig_name: str, max_error_m: float) -> Tensor:
        """(N,) bool: the point of a rig with measurements has at most this error."""
        return self.measurements[rig_name].error_m.abs() <= max_error_m

    def get_clouds_by_sensor(self, rig_name: str | None = None, *, max_error_m: float = math.inf) -> dict[str, Tensor]:
        """Return the true hit points of each sensor of a rig.

        Args:
            rig_name: Name of the rig; may be omitted if there is only one.
            max_error_m: Points with a larger measurement error are excluded.

        Returns:
            Name of each sensor -> (N, 3) points in the vehicle frame.

        Raises:
            ValueError: The frame has no such rig, or `sensor_point_counts` is unknown.
        """
        name = self._resolve_rig_name(rig_name)
        if self.sensor_point_counts is None or name not in self.sensor_point_counts:
            raise ValueError(
                f"frame {self.name!r}: redundancy needs the points of each sensor of {name!r}; set sensor_point_counts"
            )
        point_counts = self.sensor_point_counts[name]
        sizes = list(point_counts.values())
        clouds = dict(zip(point_counts, torch.split(self.clouds[name], sizes), strict=True))
        if name not in self.measurements or max_error_m == math.inf:
            return clouds
        masks = torch.split(self._is_accurate(name, max_error_m), sizes)
        return {sensor: cloud[mask] for (sensor, cloud), mask in zip(clouds.items(), masks, strict=True)}

    def pin_memory(self) -> "Frame":
        """Copy the frame to page-locked memory; DataLoader calls this if `pin_memory=True`."""
        return self._transform_tensors(Tensor.pin_memory, None if self.boxes is None else self.boxes.pin_memory())

    def to(self, device: torch.device | str) -> "Frame":
        """Copy the frame to a device.

        Args:
            device: Target device.

        Returns:
            The copy; its tensors are float32 if the device does not support float64.
        """

        def move(tensor: Tensor) -> Tensor:
            return move_tensor(tensor, device)

        return self._transform_tensors(move, None if self.boxes is None else self.boxes.to(device))

    def get_heights_m(self, band_frame: BandFrame) -> Tensor | None:
        """Return the heights by which reference points are assigned to height bands.

        Args:
            band_frame: "ground": bands above local ground; "vehicle": bands of z in the vehicle frame.

        Returns:
            (M,) heights above local ground; None for "vehicle".

        Raises:
            ValueError: "ground", but the heights are unknown; or "vehicle", but the points were sampled within bands
                above local ground (they have weights and heights).
        """
        if band_frame == "vehicle":
            if None not in (self.reference_weights, self.reference_heights_m):
                raise ValueError(
                    f"frame {self.name!r}: its reference points have areas and heights above the ground, so they were "
                    "sampled for bands above the ground; use the band frame ground"
                )
            return None
        if self.reference_heights_m is None:
            raise ValueError(
                f"frame {self.name!r}: the heights of its reference points above the ground (reference_heights_m) are "
                "unknown; use the band frame vehicle"
            )
        return self.reference_heights_m

    def _transform_tensors(self, transform: Callable[[Tensor], Tensor], boxes: Boxes | None) -> "Frame":
        """Copy the frame with every tensor transformed and with other boxes."""
        weights, heights_m = self.reference_weights, self.reference_heights_m
        measurements = {}
        for name, measurement in self.measurements.items():
            measurements[name] = Measurement(transform(measurement.points), transform(measurement.error_m))
        return replace(
            self,
            clouds={name: transform(cloud) for name, cloud in self.clouds.items()},
            reference=transform(self.reference),
            reference_weights=None if weights is None else transform(weights),
            reference_heights_m=None if heights_m is None else transform(heights_m),
            boxes=boxes,
            measurements=measurements,
        )


# Classes on this list load with `torch.load(weights_only=True)`, the default.
torch.serialization.add_safe_globals([Frame, Measurement])
