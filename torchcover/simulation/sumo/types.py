"""Which of our bodies stands for a type of SUMO."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from torchcover.files import feed_xml, reads
from torchcover.simulation.traffic.vehicle_class import VehicleType

PIECE_BYTES = 1 << 18

# What SUMO takes for the length of a type that has none.
USUAL_LENGTH_M = {
    "pedestrian": 0.215, "bicycle": 1.6, "scooter": 1.2, "moped": 2.1, "motorcycle": 2.2, "truck": 7.1,
    "trailer": 16.5, "bus": 12.0, "coach": 14.0, "tram": 22.0, "delivery": 6.5, "emergency": 6.5,
}  # fmt: skip
CAR_LENGTH_M = 5.0
# In floating car data alone a type is but a name.
WORDS = (
    ("ped", "pedestrian"), ("person", "pedestrian"), ("motorcycle", "motorcycle"), ("moped", "moped"),
    ("bike", "bicycle"), ("bicycle", "bicycle"), ("cycl", "bicycle"), ("bus", "bus"), ("coach", "coach"),
    ("truck", "truck"), ("trailer", "trailer"), ("lorry", "truck"), ("tram", "tram"), ("rail", "rail"),
    ("train", "rail"), ("subway", "subway"), ("ship", "ship"), ("van", "delivery"), ("delivery", "delivery"),
)  # fmt: skip


def type_of(name: str, on_foot: bool, known: Mapping[str, VehicleType]) -> VehicleType:
    """A type by its name: one that is known, else what its name says.

    Example:
        >>> type_of("DEFAULT_BIKETYPE", False, {}).vehicle_class
        'bicycle'
    """
    if on_foot:  # all have one class, and the same length
        return VehicleType("child" if "child" in name.lower() else "pedestrian", USUAL_LENGTH_M["pedestrian"])
    if name in known:
        return known[name]
    vehicle_class = next((found for word, found in WORDS if word in name.lower()), "passenger")
    return VehicleType(vehicle_class, USUAL_LENGTH_M.get(vehicle_class, CAR_LENGTH_M))


@reads("routes of SUMO")
def read_types(path: Path) -> dict[str, VehicleType]:
    """The types that a file of routes declares.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: Not XML, entities, or a length that is no positive number.
    """
    found: dict[str, VehicleType] = {}

    def start(name: str, names_and_values: list[str]) -> None:
        attributes = dict(zip(names_and_values[::2], names_and_values[1::2], strict=True))
        if name == "vType" and "id" in attributes:
            vehicle_class = attributes.get("vClass", "passenger")
            length_m = float(attributes.get("length", USUAL_LENGTH_M.get(vehicle_class, CAR_LENGTH_M)))
            if not length_m > 0:
                raise ValueError(f"type {attributes['id']!r}: a positive length is needed; got {length_m:g}")
            found[attributes["id"]] = VehicleType(vehicle_class, length_m)

    with path.open("rb") as file:
        feed_xml(iter(lambda: file.read(PIECE_BYTES), b""), start)
    return found


def types_of(paths: Sequence[Path]) -> dict[str, VehicleType]:
    """The types that several files declare together."""
    return {name: found for path in paths for name, found in read_types(path).items()}
