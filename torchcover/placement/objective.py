"""An objective: which share of what counts as seen."""

from pydantic import PositiveFloat

from torchcover.simulation import Document


class Objective(Document):
    """A number of a rig that a search makes larger: the mean detection over bands and regions.

    Args:
        detection: Threshold in metres.
        band: Height band, or several.
        region: Region, or several.
    """

    detection: PositiveFloat = 0.4
    band: str | tuple[str, ...] = ("ground", "obstacle")
    region: str | tuple[str, ...]
