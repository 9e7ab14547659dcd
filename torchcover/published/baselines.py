"""What any metric has to beat: numbers of a rig that nobody needs a coverage metric for."""

import torch
from torch import Tensor

from torchcover.data import Frame
from torchcover.published.world_ratios import Ratio, WorldRatios
from torchcover.simulation import Rig


class Points(WorldRatios):
    """Mean number of points of a rig in a step.

    Args:
        rig: Whose clouds; those of the only rig if not given.

    Example:
        >>> points = Points()
        >>> points.update(Frame({"rig": torch.zeros(5, 3)}, torch.zeros(1, 3), index=0, name="a"))
        >>> points.compute()[0].value
        5.0
    """

    def __init__(self, rig: str | None = None) -> None:
        super().__init__([Ratio("points", "points", higher_is_better=True, count_of="steps")], {}, rig)

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        cloud = frame.sensor if self.rig is None else frame.cloud_of(self.rig)
        return torch.ones(1), torch.tensor([len(cloud)]), torch.ones(1, dtype=torch.int64)


def mean_height_m(rig: Rig) -> float:
    """Mean height of a rig's sensors above the ground, in metres.

    Example:
        >>> mean_height_m(Rig.load("place3d2024_center"))
        2.5
    """
    return round(sum(sensor.mount.z_m for sensor in rig.sensors) / len(rig.sensors), 6)


def rays(rig: Rig) -> int:
    """How many rays a rig casts in a step.

    Example:
        >>> rays(Rig.load("place3d2024_center"))
        16000
    """
    return sum(sensor.rays for sensor in rig.sensors)
