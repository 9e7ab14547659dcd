"""Road networks of SUMO: lanes, junctions, connections, and the part of a network near the way of the ego."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn
from xml.parsers import expat

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.files import check_memory, guard_reader
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.traffic.assemble import HORIZON_M

PIECE_BYTES = 1 << 18
# Of lanes without a width, as SUMO has it.
LANE_WIDTH_M = 3.2
# Nobody is afraid of lanes that are wider; a number beyond is a mistake.
MAX_WIDTH_M = 100.0
# Lanes of these only, as far as anybody may use them, are no roads.
NO_ROADS = frozenset({"rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car", "ship"})
SAME_PLACE_M = 1e-3
# What is kept of a file takes about so many times its bytes.
KEPT_PER_BYTE = 5

LaneUse = Literal["road", "turn", "bay", "shoulder", "sidewalk", "crossing", "corner"]


class NetworkLane(NamedTuple):
    """A lane of a street in one direction, the `edge_id`: classes of vehicles may use it, or are barred, or "all".

    "road" and "turn" (on a junction) are for vehicles, a "bay" for those who park, a "shoulder" for nobody; a
    "sidewalk", a "crossing" and a "corner", which joins these two, are for those on foot. `line_m` (K, 3) is its
    middle, in the direction of travel, K >= 2; of a corner its outline instead, K >= 3.
    """

    edge_id: str
    use: LaneUse
    width_m: float
    line_m: Float64
    speed_mps: float
    allowed_classes: frozenset[str]
    disallowed_classes: frozenset[str]

    def is_allowed(self, vehicle_class: str) -> bool:
        """Whether vehicles of a class may use it."""
        return not {"all", vehicle_class} & self.disallowed_classes and bool(
            {"all", vehicle_class} & self.allowed_classes
        )


class Network(NamedTuple):
    """A road network: lanes, those of an edge from the outer side of the road inwards; (K, 3) outlines of junctions.

    `connections` are pairs of numbers of lanes, of which the one leads on to the other across a junction.
    """

    lanes: tuple[NetworkLane, ...]
    junctions: tuple[Float64, ...]
    connections: tuple[tuple[int, int], ...]

    def find_successors(self, vehicle_class: str) -> dict[str, tuple[str, ...]]:
        """Of each edge that vehicles of a class may use, the names of those on which they may go on from there."""
        roads = [lane.use == "road" and lane.is_allowed(vehicle_class) for lane in self.lanes]
        found: dict[str, set[str]] = {lane.edge_id: set() for lane, may in zip(self.lanes, roads, strict=True) if may}
        for source, target in self.connections:
            if roads[source] and roads[target]:
                found[self.lanes[source].edge_id].add(self.lanes[target].edge_id)
        return {edge: tuple(sorted(found[edge])) for edge in sorted(found)}


def read_network(path: Path) -> Network:
    """Read a `.net.xml` file; the one that was read last is kept."""
    status = path.stat() if path.exists() else None
    return _read_again(path, status and (status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=1)
def _read_again(path: Path, _version: tuple[int, int] | None) -> Network:
    return _read(path)


@guard_reader("a road network of SUMO")
def _read(path: Path) -> Network:
    check_memory(KEPT_PER_BYTE * path.stat().st_size)
    collector = _Collector()
    parse_xml_stream(read_chunks(path), collector.start)
    lanes = tuple(collector.lanes.values())
    if not any(lane.use == "road" for lane in lanes):
        raise ValueError(f"a network with a street for vehicles is needed; it has {len(lanes)} lanes, none of which is")
    number = {name: at for at, name in enumerate(collector.lanes)}
    joined = ((number.get(source), number.get(target)) for source, target in collector.connections)
    return Network(
        lanes=lanes,
        junctions=tuple(collector.junctions),
        connections=tuple((one, other) for one, other in joined if one is not None and other is not None),
    )


# A lane by the name of its edge and its number there.
LaneId = tuple[str, str]
XmlAttributes = dict[str, str]


class _Collector:
    """Keeps what is needed of a network, as start tags come in: its file may be larger than a tree of it could be."""

    def __init__(self) -> None:
        self.lanes: dict[LaneId, NetworkLane] = {}
        self.junctions: list[Float64] = []
        self.connections: list[tuple[LaneId, LaneId]] = []
        self._edge: XmlAttributes = {}
        self._began = False

    def start(self, name: str, attributes: list[str]) -> None:
        """A tag; see `parse_xml_stream`."""
        if not self._began:
            if name != "net":
                raise ValueError(f"a network of SUMO begins with <net>; got <{name}>")
            self._began = True
        elif name in ("edge", "lane", "junction", "connection"):
            self._keep(name, pair_attributes(attributes))

    def _keep(self, name: str, item: XmlAttributes) -> None:
        if name == "edge":
            self._edge = item
        elif name == "lane":
            if lane := _lane(self._edge, item):
                self.lanes[lane.edge_id, item.get("index", "")] = lane
        elif name == "connection":
            source, source_lane, target, target_lane = (item.get(k, "") for k in ("from", "fromLane", "to", "toLane"))
            self.connections.append(((source, source_lane), (target, target_lane)))
        else:
            outline_m = _places(item.get("shape", ""))
            if item.get("type") != "internal" and len(outline_m) >= 3:
                self.junctions.append(outline_m)


def pair_attributes(attributes: list[str]) -> XmlAttributes:
    """Return the names and values of `parse_xml_stream`, which follow each other in turn, as a dict."""
    return dict(zip(attributes[::2], attributes[1::2], strict=True))


def _lane(edge: XmlAttributes, item: XmlAttributes) -> NetworkLane | None:
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


def _use(function: str, kind: str, classes: frozenset[str], barred: frozenset[str]) -> LaneUse | None:
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


def _number(item: XmlAttributes, key: str, otherwise: float) -> float:
    text = item.get(key)
    try:
        return otherwise if text is None else float(text)
    except ValueError:
        raise ValueError(f"lane {item.get('id')!r}: {key} is {text!r}, not a number") from None


# Lanes are asked for their height this often.
SAMPLE_M = 2.0
# A lane so far above another one, in a square of this size or next to it, is on a bridge.
BRIDGE_M = 2.5
SQUARE_M = 4.0
# Streets are built a little farther than is seen, so that none ends in sight; bodies are as long as this.
BEYOND_M = 25.0
# What lies between carriageways that are no farther apart, and has this share of its outline in common with them, is a
# median; what is smaller is a gap that the drawing of a network left.
MEDIAN_M = 6.0
ENCLOSED = 0.95
SMALLEST_MEDIAN_M2 = 3.0
ALONGSIDE_M = 0.05
WAY_WITHIN_M = 0.5
# Whoever is farther from all streets has left them.
OFF_STREET_M = 10.0


class Vicinity:
    """A piece of a network, near the ego's (T, 2) way, of whose places `origin_m` (2,) was subtracted in float64.

    `lane_points_m` are (N, 3) places along all lanes, and `lane_indices` (N,) the numbers of their lanes.
    """

    def __init__(self, network: Network, ego_path_m: Float64, origin_m: Float64) -> None:
        self.ego_path = shapely.LineString(
            ego_path_m if len(ego_path_m) > 1 else np.repeat(ego_path_m, 2, axis=0)
        ).simplify(WAY_WITHIN_M)
        shapely.prepare(self.ego_path)
        self.lower_m, self.upper_m = ego_path_m.min(axis=0) - HORIZON_M, ego_path_m.max(axis=0) + HORIZON_M
        shift_m = np.array([*origin_m, 0.0])
        near = self._near([lane.line_m for lane in network.lanes], shift_m)
        lanes = (network.lanes[number] for number in near.tolist())
        self.lanes = tuple(lane._replace(line_m=lane.line_m - shift_m) for lane in lanes)
        lines = shapely.segmentize(_lines([lane.line_m for lane in self.lanes]), SAMPLE_M)
        self.lane_points_m, self.lane_indices = shapely.get_coordinates(lines, include_z=True, return_index=True)
        near = self._near(network.junctions, shift_m)
        self.junctions = tuple(network.junctions[number] - shift_m for number in near.tolist())

    def _near(self, lines_m: Sequence[Float64], shift_m: Float64) -> Int64:
        """Numbers of the lines that may be seen from the way."""
        if not lines_m:
            return np.empty(0, dtype=np.int64)
        first = np.concatenate([[0], np.cumsum([len(line) for line in lines_m])[:-1]])
        places_m = (np.concatenate(lines_m) - shift_m)[:, :2]
        low_m, high_m = np.minimum.reduceat(places_m, first), np.maximum.reduceat(places_m, first)
        meet = (low_m <= self.upper_m + BEYOND_M) & (high_m >= self.lower_m - BEYOND_M)
        near = np.flatnonzero(meet.all(axis=1))
        boxes = shapely.box(*low_m[near].T, *high_m[near].T)
        return np.asarray(near[shapely.dwithin(boxes, self.ego_path, HORIZON_M + BEYOND_M)])

    def is_visible(self, positions_m: Float64) -> Bools:
        """(N,) whether (N, 2) places may be seen from the way."""
        return np.asarray(shapely.dwithin(shapely.points(positions_m), self.ego_path, HORIZON_M + BEYOND_M))

    def is_on_street(self, positions_m: Float64) -> Bools:
        """(N,) whether (N, 2) places are on a street, or at least near to one."""
        on = np.zeros(len(positions_m), dtype=bool)
        if self.lanes:
            near = shapely.STRtree(self.street_polygons).query(shapely.points(positions_m), "dwithin", OFF_STREET_M)
            on[near[0]] = True
        return on

    def build_surfaces(self, *uses: LaneUse) -> NDArray[np.object_]:
        """The polygons in plan of all lanes of some uses that lie on the ground."""
        lanes = [lane for k, lane in enumerate(self.lanes) if lane.use in uses and k not in self.bridge_lane_indices]
        return _outlines(lanes, [lane.line_m for lane in lanes if lane.use == "corner"])

    @cached_property
    def bridge_lane_indices(self) -> frozenset[int]:
        """Numbers of the lanes that lie on bridges, at least in part."""
        return frozenset(self.lane_indices[self.on_bridge_mask].tolist())

    def build_bridge_area(self, margin_m: float) -> shapely.Geometry:
        """What is no farther in plan from the middle of a lane on a bridge."""
        lines = _lines([self.lanes[number].line_m[:, :2] for number in sorted(self.bridge_lane_indices)])
        return shapely.union_all(shapely.buffer(lines, margin_m))

    @cached_property
    def street_polygons(self) -> NDArray[np.object_]:
        """The polygons in plan of all that is street, be it on a bridge or not."""
        corners = (lane.line_m for lane in self.lanes if lane.use == "corner")
        return np.concatenate([_outlines(self.lanes, [*self.junctions, *corners]), self.median_polygons])

    @cached_property
    def median_polygons(self) -> NDArray[np.object_]:
        """The polygons in plan of what lies between carriageways."""
        driven = shapely.union_all([*self.build_surfaces("road", "turn", "shoulder"), *map(_polygon, self.junctions)])
        closed = shapely.buffer(shapely.buffer(driven, MEDIAN_M / 2, quad_segs=2), -MEDIAN_M / 2, quad_segs=2)
        others = shapely.union_all(self.build_surfaces("bay", "sidewalk", "corner", "crossing"))
        pieces = shapely.get_parts(shapely.difference(shapely.difference(closed, driven), others))
        pieces = pieces[(shapely.get_type_id(pieces) == 3) & (shapely.area(pieces) > SMALLEST_MEDIAN_M2)]
        outlines = shapely.get_exterior_ring(pieces)
        shared = shapely.intersection(outlines, shapely.buffer(driven, ALONGSIDE_M))
        return np.asarray(pieces[shapely.length(shared) > ENCLOSED * shapely.length(outlines)])

    @cached_property
    def on_bridge_mask(self) -> Bools:
        """(N,) which samples lie on bridges: there is a street below."""
        square = ((self.lane_points_m[:, :2] - self.lane_points_m[:, :2].min(axis=0)) / SQUARE_M).astype(np.int64) + 1
        lowest = np.full(square.max(axis=0) + 2, np.inf)
        np.minimum.at(lowest, tuple(square.T), self.lane_points_m[:, 2])
        for axis in (0, 1):
            lowest = np.minimum.reduce([lowest, np.roll(lowest, 1, axis), np.roll(lowest, -1, axis)])
        return np.asarray(self.lane_points_m[:, 2] > lowest[tuple(square.T)] + BRIDGE_M)


def _lines(lines_m: Sequence[Float64]) -> NDArray[np.object_]:
    if not lines_m:
        return np.empty(0, dtype=object)
    count = [len(line) for line in lines_m]
    of_line = np.repeat(np.arange(len(count)), count)
    return np.asarray(shapely.linestrings(np.concatenate(lines_m), indices=of_line))


def _outlines(lanes: Sequence[NetworkLane], areas_m: Sequence[Float64]) -> NDArray[np.object_]:
    """The polygons in plan of lanes but corners, and of areas by their outlines."""
    along = [lane for lane in lanes if lane.use != "corner"]
    lines = _lines([lane.line_m[:, :2] for lane in along])
    found = shapely.buffer(lines, [lane.width_m / 2 for lane in along], cap_style="flat", join_style="mitre")
    return np.concatenate([found, np.array([_polygon(area_m) for area_m in areas_m], dtype=object)])


def _polygon(outline_m: Float64) -> shapely.Geometry:
    """What an outline encloses, also one that crosses itself."""
    return shapely.make_valid(shapely.Polygon(outline_m[:, :2]))


def read_chunks(path: Path) -> Iterator[bytes]:
    """Yield a file in pieces of 256 KiB, for `parse_xml_stream`."""
    with path.open("rb") as file:
        yield from iter(lambda: file.read(PIECE_BYTES), b"")


def parse_xml_stream(
    chunks: Iterable[bytes], on_start: Callable[[str, list[str]], None], on_end: Callable[[str], None] | None = None
) -> None:
    """Read XML that may be of any length, one tag after the other; nothing of it is kept.

    `on_start`: called with the name of each element, and with the names and values of its attributes in turn; what it
    raises ends the reading. `on_end`: called with the name at its end. ValueError: not XML, or it declares entities.

    Example:
        >>> parse_xml_stream([b"<a x='1'", b"><b/></a>"], lambda name, attributes: print(name, attributes))
        a ['x', '1']
        b []
    """

    def refuse(*_: object) -> NoReturn:
        raise ValueError("an XML file without entities is needed")

    parser = expat.ParserCreate()
    parser.ordered_attributes = True
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = on_start
    parser.EndElementHandler = on_end
    try:
        for piece in chunks:
            parser.Parse(piece)
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise ValueError(f"not XML ({error})") from error
