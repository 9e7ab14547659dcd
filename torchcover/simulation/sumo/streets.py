"""Sampled town for SUMO: a plan with lanes, parking bays, bends and hills, and traffic without destinations."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
StreetEnds = tuple[str, str]  # names of the nodes at both ends of a street, in alphabetical order


@dataclass(frozen=True)
class TownParams:
    """Dimensions of streets.

    Args:
        lane_m: Width of lanes.
        bicycle_lane_m: Width of bicycle lanes.
        bay_m: Width of parking bays.
        sidewalk_m: Smallest and largest width of sidewalks.
        median_m: Smallest and largest width of half of a median.
        bay_share: Share of the street sides with parking bays.
        bicycle_lane_share: Share of the street sides with bicycle lanes.
        median_share: Share of the street sides with a median.
        min_clearance_m: Smallest distance between the centerlines of two streets that do not meet.
        num_segments: Number of straight segments of a bend.
        corner_radius_m: Radius of curbs at corners.
        turning_mps2: Lateral acceleration of vehicles in turns.
        curve_m: Length over which the curvature of a turn is measured; drivers round curves within it.
    """

    lane_m: float = 3.25
    bicycle_lane_m: float = 1.8
    bay_m: float = 2.3
    sidewalk_m: tuple[float, float] = (2.4, 3.4)
    median_m: tuple[float, float] = (0.8, 1.8)
    bay_share: float = 0.7
    bicycle_lane_share: float = 0.5
    median_share: float = 0.3
    min_clearance_m: float = 40.0
    num_segments: int = 10
    corner_radius_m: float = 6.0
    turning_mps2: float = 2.0
    curve_m: float = 5.0


TOWN = TownParams()


class RandomStreets(Document):
    """Streets and traffic that are sampled from a seed.

    Args:
        layout: Plan of the streets; sampled if None.
        max_lanes_per_direction: Largest number of lanes in each direction.
        speed_limit_mps: Speed limit.
        max_bend_ratio: Largest offset of the middle of a street from the straight line, as a share of its length.
        hill_height_std_m: Standard deviation of the ground height; 0 is a plane.
        traffic_per_km: Vehicles per kilometer of lane.
        buses_per_km: Buses per kilometer of lane, in addition.
        cyclists_per_km: Cyclists per kilometer of lane that they may use.
        people_per_km: Pedestrians per kilometer of sidewalk.
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
        """Sample a network.

        Args:
            folder: Folder of the network file.
            generator: Random generator.

        Returns:
            The network file.
        """
        layout = self.layout or str(generator.choice(["rand", "grid", "spider"]))
        prefix = folder / "plan"
        seed = str(generator.integers(1 << 31))
        options = _sample_layout_options(layout, generator)
        run_program("netgenerate", *options, "--seed", seed, "--plain-output-prefix", prefix)
        nodes_m = {}
        for node in parse_xml(prefix.with_suffix(".nod.xml")).iter("node"):
            nodes_m[node.get("id", "")] = (float(node.get("x", "")), float(node.get("y", "")))
        edges = list(parse_xml(prefix.with_suffix(".edg.xml")).iter("edge"))
        hills = Hills(self.hill_height_std_m, generator)
        node_file, edge_file, network_file = folder / "nodes.xml", folder / "edges.xml", folder / "sampled.net.xml"
        edge_file.write_text(self._format_edges(nodes_m, edges, hills, generator), encoding="utf-8")
        node_file.write_text(_format_nodes(nodes_m, hills), encoding="utf-8")
        run_program(
            "netconvert", "--node-files", node_file, "--edge-files", edge_file, "--output-file", network_file,
            "--precision", "3", "--tls.guess", "--walkingareas", "--crossings.guess",
            "--no-turnarounds.except-deadend",
            "--default.junctions.radius", str(TOWN.corner_radius_m), "--junctions.internal-link-detail", "12",
        )  # fmt: skip
        network = parse_xml(network_file)
        # netconvert computes the speed of a turn from its average curvature.
        for lane in network.iterfind("edge[@function='internal']/lane"):
            line_m = np.array([text.split(",")[:2] for text in lane.get("shape", "").split()], dtype=np.float64)
            lane.set("speed", f"{min(self.speed_limit_mps, compute_turning_speed_mps(line_m)):.2f}")
        ElementTree.ElementTree(network).write(network_file)
        return network_file

    def _format_edges(
        self,
        nodes_m: Mapping[str, tuple[float, float]],
        edges: Sequence[ElementTree.Element],
        hills: Hills,
        generator: np.random.Generator,
    ) -> str:
        """Format the edges of bent streets for netconvert."""
        # Both directions of a street have the same centerline.
        edges_by_street: dict[StreetEnds, list[tuple[str, str, str]]] = {}
        for edge in edges:
            name, start, end = edge.get("id", ""), edge.get("from", ""), edge.get("to", "")
            edges_by_street.setdefault((min(start, end), max(start, end)), []).append((name, start, end))
        lines: dict[StreetEnds, shapely.LineString] = {}
        # The plan of netgenerate knows no widths: streets that come too close to earlier ones are left out.
        for ends in edges_by_street:
            start_m, end_m = np.array(nodes_m[ends[0]]), np.array(nodes_m[ends[1]])
            line = shapely.LineString(self._sample_bend(start_m, end_m, generator))
            is_clear = True
            for other_ends, other_line in lines.items():
                meets = set(ends) & set(other_ends)
                is_clear &= bool(meets or line.distance(other_line) >= TOWN.min_clearance_m)
            if is_clear:
                lines[ends] = line
        # Junctions are level: all streets are level at their ends.
        shares = np.linspace(0.0, 1.0, TOWN.num_segments + 1)
        rows = []
        for ends in remove_dead_ends(list(lines)):
            line_m, lanes = shapely.get_coordinates(lines[ends]), self._sample_lanes(generator)
            start_height_m, end_height_m = hills.compute_heights_m(line_m[[0, -1]])
            heights_m = start_height_m + (end_height_m - start_height_m) * shares**2 * (3 - 2 * shares)
            positions = [f"{x:.3f},{y:.3f},{z:.3f}" for (x, y), z in zip(line_m, heights_m, strict=True)]
            for name, start, end in edges_by_street[ends]:
                shape = " ".join(positions if start == ends[0] else positions[::-1])
                rows.append(
                    f"<edge id={quoteattr(name)} from={quoteattr(start)} to={quoteattr(end)} "
                    f'numLanes="{lanes.count("<lane")}" speed="{self.speed_limit_mps:.2f}" shape="{shape}">{lanes}'
                    "</edge>"
                )
        return f"<edges>{''.join(rows)}</edges>"

    def _sample_bend(self, start_m: Float64, end_m: Float64, generator: np.random.Generator) -> Float64:
        """Sample a line (K, 2) that leaves both ends straight."""
        shares = np.linspace(0.0, 1.0, TOWN.num_segments + 1)[:, None]
        along_m = end_m - start_m
        bend_ratio = generator.uniform(-self.max_bend_ratio, self.max_bend_ratio)
        offsets = bend_ratio * np.sin(np.pi * shares) ** 2
        return np.asarray(start_m + shares * along_m + offsets * np.array([-along_m[1], along_m[0]]))

    def _sample_lanes(self, generator: np.random.Generator) -> str:
        """Sample the lanes of one side of a street, from the houses inwards."""
        lanes = [('allow="pedestrian"', generator.uniform(*TOWN.sidewalk_m))]
        if generator.random() < TOWN.bay_share:
            lanes.append(('type="parking" disallow="all"', TOWN.bay_m))
        if self.cyclists_per_km > 0 and generator.random() < TOWN.bicycle_lane_share:
            lanes.append(('allow="bicycle"', TOWN.bicycle_lane_m))
        num_lanes = int(generator.integers(1, self.max_lanes_per_direction + 1))
        lanes += [('disallow="pedestrian"', TOWN.lane_m)] * num_lanes
        if generator.random() < TOWN.median_share:
            lanes.append(('type="median" disallow="all"', generator.uniform(*TOWN.median_m)))
        rows = []
        for index, (attributes, width_m) in enumerate(lanes):
            rows.append(f'<lane index="{index}" {attributes} width="{width_m:.2f}"/>')
        return "".join(rows)


def _format_nodes(nodes_m: Mapping[str, tuple[float, float]], hills: Hills) -> str:
    """Format the nodes with their heights for netconvert."""
    heights_m = hills.compute_heights_m(np.array(list(nodes_m.values())))
    rows = []
    for (name, (x, y)), z in zip(nodes_m.items(), heights_m, strict=True):
        rows.append(f'<node id={quoteattr(name)} x="{x:.3f}" y="{y:.3f}" z="{z:.3f}"/>')
    return f"<nodes>{''.join(rows)}</nodes>"


def compute_turning_speed_mps(line_m: Float64) -> float:
    """Compute the speed at which a turn can be driven, from its tightest part.

    Args:
        line_m: (K, 2) centerline.
    """
    steps_m = np.diff(line_m, axis=0)
    lengths_m = np.hypot(*steps_m.T)
    headings_rad = np.unwrap(np.arctan2(steps_m[:, 1], steps_m[:, 0]))
    middles_m = np.cumsum(lengths_m) - lengths_m / 2
    turns_rad = np.abs(np.interp(middles_m + TOWN.curve_m, middles_m, headings_rad) - headings_rad)
    return float(np.sqrt(TOWN.turning_mps2 * TOWN.curve_m / max(turns_rad.max(), 1e-6)))


def remove_dead_ends(streets: list[StreetEnds]) -> list[StreetEnds]:
    """Remove streets that do not continue at both ends, repeatedly.

    Args:
        streets: Ends of the streets.

    Returns:
        The remaining streets; all of them if none would remain.
    """
    remaining = streets
    while True:
        counts: Counter[str] = Counter()
        for ends in remaining:
            counts.update(ends)
        continuing = [ends for ends in remaining if counts[ends[0]] > 1 and counts[ends[1]] > 1]
        if len(continuing) == len(remaining):
            return remaining or streets
        remaining = continuing


def _sample_layout_options(layout: str, generator: np.random.Generator) -> list[str]:
    """Sample the options of netgenerate for a layout."""
    if layout == "rand":
        return ["--rand", "--rand.iterations", "45", "--rand.min-distance", "90", "--rand.max-distance", "200"]
    if layout == "grid":
        x_m, y_m = generator.uniform(90, 150), generator.uniform(90, 150)
        return ["--grid", "--grid.number", "5", "--grid.x-length", f"{x_m:.1f}", "--grid.y-length", f"{y_m:.1f}"]
    num_arms, radius_m = generator.integers(5, 8), generator.uniform(100, 140)
    options = ["--spider", "--spider.arm-number", str(num_arms), "--spider.circle-number", "3"]
    return [*options, "--spider.space-radius", f"{radius_m:.1f}", "--spider.omit-center"]


@dataclass(frozen=True)
class RandomTrafficParams:
    """Sampled traffic of a town.

    Args:
        max_speed_factor: Largest desired speed, as a factor on the speed limit.
        min_speed_mps: Smallest speed limit that counts for the length of routes.
        walking_mps: Largest speed of pedestrians.
        num_ego_candidates: Number of vehicles from which the ego vehicle is chosen after the simulation.
        max_agents: Largest number of vehicles and people.
    """

    max_speed_factor: float = 1.1
    min_speed_mps: float = 1.0
    walking_mps: float = 2.2
    num_ego_candidates: int = 8
    max_agents: int = 20_000


TRAFFIC = RandomTrafficParams()
EGO_TYPE = "ego"  # type of the candidates, which have the length of the ego vehicle
# Weights of the kinds of vehicles and pedestrians.
VEHICLE_WEIGHTS = {
    "sedan": 4.0, "hatchback": 4.0, "suv": 3.0, "pickup": 0.5, "van": 1.5, "lorry": 1.0, "truck": 0.2,
    "motorcycle": 0.6,
}  # fmt: skip
PEDESTRIAN_WEIGHTS = {"adult": 5.0, "child": 1.0}


def write_routes(
    path: Path,
    network: Network,
    random_streets: RandomStreets,
    fleet: Fleet,
    duration_s: float,
    generator: np.random.Generator,
) -> None:
    """Write routes of vehicles and pedestrians that all start at time 0.

    Args:
        path: File of the routes.
        network: Network.
        random_streets: Densities of the traffic.
        fleet: Bodies.
        duration_s: Duration for which the routes must suffice.
        generator: Random generator.

    Raises:
        ValueError: No street for cars leads to another one, or there would be too many vehicles and people.
    """
    roads = RouteSampler(network, "passenger", "road")
    if not roads.start_lengths_m.any():
        raise ValueError(
            "the network has no street that cars may use and that leads on to another one: give routes instead of "
            "random, or a larger network"
        )
    cycling, walking = RouteSampler(network, "bicycle", "road"), RouteSampler(network, "passenger", "sidewalk")
    num_vehicles = random_streets.traffic_per_km * roads.lanes_km - TRAFFIC.num_ego_candidates
    groups: list[tuple[dict[str, float], RouteSampler, float]] = [
        ({EGO_TYPE: 1.0}, roads, float(TRAFFIC.num_ego_candidates)),
        (VEHICLE_WEIGHTS, roads, num_vehicles),
        ({"bus": 1.0}, RouteSampler(network, "bus", "road"), random_streets.buses_per_km * roads.lanes_km),
        ({"cyclist": 1.0}, cycling, random_streets.cyclists_per_km * cycling.lanes_km),
        (PEDESTRIAN_WEIGHTS, walking, random_streets.people_per_km * walking.lanes_km),
    ]
    num_agents = sum(count for _, _, count in groups)
    if num_agents > TRAFFIC.max_agents:
        raise ValueError(
            f"traffic of about {num_agents:,.0f} vehicles and people; at most {TRAFFIC.max_agents:,} are sampled: "
            "lower the numbers per kilometer, or take a piece of the network"
        )
    rows = [_format_vehicle_type(kind, category, fleet) for kind, category in {**CATEGORIES, EGO_TYPE: "car"}.items()]
    # Vehicles and people start at random positions, and walk in either direction.
    for weights, sampler, count in groups:
        is_walking = weights is PEDESTRIAN_WEIGHTS
        max_speed_mps = TRAFFIC.max_speed_factor * max(sampler.max_speed_mps, TRAFFIC.min_speed_mps)
        length_m = (TRAFFIC.walking_mps if is_walking else max_speed_mps) * duration_s
        for index in range(round(count) if sampler.start_lengths_m.any() else 0):
            kind = EGO_TYPE if EGO_TYPE in weights else fleet.sample_kind(weights)
            edges = sampler.sample_route(length_m, generator)
            if is_walking and generator.random() < 0.5:
                edges = edges[::-1]
            attributes, route = f'id="{kind}.{index}" type="{kind}" depart="0"', quoteattr(" ".join(edges))
            if is_walking:
                rows.append(f'<person {attributes} departPos="random"><walk edges={route}/></person>')
            else:
                attributes += ' departPos="random_free" departLane="best"'
                rows.append(f"<vehicle {attributes}><route edges={route}/></vehicle>")
    path.write_text(f"<routes>{''.join(rows)}</routes>", encoding="utf-8")


def _format_vehicle_type(kind: str, category: str, fleet: Fleet) -> str:
    """Format the type of a body for SUMO; drivers brake as they do when it is not an emergency."""
    if category == "pedestrian":
        return f'<vType id="{kind}" vClass="pedestrian"/>'
    classes = {"truck": "truck", "bus": "bus", "motorcycle": "motorcycle", "cyclist": "bicycle"}
    vehicle_class = classes.get(category, "passenger")
    return (
        f'<vType id="{kind}" vClass="{vehicle_class}" length="{fleet.get_length_m(kind):.2f}" '
        f'width="{fleet.get_width_m(kind):.2f}" decel="3.5" speedFactor="normc(1,0.1,0.8,{TRAFFIC.max_speed_factor})"/>'
    )


class RouteSampler:
    """Sampler of routes of vehicles, or of pedestrians along the streets of vehicles.

    Args:
        network: Network.
        vehicle_class: Vehicle class.
        use: "road", or "sidewalk" for pedestrians.

    Attributes:
        start_lengths_m: (E,) length of the lanes of each edge on which a route may start.
        lanes_km: Their total length.
        max_speed_mps: Largest speed limit.
    """

    def __init__(self, network: Network, vehicle_class: str, use: Literal["road", "sidewalk"]) -> None:
        successors = network.find_successors(vehicle_class)
        if use == "sidewalk":
            walkable = {lane.edge_id for lane in network.lanes if lane.use == use}
            for edge in successors.keys() - walkable:
                del successors[edge]
            for edge, following in successors.items():
                successors[edge] = tuple(sorted(walkable & set(following)))
        self._successors = successors
        self._edges = list(successors)
        self._indices = dict(zip(self._edges, range(len(self._edges)), strict=True))
        self._lengths_m = np.zeros(len(self._edges))
        self.start_lengths_m = np.zeros(len(self._edges))
        self.max_speed_mps = 0.0
        for lane in network.lanes:
            is_usable = use == "sidewalk" or lane.is_allowed(vehicle_class)
            if lane.use != use or lane.edge_id not in successors or not is_usable:
                continue
            length_m = float(np.linalg.norm(np.diff(lane.line_m, axis=0), axis=1).sum())
            index = self._indices[lane.edge_id]
            self._lengths_m[index] = length_m
            self.start_lengths_m[index] += length_m * bool(successors[lane.edge_id])
            self.max_speed_mps = max(self.max_speed_mps, lane.speed_mps)
        self.lanes_km = float(self.start_lengths_m.sum()) / 1000

    def sample_route(self, length_m: float, generator: np.random.Generator) -> list[str]:
        """Sample successive edges.

        Args:
            length_m: Length of the route, if it does not end before.
            generator: Random generator.
        """
        shares = self.start_lengths_m / self.start_lengths_m.sum()
        route = [self._edges[int(generator.choice(len(self._edges), p=shares))]]
        driven_m = 0.0
        while driven_m < length_m and (successors := self._successors[route[-1]]):
            route.append(successors[int(generator.integers(len(successors)))])
            # Edges without length count 1 m, so that a route ends.
            driven_m += max(float(self._lengths_m[self._indices[route[-1]]]), 1.0)
        return route
