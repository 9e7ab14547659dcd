"""SUMO's road networks: lanes, junctions, and which street leads on to which."""

from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from torchcover.files import parse_xml, reads

Numbers = NDArray[np.float64]

# Of lanes without a width, as SUMO has it.
LANE_WIDTH_M = 3.2
# Nobody is afraid of lanes that are wider; a number beyond is a mistake.
MAX_WIDTH_M = 100.0
# Lanes of these only, as far as anybody may use them, are no roads.
NO_ROADS = frozenset({"rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car", "ship"})
SAME_PLACE_M = 1e-3

Use = Literal["road", "turn", "bay", "shoulder", "sidewalk", "crossing", "corner"]


class Lane(NamedTuple):
    """A lane.

    Args:
        edge: Name of the street, in one direction, that it is part of.
        use: "road" and "turn" (on a junction) are for vehicles, a "bay" for those who park, a "shoulder" for nobody; a
            "sidewalk", a "crossing" and a "corner", which joins these two, are for those on foot.
        width_m: Its width.
        line_m: (K, 3) its middle, in the direction of travel, K >= 2; of a corner its outline instead, K >= 3.
        speed_mps: What is allowed.
        classes: Of vehicles that may use it, or "all".
        barred: Classes that may not, or "all".
    """

    edge: str
    use: Use
    width_m: float
    line_m: Numbers
    speed_mps: float
    classes: frozenset[str]
    barred: frozenset[str]

    def allows(self, vehicle_class: str) -> bool:
        """Whether vehicles of a class may use it."""
        return not {"all", vehicle_class} & self.barred and bool({"all", vehicle_class} & self.classes)


class Network(NamedTuple):
    """A road network.

    Args:
        lanes: All lanes; those of one edge follow each other from the outer side of the road inwards.
        junctions: (K, 3) outlines.
        connections: Pairs of numbers of lanes, of which the one leads on to the other across a junction.
        left_hand: Whether people drive on the left.
    """

    lanes: tuple[Lane, ...]
    junctions: tuple[Numbers, ...]
    connections: tuple[tuple[int, int], ...]
    left_hand: bool

    @property
    def flat_at_m(self) -> float | None:
        """The height of everything, if it is the same everywhere."""
        heights = np.concatenate([lane.line_m[:, 2] for lane in self.lanes])
        return float(heights[0]) if (heights == heights[0]).all() else None

    def follow(self, vehicle_class: str) -> dict[str, tuple[str, ...]]:
        """Of each edge that vehicles of a class may use, the names of those on which they may go on from there."""
        roads = [lane.use == "road" and lane.allows(vehicle_class) for lane in self.lanes]
        found: dict[str, set[str]] = {lane.edge: set() for lane, may in zip(self.lanes, roads, strict=True) if may}
        for source, target in self.connections:
            if roads[source] and roads[target]:
                found[self.lanes[source].edge].add(self.lanes[target].edge)
        return {edge: tuple(sorted(found[edge])) for edge in sorted(found)}


def read_network(path: Path) -> Network:
    """Read a `.net.xml` file; the one that was read last is kept.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: Not a network of SUMO, or a lane that has no width or place.
    """
    status = path.stat() if path.exists() else None
    return _read_again(path, status and (status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=1)
def _read_again(path: Path, _version: tuple[int, int] | None) -> Network:
    return _read(path)


@reads("a road network of SUMO")
def _read(path: Path) -> Network:
    root = parse_xml(path)
    if root.tag != "net":
        raise ValueError(f"a network of SUMO begins with <net>; got <{root.tag}>")
    by_name = {
        (lane.edge, item.get("index")): lane
        for edge in root.iter("edge")
        for item in edge.iter("lane")
        if (lane := _lane(edge, item))
    }
    lanes = tuple(by_name.values())
    if not any(lane.use == "road" for lane in lanes):
        raise ValueError(f"a network with a street for vehicles is needed; it has {len(lanes)} lanes, none of which is")
    return Network(
        lanes=lanes,
        junctions=tuple(
            outline
            for junction in root.iter("junction")
            if junction.get("type") != "internal" and len(outline := _places(junction.get("shape", ""))) >= 3
        ),
        connections=_connections(root, {name: number for number, name in enumerate(by_name)}),
        left_hand=root.get("lefthand") in ("true", "1"),
    )


def _lane(edge: ElementTree.Element, item: ElementTree.Element) -> Lane | None:
    name = item.get("id", "")
    width_m, speed_mps = _number(item, "width", LANE_WIDTH_M), _number(item, "speed", 0.0)
    if not 0.0 < width_m <= MAX_WIDTH_M:
        raise ValueError(f"lane {name!r}: a width above 0 and up to {MAX_WIDTH_M:g} m is needed; got {width_m:g}")
    line_m = _places(item.get("shape", ""))
    if not np.isfinite(line_m).all():
        raise ValueError(f"lane {name!r}: its shape has NaN or infinite numbers")
    line_m = _without_repeats(line_m)
    classes = frozenset(item.get("allow", "all").split())
    barred = frozenset(item.get("disallow", "").split())
    use = _use(edge.get("function", "normal"), item.get("type", ""), classes, barred)
    if use is None or len(line_m) < (3 if use == "corner" else 2):
        return None  # a lane without length has no surface either
    return Lane(edge.get("id", ""), use, width_m, line_m, speed_mps, classes, barred)


def _use(function: str, kind: str, classes: frozenset[str], barred: frozenset[str]) -> Use | None:
    if function == "walkingarea":
        return "corner"
    if function == "crossing":
        return "crossing"
    if function not in ("normal", "internal") or classes <= NO_ROADS:
        return None
    if classes == frozenset({"pedestrian"}):
        return "sidewalk"
    if function == "internal":
        return "turn"
    if kind.lower() == "parking":
        return "bay"
    if kind.lower() == "median":
        return None
    return "shoulder" if "all" in barred else "road"


def _connections(root: ElementTree.Element, number: dict[tuple[str, str | None], int]) -> tuple[tuple[int, int], ...]:
    found = (
        ((item.get("from", ""), item.get("fromLane")), (item.get("to", ""), item.get("toLane")))
        for item in root.iter("connection")
    )
    return tuple((number[source], number[target]) for source, target in found if source in number and target in number)


def _places(shape: str) -> Numbers:
    """(K, 3) places of "x,y x,y,z ..."."""
    rows = [[float(number) for number in place.split(",")] for place in shape.split()]
    if any(len(row) not in (2, 3) for row in rows):
        raise ValueError(f"a shape of places x,y or x,y,z is needed; got {shape[:60]!r}")
    return np.array([row if len(row) == 3 else [*row, 0.0] for row in rows], dtype=np.float64).reshape(-1, 3)


def _without_repeats(line_m: Numbers) -> Numbers:
    if len(line_m) == 0:
        return line_m
    steps = np.linalg.norm(np.diff(line_m[:, :2], axis=0), axis=1)
    kept: Numbers = line_m[np.concatenate([[True], steps > SAME_PLACE_M])]
    return kept


def _number(item: ElementTree.Element, key: str, otherwise: float) -> float:
    text = item.get(key)
    try:
        return otherwise if text is None else float(text)
    except ValueError:
        raise ValueError(f"lane {item.get('id')!r}: {key} is {text!r}, not a number") from None
