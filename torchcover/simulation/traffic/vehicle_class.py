"""Which of our bodies stands for a road user of a class and a length, be it simulated or recorded."""

from collections.abc import Mapping
from typing import NamedTuple

from torchcover.files import road_user_classes

CARS = ("hatchback", "sedan", "suv", "pickup", "van")
ON_FOOT = ("adult", "child")
# They need no road, or one that is not built.
LEFT_OUT = frozenset({"rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car", "ship", "drone"})


class VehicleType(NamedTuple):
    """What is known of somebody: a class, by SUMO's names, and a length."""

    vehicle_class: str
    length_m: float

    def body(self, lengths_m: Mapping[str, float]) -> str | None:
        """The body whose length is nearest among those of the class; None if there is none of this class."""
        if self.vehicle_class in LEFT_OUT:
            return None
        kinds = road_user_classes()["bodies"].get(self.vehicle_class, CARS)
        if kinds[0] in ON_FOOT:
            return str(kinds[0])  # the simulation's lengths of people are all the same
        bodies = [name for name in lengths_m if name.partition("_")[0] in kinds]
        return min(bodies, key=lambda kind: abs(lengths_m[kind] - self.length_m))
