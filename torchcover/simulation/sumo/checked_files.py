"""Networks and routes for SUMO, checked: nothing in them may name a file to write or an address to connect to."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

from torchcover.files import feed_xml, reads

PIECE_BYTES = 1 << 18
# The elements of a network and of traffic demand. SUMO would take detectors, calibrators, rerouters, timed events and
# inclusions from the same files.
DEMAND = (
    "routes|additional|vType|vTypeDistribution|route|routeDistribution|vehicle|trip|flow|interval|stop|person|"
    "personFlow|personTrip|walk|ride|container|containerFlow|transport|tranship"
)
ELEMENTS = {
    "network": re.compile(
        "net|location|type|restriction|edge|lane|neigh|stopOffset|junction|request|connection|prohibition|roundabout|"
        "tlLogic|phase|conflict|condition|assignment|taz|tazSource|tazSink|param"
    ),
    "routes": re.compile(f"{DEMAND}|param"),
}
# Elements whose parameters SUMO obeys; those of edges, lanes and junctions are notes.
OBEYED = re.compile(f"{DEMAND}|tlLogic")
TRAFFIC_LIGHTS = frozenset({"", "static", "actuated", "delay_based", "NEMA", "off", "rail_signal", "rail_crossing"})
# Devices of vehicles without outputs of their own.
DEVICES = "battery|bluelight|driverstate|emissions|fcd|glosa|rerouting|routing|stationfinder|taxi|tripinfo|vehroute"
PARAMETERS = re.compile(
    rf"[^.:/]+|has\.(?:{DEVICES})\.device|(?:person-)?device\.(?:{DEVICES})\.[^:/]+"
    r"|(?:junctionModel|laneChangeModel|carFollowModel|parking)\.[^:/]+"
)
OUTPUT = re.compile(r"(?<!pro)file|output|href|^dest$|\bport$", re.IGNORECASE)
# Attributes that change no movement: pictures for SUMO's own windows, and files of emission models.
LEFT_OUT = frozenset({"imgFile", "osgFile", "emissionClass"})


@reads("a file of SUMO")
def copy_checked(path: Path, target: Path, kind: Literal["network", "routes"]) -> Path:
    """Copy a network or routes, as the parser understands them, if nothing in them names an output or an address.

    Args:
        path: The file.
        target: Where the copy goes. Text between the elements, pictures and emission classes are left out.
        kind: Which elements are allowed.

    Returns:
        `target`.

    Raises:
        BadFileError: Another element, parameter or attribute than SUMO needs for traffic, or not XML.
    """
    parents: list[str] = []
    with path.open("rb") as file, target.open("w", encoding="utf-8") as copy:

        def start(name: str, names_and_values: list[str]) -> None:
            attributes = list(zip(names_and_values[::2], names_and_values[1::2], strict=True))
            _check_element(kind, name, attributes, parents[-1] if parents else "")
            parents.append(name)
            kept = (f" {key}={quoteattr(value)}" for key, value in attributes if key not in LEFT_OUT)
            copy.write(f"<{name}{''.join(kept)}>")

        def end(name: str) -> None:
            parents.pop()
            copy.write(f"</{name}>\n")

        feed_xml(iter(lambda: file.read(PIECE_BYTES), b""), start, end)
    return target


def _check_element(kind: str, name: str, attributes: Sequence[tuple[str, str]], parent: str) -> None:
    if not ELEMENTS[kind].fullmatch(name):
        raise ValueError(
            f"<{name}> is not read: only elements of {'a network' if kind == 'network' else 'traffic demand'} are, "
            "for others can write files or open connections; remove it"
        )
    given = dict(attributes)
    if name == "tlLogic" and given.get("type", "") not in TRAFFIC_LIGHTS:
        raise ValueError(f"<tlLogic> of type {given['type'][:40]!r} is not read; take another type")
    if name == "param":
        key = given.get("key", "")
        if OUTPUT.search(key) or (OBEYED.fullmatch(parent) and not PARAMETERS.fullmatch(key)):
            raise ValueError(
                f"the parameter {key[:80]!r} of <{parent}> is not read, for it could make SUMO write files or open "
                "connections; remove it"
            )
    for key in given:
        if key not in LEFT_OUT and OUTPUT.search(key):
            raise ValueError(f"the attribute {key[:80]!r} of <{name}> names a file or an address; remove it")
