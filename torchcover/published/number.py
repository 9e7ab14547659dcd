"""One number of a metric that others published, with all that decides it."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple


# No dataclass: torchmetrics goes through what `compute` gives, and refuses those that are frozen.
class PublishedNumber(NamedTuple):
    """What such a metric says of one rig.

    Args:
        name: With all that decides it: "lob_30m", "object_coverage_0.4m"; of a part of it ":car" is appended.
        value: NaN if it is unknown.
        unit: "share", "nats", "points", ...
        higher_is_better: As its authors say it.
        parameters: What it was computed with.
        count: How many it is over; 0 where the value is NaN.
        count_of: What these are: "objects", "voxels", ...
        standard_error: Over independent worlds (`Frame.place_in_time`); NaN with fewer than 8 of them.
        warning: What makes it unfit for a comparison, in words.

    Example:
        >>> PublishedNumber("k_cover_2_0.4m", 0.25, "share", True, {"threshold_m": 0.4}, 12, "m2").known
        True
    """

    name: str
    value: float
    unit: str
    higher_is_better: bool
    parameters: Mapping[str, Any]
    count: int  # type: ignore[assignment]  # hides tuple.count
    count_of: str
    standard_error: float = math.nan
    warning: str | None = None

    @property
    def known(self) -> bool:
        """Whether it has a value."""
        return self.count > 0

    @property
    def is_part(self) -> bool:
        """Whether it is about a part only of what another number is about: a category, a region."""
        return ":" in self.name
