"""Maximum: worst case of a cell."""

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
    """Largest radius of any point in any frame."""

    name: ClassVar[str] = "maximum"
    description: ClassVar[str] = "maxima"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create `radius` (C,): largest radius, minus infinity before the first point."""
        initial = torch.full((num_cells,), -math.inf, dtype=torch.float64, device="cpu")
        return {"radius": SumState(initial, reduction="max")}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Update the largest radius of each cell."""
        sums["radius"].scatter_reduce_(0, frame.cell_indices, frame.radius, "amax")

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """Compute the layer of the largest radius; NaN in unobserved cells."""
        return [Layer(make_radius_quantity("maximum", "largest"), sums["radius"].where(observed_frames > 0, math.nan))]
