"""The plane z = 1: the chart of pinhole and Brown-Conrady lenses. It ends where 90 degrees begin."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class PlaneChart:
    """a = x / z, b = y / z, for z > 0."""

    limit: float = torch.inf

    def draw(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points in front of the camera, drawn where their ray meets z = 1."""
        front = z > 0
        depth = torch.where(front, z, 1.0)  # a division by 0 behind the camera would put NaN into the gradients
        return x / depth, y / depth, front

    def lift(self, a: Tensor, b: Tensor) -> Tensor:
        """(a, b, 1), normalised."""
        norm = torch.sqrt(a * a + b * b + 1.0)
        return torch.stack((a / norm, b / norm, 1.0 / norm), dim=-1)
