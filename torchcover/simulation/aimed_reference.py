"""The reference sensor of a simulation, and what it is asked about."""

from torchcover.simulation.kinds import REFERENCE_SENSORS
from torchcover.simulation.reference_sensor import ReferenceSensor
from torchcover.simulation.regions_of_interest import Asked, RegionsOfInterest
from torchcover.simulation.surface_reference import SurfaceReference

DEFAULT_REFERENCE = "surface"
# With so many points on an object, of which half are seen, its visibility has a standard error of 0.09 at most.
OBJECT_POINTS = 64


def reference_called(name: str | None = None, rays: int | None = None, asked: Asked | None = None) -> ReferenceSensor:
    """A reference sensor by its name, aimed at what is asked about.

    Args:
        name: One of `torchcover.simulation.REFERENCE_SENSORS`; "surface" if not given.
        rays: About how many rays at each step; the sensor's own number if not given.
        asked: Regions, height bands and grid, as `RegionsOfInterest.around` gives them; those of `torchcover.evaluate`
            without the near field, for the vehicle is unknown, if not given.

    Raises:
        ValueError: Another name, or too few rays.

    Example:
        >>> sensor = reference_called()
        >>> sensor.name, sensor.rays, sensor.square_metres
        ('surface', 16384, True)
    """
    kind = REFERENCE_SENSORS.get(DEFAULT_REFERENCE if name is None else name)
    if kind is None:
        raise ValueError(f"reference {name}: {' or '.join(f'`{known}`' for known in REFERENCE_SENSORS)} is needed")
    asked = asked or RegionsOfInterest().around()
    return kind.from_rays(asked.areas, rays, asked.bands_m)


def reference_of_objects(asked: Asked | None = None) -> SurfaceReference:
    """The default reference sensor with 64 points for each object in range: one that knows how visible they are.

    Args:
        asked: As in `reference_called`.

    Example:
        >>> reference_of_objects().object_points
        64
    """
    asked = asked or RegionsOfInterest().around()
    return SurfaceReference(asked.areas, bands_m=asked.bands_m, object_points=OBJECT_POINTS)
