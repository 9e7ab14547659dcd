"""Variables: what is free in a space, each a number or a choice, and where its values lie between 0 and 1."""

import math
from typing import NamedTuple

Value = float | str | bool
# Numbers are found on a grid of micrometres and millionths of a degree: a table of them can be read, and read back.
DECIMALS = 6


class FreeNumber(NamedTuple):
    """A number between two others, under the name of its sensor and key, as "roof.pitch_deg"."""

    name: str
    low: float
    high: float

    def at(self, u: float) -> float:
        """The value at a share of the way from the lowest to the highest. ValueError: it is not from 0 to 1."""
        _check_share(self.name, u)
        return min(max(round(self.low + u * (self.high - self.low), DECIMALS), self.low), self.high)

    def unit(self, value: Value) -> float:
        """The share of the way at which a value lies. ValueError: it lies outside."""
        if not self.holds(value):
            raise ValueError(f"{self.name}: a number from {self.low:g} to {self.high:g} is needed; got {value!r}")
        return (float(value) - self.low) / (self.high - self.low)

    def holds(self, value: object) -> bool:
        """Whether a value is a number in between."""
        return isinstance(value, int | float) and not isinstance(value, bool) and self.low <= value <= self.high


class FreeChoice(NamedTuple):
    """One of several options, between which there is nothing: each has an equal part of the way from 0 to 1."""

    name: str
    options: tuple[Value, ...]

    def at(self, u: float) -> Value:
        """The option in whose part a share from 0 to 1 lies. ValueError: the share is not from 0 to 1."""
        _check_share(self.name, u)
        return self.options[min(int(u * len(self.options)), len(self.options) - 1)]

    def unit(self, value: Value) -> float:
        """The middle of the part of an option. ValueError: it is none of them."""
        if not self.holds(value):
            raise ValueError(f"{self.name}: one of {', '.join(map(str, self.options))} is needed; got {value!r}")
        return (self.options.index(value) + 0.5) / len(self.options)

    def holds(self, value: object) -> bool:
        """Whether a value is one of them."""
        return any(value == option and type(value) is type(option) for option in self.options)


Variable = FreeNumber | FreeChoice


def _check_share(name: str, u: float) -> None:
    if not (math.isfinite(u) and 0.0 <= u <= 1.0):
        raise ValueError(f"{name}: a share from 0 to 1 is needed; got {u!r}")
