"""Interface of aggregations: sums, their update by a frame, and the layers that they give."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Self

import torch
from torch import Tensor

from torchcover.coverage.binning import CellMeans
from torchcover.estimation import Quantity


class Layer(NamedTuple):
    """Map of one quantity.

    Args:
        quantity: Meaning of the values.
        values: (H, Y, X) float64 in the unit of the quantity, or (C,) before expansion to the grid; NaN in unobserved
            cells.
    """

    quantity: Quantity
    values: Tensor


class SumState(NamedTuple):
    """Sum of an aggregation.

    Args:
        initial: (..., C) value before the first frame; float64 or int64.
        reduction: Merge of two sums: addition, or the larger of each entry.
    """

    initial: Tensor
    reduction: Literal["sum", "max"] = "sum"


class BinnedFrame(NamedTuple):
    """Reference points of one frame in the C cells that contain them.

    Args:
        cell_indices: (N,) int64 position of the cell of each point among the C cells.
        values: (V, N) float64 values of each point: its `radius`, then 1 for each threshold that the radius does not
            exceed, or 0; then values of redundancy if the metric distinguishes sensors.
        weights: (N,) weight of each point; None if all points weigh the same.
        cell_means: Mean of each value over the points of each cell.
    """

    cell_indices: Tensor
    values: Tensor
    weights: Tensor | None
    cell_means: CellMeans

    @property
    def radius(self) -> Tensor:
        """(N,) float64 blind spot radius in meters, at most the maximum radius."""
        return self.values[0]


@dataclass(frozen=True)
class Aggregation(ABC):
    """Reduction of the radii of a cell, over points and frames, to one or a few numbers.

    An aggregation gives maps, and numbers of regions, since a region in a height band is one large cell. The numbers
    have errors if all its sums are additive. An aggregation is a frozen dataclass whose fields define the meaning of
    the sums of a metric. A new one is a class and an entry in `AGGREGATIONS`; with fields, it overrides `parse` and
    `from_keys`.

    Attributes:
        name: Unique name, the prefix of its sums.
        description: Plural noun for its results, for messages about omissions.
        example: Example of its parameters after the colon; empty without parameters.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    example: ClassVar[str] = ""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Create the aggregation from its parameters.

        Args:
            text: Parameters in the format of `example`.

        Raises:
            ValueError: The parameters are invalid.
        """
        if text:
            raise ValueError(f"{cls.name} takes no parameters; leave out what is behind the colon")
        return cls()

    @classmethod
    def from_keys(cls, keys: AbstractSet[str]) -> Self | None:
        """Create the aggregation that gives some numbers.

        Args:
            keys: Keys of numbers; keys of other aggregations are ignored.

        Returns:
            None if no key belongs to this class.
        """
        aggregation = cls.parse("")
        own_keys = {quantity.key for quantity in aggregation.quantities}
        return None if keys.isdisjoint(own_keys) else aggregation

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities of its layers and of the numbers of each region."""
        sums = {name: state.initial.clone() for name, state in self.create_states(1).items()}
        observed_frames = torch.zeros(1, dtype=torch.int64, device="cpu")
        return tuple(layer.quantity for layer in self.compute_layers(sums, observed_frames, math.inf))

    @abstractmethod
    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create the initial sums.

        Args:
            num_cells: Number C of cells.

        Returns:
            Sums by name.
        """

    @abstractmethod
    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add a frame to initial sums over its cells, in place.

        Args:
            sums: (..., C) sums by name.
            frame: Points of the frame in C cells.
        """

    @abstractmethod
    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """Compute the layers from the sums.

        Args:
            sums: (..., C) sums by name.
            observed_frames: (C,) number of frames with a reference point in each cell.
            max_radius_m: Radius in meters at which r saturates.

        Returns:
            Layers of (C,) values over cells or regions; their quantities do not depend on the sums.
        """
