"""Road users: bodies by kind, drivers by kind, lanes filled with them, and trailers that follow at a hitch."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from torchcover.files import load_road_user_classes
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Float64
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.flow import Agent, JunctionPassage
from torchcover.simulation.traffic.idm import Driver
from torchcover.simulation.world import Actor


class Hitch(NamedTuple):
    """How a body draws another one along, of kind `trailer_kind`, whose axles never slip sideways.

    The middle of the front is `center_offset_m` before that of both, on a straight, and the hitch `hitch_offset_m` before the middle
    of the front, negative behind it. From the hitch, the axles of the rear are `hitch_to_axle_m` back, and its middle `hitch_to_center_m`.
    """

    trailer_kind: str
    center_offset_m: float
    hitch_offset_m: float
    hitch_to_axle_m: float
    hitch_to_center_m: float

    def compute_hitch_positions_m(self, poses: Float64) -> Float64:
        """(T, 2) where the hitch is, at (T, 3) poses x, y and heading in radians of the front."""
        return _shifted_m(poses, self.hitch_offset_m)[:, :2]


# At the limits of EU Directive 96/53/EC the kingpin is 12 m before the rear end, and the front of the trailer turns
# 2.04 m around it.
DRAWS: Mapping[str, Hitch] = {"truck": Hitch("trailer", 4.925, -1.175, 8.41, 5.2)}


def compute_trailer_poses(
    kinds: Sequence[str], front_poses: Sequence[Float64], initial_yaw_rad: Sequence[float] | None = None
) -> list[Float64]:
    """(T, 3) poses x, y and heading in radians of what N bodies of these kinds draw along, whose own are likewise.

    T may differ. `initial_yaw_rad` are headings of the rears at first; straight behind if not given.
    """
    if not kinds:
        return []
    hitches = [DRAWS[kind] for kind in kinds]
    leads_m = [hitch.compute_hitch_positions_m(own) for hitch, own in zip(hitches, front_poses, strict=True)]
    first = np.array([own[0, 2] for own in front_poses] if initial_yaw_rad is None else initial_yaw_rad)
    yaws = compute_tractrix_yaw_rad(
        stack_paths(leads_m), np.array([hitch.hitch_to_axle_m for hitch in hitches]), first
    ).T
    return [
        _shifted_m(np.column_stack([lead_m, yaw[: len(lead_m)]]), -hitch.hitch_to_center_m)
        for hitch, lead_m, yaw in zip(hitches, leads_m, yaws, strict=True)
    ]


def stack_paths(paths_m: Sequence[Float64]) -> Float64:
    """(T, N, 2) N ways, of which each stays at its end until the longest is there."""
    longest = max(map(len, paths_m))
    return np.stack([np.pad(way_m, ((0, longest - len(way_m)), (0, 0)), "edge") for way_m in paths_m], axis=1)


def compute_tractrix_yaw_rad(lead_positions_m: Float64, rod_lengths_m: Float64, initial_yaw_rad: Float64) -> Float64:
    """(T, N) headings in radians, without leaps, of N rods that are drawn along at their front ends, (T, N, 2).

    Their rear ends never slip sideways. Exact for ways of straight pieces: with the angle a between rod and way, tan(a
    / 2) falls by exp(-way / length).
    """
    ways_m = np.diff(lead_positions_m, axis=0)
    towards = np.arctan2(ways_m[..., 1], ways_m[..., 0])
    falls = np.exp(-np.hypot(ways_m[..., 0], ways_m[..., 1]) / rod_lengths_m)
    found = np.empty(lead_positions_m.shape[:2])
    found[0] = initial_yaw_rad
    for k, (toward, fall) in enumerate(zip(towards, falls, strict=True)):
        half = np.tan((toward - found[k]) / 2)
        found[k + 1] = found[k] + 2 * (np.arctan(half) - np.arctan(half * fall))
    return found


def _shifted_m(poses: Float64, ahead_m: float) -> Float64:
    """(T, 3) poses so much ahead."""
    yaw = poses[:, 2]
    return poses + ahead_m * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)


CARS = ("hatchback", "sedan", "suv", "pickup", "van")
ON_FOOT = ("adult", "child")
# They need no road, or one that is not built.
LEFT_OUT = frozenset({"rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car", "ship", "drone"})


class VehicleType(NamedTuple):
    """What is known of somebody: a class, by SUMO's names, and a length."""

    vehicle_class: str
    length_m: float

    def find_body(self, lengths_m: Mapping[str, float]) -> str | None:
        """The body whose length is nearest among those of the class; None if there is none of this class."""
        if self.vehicle_class in LEFT_OUT:
            return None
        kinds = load_road_user_classes()["bodies"].get(self.vehicle_class, CARS)
        if kinds[0] in ON_FOOT:
            return str(kinds[0])  # the simulation's lengths of people are all the same
        bodies = [name for name in lengths_m if name.partition("_")[0] in kinds]
        return min(bodies, key=lambda kind: abs(lengths_m[kind] - self.length_m))


# What each built-in body counts as.
BODIES = {
    **dict.fromkeys(("suv", "sedan", "hatchback", "pickup", "van"), "car"),
    **dict.fromkeys(("lorry", "truck"), "truck"),
    # It has a box and a category of its own, as in nuScenes.
    **{kind: kind for kind in ("trailer", "bus", "motorcycle", "cyclist")},
    **dict.fromkeys(("adult", "child"), "pedestrian"),
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
    meshes = {kind: Vehicle.load(name).build_mesh() for kind, name in called.items()}
    for kind, is_rear in (("truck", False), ("trailer", True)):
        parts = tuple(part for part, at_rear in zip(truck.parts, behind, strict=True) if at_rear is is_rear)
        meshes[kind] = truck.model_copy(update={"parts": parts}).build_mesh()
    for kind, sizes in SIZES.items():
        for number, shares in enumerate(sizes, 2):
            meshes[f"{kind}_{number}"] = meshes[kind]._replace(vertices_m=meshes[kind].vertices_m * np.array(shares))
    return meshes


class Fleet:
    """The bodies of a world, and the drivers drawn for them. ValueError: a kind has no body."""

    def __init__(self, body_meshes: Mapping[str, Mesh], ego_mesh: Mesh | None, generator: np.random.Generator) -> None:
        missing = sorted(CATEGORIES.keys() - body_meshes.keys())
        if missing:
            raise ValueError(f"traffic needs a body for each kind; there is none for {', '.join(missing)}")
        self.meshes = {
            EGO: body_meshes["suv"] if ego_mesh is None else ego_mesh,
            **{kind: body_meshes[kind] for kind in CATEGORIES},
        }
        self._sizes = {kind: BoundingBox.from_points(mesh.vertices_m).size_m for kind, mesh in self.meshes.items()}
        self._lengths_m = {kind: self._length_m(kind) for kind in self.meshes}  # asked thousands of times a world
        self._generator = generator
        self.parked: list[Actor] = []
        self.omitted_count = 0

    def get_length_m(self, kind: str) -> float:
        """Extent along x, on a straight with all that it draws along."""
        return self._lengths_m[kind]

    def _length_m(self, kind: str) -> float:
        parts_m = [length_m for length_m, _ in self.get_sizes_m(kind)]
        return (
            sum(parts_m) / 2 - DRAWS[kind].hitch_offset_m + DRAWS[kind].hitch_to_center_m
            if kind in DRAWS
            else parts_m[0]
        )

    def get_sizes_m(self, kind: str) -> tuple[tuple[float, float], ...]:
        """Lengths and widths of the body and of what it draws along."""
        return tuple(self._sizes[part][:2] for part in get_part_kinds(kind))

    def get_width_m(self, kind: str) -> float:
        """Extent along y."""
        return self._sizes[kind][1]

    def sample_kind(self, weights: Mapping[str, float]) -> str:
        """One kind, each with a probability in proportion to its weight, in one of its sizes."""
        names, up_to = _bodies_of(tuple(weights), tuple(weights.values()))
        return names[bisect_right(up_to, self._generator.random())]

    def sample_driver(self, typical_driver: Driver, speed_spread: float) -> Driver:
        """A driver whose desired speed differs from the typical one by up to `speed_spread`, a share of it."""
        # As `uniform` would, which takes thrice as long.
        share = 1 - speed_spread + (1 + speed_spread - (1 - speed_spread)) * self._generator.random()
        desired_mps = float(typical_driver.desired_speed_mps * share)
        rest = (
            typical_driver.headway_s,
            typical_driver.standstill_gap_m,
            typical_driver.acceleration_mps2,
            typical_driver.deceleration_mps2,
        )
        return Driver(desired_mps, *rest)  # by hand: there are thousands of them in a world

    def create_agent(self, kind: str, lane_index: int, lane_position_m: float, driver: Driver) -> Agent:
        """Somebody of a kind on a lane."""
        return Agent(kind, self.get_length_m(kind), lane_index, lane_position_m, driver)

    def add_parked_vehicle(
        self,
        kind: str,
        pose: tuple[float, float, float],
        height_m: float = 0.0,
        tilt_deg: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Note a body down in `parked`, at a pose x, y in metres and yaw in degrees; pitch and roll on a slope."""
        x_m, y_m, yaw_deg = pose
        place = Trajectory.create_static((x_m, y_m, height_m), (yaw_deg, *tilt_deg))
        self.parked.append(Actor(f"parked {kind} {len(self.parked)}", CATEGORIES[kind], self.meshes[kind], place))

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
        """Fill a lane with agents at random gaps, `density_per_km` as far as they fit at full speed; nobody on a junction.

        The fronts and rears of all lie in `span_m` on it, clear of `existing_agents`, who are there already. `drivers` are
        the weight and the typical driver of each kind that uses the lane, `passages` the junctions on it; speeds spread by
        `speed_spread`, those of lorries and buses by `heavy_speed_spread`.
        """
        mix = {kind: weight for kind, (weight, _) in drivers.items()}
        agents: list[Agent] = []
        others = [other for other in existing_agents if other.lane_index == lane_index]
        rear = span_m[0]
        while density_per_km > 0:
            kind = self.sample_kind(mix)
            driver = self.sample_driver(
                drivers[KIND_OF[kind]][1], heavy_speed_spread if KIND_OF[kind] in HEAVY else speed_spread
            )
            # What one keeps at full speed, so that nobody has to brake at first.
            gap = float(driver.standstill_gap_m + driver.headway_s * driver.desired_speed_mps)
            length = self.get_length_m(kind)
            rear += gap + self._generator.exponential(max(1000.0 / density_per_km - gap - length, 0.1))
            if rear + length > span_m[1]:
                break
            agent = self.create_agent(kind, lane_index, rear + length / 2, driver)
            if not _in_the_way(agent, passages, gap, others):
                agents.append(agent)
            rear += length
        return agents


def get_part_kinds(kind: str) -> tuple[str, ...]:
    """A kind, and that of what it draws along."""
    return (kind, DRAWS[kind].trailer_kind) if kind in DRAWS else (kind,)


@lru_cache(maxsize=64)
def _bodies_of(kinds: tuple[str, ...], weights: tuple[float, ...]) -> tuple[list[str], list[float]]:
    """The bodies of some kinds, all sizes of a kind alike, and the share that each and those before it have."""
    sizes = [[name for name, kind in KIND_OF.items() if kind == one] for one in kinds]
    shares = np.repeat(np.array(weights) / np.sum(weights), [len(names) for names in sizes])
    up_to = (shares / np.repeat([len(names) for names in sizes], [len(names) for names in sizes])).cumsum()
    return [name for names in sizes for name in names], (up_to / up_to[-1]).tolist()


def _in_the_way(agent: Agent, gates: Sequence[JunctionPassage], gap_m: float, others: Sequence[Agent]) -> bool:
    rear, front = agent.lane_position_m - agent.length_m / 2, agent.lane_position_m + agent.length_m / 2
    # Gates follow each other: of those that are not behind, the first is the nearest.
    gate = bisect_right(gates, rear, key=lambda gate: gate.exit_m)
    if gate < len(gates) and front > gates[gate].stop_line_m - gap_m:
        return True
    return any(
        abs(agent.lane_position_m - other.lane_position_m) < (agent.length_m + other.length_m) / 2 + gap_m
        for other in others
    )
