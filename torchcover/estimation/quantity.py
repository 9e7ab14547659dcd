"""What a number is: its one key, its title, its unit, and which direction is better."""

from typing import NamedTuple, TypeAlias

# "m" is metres, "m2" their squares, "sensors" a number of them, "nats" an entropy, ...; a "share" lies in [0, 1], and
# tables and maps show it in percent.
Unit: TypeAlias = str


# No dataclass, as no part of a `Number` is: torchmetrics goes through what `compute` gives, and refuses frozen ones.
class Quantity(NamedTuple):
    """What a number, or every cell of a map, is.

    Args:
        key: Its name in files, dicts and loggers; with `_error` behind it, that of its standard error.
        title: What tables and maps call it, without its unit.
        unit: "m", "share" for a number in [0, 1], "sensors", "nats", ...
        lower_is_better: Whether less of it is better. Nothing else decides the direction of a number.

    Example:
        >>> Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True).gain(-0.1)
        0.1
    """

    key: str
    title: str
    unit: Unit
    lower_is_better: bool

    def gain(self, difference: float) -> float:
        """A difference of two of them with the sign turned so that more is better."""
        return -difference if self.lower_is_better else difference
