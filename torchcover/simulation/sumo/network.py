"""Road networks of SUMO: lanes, outlines of junctions, and connections between lanes."""

from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from torchcover.files import check_memory, guard_reader
from torchcover.geometry.arrays import Float64
from torchcover.simulation.sumo.xml_stream import XmlAttributes, pair_attributes, parse_xml_stream, read_chunks

LaneUse = Literal["road", "turn", "bay", "shoulder", "sidewalk", "crossing", "corner"]
LaneId = tuple[str, str]  # name of the edge and index of the lane on it

MAX_WIDTH_M = 100.0  # a larger width is an error in the file
SAME_POSITION_M = 1e-3  # positions that are closer are the same


class NetworkLane(NamedTuple):
    """Lane of an edge, which is a street in one direction.

    Args:
        edge_id: Name of the edge.
        use: "road" and "turn" (on a junction) for vehicles, "bay" for parking, "shoulder" for no one; "sidewalk",
            "crossing" and "corner", which joins these two, for pedestrians.
        width_m: Width.
        line_m: (K, 3) centerline in the direction of travel, K >= 2; for a corner its outline, K >= 3.
        speed_mps: Speed limit.
        allowed_classes: Vehicle classes that may use the lane, or "all".
        disallowed_classes: Vehicle classes that may not use the lane, or "all".
    """

    edge_id: str
    use: LaneUse
    width_m: float
    line_m: Float64
    speed_mps: float
    allowed_classes: frozenset[str]
    disallowed_classes: frozenset[str]

    def is_allowed(self, vehicle_class: str) -> bool:
        """Test whether vehicles of a class may use the lane.

        Args:
            vehicle_class: Vehicle class in SUMO's vocabulary, such as "bicycle".
        """
        names = {"all", vehicle_class}
        return not names & self.disallowed_classes and bool(names & self.allowed_classes)


class Network(NamedTuple):
    """Road network.

    Args:
        lanes: Lanes; those of an edge from the outer side inwards.
        junctions: (K, 3) outline of each junction.
        connections: Pairs of lane indices; the first lane leads to the second across a junction.
    """

    lanes: tuple[NetworkLane, ...]
    junctions: tuple[Float64, ...]
    connections: tuple[tuple[int, int], ...]

    def find_successors(self, vehicle_class: str) -> dict[str, tuple[str, ...]]:
        """Find the edges to which edges lead.

        Args:
            vehicle_class: Vehicle class for which edges count.

        Returns:
            Names of the following edges by the name of the edge, both sorted; empty at a dead end.
        """
        is_road = [lane.use == "road" and lane.is_allowed(vehicle_class) for lane in self.lanes]
        successors: dict[str, set[str]] = {}
        for lane, is_usable in zip(self.lanes, is_road, strict=True):
            if is_usable:
                successors[lane.edge_id] = set()
        for source, target in self.connections:
            if is_road[source] and is_road[target]:
                successors[self.lanes[source].edge_id].add(self.lanes[target].edge_id)
        return {edge: tuple(sorted(successors[edge])) for edge in sorted(successors)}


def read_network(path: Path) -> Network:
    """Read a `.net.xml` file; the last one is cached until it changes.

    Args:
        path: The file.

    Raises:
        BadFileError: It is no network with a street for vehicles.
    """
    status = path.stat() if path.exists() else None
    return _read_version(path, status and (status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=1)
def _read_version(path: Path, _version: tuple[int, int] | None) -> Network:
    """Read a network unless this version (size and time of change) is cached."""
    return _read_network(path)


@guard_reader("a road network of SUMO")
def _read_network(path: Path) -> Network:
    """Read a network; errors name the file."""
    memory_per_byte = 5  # size of a network in memory, relative to its file
    check_memory(memory_per_byte * path.stat().st_size)
    parser = NetworkParser()
    parse_xml_stream(read_chunks(path), parser.start_element)
    lanes = tuple(parser.lanes.values())
    if not any(lane.use == "road" for lane in lanes):
        raise ValueError(f"a network with a street for vehicles is needed; it has {len(lanes)} lanes, none of which is")
    indices = dict(zip(parser.lanes, range(len(lanes)), strict=True))
    connections = []
    for source, target in parser.connections:
        if source in indices and target in indices:
            connections.append((indices[source], indices[target]))
    return Network(lanes, tuple(parser.junctions), tuple(connections))


class NetworkParser:
    """Collector of lanes, junctions and connections from the tags of a network.

    Attributes:
        lanes: Lanes by edge and index.
        junctions: (K, 3) outlines of junctions.
        connections: Pairs of lanes.
    """

    def __init__(self) -> None:
        self.lanes: dict[LaneId, NetworkLane] = {}
        self.junctions: list[Float64] = []
        self.connections: list[tuple[LaneId, LaneId]] = []
        self._edge: XmlAttributes = {}
        self._has_root = False

    def start_element(self, name: str, names_and_values: list[str]) -> None:
        """Process a start tag from `parse_xml_stream`."""
        if not self._has_root:
            if name != "net":
                raise ValueError(f"a network of SUMO begins with <net>; got <{name}>")
            self._has_root = True
        if name not in ("edge", "lane", "junction", "connection"):
            return
        item = pair_attributes(names_and_values)
        if name == "edge":
            self._edge = item
        elif name == "lane":
            lane = parse_lane(self._edge, item)
            if lane is not None:
                self.lanes[lane.edge_id, item.get("index", "")] = lane
        elif name == "connection":
            source = item.get("from", ""), item.get("fromLane", "")
            self.connections.append((source, (item.get("to", ""), item.get("toLane", ""))))
        else:
            outline_m = parse_shape(item.get("shape", ""))
            if item.get("type") != "internal" and len(outline_m) >= 3:
                self.junctions.append(outline_m)


def parse_lane(edge: XmlAttributes, item: XmlAttributes) -> NetworkLane | None:
    """Parse a lane.

    Args:
        edge: Attributes of its edge.
        item: Attributes of the lane.

    Returns:
        The lane; None for medians, tracks of trains and lanes without length.

    Raises:
        ValueError: A width, number or shape is not valid.
    """
    name = item.get("id", "")
    default_width_m = 3.2  # SUMO's default
    width_m, speed_mps = parse_number(item, "width", default_width_m), parse_number(item, "speed", 0.0)
    if not 0.0 < width_m <= MAX_WIDTH_M:
        raise ValueError(f"lane {name!r}: a width above 0 and up to {MAX_WIDTH_M:g} m is needed; got {width_m:g}")
    line_m = parse_shape(item.get("shape", ""))
    if not np.isfinite(line_m).all():
        raise ValueError(f"lane {name!r}: its shape has NaN or infinite numbers")
    # Repeated positions have no direction.
    if len(line_m):
        steps_m = np.linalg.norm(np.diff(line_m[:, :2], axis=0), axis=1)
        line_m = line_m[np.concatenate([[True], steps_m > SAME_POSITION_M])]
    allowed = frozenset(item.get("allow", "all").split())
    disallowed = frozenset(item.get("disallow", "").split())
    use = find_lane_use(edge.get("function", "normal"), item.get("type", ""), allowed, disallowed)
    if use is None or len(line_m) < (3 if use == "corner" else 2):
        return None  # a lane without length has no surface either
    return NetworkLane(edge.get("id", ""), use, width_m, line_m, speed_mps, allowed, disallowed)


def find_lane_use(
    edge_function: str, lane_type: str, allowed: frozenset[str], disallowed: frozenset[str]
) -> LaneUse | None:
    """Find the use of a lane.

    Args:
        edge_function: Attribute "function" of its edge.
        lane_type: Attribute "type" of the lane.
        allowed: Vehicle classes that may use it, or "all".
        disallowed: Vehicle classes that may not use it, or "all".

    Returns:
        The use; None for medians and tracks of trains.
    """
    if edge_function == "walkingarea":
        return "corner"
    if edge_function == "crossing":
        return "crossing"
    no_road_classes = "rail rail_urban rail_electric rail_fast tram subway cable_car ship"
    if edge_function not in ("normal", "internal") or allowed <= set(no_road_classes.split()):
        return None
    if allowed == {"pedestrian"}:
        return "sidewalk"
    if edge_function == "internal":
        return "turn"
    if lane_type.lower() == "parking":
        return "bay"
    if lane_type.lower() == "median":
        return None
    return "shoulder" if "all" in disallowed else "road"


def parse_shape(text: str) -> Float64:
    """Parse the shape of a lane or junction.

    Args:
        text: Positions "x,y x,y,z ..."; a missing z is 0.

    Returns:
        (K, 3) positions in meters.

    Raises:
        ValueError: A position has not two or three numbers.
    """
    positions_m = []
    for position_text in text.split():
        position_m = [float(number) for number in position_text.split(",")]
        if len(position_m) not in (2, 3):
            raise ValueError(f"a shape of positions x,y or x,y,z is needed; got {text[:60]!r}")
        positions_m.append(position_m if len(position_m) == 3 else [*position_m, 0.0])
    return np.array(positions_m, dtype=np.float64).reshape(-1, 3)


def parse_number(item: XmlAttributes, key: str, default: float) -> float:
    """Parse a number of a lane.

    Args:
        item: Attributes of the lane.
        key: Name of the attribute.
        default: Result if the attribute is missing.

    Raises:
        ValueError: It is not a number.
    """
    text = item.get(key)
    try:
        return default if text is None else float(text)
    except ValueError:
        raise ValueError(f"lane {item.get('id')!r}: {key} is {text!r}, not a number") from None
