"""A number of a result that a search makes better, as a space writes it."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import torch
from pydantic import Field, NonNegativeFloat, model_validator

from torchcover.coverage import Region
from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.estimation import Estimate, Quantity
from torchcover.evaluation.checking import check
from torchcover.evaluation.requirements import AnyRequirement, RegionRequirement, Requirements, Verdict
from torchcover.evaluation.target_survey import build_flat_ground
from torchcover.simulation import Document, Rig, Scenario
from torchcover.simulation.regions_of_interest import RegionOfInterest

NonEmptyName = Annotated[str, Field(min_length=1)]

THRESHOLD_M = 0.4
# Numbers by area or over known cells.
CHOSEN = re.compile(r"(radius_m|(detection|sensors|make_redundancy_quantity)_[\d.]+m)(_without_|$)")


def check_requirements(
    rig: Rig, requirements: Requirements, scenario: Scenario, sensor_model: Literal["ideal", "real"] | None
) -> Sequence[Verdict]:
    """Check requirements of targets and encounters for a rig on the ego of a world, in free space or their scenario."""
    ego: Any = scenario.ego
    where = requirements.scenario or build_flat_ground().model_copy(update={"ego": ego})
    vehicle = getattr(ego.shape, "vehicle", None)
    (found,) = check(rig, requirements, where, vehicle=vehicle, sensor_model=sensor_model).verdicts.values()
    return found


class Objective(Document):
    """A number of a rig that is made better: a mean over some regions and height bands, each weighing the same.

    Args:
        number: "radius_m", "detection_0.4m"; "cells_radius_m" over known cells whatever the search is by;
            "radius_maximum_m" of an aggregation; "seen_by_two_0.4m" or "detection_0.4m_without_roof" of redundancy,
            where "any" stands for the sensor whose failure is worst. Whether more or less of it is better, it knows
            itself.
        threshold_m: Threshold in metres, in short for the number `detection_0.4m`: a reference point with a point of the
            rig within it counts as detected. 0.4 if no number is given.
        band: Name of a height band of the paper, "ground" or "obstacle", or several; both if not given.
        region: Name of a region, or several, as tables of `torchcover.evaluate` call them: "20m", "80m", "160m" ahead,
            "front_3m", "rear_3m", "left_3m", "right_3m" around the vehicle; or regions of one's own by name, written as
            those in a YAML file of `RegionsOfInterest`.
        requirement: Instead of all these one number that is required of a body at places, written out, or in encounters,
            as in `Requirements`: made better is the share of the places, or encounters, that keep it. It is measured
            there, the same in all worlds; what is not checked is not kept.

    Example:
        >>> far = Objective(detection=0.4, band=["ground", "obstacle"], region="80m")
        >>> far.key, far.places
        ('detection_0.4m', (('80m', 'ground'), ('80m', 'obstacle')))
        >>> Objective(number="radius_m", region={"behind": {"x_m": [-10.0, -3.0], "y_m": [-2.0, 2.0]}}).places[0][0]
        'behind'
        >>> Objective(requires={"target": "child", "at": {"within_m": 3.0, "sides": ["front"]}, "points": 5}).words
        "child_110cm, within_m 3.0 sides ['front'], points >= 5"
    """

    number: NonEmptyName | None = None
    threshold_m: NonNegativeFloat | None = None
    band: NonEmptyName | tuple[NonEmptyName, ...] | None = None
    region: (
        NonEmptyName
        | Annotated[tuple[NonEmptyName, ...], Field(min_length=1)]
        | Annotated[dict[NonEmptyName, RegionOfInterest], Field(min_length=1)]
        | None
    ) = None
    requirement: AnyRequirement | None = None

    @model_validator(mode="after")
    def _check_one_of(self) -> Self:
        if self.requirement is not None:
            return self._check_requires()
        if self.number is not None and self.threshold_m is not None:
            raise ValueError(f"number, detection: one of the two is possible; got {self.number!r} and a threshold")
        if self.region is None:
            raise ValueError(f"region: it is needed for {self.key!r}")
        return self

    def _check_requires(self) -> Self:
        one = self.requirement
        if others := sorted(self.model_fields_set - {"requires"}):
            raise ValueError(f"requires: it makes an objective alone; leave out {', '.join(others)}")
        if isinstance(one, RegionRequirement):
            raise ValueError("requires: of a region give its number, band and region instead")
        if one is not None and len(one.bounds) > 1:
            raise ValueError(f"requires: one number is needed; got {', '.join(each.text for each in one.bounds)}")
        if isinstance(at := getattr(one, "at", None), str):
            raise ValueError(f"requires.at: write the place out, as in within_m: 3; got the name {at!r}")
        return self

    def compute_met_share(
        self, rig: Rig, scenario: Scenario, sensor_model: Literal["ideal", "real"] | None
    ) -> Estimate:
        """Of what `requires` asks about, in no blocks; NaN if it is nowhere, as no body has room."""
        (one,) = check_requirements(
            rig, Requirements.model_validate({"requirements": [self.requirement]}), scenario, sensor_model
        )
        share = (
            (one.total_count - one.not_met_count - one.undecided_count) / one.total_count
            if one.total_count
            else math.nan
        )
        quantity = Quantity(self.key, self.description, "share", lower_is_better=False)
        return Estimate.from_values([quantity], torch.tensor([share], dtype=torch.float64, device="cpu"))

    @property
    def key(self) -> str:
        """Of its number."""
        if self.requirement is not None:
            return "requires"
        return self.number or f"detection_{THRESHOLD_M if self.threshold_m is None else self.threshold_m:g}m"

    @property
    def description(self) -> str:
        """In one line.

        Example:
            >>> Objective(region="80m").words, Objective(number="radius_m", region="20m", band="ground").words
            ('80m', 'radius_m, 20m, ground')
        """
        if self.requirement is not None:
            return f"{self.requirement.text}, {self.requirement.bounds[0].text}"
        plain = self.key == f"detection_{THRESHOLD_M:g}m"
        bands = (self.band,) if isinstance(self.band, str) else self.band or ()
        regions = (self.region,) if isinstance(self.region, str) else self.region or ()
        return ", ".join([*([] if plain else [self.key]), *regions, *bands])

    @property
    def parts(self) -> "tuple[Objective, ...]":
        """What it is the mean of: an objective for each region and band."""
        each = ((region, band, self.region) for region, band in self.region_bands)
        return tuple(
            Objective(number=self.key, band=band, region={name: own[name]} if isinstance(own, dict) else name)
            for name, band, own in each
        )

    @property
    def fixed_average(self) -> str:
        """What its number is a mean over where that is no choice.

        Returns:
            "cells" of a number over observed cells, "-" of an aggregation or what is required; else empty: "area" or
            "cells", as a search is asked.

        Example:
            >>> [Objective(number=key, region="20m").own_estimate for key in ("cells_radius_m", "radius_maximum_m")]
            ['known', '-']
        """
        if self.key.startswith("known_"):
            return "cells"
        return "" if CHOSEN.match(self.key) else "-"

    @property
    def region_bands(self) -> tuple[tuple[str, str], ...]:
        """The regions and bands that it is the mean over; none of what is required."""
        bands = (self.band,) if isinstance(self.band, str) else tuple(PAPER_HEIGHTS) if self.band is None else self.band
        regions = (self.region,) if isinstance(self.region, str) else tuple(self.region or ())
        return tuple((region, band) for region in regions for band in bands)

    def resolve_regions(self, named_regions: Mapping[str, Region]) -> tuple[Region, ...]:
        """Its regions.

        Args:
            named_regions: Those that have names of their own.

        Raises:
            ValueError: One is called by a name that none of these has; a band is none of the paper's, or there is none.
        """
        if unknown := [band for _, band in self.region_bands if band not in PAPER_HEIGHTS]:
            raise ValueError(f"band {unknown[0]!r}: {' or '.join(map(repr, PAPER_HEIGHTS))} is needed")
        if not self.region_bands:
            raise ValueError("band: at least one is needed")
        if isinstance(self.region, dict):
            return tuple(region.build_region(name) for name, region in self.region.items())
        names = dict.fromkeys(region for region, _ in self.region_bands)
        if unknown := [name for name in names if name not in named_regions]:
            raise ValueError(
                f"region {unknown[0]!r}: one of {', '.join(named_regions)} is needed, or {{name: {{x_m, y_m}}}}"
            )
        return tuple(named_regions[name] for name in names)
