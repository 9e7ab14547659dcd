"""Regions: named rectangles of cells that a number is given for."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from torchcover.coverage.grid import BevGrid


@dataclass(frozen=True)
class Region:
    """A rectangle in the vehicle frame, half-open on both axes. A cell belongs to it if its centre does.

    Args:
        name: What tables and loggers call it.
        x: Lower and upper bound forward, in metres.
        y: Lower and upper bound to the left, in metres.

    Raises:
        ValueError: No name, or bounds that are inverted or not finite.

    Example:
        >>> Region("rear", x=(-10.0, -2.5), y=(-2.5, 2.5)).mask(BevGrid(x=(-10.0, 10.0), y=(-5.0, 5.0), cell=0.5)).sum()
        tensor(150)
    """

    name: str
    x: tuple[float, float]
    y: tuple[float, float]

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("a region needs a name")
        for axis, (low, high) in (("x", self.x), ("y", self.y)):
            if not (-float("inf") < low < high < float("inf")):
                raise ValueError(f"region {self.name!r}: {axis} needs finite bounds, lower first; got {(low, high)}")

    def mask(self, grid: BevGrid) -> Tensor:
        """(Y, X) bool: the cells of the grid that belong to the region.

        Raises:
            ValueError: The region reaches beyond the grid, so that its number would be about something smaller.
        """
        for axis, region, bounds in (("x", self.x, grid.x), ("y", self.y, grid.y)):
            if region[0] < bounds[0] or region[1] > bounds[1]:
                raise ValueError(
                    f"region {self.name!r} spans {axis} = {region[0]:g} to {region[1]:g} m, beyond the grid's "
                    f"{bounds[0]:g} to {bounds[1]:g} m; enlarge the grid or leave the region out"
                )
        x, y = grid.x_centres_m, grid.y_centres_m
        return ((y >= self.y[0]) & (y < self.y[1]))[:, None] & ((x >= self.x[0]) & (x < self.x[1]))


def check_regions(regions: Sequence[Region], grid: BevGrid) -> None:
    """Refuse regions that no number of a grid can be given for.

    Raises:
        ValueError: One reaches beyond the grid, or holds no cell centre.
    """
    for region in regions:
        if not region.mask(grid).any():
            raise ValueError(f"region {region.name!r} holds no cell centre; use smaller cells than {grid.cell:g} m")


def regions_within(grid: BevGrid) -> tuple[Region, ...]:
    """Those of the paper's regions that the grid holds.

    Example:
        >>> [region.name for region in regions_within(BevGrid(x=(0.0, 100.0), y=(-40.0, 40.0)))]
        ['20m', '80m']
    """
    return tuple(
        region
        for region in forward_regions()
        if grid.x[0] <= region.x[0]
        and region.x[1] <= grid.x[1]
        and grid.y[0] <= region.y[0]
        and region.y[1] <= grid.y[1]
    )


def forward_regions(ranges: Sequence[float] = (20.0, 80.0, 160.0)) -> tuple[Region, ...]:
    """The paper's regions in front of the vehicle: x in [0, R), y in [-R/4, R/4).

    Args:
        ranges: R of each region in metres.

    Returns:
        One region a range, named after it: "20m", "80m", ...

    Example:
        >>> forward_regions((20,))
        (Region(name='20m', x=(0.0, 20.0), y=(-5.0, 5.0)),)
    """
    return tuple(Region(f"{reach:g}m", (0.0, float(reach)), (-reach / 4, reach / 4)) for reach in ranges)
