"""One number of a metric that others published, with all that decides it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PublishedNumber:
    """What such a metric says of one rig.

    Args:
        name: With all that decides it: "object_coverage_0.4m_car", "lob_30m".
        value: NaN if it is unknown.
        unit: "share", "nats", "points", ...
        higher_is_better: As its authors say it.
        parameters: What it was computed with.
        count: How many it is over; 0 where the value is NaN.
        count_of: What these are: "objects", "voxels", ...
        standard_error: Over independent worlds (`Frame.place_in_time`); NaN with fewer than 8 of them.
        warning: What makes it unfit for a comparison, in words.

    Raises:
        ValueError: A value of nothing, or nothing known of something that was counted.

    Example:
        >>> PublishedNumber("k_cover_2_0.4m", 0.25, "share", True, {"threshold_m": 0.4}, 12, "m2").known
        True
    """

    name: str
    value: float
    unit: str
    higher_is_better: bool
    parameters: Mapping[str, Any]
    count: int
    count_of: str
    standard_error: float = math.nan
    warning: str | None = None

    def __post_init__(self) -> None:
        if math.isnan(self.value) != (self.count == 0):
            raise ValueError(
                f"{self.name}: a value goes with a count above 0, and NaN with 0; got {self.value} and {self.count}"
            )

    @property
    def known(self) -> bool:
        """Whether it has a value."""
        return self.count > 0
