"""The weather of a scenario: what it takes from the light on its way, and from the road."""

from typing import ClassVar, Literal

from pydantic import NonNegativeFloat, PositiveFloat

from torchcover.simulation.documents import BuiltIn
from torchcover.simulation.returns import extinction_per_m


class Weather(BuiltIn):
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

    folder: ClassVar[str] = "weather"

    name: str = "weather"
    description: str = ""
    visibility_m: PositiveFloat | None = None
    rain_mm_h: NonNegativeFloat = 0.0
    road: Literal["dry", "wet"] = "dry"

    @property
    def extinction_per_m(self) -> float:
        """Of light on its way through the air, one way."""
        return extinction_per_m(self.visibility_m, self.rain_mm_h)


CLEAR = Weather(name="clear")
