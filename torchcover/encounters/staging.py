"""An encounter with the vehicle that has it: who is where at any time, and when they touch."""

import math
from functools import lru_cache
from itertools import combinations, groupby

import numpy as np

from torchcover.encounters.encounter import Encounter, EncounterPath, Obstacle
from torchcover.geometry import BoundingBox, compute_contact_time_s, find_overlaps, invert, transform_outline
from torchcover.geometry.arrays import Bools, Float64
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.bodies import Shape, build_actor_mesh, get_shape_name
from torchcover.simulation.moving import BodyGeometry, BodyGeometryCache
from torchcover.simulation.scene import SceneGeometry
from torchcover.simulation.shapes import Plane
from torchcover.simulation.world import Actor, Scene
from torchcover.targets.placing import build_poses

# Looks are at whole ones of these.
STEP_S = 0.001
# Where they touch in a bend is found by so many steps in a millisecond.
FINELY = 1000
# A bend is straight in between.
BEND_S = 0.01
# The meeting is of middles: outlines may touch later, as where one drives into the side of the other's end.
AFTER_S = 2.0
GROUND_M = 2000.0
# So far inside is beside: a gap may be 0.
TOUCH_M = 1e-6


@lru_cache(maxsize=64)
def get_solid(shape: Shape) -> BodyGeometry:
    """The body, made once for all encounters that have it."""
    return BodyGeometry(build_actor_mesh(f"body {get_shape_name(shape)!r}", shape, "other", keep_height=True))


class StagedEncounter:
    """Who is where. Time 0 is where it begins; `contact_time_s` is when the outlines touch if nobody brakes or turns away.

    Outlines are boxes, upright, of the ego and of the other.

    Args:
        encounter: What happens.
        ego_solid: The body of the vehicle that carries the rig, in the vehicle frame.

    Raises:
        ValueError: The two never touch, or do from the beginning; an obstacle on a way.
    """

    def __init__(self, encounter: Encounter, ego: BodyGeometry) -> None:
        self.encounter, self.ego_solid = encounter, ego
        self.road_user_solid = get_solid(encounter.road_user.body)
        self.obstacles = self._placed_obstacles()
        self.contact_time_s = self._contact_s()
        self._check_ways()

    def compute_world_T_ego(self, times_s: Float64) -> Float64:
        """(T, 4, 4) where the ego is; the meeting is at the origin, and the ego heads along x there."""
        way = self.encounter.ego
        end_m = self.ego_solid.bounding_box.upper_m[0] if way.speed_kmh >= 0 else self.ego_solid.bounding_box.lower_m[0]
        return _along(way, times_s - self.encounter.lead_time_s, (-end_m, 0.0), 0.0)

    def compute_world_T_road_user(self, times_s: Float64) -> Float64:
        """(T, 4, 4) where the other is."""
        way, box = self.encounter.road_user, self.ego_solid.bounding_box
        y_m = box.lower_m[1] + way.impact_location * box.size_m[1]
        return _along(way, times_s - self.encounter.lead_time_s, (0.0, y_m), math.radians(way.yaw_deg))

    def compute_vehicle_T_road_user(self, times_s: Float64) -> Float64:
        """(T, 4, 4) where the other is, as the ego has it."""
        return np.asarray(invert(self.compute_world_T_ego(times_s)) @ self.compute_world_T_road_user(times_s))

    def build_scene(self, solids: BodyGeometryCache, *, includes_road_user: bool = False) -> SceneGeometry:
        """All but the other, or the `includes_road_user`, with a time step of a millisecond."""
        steps = math.ceil(self.contact_time_s / STEP_S)
        times_s = np.linspace(0.0, steps * STEP_S, 1 + math.ceil(steps * STEP_S / BEND_S))
        along = Trajectory.from_poses(times_s, self.compute_world_T_ego(times_s))
        # Transient: even an ego at rest is no part of what never moves, as it is in all other encounters.
        drive = Trajectory(along.times_s, along.positions_m, along.angles_deg, is_transient=True)
        ground = Plane(type="plane", size_m=(GROUND_M, GROUND_M)).build_mesh().assign_material("road")
        static = (ground, *(get_solid(one.body).mesh.transform(pose) for one, pose in self.obstacles))
        ego = Actor("ego", "ego", self.ego_solid.mesh, drive)
        way = Trajectory.from_poses(times_s, self.compute_world_T_road_user(times_s))
        others = (
            (Actor("other", get_shape_name(self.encounter.road_user.body), self.road_user_solid.mesh, way),)
            if includes_road_user
            else ()
        )
        return SceneGeometry(Scene(static, ego, others, STEP_S, steps * STEP_S, ground_mesh_indices=(0,)), solids)

    def _placed_obstacles(self) -> list[tuple[Obstacle, Float64]]:
        """Each and its (4, 4) pose: rows on either side of the ego's way, before and beyond the other."""
        lower_m, upper_m = _extent_m(self.road_user_solid.bounding_box, math.radians(self.encounter.road_user.yaw_deg))
        ego_m, backwards = self.ego_solid.bounding_box, self.encounter.ego.speed_kmh < 0
        found = list[tuple[Obstacle, Float64]]()
        rows = sorted(self.encounter.obstacles, key=lambda one: (one.side, one.position))
        for (side, where), row in groupby(rows, key=lambda one: (one.side, one.position)):
            # The ego comes from -x, in reverse from x.
            ahead = (where == "beyond") != backwards
            end_m = upper_m[0] if ahead else -lower_m[0]
            for one in row:
                low_m, high_m = _extent_m(get_solid(one.body).bounding_box, math.radians(one.yaw_deg))
                end_m += one.longitudinal_gap_m
                x_m = end_m - low_m[0] if ahead else -end_m - high_m[0]
                end_m += high_m[0] - low_m[0]
                if side == "left":
                    y_m = ego_m.upper_m[1] + one.lateral_gap_m - low_m[1]
                else:
                    y_m = ego_m.lower_m[1] - one.lateral_gap_m - high_m[1]
                found.append((one, build_poses(np.array([[x_m, y_m]]), np.array([math.radians(one.yaw_deg)]))[0]))
        return found

    def _contact_s(self) -> float:
        end_s, words = self.encounter.lead_time_s + AFTER_S, self.encounter.description
        times_s = STEP_S * np.arange(math.ceil(end_s / STEP_S) + 1, dtype=np.float64)
        # Within a step neither turns, but for one in a bend: there it is found out more finely.
        for step in np.flatnonzero(self._touch_s(times_s) < STEP_S).tolist():
            about_s = times_s[max(step - 1, 0) : step + 3]
            finely_s = np.linspace(about_s[0], about_s[-1], FINELY * (len(about_s) - 1) + 1)
            touch_s = self._touch_s(finely_s)
            touches = np.flatnonzero(touch_s < np.diff(finely_s))
            if len(touches) == 0:
                continue
            found_s = float(finely_s[touches[0]] + touch_s[touches[0]])
            if found_s == 0:
                raise ValueError(
                    f"{words}: the outlines of the two overlap from the beginning; let it begin earlier (seconds, "
                    "from_m), or give them other speeds"
                )
            return found_s
        raise ValueError(
            f"{words}: the two never touch, up to {AFTER_S:g} s after the meeting; change other.at_width, yaw_deg "
            "or a speed"
        )

    def _touch_s(self, times_s: Float64) -> Float64:
        """(T - 1,) how long after each time they would touch, if they went on as until the next one."""
        there = self.compute_vehicle_T_road_user(times_s)
        velocity_mps = np.diff(there[:, :2, 3], axis=0) / np.diff(times_s)[:, None]
        return compute_contact_time_s(
            self.ego_solid.bounding_box.outline_m,
            transform_outline(self.road_user_solid.bounding_box.outline_m, there[:-1]),
            velocity_mps,
        )

    def _check_ways(self) -> None:
        """Until they touch, nobody drives or walks through an obstacle, and none is inside another."""
        for (one, pose), (other, there) in combinations(self.obstacles, 2):
            if _inside(get_solid(other.body), (np.linalg.inv(pose) @ there)[None], get_solid(one.body)).any():
                raise ValueError(
                    f"{self.encounter.description}: the obstacles {get_shape_name(one.body)!r} and {get_shape_name(other.body)!r} are inside "
                    "one another; change their gap_m or beside_m"
                )
        times_s = np.append(np.arange(0.0, self.contact_time_s, BEND_S), self.contact_time_s)
        ways = (
            ("the ego", self.ego_solid, self.compute_world_T_ego),
            ("the other", self.road_user_solid, self.compute_world_T_road_user),
        )
        for obstacle, pose in self.obstacles:
            for who, solid, way in ways:
                there = np.linalg.inv(way(times_s)) @ pose
                on_way = _inside(get_solid(obstacle.body), there, solid)
                if on_way.any():
                    at_s = times_s[on_way.argmax()] - self.contact_time_s
                    raise ValueError(
                        f"{self.encounter.description}: the obstacle {get_shape_name(obstacle.body)!r} is in the way of {who}, "
                        f"{-at_s:.2f} s before the two touch; change its beside_m or gap_m, or let the encounter begin "
                        "later (from_m, seconds)"
                    )


def _inside(solid: BodyGeometry, there: Float64, other: BodyGeometry) -> Bools:
    """(P,) whether the box of a body at (P, 4, 4) poses is inside that of another, by more than a touch."""
    corners_m = other.bounding_box.corners_m
    return find_overlaps(solid.bounding_box, there, corners_m - TOUCH_M * np.sign(corners_m - corners_m.mean(axis=0)))


def _along(way: EncounterPath, before_s: Float64, at_m: tuple[float, float], heading: float) -> Float64:
    """(T, 4, 4) poses at (T,) times after the meeting, where somebody is at a place with a heading."""
    gone_m = way.speed_mps * before_s
    if way.radius_m is None:
        turned, x_m, y_m = np.zeros_like(gone_m), gone_m, np.zeros_like(gone_m)
    else:
        bend_m = abs(way.radius_m) * math.radians(way.turn_deg)
        turned = np.clip(gone_m, -bend_m, bend_m) / way.radius_m
        straight_m = gone_m - turned * way.radius_m
        x_m = way.radius_m * np.sin(turned) + straight_m * np.cos(turned)
        # Wide bends would lose the digits of 1 - cos.
        y_m = 2 * way.radius_m * np.sin(turned / 2) ** 2 + straight_m * np.sin(turned)
    cos, sin = math.cos(heading), math.sin(heading)
    positions_m = np.stack([at_m[0] + cos * x_m - sin * y_m, at_m[1] + sin * x_m + cos * y_m], axis=1)
    return build_poses(positions_m, heading + turned)


def _extent_m(box: BoundingBox, yaw: float) -> tuple[Float64, Float64]:
    """(2,) lowest and (2,) highest x, y of a box that is turned."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    corners_m = box.corners_m[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    return corners_m.min(axis=0), corners_m.max(axis=0)
