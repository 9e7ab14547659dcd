"""A town drawn for SUMO: its plan with lanes, bays, curves and hills of our own, and traffic without destination."""

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely
from pydantic import Field

from torchcover.files import parse_xml
from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Document
from torchcover.simulation.sumo.network import Network
from torchcover.simulation.sumo.simulating import run_program
from torchcover.simulation.traffic.fleet import CATEGORIES, Fleet
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.kind import PeoplePerKm, VehiclesPerKm

NetworkLayout = Literal["rand", "grid", "spider"]

LANE_M, BICYCLE_LANE_M, BAY_M = 3.25, 1.8, 2.3
SIDEWALK_M = (2.4, 3.4)
MEDIAN_M = (0.8, 1.8)
# Shares of the streets that have them.
WITH_BAYS, WITH_BICYCLE_LANES, WITH_MEDIAN = 0.7, 0.5, 0.3
# Two streets that do not meet keep so far apart, middle to middle: the plan knows no widths.
APART_M = 40.0
BEND_PIECES = 10
# Of kerbs at corners; nobody turns there with more than so much to the side, by much. Curves are judged over a length
# within which drivers round them.
CORNER_M, TURN_MPS2, CURVE_M = 6.0, 2.0, 5.0


class RandomStreets(Document):
    """Streets and traffic that are drawn from a seed.

    Args:
        layout: Their plan; one of the three is drawn if not given.
        max_lanes_per_direction: The most of a street, each way.
        speed_limit_mps: What is allowed.
        max_bend_ratio: How far the middle of a street may lie aside of the straight line, as a share of its length.
        hill_height_std_m: Height of the hills, as a standard deviation; 0 is a plain.
        traffic_per_km: Vehicles to a kilometre of lane.
        buses_per_km: Buses among them.
        cyclists_per_km: Likewise, beside them.
        people_per_km: To a kilometre of sidewalk.
    """

    layout: NetworkLayout | None = None
    max_lanes_per_direction: Annotated[int, Field(ge=1, le=3)] = 2
    speed_limit_mps: Annotated[float, Field(ge=5.0, le=35.0)] = 13.9
    max_bend_ratio: Annotated[float, Field(ge=0.0, le=0.1)] = 0.06
    hill_height_std_m: Annotated[float, Field(ge=0.0, le=5.0)] = 0.5
    traffic_per_km: VehiclesPerKm = 14.0
    buses_per_km: VehiclesPerKm = 1.0
    cyclists_per_km: PeoplePerKm = 1.5
    people_per_km: PeoplePerKm = 16.0

    def build_network(self, folder: Path, generator: np.random.Generator) -> Path:
        """Draw a network, and write it into a folder."""
        plan = self.layout or str(generator.choice(["rand", "grid", "spider"]))
        prefix = folder / "plan"
        seed = str(generator.integers(1 << 31))
        run_program("netgenerate", *_options(plan, generator), "--seed", seed, "--plain-output-prefix", prefix)
        nodes = {
            node.get("id", ""): (float(node.get("x", "")), float(node.get("y", "")))
            for node in parse_xml(prefix.with_suffix(".nod.xml")).iter("node")
        }
        edges = list(parse_xml(prefix.with_suffix(".edg.xml")).iter("edge"))
        hills = Hills(self.hill_height_std_m, generator)
        node_file, edge_file, network = folder / "nodes.xml", folder / "edges.xml", folder / "drawn.net.xml"
        edge_file.write_text(self._edges(nodes, edges, hills, generator), encoding="utf-8")
        rows = [
            f'<node id={quoteattr(name)} x="{x:.3f}" y="{y:.3f}" z="{z:.3f}"/>'
            for (name, (x, y)), z in zip(
                nodes.items(), hills.compute_heights_m(np.array(list(nodes.values()))), strict=True
            )
        ]
        node_file.write_text(f"<nodes>{''.join(rows)}</nodes>", encoding="utf-8")
        run_program(
            "netconvert", "--node-files", node_file, "--edge-files", edge_file, "--output-file", network,
            "--precision", "3", "--tls.guess", "--walkingareas", "--crossings.guess",
            "--no-turnarounds.except-deadend",
            "--default.junctions.radius", str(CORNER_M), "--junctions.internal-link-detail", "12",
        )  # fmt: skip
        drawn = parse_xml(network)
        for lane in drawn.iterfind("edge[@function='internal']/lane"):
            line_m = np.array([place.split(",")[:2] for place in lane.get("shape", "").split()], dtype=np.float64)
            lane.set("speed", f"{min(self.speed_limit_mps, compute_turning_speed_mps(line_m)):.2f}")
        ElementTree.ElementTree(drawn).write(network)
        return network

    def _edges(
        self,
        nodes: dict[str, tuple[float, float]],
        edges: list[ElementTree.Element],
        hills: Hills,
        generator: np.random.Generator,
    ) -> str:
        streets: dict[tuple[str, str], list[tuple[str, str, str]]] = {}
        for edge in edges:
            name, start, end = (edge.get(key, "") for key in ("id", "from", "to"))
            streets.setdefault((min(start, end), max(start, end)), []).append((name, start, end))
        ways: dict[tuple[str, str], shapely.LineString] = {}
        for ends in streets:
            start_m, end_m = (np.array(nodes[end]) for end in ends)
            way = shapely.LineString(self._bent(start_m, end_m, generator))
            if all(set(ends) & set(others) or way.distance(other) >= APART_M for others, other in ways.items()):
                ways[ends] = way
        rows = []
        for ends in _without_dead_ends(list(ways)):
            way_m, lanes = shapely.get_coordinates(ways[ends]), self._lanes(generator)
            # Junctions are level: so are the ends of all that meet there.
            share = np.linspace(0.0, 1.0, BEND_PIECES + 1)
            from_m, to_m = hills.compute_heights_m(way_m[[0, -1]])
            climb_m = from_m + (to_m - from_m) * share**2 * (3 - 2 * share)
            places = [f"{x:.3f},{y:.3f},{z:.3f}" for (x, y), z in zip(way_m, climb_m, strict=True)]
            for name, start, end in streets[ends]:
                shape = " ".join(places if start == ends[0] else places[::-1])
                rows.append(
                    f"<edge id={quoteattr(name)} from={quoteattr(start)} to={quoteattr(end)} "
                    f'numLanes="{lanes.count("<lane")}" speed="{self.speed_limit_mps:.2f}" shape="{shape}">{lanes}</edge>'
                )
        return f"<edges>{''.join(rows)}</edges>"

    def _bent(self, start_m: Float64, end_m: Float64, generator: np.random.Generator) -> Float64:
        """(K, 2) a way that leaves both ends straight."""
        share = np.linspace(0.0, 1.0, BEND_PIECES + 1)[:, None]
        along = end_m - start_m
        aside = generator.uniform(-self.max_bend_ratio, self.max_bend_ratio) * np.sin(np.pi * share) ** 2
        return np.asarray(start_m + share * along + aside * np.array([-along[1], along[0]]))

    def _lanes(self, generator: np.random.Generator) -> str:
        """One side of a street, from the houses inwards."""
        lanes = [('allow="pedestrian"', generator.uniform(*SIDEWALK_M))]
        if generator.random() < WITH_BAYS:
            lanes.append(('type="parking" disallow="all"', BAY_M))
        if self.cyclists_per_km > 0 and generator.random() < WITH_BICYCLE_LANES:
            lanes.append(('allow="bicycle"', BICYCLE_LANE_M))
        lanes += [('disallow="pedestrian"', LANE_M)] * int(generator.integers(1, self.max_lanes_per_direction + 1))
        if generator.random() < WITH_MEDIAN:
            lanes.append(('type="median" disallow="all"', generator.uniform(*MEDIAN_M)))
        return "".join(f'<lane index="{k}" {who} width="{width:.2f}"/>' for k, (who, width) in enumerate(lanes))


def compute_turning_speed_mps(line_m: Float64) -> float:
    """How fast a turn, (K, 2) places of its lane, may be driven: where it is tightest, not on its average."""
    steps_m = np.diff(line_m, axis=0)
    lengths_m = np.hypot(*steps_m.T)
    turned = np.unwrap(np.arctan2(steps_m[:, 1], steps_m[:, 0]))
    middles_m = np.cumsum(lengths_m) - lengths_m / 2
    further = np.abs(np.interp(middles_m + CURVE_M, middles_m, turned) - turned)
    return float(np.sqrt(TURN_MPS2 * CURVE_M / max(further.max(), 1e-6)))


def _without_dead_ends(streets: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Those that go on at both ends; all, if none does."""
    kept = streets
    while True:
        met = Counter(end for ends in kept for end in ends)
        fewer = [ends for ends in kept if all(met[end] > 1 for end in ends)]
        if len(fewer) == len(kept):
            return kept or streets
        kept = fewer


def _options(plan: str, generator: np.random.Generator) -> list[str]:
    def drawn(low: float, high: float) -> str:
        return f"{generator.uniform(low, high):.1f}"

    if plan == "rand":
        options = ["--rand", "--rand.iterations", "45", "--rand.min-distance", "90", "--rand.max-distance", "200"]
    elif plan == "grid":
        options = ["--grid", "--grid.number", "5", "--grid.x-length", drawn(90, 150), "--grid.y-length", drawn(90, 150)]
    else:
        arms = str(generator.integers(5, 8))
        options = ["--spider", "--spider.arm-number", arms, "--spider.circle-number", "3"]
        options += ["--spider.space-radius", drawn(100, 140), "--spider.omit-center"]
    return options


# Nobody is so much faster than what is allowed, nor walks faster.
FASTER = 1.1
WALKING_MPS = 2.2
SLOWEST_MPS = 1.0
# They brake as drivers do who are not in an emergency.
DRIVERS = f'decel="3.5" speedFactor="normc(1,0.1,0.8,{FASTER})"'
# The ego is one of those who have its length; which one, is found out when they have driven.
EGO_TYPE, EGOS = "ego", 8
MAX_AGENTS = 20_000


# Weight by our kinds of bodies.
TRAFFIC = {"sedan": 4.0, "hatchback": 4.0, "suv": 3.0, "pickup": 0.5, "van": 1.5, "lorry": 1.0, "truck": 0.2}
TRAFFIC |= {"motorcycle": 0.6}
PEOPLE = {"adult": 5.0, "child": 1.0}
CLASSES = {"truck": "truck", "bus": "bus", "motorcycle": "motorcycle", "cyclist": "bicycle"}


def write_routes(
    path: Path,
    network: Network,
    random_streets: RandomStreets,
    fleet: Fleet,
    duration_s: float,
    generator: np.random.Generator,
) -> None:
    """Write vehicles and people, all of whom set off at 0.

    ValueError: no street that cars may use leads anywhere, or there would be more than 20,000.
    """
    rows = [
        f'<vType id="{kind}" vClass="pedestrian"/>'
        if category == "pedestrian"
        else f'<vType id="{kind}" vClass="{CLASSES.get(category, "passenger")}" length="{fleet.get_length_m(kind):.2f}" '
        f'width="{fleet.get_width_m(kind):.2f}" {DRIVERS}/>'
        for kind, category in {**CATEGORIES, EGO_TYPE: "car"}.items()
    ]
    roads = _Ways(network, "passenger", "road")
    if not roads.length_m.any():
        raise ValueError(
            "the network has no street that cars may use and that leads on to another one: give routes instead of "
            "random, or a larger network"
        )
    cycling, walking = _Ways(network, "bicycle", "road"), _Ways(network, "passenger", "sidewalk")
    groups = [
        ({EGO_TYPE: 1.0}, roads, float(EGOS)),
        (TRAFFIC, roads, random_streets.traffic_per_km * roads.lanes_km - EGOS),
        ({"bus": 1.0}, _Ways(network, "bus", "road"), random_streets.buses_per_km * roads.lanes_km),
        ({"cyclist": 1.0}, cycling, random_streets.cyclists_per_km * cycling.lanes_km),
        (PEOPLE, walking, random_streets.people_per_km * walking.lanes_km),
    ]
    if (everybody := sum(number for _, _, number in groups)) > MAX_AGENTS:
        raise ValueError(
            f"traffic of about {everybody:,.0f} vehicles and people; at most {MAX_AGENTS:,} are drawn: lower the "
            "numbers to a kilometre, or take a piece of the network"
        )
    for mix, ways, number in groups:
        on_foot = mix is PEOPLE
        speed_mps = WALKING_MPS if on_foot else FASTER * max(ways.speed_mps, SLOWEST_MPS)
        for k in range(round(number) if ways.length_m.any() else 0):
            kind = EGO_TYPE if EGO_TYPE in mix else fleet.sample_kind(mix)
            way = ways.draw(speed_mps * duration_s, generator)
            if on_foot and generator.random() < 0.5:
                way = way[::-1]
            who, edges = f'id="{kind}.{k}" type="{kind}" depart="0"', quoteattr(" ".join(way))
            rows.append(
                f'<person {who} departPos="random"><walk edges={edges}/></person>'
                if on_foot
                else f'<vehicle {who} departPos="random_free" departLane="best"><route edges={edges}/></vehicle>'
            )
    path.write_text(f"<routes>{''.join(rows)}</routes>", encoding="utf-8")


class _Ways:
    """Draws ways of vehicles of a class, or of those who walk beside them."""

    def __init__(self, network: Network, vehicle_class: str, use: str) -> None:
        follow = network.find_successors(vehicle_class)
        if use == "sidewalk":
            walked = {lane.edge_id for lane in network.lanes if lane.use == use}
            follow = {edge: tuple(walked & set(after)) for edge, after in follow.items() if edge in walked}
        self._follow = {edge: tuple(sorted(after)) for edge, after in follow.items()}
        lanes = [
            lane
            for lane in network.lanes
            if lane.use == use
            and lane.edge_id in self._follow
            and (use == "sidewalk" or lane.is_allowed(vehicle_class))
        ]
        self._edges = list(self._follow)
        number = {edge: k for k, edge in enumerate(self._edges)}
        self._long_m = np.zeros(len(self._edges))  # of each edge, once
        self.length_m = np.zeros(len(self._edges))  # of its lanes together, if one may begin there
        for lane in lanes:
            long_m = float(np.linalg.norm(np.diff(lane.line_m, axis=0), axis=1).sum())
            self._long_m[number[lane.edge_id]] = long_m
            self.length_m[number[lane.edge_id]] += long_m * bool(self._follow[lane.edge_id])
        self._number = number
        self.lanes_km = float(self.length_m.sum()) / 1000
        self.speed_mps = max((lane.speed_mps for lane in lanes), default=0.0)

    def draw(self, length_m: float, generator: np.random.Generator) -> list[str]:
        """Edges that follow each other, of a length together, or to where nothing follows."""
        way = [self._edges[int(generator.choice(len(self._edges), p=self.length_m / self.length_m.sum()))]]
        gone_m = 0.0
        while gone_m < length_m and (follow := self._follow[way[-1]]):
            way.append(follow[int(generator.integers(len(follow)))])
            # A way is never so long as the number of its edges could get where they have no length.
            gone_m += max(float(self._long_m[self._number[way[-1]]]), 1.0)
        return way
