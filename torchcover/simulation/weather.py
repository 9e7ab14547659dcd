"""The weather of a scenario: what it takes from the light on its way, and from the road."""

from pathlib import Path
from typing import Literal, Self

from pydantic import NonNegativeFloat, PositiveFloat

from torchcover.simulation.documents import Document, load_document
from torchcover.simulation.returns import extinction_per_m


class Weather(Document):
    """What the air and the road are like.

    Args:
        name: What tables call it.
        description: What it is, and where its numbers come from.
        visibility_m: How far one sees in fog: the meteorological optical range, 5 % of contrast. None if it is clear.
        rain_mm_h: Rate of the rain.
        road: A wet one mirrors light ahead, as the material `wet_road`.

    Example:
        >>> Weather.load("fog_100m").extinction_per_m > Weather.load("rain_50mm_h").extinction_per_m
        True
    """

    name: str = "weather"
    description: str = ""
    visibility_m: PositiveFloat | None = None
    rain_mm_h: NonNegativeFloat = 0.0
    road: Literal["dry", "wet"] = "dry"

    @classmethod
    def load(cls, path_or_name: str | Path) -> Self:
        """Read a weather from a YAML file, or a built-in one by its name.

        Raises:
            FileNotFoundError: No such file or name.
            ValueError: The file is not a weather.
        """
        return load_document(cls, "weather", path_or_name)

    @property
    def extinction_per_m(self) -> float:
        """Of light on its way through the air, one way."""
        return extinction_per_m(self.visibility_m, self.rain_mm_h)


CLEAR = Weather(name="clear")
