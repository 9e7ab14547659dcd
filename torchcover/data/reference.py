"""The reference sensor of a simulation, and what it is asked about."""

from torchcover.coverage import forward_regions
from torchcover.simulation import REFERENCE_SENSORS, ReferenceSensor, SurfaceReference
from torchcover.simulation.reference_sensor import Areas

DEFAULT_REFERENCE = "surface"
# Holds the paper's regions, and the space beside and behind the vehicle.
GRID_X_M = (-40.0, 160.0)
GRID_Y_M = (-40.0, 40.0)
# With so many points on an object, of which half are seen, its visibility has a standard error of 0.09 at most.
OBJECT_POINTS = 64


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
    return kind.from_rays(_areas(), rays)


def reference_of_objects() -> SurfaceReference:
    """The default reference sensor with 64 points for each object in range: one that knows how visible they are.

    Example:
        >>> reference_of_objects().object_points
        64
    """
    return SurfaceReference(_areas(), object_points=OBJECT_POINTS)


def _areas() -> Areas:
    return (*((region.x, region.y) for region in forward_regions()), (GRID_X_M, GRID_Y_M))
