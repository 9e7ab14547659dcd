"""Objectives of a placement search: numbers of a rig that it maximizes or minimizes."""

import math
import re
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Literal, Self

import torch
from pydantic import Field, NonNegativeFloat, model_validator

from torchcover.coverage import Region
from torchcover.coverage.grid import PAPER_HEIGHTS
from torchcover.estimation import Estimate, Quantity
from torchcover.evaluation.requirements import AnyRequirement, RegionRequirement, Requirements
from torchcover.evaluation.requirements_check import check
from torchcover.evaluation.target_visibility import build_flat_ground
from torchcover.evaluation.verdicts import Verdict
from torchcover.simulation import Document, Rig, Scenario
from torchcover.simulation.regions_of_interest import RegionOfInterest

NonEmptyName = Annotated[str, Field(min_length=1)]

DEFAULT_THRESHOLD_M = 0.4  # of the paper


def check_requirements(
    rig: Rig, requirements: Requirements, scenario: Scenario, sensor_model: Literal["ideal", "real"] | None
) -> Sequence[Verdict]:
    """Check requirements of targets and encounters for a rig, on flat ground or in the scenario of the requirements.

    Args:
        rig: The rig.
        requirements: Requirements of targets and encounters.
        scenario: Scenario whose ego vehicle carries the rig.
        sensor_model: "ideal", "real", or None for the model of the rig.
    """
    ego: Any = scenario.ego
    test_scenario = requirements.scenario or build_flat_ground().model_copy(update={"ego": ego})
    vehicle = getattr(ego.shape, "vehicle", None)
    (verdicts,) = check(rig, requirements, test_scenario, vehicle=vehicle, sensor_model=sensor_model).verdicts.values()
    return verdicts


class Objective(Document):
    """Number of a rig to optimize: the mean over regions and height bands with equal weights.

    The number itself defines whether more or less of it is better.

    Args:
        number: Key of the number: "radius_m", "detection_0.4m"; "cells_radius_m" averages over observed cells even if
            the search averages by area; "radius_maximum_m" of an aggregation; "detected_by_two_0.4m" or
            "detection_0.4m_without_roof" of redundancy, where "any" stands for the sensor whose failure is worst.
        threshold_m: Threshold in meters of the number `detection_*m`; 0.4 if no number is given.
        band: Height band of the paper, "ground" or "obstacle", or several; both by default.
        region: Region of `torchcover.evaluate`, or several: "20m", "80m", "160m" ahead, "front_3m", "rear_3m",
            "left_3m", "right_3m" around the vehicle; or custom regions by name, as in `RegionsOfInterest`.
        requirement: Instead of the other arguments, a requirement of targets or encounters with one bound, as in
            `Requirements`; the number is the share of positions or encounters that meet it.

    Example:
        >>> far = Objective(threshold_m=0.4, band=["ground", "obstacle"], region="80m")
        >>> far.key, far.region_bands
        ('detection_0.4m', (('80m', 'ground'), ('80m', 'obstacle')))
        >>> rear = {"rear": {"x_m": [-10.0, -3.0], "y_m": [-2.0, 2.0]}}
        >>> Objective(number="radius_m", region=rear).region_bands[0]
        ('rear', 'ground')
        >>> child = {"target": "child", "positions": {"within_m": 3.0, "sides": ["front"]}, "points": 5}
        >>> Objective(requirement=child).description
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
    def _check_keys(self) -> Self:
        """Check that an objective has either a requirement or a valid number of regions."""
        if self.requirement is not None:
            return self._check_requirement()
        if self.number is not None and self.threshold_m is not None:
            raise ValueError(f"number, threshold_m: got {self.number!r} and {self.threshold_m:g}; give one of the two")
        if self.region is None:
            raise ValueError(f"region: {self.key!r} needs one; add it")
        return self

    def _check_requirement(self) -> Self:
        """Check that a requirement can be scored by the share of positions or encounters that meet it."""
        requirement = self.requirement
        if unused := sorted(self.model_fields_set - {"requirement"}):
            raise ValueError(f"requirement: it needs no other keys; remove {', '.join(unused)}")
        if isinstance(requirement, RegionRequirement):
            raise ValueError("requirement: got one of a region; give number, band and region instead")
        if requirement is not None and len(requirement.bounds) > 1:
            bounds = ", ".join(bound.text for bound in requirement.bounds)
            raise ValueError(f"requirement: got {bounds}; give one bound")
        if isinstance(positions := getattr(requirement, "positions", None), str):
            raise ValueError(
                f"requirement.positions: got the name {positions!r}; give the positions, as in within_m: 3"
            )
        return self

    def compute_met_share(
        self, rig: Rig, scenario: Scenario, sensor_model: Literal["ideal", "real"] | None
    ) -> Estimate:
        """Compute the share of positions or encounters that meet the requirement.

        Args:
            rig: The rig.
            scenario: Scenario whose ego vehicle carries the rig.
            sensor_model: "ideal", "real", or None for the model of the rig.

        Returns:
            The share without blocks; NaN if the target has no free position.
        """
        requirements = Requirements.model_validate({"requirements": [self.requirement]})
        (verdict,) = check_requirements(rig, requirements, scenario, sensor_model)
        share = math.nan
        if verdict.total_count:
            met_count = verdict.total_count - verdict.not_met_count - verdict.undecided_count
            share = met_count / verdict.total_count
        quantity = Quantity(self.key, self.description, "share", lower_is_better=False)
        return Estimate.from_values([quantity], torch.tensor([share], dtype=torch.float64, device="cpu"))

    @property
    def key(self) -> str:
        """Key of the number in results."""
        if self.requirement is not None:
            return "requirement"
        return self.number or f"detection_{DEFAULT_THRESHOLD_M if self.threshold_m is None else self.threshold_m:g}m"

    @property
    def description(self) -> str:
        """Description in one line.

        Example:
            >>> Objective(region="80m").description
            '80m'
            >>> Objective(number="radius_m", region="20m", band="ground").description
            'radius_m, 20m, ground'
        """
        if self.requirement is not None:
            return f"{self.requirement.text}, {self.requirement.bounds[0].text}"
        number = [] if self.key == f"detection_{DEFAULT_THRESHOLD_M:g}m" else [self.key]
        bands = (self.band,) if isinstance(self.band, str) else self.band or ()
        return ", ".join([*number, *self._region_names, *bands])

    @property
    def parts(self) -> "tuple[Objective, ...]":
        """Objectives of each region and band, whose mean is this objective."""
        parts = []
        for name, band in self.region_bands:
            region = {name: self.region[name]} if isinstance(self.region, dict) else name
            parts.append(Objective(number=self.key, band=band, region=region))
        return tuple(parts)

    @property
    def fixed_average(self) -> str:
        """Average of the number if the search does not choose it.

        Returns:
            "cells" for a number over observed cells, "-" for an aggregation or a requirement, otherwise empty.

        Example:
            >>> [Objective(number=key, region="20m").fixed_average for key in ("cells_radius_m", "radius_maximum_m")]
            ['cells', '-']
        """
        if self.key.startswith("cells_"):
            return "cells"
        has_both_averages = re.match(r"(radius_m|(detection|sensors|detected_by_two)_[\d.]+m)(_without_|$)", self.key)
        return "" if has_both_averages else "-"

    @property
    def region_bands(self) -> tuple[tuple[str, str], ...]:
        """Pairs of region and band that the number is the mean over; empty for a requirement."""
        bands = (self.band,) if isinstance(self.band, str) else tuple(PAPER_HEIGHTS) if self.band is None else self.band
        return tuple(product(self._region_names, bands))

    @property
    def _region_names(self) -> tuple[str, ...]:
        return (self.region,) if isinstance(self.region, str) else tuple(self.region or ())

    def resolve_regions(self, named_regions: Mapping[str, Region]) -> tuple[Region, ...]:
        """Return the regions of the number.

        Args:
            named_regions: Regions that can be given by name.

        Raises:
            ValueError: A region or band is unknown, or there is no band.
        """
        for _, band in self.region_bands:
            if band not in PAPER_HEIGHTS:
                raise ValueError(f"band {band!r}: give {' or '.join(repr(name) for name in PAPER_HEIGHTS)}")
        if not self.region_bands:
            raise ValueError("band: got none; give at least one")
        if isinstance(self.region, dict):
            return tuple(region.build_region(name) for name, region in self.region.items())
        names = dict.fromkeys(self._region_names)
        if unknown := [name for name in names if name not in named_regions]:
            raise ValueError(
                f"region {unknown[0]!r}: give one of {', '.join(named_regions)}, or {{name: {{x_m, y_m}}}}"
            )
        return tuple(named_regions[name] for name in names)
