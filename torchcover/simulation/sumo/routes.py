"""Sampled traffic for SUMO: routes of vehicles and pedestrians without destinations."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np

from torchcover.simulation.sumo.network import Network
from torchcover.simulation.sumo.streets import RandomStreets
from torchcover.simulation.traffic.fleet import CATEGORIES, Fleet


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
