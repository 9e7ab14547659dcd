"""Road users: bodies and drivers of each kind, and lanes filled with agents."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from torchcover.files import load_road_user_classes
from torchcover.geometry import BoundingBox
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.scene import Actor
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.flow import Agent
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.traffic.junctions import JunctionPassage
from torchcover.simulation.traffic.trailers import HITCHES


class VehicleType(NamedTuple):
    """Type of a road user in a recording or simulation.

    Args:
        vehicle_class: Vehicle class in SUMO's vocabulary, such as "passenger".
        length_m: Length.
    """

    vehicle_class: str
    length_m: float

    def find_body(self, lengths_m: Mapping[str, float]) -> str | None:
        """Find the body that represents this type.

        Args:
            lengths_m: Length of each available body.

        Returns:
            The body of the class whose length is nearest; None for rail vehicles, ships and drones.
        """
        classes_without_body = "rail rail_urban rail_electric rail_fast subway cable_car ship drone"
        if self.vehicle_class in classes_without_body.split():
            return None
        cars = ("hatchback", "sedan", "suv", "pickup", "van")
        kinds = load_road_user_classes()["bodies"].get(self.vehicle_class, cars)
        if kinds[0] in ("adult", "child"):
            return str(kinds[0])  # SUMO gives all people one length
        bodies = [body for body in lengths_m if body.partition("_")[0] in kinds]
        differences_m = [abs(lengths_m[body] - self.length_m) for body in bodies]
        return bodies[int(np.argmin(differences_m))]


# Category of each built-in kind; a trailer has its own box and category, as in nuScenes.
KIND_CATEGORIES = {
    **dict.fromkeys(("suv", "sedan", "hatchback", "pickup", "van"), "car"),
    **dict.fromkeys(("lorry", "truck"), "truck"),
    **{kind: kind for kind in ("trailer", "bus", "motorcycle", "cyclist")},
    **dict.fromkeys(("adult", "child"), "pedestrian"),
}
# Length, width and height of further bodies of a kind, as factors on the size of its first body; within the spread of
# boxes in recorded logs (docs/measured/streets.md).
SIZE_FACTORS: Mapping[str, tuple[tuple[float, float, float], ...]] = {
    "suv": ((0.91, 0.95, 1.02), (1.03, 1.03, 1.10)),
    "sedan": ((0.94, 0.98, 0.99), (1.04, 1.02, 1.03)),
    "hatchback": ((0.90, 0.96, 1.00), (1.02, 1.01, 1.08)),
    "pickup": ((1.07, 1.05, 1.04),),
    "van": ((0.80, 0.94, 0.72), (0.90, 0.98, 0.82)),
    "lorry": ((0.84, 0.94, 0.90), (1.13, 1.02, 1.07)),
    "adult": ((0.95, 0.92, 0.94), (1.05, 1.06, 1.05)),
    "child": ((0.90, 0.90, 0.88), (1.10, 1.08, 1.15)),
}
# Kind of each body: further bodies of a kind have a number behind its name, from 2.
BODY_KINDS = {f"{kind}_{number}": kind for kind, sizes in SIZE_FACTORS.items() for number in range(2, 2 + len(sizes))}
BODY_KINDS |= {kind: kind for kind in KIND_CATEGORIES}
CATEGORIES = {body: KIND_CATEGORIES[kind] for body, kind in sorted(BODY_KINDS.items())}
HEAVY_KINDS = ("truck", "lorry", "bus")
# Name of the ego vehicle, and prefix of the name of an actor that is a trailer.
EGO = "ego"
REAR_OF = "rear of "

PEDESTRIAN = Driver(
    desired_speed_mps=1.4, headway_s=0.4, standstill_gap_m=0.5, acceleration_mps2=1.0, deceleration_mps2=1.5
)
CYCLIST = Driver(
    desired_speed_mps=5.0, headway_s=0.8, standstill_gap_m=1.0, acceleration_mps2=0.8, deceleration_mps2=1.8
)


@cache
def load_bodies() -> Mapping[str, Mesh]:
    """Load the mesh of each built-in body in `CATEGORIES`."""
    truck = Vehicle.load("truck")
    meshes: dict[str, Mesh] = {}
    for kind in KIND_CATEGORIES:
        if kind not in ("truck", "trailer"):
            meshes[kind] = Vehicle.load("child_120cm" if kind == "child" else kind).build_mesh()
    # The built-in truck is one vehicle, which is divided into tractor and trailer.
    for kind in ("truck", "trailer"):
        parts = tuple(part for part in truck.parts if part.name.startswith("trailer") == (kind == "trailer"))
        meshes[kind] = truck.model_copy(update={"parts": parts}).build_mesh()
    for kind, sizes in SIZE_FACTORS.items():
        for number, factors in enumerate(sizes, 2):
            meshes[f"{kind}_{number}"] = meshes[kind]._replace(vertices_m=meshes[kind].vertices_m * np.array(factors))
    return meshes


class Fleet:
    """Bodies of a scene, samples of drivers, and the parked vehicles.

    Args:
        body_meshes: Mesh of each body in `CATEGORIES`.
        ego_mesh: Mesh of the ego vehicle; the body "suv" if None.
        generator: Random generator of kinds and drivers.

    Attributes:
        meshes: Mesh of each body and of the ego vehicle.
        parked: Actors that never move.
        omitted_count: Number of road users that were omitted because their bodies would overlap others.

    Raises:
        ValueError: A body has no mesh.
    """

    def __init__(self, body_meshes: Mapping[str, Mesh], ego_mesh: Mesh | None, generator: np.random.Generator) -> None:
        missing = sorted(CATEGORIES.keys() - body_meshes.keys())
        if missing:
            raise ValueError(f"no body for {', '.join(missing)}; traffic needs a mesh for each kind")
        self.meshes = {EGO: body_meshes["suv"] if ego_mesh is None else ego_mesh}
        self.meshes |= {kind: body_meshes[kind] for kind in CATEGORIES}
        self._sizes_m = {kind: BoundingBox.from_points(mesh.vertices_m).size_m for kind, mesh in self.meshes.items()}
        # Lengths are computed once because a scene looks them up thousands of times.
        self._lengths_m = {kind: self._compute_length_m(kind) for kind in self.meshes}
        self._generator = generator
        self.parked: list[Actor] = []
        self.omitted_count = 0

    def get_length_m(self, kind: str) -> float:
        """Return the extent of a body along x, on a straight and with its trailer."""
        return self._lengths_m[kind]

    def _compute_length_m(self, kind: str) -> float:
        """Compute the length of a body with its trailer, from bumper to bumper."""
        part_lengths_m = [length_m for length_m, _ in self.get_sizes_m(kind)]
        if kind not in HITCHES:
            return part_lengths_m[0]
        return sum(part_lengths_m) / 2 - HITCHES[kind].hitch_offset_m + HITCHES[kind].hitch_to_center_m

    def get_sizes_m(self, kind: str) -> tuple[tuple[float, float], ...]:
        """Return length and width of a body and, if it has one, of its trailer."""
        return tuple(self._sizes_m[part][:2] for part in get_part_kinds(kind))

    def get_width_m(self, kind: str) -> float:
        """Return the extent of a body along y."""
        return self._sizes_m[kind][1]

    def sample_kind(self, weights: Mapping[str, float]) -> str:
        """Sample a body.

        Args:
            weights: Relative frequency of each kind; all bodies of a kind are equally frequent.

        Returns:
            Key of `CATEGORIES`, or of `weights`.
        """
        bodies, cumulative_shares = list_bodies(tuple(weights), tuple(weights.values()))
        return bodies[bisect_right(cumulative_shares, self._generator.random())]

    def sample_driver(self, typical_driver: Driver, speed_spread: float) -> Driver:
        """Sample a driver.

        Args:
            typical_driver: Driver with the mean desired speed.
            speed_spread: Largest relative deviation of the desired speed.

        Returns:
            Driver with a uniformly distributed desired speed.
        """
        # Written out because `uniform` takes three times as long, and a scene has thousands of drivers.
        factor = 1 - speed_spread + (1 + speed_spread - (1 - speed_spread)) * self._generator.random()
        driver, desired_mps = typical_driver, float(typical_driver.desired_speed_mps * factor)
        gaps = (driver.headway_s, driver.standstill_gap_m)
        return Driver(desired_mps, *gaps, driver.acceleration_mps2, driver.deceleration_mps2)

    def create_agent(self, kind: str, lane_index: int, lane_position_m: float, driver: Driver) -> Agent:
        """Create an agent with the length of its body.

        Args:
            kind: Body.
            lane_index: Index of the lane.
            lane_position_m: Position of the center along the lane.
            driver: Driver.
        """
        return Agent(kind, self.get_length_m(kind), lane_index, lane_position_m, driver)

    def add_parked_vehicle(
        self,
        kind: str,
        pose: tuple[float, float, float],
        height_m: float = 0.0,
        tilt_deg: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Append a vehicle to `parked`.

        Args:
            kind: Body.
            pose: x and y in meters and yaw in degrees.
            height_m: z of the ground.
            tilt_deg: Pitch and roll.
        """
        x_m, y_m, yaw_deg = pose
        trajectory = Trajectory.create_static((x_m, y_m, height_m), (yaw_deg, *tilt_deg))
        name = f"parked {kind} {len(self.parked)}"
        self.parked.append(Actor(name, CATEGORIES[kind], self.meshes[kind], trajectory))

    def fill_lane(
        self,
        lane_index: int,
        span_m: tuple[float, float],
        density_per_km: float,
        drivers: Mapping[str, tuple[float, Driver]],
        *,
        passages: Sequence[JunctionPassage] = (),
        existing_agents: Sequence[Agent] = (),
        speed_spread: float = 0.12,
        heavy_speed_spread: float = 0.12,
    ) -> list[Agent]:
        """Fill a lane with agents at random gaps.

        Args:
            lane_index: Index of the lane.
            span_m: First and last position; all agents are within it from bumper to bumper.
            density_per_km: Agents per kilometer, as far as they fit at full speed.
            drivers: Weight and typical driver of each kind on the lane.
            passages: Junctions on the lane, which stay empty.
            existing_agents: Agents whose surroundings stay empty.
            speed_spread: Largest relative deviation of desired speeds.
            heavy_speed_spread: The same for trucks and buses.

        Returns:
            The new agents, from the start of the lane.
        """
        weights = {kind: weight for kind, (weight, _) in drivers.items()}
        agents: list[Agent] = []
        neighbors = [agent for agent in existing_agents if agent.lane_index == lane_index]
        rear_m = span_m[0]
        while density_per_km > 0:
            body = self.sample_kind(weights)
            kind = BODY_KINDS[body]
            driver = self.sample_driver(drivers[kind][1], heavy_speed_spread if kind in HEAVY_KINDS else speed_spread)
            # The gap at full speed, so that no driver must brake at the start.
            gap_m = float(driver.standstill_gap_m + driver.headway_s * driver.desired_speed_mps)
            length_m = self.get_length_m(body)
            rear_m += gap_m + self._generator.exponential(max(1000.0 / density_per_km - gap_m - length_m, 0.1))
            if rear_m + length_m > span_m[1]:
                break
            agent = self.create_agent(body, lane_index, rear_m + length_m / 2, driver)
            if not _is_blocked(agent, passages, gap_m, neighbors):
                agents.append(agent)
            rear_m += length_m
        return agents


def get_part_kinds(kind: str) -> tuple[str, ...]:
    """Return a kind and, if it has one, the kind of its trailer."""
    return (kind, HITCHES[kind].trailer_kind) if kind in HITCHES else (kind,)


@lru_cache(maxsize=64)
def list_bodies(kinds: tuple[str, ...], weights: tuple[float, ...]) -> tuple[list[str], list[float]]:
    """List the bodies of kinds and their frequencies.

    Args:
        kinds: Kinds.
        weights: Weight of each kind, which its bodies share equally.

    Returns:
        Bodies, and the cumulative share of each one, up to 1.
    """
    bodies: list[str] = []
    shares: list[float] = []
    for kind, weight in zip(kinds, np.array(weights) / np.sum(weights), strict=True):
        kind_bodies = [body for body, body_kind in BODY_KINDS.items() if body_kind == kind]
        bodies += kind_bodies
        shares += [weight / len(kind_bodies)] * len(kind_bodies)
    cumulative_shares = np.cumsum(shares)
    return bodies, (cumulative_shares / cumulative_shares[-1]).tolist()


def _is_blocked(agent: Agent, passages: Sequence[JunctionPassage], gap_m: float, neighbors: Sequence[Agent]) -> bool:
    """Test whether an agent is on a junction, or closer than a gap to a junction or to a neighbor."""
    rear_m, front_m = agent.lane_position_m - agent.length_m / 2, agent.lane_position_m + agent.length_m / 2
    # Passages are in order: the first one that is not behind is the nearest.
    next_passage = bisect_right(passages, rear_m, key=attrgetter("exit_m"))
    if next_passage < len(passages) and front_m > passages[next_passage].stop_line_m - gap_m:
        return True
    return any(
        abs(agent.lane_position_m - neighbor.lane_position_m) < (agent.length_m + neighbor.length_m) / 2 + gap_m
        for neighbor in neighbors
    )
