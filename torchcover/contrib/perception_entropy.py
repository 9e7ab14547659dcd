"""Perception entropy: how uncertain a detector is about an object with so many points on it."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

import torchcover.geometry.first_calls  # noqa: F401
from torchcover.contrib.frame_metric import WorldRatios, said
from torchcover.contrib.object_strata import CATEGORIES, RANGE_BORDERS_M, ObjectStrata
from torchcover.contrib.sights import count_in_boxes, rig_of
from torchcover.coverage.quantity import MEASURED_WITHIN_M
from torchcover.frames import Frame
from torchcover.simulation import CameraSensor, Sensor

# Of average precision a ln m + b over m points or pixels on the object, as GO4ROBO has them.
CONSTANTS: Mapping[str, tuple[float, float]] = MappingProxyType({"lidar": (0.152, 0.659), "camera": (0.055, 0.155)})
PRECISIONS = (0.001, 0.999)


def standard_deviation(measurements: Tensor, kind: str) -> Tensor:
    """The sigma of objects with (K,) measurements of one kind of sensor: 1 / AP - 1, AP = a ln m + b.

    AP is kept within [0.001, 0.999], as GO4ROBO does; with the constants of LiDARs it is 0.999 from 10 points on. No
    measurement is as bad as can be.
    """
    a, b = CONSTANTS[kind]
    precision = (a * measurements.double().log() + b).clamp(*PRECISIONS)
    return 1 / precision - 1


def late_fusion(sigmas: Sequence[Tensor]) -> Tensor:
    """The sigma of several kinds of sensors together: (sum of sigma_i^-2)^-1/2."""
    return torch.stack(list(sigmas)).pow(-2).sum(dim=0).pow(-0.5)


def entropy(sigma: Tensor, *, bounded: bool = False) -> Tensor:
    """Nats of a Gaussian in the plane: 2 ln sigma + 1 + ln 2 pi; bounded: 2 ln(sigma + 1) + ln 2 pi."""
    if bounded:
        return 2 * (sigma + 1).log() + math.log(2 * math.pi)
    return 2 * sigma.log() + 1 + math.log(2 * math.pi)


class PerceptionEntropy(WorldRatios):
    """Mean over objects of their perception entropy (Ma et al. 2021, as GO4ROBO has it); lower is better.

    Points of LiDARs on an object are added up, those of cameras too, and the two kinds are fused late. The plain form
    is unbounded in the quality of a detector and dominated by whether an object has 10 points; the bounded one, of
    GO4ROBO's differentiable path, is never below ln 2 pi.

    Args:
        sensors: The rig's sensors; if not given, or without a camera, all points are taken for those of LiDARs.
        categories: Those that have numbers of their own.
        range_borders_m: Borders between bins of range; farther objects do not count.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.

    Raises:
        ValueError: From `update`: a frame without boxes; of a rig with cameras, if it is unknown which points are of
            which sensor.

    Example:
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0]]), hits={"rig": torch.tensor([5])})
        >>> metric = PerceptionEntropy()
        >>> metric.update(Frame({"rig": torch.zeros(0, 3)}, torch.zeros(0, 3), 0, "a", boxes=boxes))
        >>> round(metric.compute()[0].value, 6)
        -1.638678
    """

    def __init__(
        self,
        sensors: Sequence[Sensor] = (),
        categories: Sequence[str] = CATEGORIES,
        range_borders_m: Sequence[float] = RANGE_BORDERS_M,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        cameras = {sensor.name: sensor.counts_as for sensor in sensors if isinstance(sensor, CameraSensor)}
        strata = ObjectStrata(categories, range_borders_m)
        given = {"range_m": strata.range_borders_m[-1], "constants": dict(CONSTANTS), "cameras": sorted(cameras)}
        ratios = [
            said(form + name, "nats", "objects", lower_is_better=True, **given)
            for form in ("perception_entropy", "perception_entropy_bounded")
            for name in strata.names
        ]
        super().__init__(ratios, {**strata.meaning, "cameras": tuple(sorted(cameras.items()))}, **kwargs)
        self.strata = strata
        self.cameras = cameras

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        sigma = self._sigma(frame, rig_of(frame, self.rig))
        members = self.sights.members(frame, self.strata).to(sigma.device)
        values = torch.stack([entropy(sigma), entropy(sigma, bounded=True)])
        count = members.sum(dim=1).repeat(2)
        return count, (values @ members.T).flatten(), count.long()

    def _sigma(self, frame: Frame, rig: str) -> Tensor:
        if not self.cameras:
            return standard_deviation(self.sights.hits(frame, rig), "lidar")
        boxes, measurements = self.sights.boxes(frame), dict[str, Tensor]()
        for name, cloud in frame.clouds_by_sensor(rig, within_m=MEASURED_WITHIN_M).items():
            kind = "camera" if name in self.cameras else "lidar"
            of_sensor = self.cameras.get(name, 1) * count_in_boxes(cloud, boxes)
            measurements[kind] = measurements.get(kind, torch.zeros_like(of_sensor)) + of_sensor
        return late_fusion([standard_deviation(count, kind) for kind, count in measurements.items()])
