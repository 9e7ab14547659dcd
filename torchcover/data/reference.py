"""The reference sensor of a simulation, and what it is asked about."""

from torchcover.coverage import forward_regions
from torchcover.simulation import REFERENCE_SENSORS, ReferenceSensor

DEFAULT_REFERENCE = "surface"
# Holds the paper's regions, and the space beside and behind the vehicle.
GRID_X_M = (-40.0, 160.0)
GRID_Y_M = (-40.0, 40.0)


def reference_called(name: str | None = None, rays: int | None = None) -> ReferenceSensor:
    """A reference sensor by its name, asked about the paper's regions and the grid of `torchcover.evaluate`.

    Args:
        name: One of `torchcover.simulation.REFERENCE_SENSORS`; "surface" if not given.
        rays: About how many rays at each step; the sensor's own number if not given.

    Raises:
        ValueError: Another name, or too few rays.

    Example:
        >>> sensor = reference_called()
        >>> sensor.name, sensor.rays, sensor.weight_kind
        ('surface', 16384, 'm2')
    """
    kind = REFERENCE_SENSORS.get(DEFAULT_REFERENCE if name is None else name)
    if kind is None:
        raise ValueError(f"reference {name}: {' or '.join(f'`{known}`' for known in REFERENCE_SENSORS)} is needed")
    areas = (*((region.x, region.y) for region in forward_regions()), (GRID_X_M, GRID_Y_M))
    return kind.from_rays(areas, rays)
