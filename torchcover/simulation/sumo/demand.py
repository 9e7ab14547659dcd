"""Traffic on the streets of a network, drawn: ways without an aim that never end within a run."""

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from torchcover.simulation.sumo.network import Network
from torchcover.simulation.sumo.streets import DrawnStreets
from torchcover.simulation.traffic.fleet import CATEGORIES, Fleet

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
    path: Path, network: Network, streets: DrawnStreets, fleet: Fleet, duration_s: float, generator: np.random.Generator
) -> None:
    """Write vehicles and people, all of whom set off at 0.

    ValueError: no street that cars may use leads anywhere, or there would be more than 20,000.
    """
    rows = [
        f'<vType id="{kind}" vClass="pedestrian"/>'
        if category == "pedestrian"
        else f'<vType id="{kind}" vClass="{CLASSES.get(category, "passenger")}" length="{fleet.length_m(kind):.2f}" '
        f'width="{fleet.width_m(kind):.2f}" {DRIVERS}/>'
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
        (TRAFFIC, roads, streets.traffic_per_km * roads.lanes_km - EGOS),
        ({"bus": 1.0}, _Ways(network, "bus", "road"), streets.buses_per_km * roads.lanes_km),
        ({"cyclist": 1.0}, cycling, streets.cyclists_per_km * cycling.lanes_km),
        (PEOPLE, walking, streets.people_per_km * walking.lanes_km),
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
            kind = EGO_TYPE if EGO_TYPE in mix else fleet.draw_kind(mix)
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
        follow = network.follow(vehicle_class)
        if use == "sidewalk":
            walked = {lane.edge for lane in network.lanes if lane.use == use}
            follow = {edge: tuple(walked & set(after)) for edge, after in follow.items() if edge in walked}
        self._follow = {edge: tuple(sorted(after)) for edge, after in follow.items()}
        lanes = [
            lane
            for lane in network.lanes
            if lane.use == use and lane.edge in self._follow and (use == "sidewalk" or lane.allows(vehicle_class))
        ]
        self._edges = list(self._follow)
        number = {edge: k for k, edge in enumerate(self._edges)}
        self._long_m = np.zeros(len(self._edges))  # of each edge, once
        self.length_m = np.zeros(len(self._edges))  # of its lanes together, if one may begin there
        for lane in lanes:
            long_m = float(np.linalg.norm(np.diff(lane.line_m, axis=0), axis=1).sum())
            self._long_m[number[lane.edge]] = long_m
            self.length_m[number[lane.edge]] += long_m * bool(self._follow[lane.edge])
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
