"""What a rig is scored by: detection in some regions and height bands."""

from collections.abc import Mapping
from typing import Annotated, NamedTuple

from pydantic import Field, NonNegativeFloat

from torchcover.coverage import Region
from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.simulation import Document
from torchcover.simulation.regions_of_interest import RegionOfInterest

Name = Annotated[str, Field(min_length=1)]


class Question(NamedTuple):
    """A number of one region in one band: the detection within `threshold_m`."""

    threshold_m: float
    band: str
    region: str


class Objective(Document):
    """The mean of the detection over some regions and height bands, each weighing the same. Higher is better.

    Args:
        detection: Threshold in metres: a reference point with a point of the rig within it counts as detected.
        band: Name of a height band of the paper, "ground" or "obstacle", or several.
        region: Name of a region, or several, as tables of `torchcover.evaluate` call them: "20m", "80m", "160m" ahead,
            "front_3m", "rear_3m", "left_3m", "right_3m" around the vehicle; or regions of one's own by name, written as
            those in a YAML file of `RegionsOfInterest`.

    Example:
        >>> far = Objective(detection=0.4, band=["ground", "obstacle"], region="80m")
        >>> [(each.band, each.region) for each in far.questions]
        [('ground', '80m'), ('obstacle', '80m')]
        >>> Objective(region={"behind": {"x_m": [-10.0, -3.0], "y_m": [-2.0, 2.0]}}).questions[0].region
        'behind'
    """

    detection: NonNegativeFloat = 0.4
    band: Name | tuple[Name, ...] = tuple(PAPER_HEIGHTS)
    region: (
        Name
        | Annotated[tuple[Name, ...], Field(min_length=1)]
        | Annotated[dict[Name, RegionOfInterest], Field(min_length=1)]
    )

    @property
    def questions(self) -> tuple[Question, ...]:
        """What it is the mean of."""
        bands = (self.band,) if isinstance(self.band, str) else self.band
        regions = (self.region,) if isinstance(self.region, str) else tuple(self.region)
        return tuple(Question(self.detection, band, region) for region in regions for band in bands)

    def regions(self, usual: Mapping[str, Region]) -> tuple[Region, ...]:
        """Its regions.

        Args:
            usual: Those that have names of their own.

        Raises:
            ValueError: One is called by a name that none of these has.
        """
        if isinstance(self.region, dict):
            return tuple(region.called(name) for name, region in self.region.items())
        names = (self.region,) if isinstance(self.region, str) else self.region
        if unknown := [name for name in names if name not in usual]:
            raise ValueError(f"region {unknown[0]!r}: one of {', '.join(usual)} is needed, or {{name: {{x_m, y_m}}}}")
        return tuple(usual[name] for name in names)
