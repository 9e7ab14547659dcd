"""What an aggregation is: its sums, how a step enters them, and the layers that they make."""

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
    """One quantity over the grid.

    Args:
        quantity: What the values are.
        values: (H, Y, X) float64 in the quantity's unit, or (C,) before it has the shape of the grid; NaN in a
            cell that no reference point ever probed.
    """

    quantity: Quantity
    values: Tensor


class SumState(NamedTuple):
    """A sum of an aggregation.

    Args:
        initial: (..., C) what it is before the first step; float64 or int64.
        reduction: How two of them become one: added up, or the larger of each entry.
    """

    initial: Tensor
    reduction: Literal["sum", "max"] = "sum"


class BinnedFrame(NamedTuple):
    """The reference points of one step, in those C cells that they lie in.

    Args:
        cell_indices: (N,) int64 which of the C cells each point lies in.
        values: (V, N) float64 of each point: its `radius`, then 1 for each threshold that it is within, or 0; then what
            there is to say of the sensors, if the metric knows them.
        weights: (N,) weight of each point; None if all weigh the same.
        cell_means: Of each value over the points of each cell.
    """

    cell_indices: Tensor
    values: Tensor
    weights: Tensor | None
    cell_means: CellMeans

    @property
    def radius(self) -> Tensor:
        """(N,) float64 blind spot radius in metres, at most `max_radius`."""
        return self.values[0]


@dataclass(frozen=True)
class Aggregation(ABC):
    """How the radii of a cell, point by point and step by step, become one number, or a few.

    It gives maps, and numbers of regions: a region in a height band is one large cell. The numbers have errors where
    all its states are added up. An aggregation is a frozen dataclass: its fields are part of what the sums of a metric
    mean. A new one is a class and a line in `AGGREGATIONS`; one with fields reads them in `parse` and `from_keys`.

    Attributes:
        name: Tells it from the others; its states begin with it.
        description: What it gives, in the plural, for what a run says that it left out.
        example: Its parameters as they are written behind its name; empty if it has none.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    example: ClassVar[str] = ""

    @classmethod
    def parse(cls, text: str) -> Self:
        """The one with these parameters, which are written as in `example`.

        Raises:
            ValueError: Others than it takes.
        """
        if text:
            raise ValueError(f"{cls.name} takes no parameters; leave out what is behind the colon")
        return cls()

    @classmethod
    def from_keys(cls, keys: AbstractSet[str]) -> Self | None:
        """The one that gives those of some numbers that this kind can give; None if there are none."""
        one = cls.parse("")
        return None if keys.isdisjoint(quantity.key for quantity in one.quantities) else one

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What it gives a map, and a number of each region of, whatever it has seen."""
        empty = {name: state.initial.clone() for name, state in self.create_states(1).items()}
        nothing = torch.zeros(1, dtype=torch.int64, device="cpu")
        return tuple(layer.quantity for layer in self.compute_layers(empty, nothing, math.inf))

    @abstractmethod
    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """The empty sums over so many cells, by name."""

    @abstractmethod
    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add a step to the empty sums over its cells, in place."""

    @abstractmethod
    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """What the sums say.

        Args:
            sums: The sums.
            observed_frames: (C,) steps that had a reference point in each cell.
            max_radius_m: Saturation of the radius in metres.

        Returns:
            Layers of (C,) values, which the metric gives the shape of the grid, or reads as the numbers of C regions;
            the same quantities whatever the sums.
        """
