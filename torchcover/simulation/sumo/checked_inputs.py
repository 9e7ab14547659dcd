"""Checks of files of users before SUMO reads them: they must not make it write files or open connections."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

from torchcover.files import guard_reader
from torchcover.simulation.sumo.xml_stream import parse_xml_stream, read_chunks

# Elements of networks and of traffic demand. SUMO would also accept detectors, calibrators, rerouters, timed events
# and inclusions, which write files or open connections.
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
# Devices of vehicles without outputs of their own, and all parameters that do not write files.
DEVICES = "battery|bluelight|driverstate|emissions|fcd|glosa|rerouting|routing|stationfinder|taxi|tripinfo|vehroute"
SAFE_PARAMETERS = re.compile(
    rf"[^.:/]+|has\.(?:{DEVICES})\.device|(?:person-)?device\.(?:{DEVICES})\.[^:/]+"
    r"|(?:junctionModel|laneChangeModel|carFollowModel|parking)\.[^:/]+"
)
OUTPUT = re.compile(r"(?<!pro)file|output|href|^dest$|\bport$", re.IGNORECASE)


@guard_reader("a file of SUMO")
def copy_checked(path: Path, target_path: Path, kind: Literal["network", "routes"]) -> Path:
    """Copy a network or routes, if nothing in them names an output or an address.

    Args:
        path: The file.
        target_path: Path of the copy, without text between elements and without pictures and emission classes.
        kind: Kind of the elements that are allowed.

    Returns:
        `target_path`.

    Raises:
        BadFileError: The file has an element, parameter or attribute that SUMO does not need for traffic, or is not
            XML.
    """
    parents: list[str] = []
    with target_path.open("w", encoding="utf-8") as copy:

        def start_element(name: str, names_and_values: list[str]) -> None:
            # Attributes are checked and copied as the parser understands them.
            attributes = list(zip(names_and_values[::2], names_and_values[1::2], strict=True))
            attributes = [(key, value) for key, value in attributes if not is_ignored(key)]
            check_attribute_count(name, len(names_and_values) // 2)
            check_element(kind, name, attributes, parents[-1] if parents else "")
            parents.append(name)
            copy.write(f"<{name}{''.join(f' {key}={quoteattr(value)}' for key, value in attributes)}>")

        def end_element(name: str) -> None:
            parents.pop()
            copy.write(f"</{name}>\n")

        parse_xml_stream(read_chunks(path), start_element, end_element)
    return target_path


def is_ignored(key: str) -> bool:
    """Test whether an attribute changes no motion.

    Args:
        key: Name of the attribute.

    Returns:
        True for pictures of SUMO's windows and files of emission models.
    """
    return key in ("imgFile", "osgFile", "emissionClass")


def check_element(kind: str, name: str, attributes: Sequence[tuple[str, str]], parent: str) -> None:
    """Check that an element names no output or address.

    Args:
        kind: Kind of the file, see `ELEMENTS`.
        name: Name of the element.
        attributes: Names and values of its attributes.
        parent: Name of the element that contains it.

    Raises:
        ValueError: It does.
    """
    if not ELEMENTS[kind].fullmatch(name):
        raise ValueError(
            f"<{name}> is not read: only elements of {'a network' if kind == 'network' else 'traffic demand'} are, "
            "because others can write files or open connections; remove it"
        )
    values = dict(attributes)
    safe_signals = ("", "static", "actuated", "delay_based", "NEMA", "off", "rail_signal", "rail_crossing")
    if name == "tlLogic" and values.get("type", "") not in safe_signals:
        raise ValueError(f"<tlLogic> of type {values['type'][:40]!r} is not read; take another type")
    if name == "param":
        key = values.get("key", "")
        # Parameters of edges, lanes and junctions are only notes.
        has_effect = re.fullmatch(f"{DEMAND}|tlLogic", parent)
        if OUTPUT.search(key) or (has_effect and not SAFE_PARAMETERS.fullmatch(key)):
            raise ValueError(
                f"the parameter {key[:80]!r} of <{parent}> is not read, because it could make SUMO write files or open "
                "connections; remove it"
            )
    check_projection(values.get("projParameter", ""))
    for key in values:
        if OUTPUT.search(key):
            raise ValueError(f"the attribute {key[:80]!r} of <{name}> names a file or an address; remove it")


def check_attribute_count(name: str, attribute_count: int) -> None:
    """Check the number of attributes of an element, because SUMO compares each with each.

    Args:
        name: Name of the element.
        attribute_count: Number of its attributes.

    Raises:
        ValueError: There are too many.
    """
    max_attributes = 1000
    if attribute_count > max_attributes:
        raise ValueError(f"<{name[:40]}> has {attribute_count} attributes; at most {max_attributes} are read")


def check_projection(parameters: str) -> None:
    """Check that a projection names no file: PROJ would also open a pipe, which never ends.

    Args:
        parameters: Parameters for PROJ.

    Raises:
        ValueError: It does.
    """
    if re.search(r"=\s*\S*[/\\]", parameters):
        raise ValueError(f"the projection {parameters.strip()[:80]!r} names a file; remove this parameter")
