"""What surfaces are made of, as far as a LiDAR can tell."""

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, NonNegativeFloat

from torchcover.simulation.documents import Document, load_document


class Material(Document):
    """A surface, as light of 905 nm meets it.

    Args:
        name: What a body's `material` calls it.
        description: What it is, and where its numbers come from.
        reflectivity: Share of light that a white, rough surface would return, 0 to 1: the median. `retroreflective`:
            it sends light back to where it came from, and always returns.
        incidence_exponent: k; what returns falls as the cosine of the incidence to the power of k. 1 is Lambert's law.
        spread: Standard deviation of ln reflectivity.
        varies_by: Whether that is between places, drawn for each ray, or between bodies, so that a dark one is dark all
            over.

    Example:
        >>> Material.load("road").incidence_exponent
        0.2
    """

    name: str
    description: str = ""
    reflectivity: Annotated[float, Field(ge=0.0, le=1.0)] | Literal["retroreflective"]
    incidence_exponent: NonNegativeFloat = 1.0
    spread: NonNegativeFloat = 0.0
    varies_by: Literal["place", "body"] = "place"

    @classmethod
    def load(cls, path_or_name: str | Path) -> Self:
        """Read a material from a YAML file, or a built-in one by its name.

        Raises:
            FileNotFoundError: No such file or name; the message has the nearest name.
            ValueError: The file is not a material.
        """
        return load_document(cls, "materials", path_or_name)

    @property
    def share(self) -> float:
        """The reflectivity as a number: infinite for a retroreflector."""
        return np.inf if self.reflectivity == "retroreflective" else float(self.reflectivity)
