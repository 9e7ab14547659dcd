"""SUMO's road networks: lanes, junctions, and which street leads on to which."""

from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from torchcover.files import check_memory, feed_xml, reads
from torchcover.geometry.arrays import Float64

# Of lanes without a width, as SUMO has it.
LANE_WIDTH_M = 3.2
# Nobody is afraid of lanes that are wider; a number beyond is a mistake.
MAX_WIDTH_M = 100.0
# Lanes of these only, as far as anybody may use them, are no roads.
NO_ROADS = frozenset({"rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car", "ship"})
SAME_PLACE_M = 1e-3
PIECE_BYTES = 1 << 18
# What is kept of a file takes about so many times its bytes.
KEPT_PER_BYTE = 5

Use = Literal["road", "turn", "bay", "shoulder", "sidewalk", "crossing", "corner"]


class NetworkLane(NamedTuple):
    """A lane of a street in one direction, the `edge`: classes of vehicles may use it, or are barred, or "all".

    "road" and "turn" (on a junction) are for vehicles, a "bay" for those who park, a "shoulder" for nobody; a
    "sidewalk", a "crossing" and a "corner", which joins these two, are for those on foot. `line_m` (K, 3) is its
    middle, in the direction of travel, K >= 2; of a corner its outline instead, K >= 3.
    """

    edge: str
    use: Use
    width_m: float
    line_m: Float64
    speed_mps: float
    classes: frozenset[str]
    barred: frozenset[str]

    def allows(self, vehicle_class: str) -> bool:
        """Whether vehicles of a class may use it."""
        return not {"all", vehicle_class} & self.barred and bool({"all", vehicle_class} & self.classes)


class Network(NamedTuple):
    """A road network: lanes, those of an edge from the outer side of the road inwards; (K, 3) outlines of junctions.

    `connections` are pairs of numbers of lanes, of which the one leads on to the other across a junction.
    """

    lanes: tuple[NetworkLane, ...]
    junctions: tuple[Float64, ...]
    connections: tuple[tuple[int, int], ...]
    left_hand: bool

    def follow(self, vehicle_class: str) -> dict[str, tuple[str, ...]]:
        """Of each edge that vehicles of a class may use, the names of those on which they may go on from there."""
        roads = [lane.use == "road" and lane.allows(vehicle_class) for lane in self.lanes]
        found: dict[str, set[str]] = {lane.edge: set() for lane, may in zip(self.lanes, roads, strict=True) if may}
        for source, target in self.connections:
            if roads[source] and roads[target]:
                found[self.lanes[source].edge].add(self.lanes[target].edge)
        return {edge: tuple(sorted(found[edge])) for edge in sorted(found)}


def read_network(path: Path) -> Network:
    """Read a `.net.xml` file; the one that was read last is kept."""
    status = path.stat() if path.exists() else None
    return _read_again(path, status and (status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=1)
def _read_again(path: Path, _version: tuple[int, int] | None) -> Network:
    return _read(path)


@reads("a road network of SUMO")
def _read(path: Path) -> Network:
    check_memory(KEPT_PER_BYTE * path.stat().st_size)
    collector = _Collector()
    with path.open("rb") as file:
        feed_xml(iter(lambda: file.read(PIECE_BYTES), b""), collector.start)
    lanes = tuple(collector.lanes.values())
    if not any(lane.use == "road" for lane in lanes):
        raise ValueError(f"a network with a street for vehicles is needed; it has {len(lanes)} lanes, none of which is")
    number = {name: at for at, name in enumerate(collector.lanes)}
    joined = ((number.get(source), number.get(target)) for source, target in collector.connections)
    return Network(
        lanes=lanes,
        junctions=tuple(collector.junctions),
        connections=tuple((one, other) for one, other in joined if one is not None and other is not None),
        left_hand=collector.left_hand,
    )


# A lane by the name of its edge and its number there.
LaneName = tuple[str, str]
Attributes = dict[str, str]


class _Collector:
    """Keeps what is needed of a network, as start tags come in: its file may be larger than a tree of it could be."""

    def __init__(self) -> None:
        self.lanes: dict[LaneName, NetworkLane] = {}
        self.junctions: list[Float64] = []
        self.connections: list[tuple[LaneName, LaneName]] = []
        self.left_hand = False
        self._edge: Attributes = {}
        self._keep = {
            "edge": self._begin_edge,
            "lane": self._lane,
            "junction": self._junction,
            "connection": self._join,
        }
        self._began = False

    def start(self, name: str, attributes: list[str]) -> None:
        """A tag; see `feed_xml`."""
        if not self._began:
            if name != "net":
                raise ValueError(f"a network of SUMO begins with <net>; got <{name}>")
            self._began = True
            self.left_hand = _named(attributes).get("lefthand") in ("true", "1")
        elif name in self._keep:
            self._keep[name](_named(attributes))

    def _begin_edge(self, edge: Attributes) -> None:
        self._edge = edge

    def _lane(self, item: Attributes) -> None:
        lane = _lane(self._edge, item)
        if lane is not None:
            self.lanes[lane.edge, item.get("index", "")] = lane

    def _junction(self, item: Attributes) -> None:
        outline_m = _places(item.get("shape", ""))
        if item.get("type") != "internal" and len(outline_m) >= 3:
            self.junctions.append(outline_m)

    def _join(self, item: Attributes) -> None:
        names = [item.get(key, "") for key in ("from", "fromLane", "to", "toLane")]
        self.connections.append(((names[0], names[1]), (names[2], names[3])))


def _named(attributes: list[str]) -> Attributes:
    return dict(zip(attributes[::2], attributes[1::2], strict=True))


def _lane(edge: Attributes, item: Attributes) -> NetworkLane | None:
    name = item.get("id", "")
    width_m, speed_mps = _number(item, "width", LANE_WIDTH_M), _number(item, "speed", 0.0)
    if not 0.0 < width_m <= MAX_WIDTH_M:
        raise ValueError(f"lane {name!r}: a width above 0 and up to {MAX_WIDTH_M:g} m is needed; got {width_m:g}")
    line_m = _places(item.get("shape", ""))
    if not np.isfinite(line_m).all():
        raise ValueError(f"lane {name!r}: its shape has NaN or infinite numbers")
    if len(line_m):
        steps = np.linalg.norm(np.diff(line_m[:, :2], axis=0), axis=1)
        line_m = line_m[np.concatenate([[True], steps > SAME_PLACE_M])]
    classes = frozenset(item.get("allow", "all").split())
    barred = frozenset(item.get("disallow", "").split())
    use = _use(edge.get("function", "normal"), item.get("type", ""), classes, barred)
    if use is None or len(line_m) < (3 if use == "corner" else 2):
        return None  # a lane without length has no surface either
    return NetworkLane(edge.get("id", ""), use, width_m, line_m, speed_mps, classes, barred)


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


def _places(shape: str) -> Float64:
    """(K, 3) places of "x,y x,y,z ..."."""
    rows = [[float(number) for number in place.split(",")] for place in shape.split()]
    if any(len(row) not in (2, 3) for row in rows):
        raise ValueError(f"a shape of places x,y or x,y,z is needed; got {shape[:60]!r}")
    return np.array([row if len(row) == 3 else [*row, 0.0] for row in rows], dtype=np.float64).reshape(-1, 3)


def _number(item: Attributes, key: str, otherwise: float) -> float:
    text = item.get(key)
    try:
        return otherwise if text is None else float(text)
    except ValueError:
        raise ValueError(f"lane {item.get('id')!r}: {key} is {text!r}, not a number") from None
