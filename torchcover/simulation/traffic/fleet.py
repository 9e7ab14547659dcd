"""Who is on the road: bodies by kind, how each kind drives, and lanes filled with them."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache

import numpy as np

from torchcover.geometry import BoundingBox
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.articulated import DRAWS
from torchcover.simulation.traffic.flow import Agent
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.signals import Gate
from torchcover.simulation.world import Actor

# What each built-in body counts as.
BODIES = {
    "suv": "car",
    "sedan": "car",
    "hatchback": "car",
    "pickup": "car",
    "van": "car",
    "lorry": "truck",
    "truck": "truck",
    # It has a box and a category of its own, as in nuScenes.
    "trailer": "trailer",
    "bus": "bus",
    "motorcycle": "motorcycle",
    "cyclist": "cyclist",
    "adult": "pedestrian",
    "child": "pedestrian",
}
# Lengths, widths and heights of others of a kind, as shares of its body's: within the spreads of boxes in recorded
# logs (docs/measured/streets.md).
SIZES: Mapping[str, tuple[tuple[float, float, float], ...]] = {
    "suv": ((0.91, 0.95, 1.02), (1.03, 1.03, 1.10)),
    "sedan": ((0.94, 0.98, 0.99), (1.04, 1.02, 1.03)),
    "hatchback": ((0.90, 0.96, 1.00), (1.02, 1.01, 1.08)),
    "pickup": ((1.07, 1.05, 1.04),),
    "van": ((0.80, 0.94, 0.72), (0.90, 0.98, 0.82)),
    "lorry": ((0.84, 0.94, 0.90), (1.13, 1.02, 1.07)),
    "adult": ((0.95, 0.92, 0.94), (1.05, 1.06, 1.05)),
    "child": ((0.90, 0.90, 0.88), (1.10, 1.08, 1.15)),
}
# Those of other sizes have a number behind their kind.
KIND_OF = {f"{kind}_{number}": kind for kind, sizes in SIZES.items() for number in range(2, 2 + len(sizes))}
KIND_OF |= {kind: kind for kind in BODIES}
CATEGORIES = {name: BODIES[kind] for name, kind in sorted(KIND_OF.items())}
EGO = "ego"
HEAVY = ("truck", "lorry", "bus")
REAR_OF = "rear of "

WALKING = Driver(
    desired_speed_mps=1.4, headway_s=0.4, standstill_gap_m=0.5, acceleration_mps2=1.0, deceleration_mps2=1.5
)
CYCLING = Driver(
    desired_speed_mps=5.0, headway_s=0.8, standstill_gap_m=1.0, acceleration_mps2=0.8, deceleration_mps2=1.8
)


@cache
def load_bodies() -> Mapping[str, Mesh]:
    """The built-in bodies, in all their sizes."""
    truck = Vehicle.load("truck")
    behind = [part.name.startswith("trailer") for part in truck.parts]
    called = {kind: kind for kind in BODIES if kind not in ("truck", "trailer")} | {"child": "child_120cm"}
    meshes = {kind: Vehicle.load(name).mesh() for kind, name in called.items()}
    for kind, is_rear in (("truck", False), ("trailer", True)):
        parts = tuple(part for part, at_rear in zip(truck.parts, behind, strict=True) if at_rear is is_rear)
        meshes[kind] = truck.model_copy(update={"parts": parts}).mesh()
    for kind, sizes in SIZES.items():
        for number, shares in enumerate(sizes, 2):
            meshes[f"{kind}_{number}"] = meshes[kind]._replace(vertices_m=meshes[kind].vertices_m * np.array(shares))
    return meshes


class Fleet:
    """The bodies of a world, and the drivers drawn for them. ValueError: a kind has no body."""

    def __init__(self, bodies: Mapping[str, Mesh], ego: Mesh | None, generator: np.random.Generator) -> None:
        missing = sorted(CATEGORIES.keys() - bodies.keys())
        if missing:
            raise ValueError(f"traffic needs a body for each kind; there is none for {', '.join(missing)}")
        self.meshes = {EGO: bodies["suv"] if ego is None else ego, **{kind: bodies[kind] for kind in CATEGORIES}}
        self._sizes = {kind: BoundingBox.around(mesh.vertices_m).size_m for kind, mesh in self.meshes.items()}
        self._lengths_m = {kind: self._length_m(kind) for kind in self.meshes}  # asked thousands of times a world
        self._generator = generator
        self.parked: list[Actor] = []
        self.left_out = 0

    def length_m(self, kind: str) -> float:
        """Extent along x, on a straight with all that it draws along."""
        return self._lengths_m[kind]

    def _length_m(self, kind: str) -> float:
        parts_m = [length_m for length_m, _ in self.sizes_m(kind)]
        return sum(parts_m) / 2 - DRAWS[kind].hitch_m + DRAWS[kind].middle_m if kind in DRAWS else parts_m[0]

    def sizes_m(self, kind: str) -> tuple[tuple[float, float], ...]:
        """Lengths and widths of the body and of what it draws along."""
        return tuple(self._sizes[part][:2] for part in parts_of(kind))

    def width_m(self, kind: str) -> float:
        """Extent along y."""
        return self._sizes[kind][1]

    def draw_kind(self, mix: Mapping[str, float]) -> str:
        """One kind, each with a probability in proportion to its weight, in one of its sizes."""
        names, up_to = _bodies_of(tuple(mix), tuple(mix.values()))
        return names[bisect_right(up_to, self._generator.random())]

    def draw_driver(self, typical: Driver, spread: float) -> Driver:
        """A driver whose desired speed differs from the typical one by up to `spread`, a share of it."""
        # As `uniform` would, which takes thrice as long.
        share = 1 - spread + (1 + spread - (1 - spread)) * self._generator.random()
        desired_mps = float(typical.desired_speed_mps * share)
        rest = typical.headway_s, typical.standstill_gap_m, typical.acceleration_mps2, typical.deceleration_mps2
        return Driver(desired_mps, *rest)  # by hand: there are thousands of them in a world

    def agent(self, kind: str, lane: int, place_m: float, driver: Driver) -> Agent:
        """Somebody of a kind on a lane."""
        return Agent(kind, self.length_m(kind), lane, place_m, driver)

    def park(
        self,
        kind: str,
        pose: tuple[float, float, float],
        height_m: float = 0.0,
        tilt_deg: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Note a body down in `parked`, at a pose x, y in metres and yaw in degrees; pitch and roll on a slope."""
        x_m, y_m, yaw_deg = pose
        place = Trajectory.resting((x_m, y_m, height_m), (yaw_deg, *tilt_deg))
        self.parked.append(Actor(f"parked {kind} {len(self.parked)}", CATEGORIES[kind], self.meshes[kind], place))

    def fill(
        self,
        lane: int,
        span_m: tuple[float, float],
        per_km: float,
        drivers: Mapping[str, tuple[float, Driver]],
        *,
        gates: Sequence[Gate] = (),
        keep_free: Sequence[Agent] = (),
        spread: float = 0.12,
        heavy_spread: float = 0.12,
    ) -> list[Agent]:
        """Fill a lane with agents at random gaps, `per_km` as far as they fit at full speed; nobody on a junction.

        The fronts and rears of all lie in `span_m` on it, clear of `keep_free`, who are there already. `drivers` are
        the weight and the typical driver of each kind that uses the lane, `gates` the junctions on it; speeds spread by
        `spread`, those of lorries and buses by `heavy_spread`.
        """
        mix = {kind: weight for kind, (weight, _) in drivers.items()}
        agents: list[Agent] = []
        others = [other for other in keep_free if other.lane == lane]
        rear = span_m[0]
        while per_km > 0:
            kind = self.draw_kind(mix)
            driver = self.draw_driver(drivers[KIND_OF[kind]][1], heavy_spread if KIND_OF[kind] in HEAVY else spread)
            # What one keeps at full speed, so that nobody has to brake at first.
            gap = float(driver.standstill_gap_m + driver.headway_s * driver.desired_speed_mps)
            length = self.length_m(kind)
            rear += gap + self._generator.exponential(max(1000.0 / per_km - gap - length, 0.1))
            if rear + length > span_m[1]:
                break
            agent = self.agent(kind, lane, rear + length / 2, driver)
            if not _in_the_way(agent, gates, gap, others):
                agents.append(agent)
            rear += length
        return agents


def parts_of(kind: str) -> tuple[str, ...]:
    """A kind, and that of what it draws along."""
    return (kind, DRAWS[kind].rear) if kind in DRAWS else (kind,)


@lru_cache(maxsize=64)
def _bodies_of(kinds: tuple[str, ...], weights: tuple[float, ...]) -> tuple[list[str], list[float]]:
    """The bodies of some kinds, all sizes of a kind alike, and the share that each and those before it have."""
    sizes = [[name for name, kind in KIND_OF.items() if kind == one] for one in kinds]
    shares = np.repeat(np.array(weights) / np.sum(weights), [len(names) for names in sizes])
    up_to = (shares / np.repeat([len(names) for names in sizes], [len(names) for names in sizes])).cumsum()
    return [name for names in sizes for name in names], (up_to / up_to[-1]).tolist()


def _in_the_way(agent: Agent, gates: Sequence[Gate], gap_m: float, others: Sequence[Agent]) -> bool:
    rear, front = agent.place_m - agent.length_m / 2, agent.place_m + agent.length_m / 2
    # Gates follow each other: of those that are not behind, the first is the nearest.
    gate = bisect_right(gates, rear, key=lambda gate: gate.exit_m)
    if gate < len(gates) and front > gates[gate].enter_m - gap_m:
        return True
    return any(abs(agent.place_m - other.place_m) < (agent.length_m + other.length_m) / 2 + gap_m for other in others)
