"""The maximum: the worst case of a cell."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedFrame, Layer, SumState
from torchcover.coverage.quantities import make_radius_quantity


@dataclass(frozen=True)
class Maximum(Aggregation):
    """The largest radius of any point of any step."""

    name: ClassVar[str] = "maximum"
    description: ClassVar[str] = "maxima"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """`radius` (C,): the largest so far, minus infinity before the first."""
        return {
            "radius": SumState(torch.full((num_cells,), -math.inf, dtype=torch.float64, device="cpu"), reduction="max")
        }

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Keep what is larger."""
        sums["radius"].scatter_reduce_(0, frame.cell_indices, frame.radius, "amax")

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """The largest radius."""
        return [Layer(make_radius_quantity("maximum", "largest"), sums["radius"].where(observed_frames > 0, math.nan))]
