"""What a rig gets from a target in each step: it is cast alone, then the depth of the scene says which rays arrive."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, build_transform
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.instant import SceneSnapshot, run_in_threads
from torchcover.simulation.moving import MovingBodies
from torchcover.simulation.rays import compute_outlines, rotate
from torchcover.simulation.reference_sensor import ReferenceContext, sample_position_in_shell
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import SceneGeometry
from torchcover.simulation.sensor import RayHits, SensorNoise
from torchcover.simulation.sight import MountedSensor, RayEnds
from torchcover.simulation.stage import MountedRigStore, SceneStore
from torchcover.targets.placing import blocked, ground_under, standing
from torchcover.targets.surface import SAMPLES, Surface, Target

# From so many random places in all the visible surface is looked at, and from one at each step at least.
PLACES = 8
# The shell of the reference sensors.
SHELL_M = 0.5
POSITIONS_AT_ONCE = 4096
RIG = "rig"


class SensorStep(NamedTuple):
    """One sensor at one step: where its rays end without a target, and the random numbers of each."""

    ends: RayEnds
    draws: SensorNoise

    @classmethod
    def of_rig(cls, ends: Sequence[RayEnds], seed: int, step: int) -> "list[SensorStep]":
        """The sensors of a rig, with the numbers of each ray: all places see the same rays err and drop out."""
        return [
            cls(one, SensorNoise(np.random.default_rng([seed, step, k]), num_rays=len(one.range_m)))
            for k, one in enumerate(ends, 1)
        ]


class Step(NamedTuple):
    """One step.

    `sensors` of the rig; `ground_z_m` (P,) where the target stands, in the vehicle frame; `free` (P,) where there is
    ground, and room; `visible` (places, P, bytes) as `seen_from`.
    """

    sensors: Sequence[SensorStep]
    ground_z_m: Float64
    free: Bools
    visible: NDArray[np.uint8]


class Steps:
    """The steps of a run, `every_steps` time steps of the scenario apart.

    `vehicle_T_target` (P, 4, 4) is where the target stands, but for the height of the ground there.
    """

    def __init__(
        self,
        rig: Rig,
        scenario: Scenario,
        target: Target,
        surface: Surface,
        vehicle_T_target: Float64,
        *,
        steps: int,
        every_steps: int,
        seed: int,
    ) -> None:
        self._scenario, self._target, self._surface, self._poses = scenario, target, surface, vehicle_T_target
        self._steps, self._every_steps, self._seed = steps, every_steps, seed
        self.places = max(1, -(-PLACES // steps))
        self._stages = MountedRigStore(SceneStore(scenario, seed), {RIG: rig})
        sensor_reach_m = [
            float(np.linalg.norm(s.mount.to_matrix()[:3, 3])) + scenario.compute_max_range_m(s) for s in rig.sensors
        ]
        raster_reach_m = float(np.linalg.norm(vehicle_T_target[:, :3, 3], axis=1).max(initial=0.0))
        self._within_m = max([raster_reach_m + target.solid.reach_m, *sensor_reach_m])

    @property
    def mounted(self) -> Sequence[MountedSensor]:
        """The sensors; their rays are the same at every step."""
        return self._stages.get_mounted_rigs(self._scenario.locate(0)[0]).sensors_by_rig[RIG]

    def __iter__(self) -> Iterator[Step]:
        """One after the other.

        FileNotFoundError: a mesh, vehicle or trajectory file is missing. ValueError: a sensor or an actor that is where
        none can be.
        """
        resting: tuple[list[RayEnds], Float64, Bools] | None = None
        for index in range(self._steps):
            run, step = self._scenario.locate(index * self._every_steps)
            stage = self._stages.get_mounted_rigs(run)
            instant = stage.scene_geometry.get_snapshot(step, max_distance_m=self._within_m)
            stage.check_mounts(instant)
            # Where nothing moves, the first answer holds.
            ends, ground_z_m, free = resting or (
                [m.compute_ray_ends(instant) for m in stage.sensors_by_rig[RIG]],
                *free_places(instant, self._target, self._surface, self._poses),
            )
            if not stage.scene_geometry.has_motion and self._scenario.is_repeating:
                resting = ends, ground_z_m, free
            visible = self._visible(stage.scene_geometry, instant, standing(self._poses, ground_z_m), index)
            yield Step(SensorStep.of_rig(ends, self._seed, index), ground_z_m, free, visible)

    def _visible(
        self, scene: SceneGeometry, instant: SceneSnapshot, vehicle_T_target: Float64, index: int
    ) -> NDArray[np.uint8]:
        generator = np.random.default_rng([self._seed, index])
        surroundings = ReferenceContext(
            scene, instant, generator, f"{self._scenario.name} step {index}", torch.get_num_threads()
        )
        seen = []
        for _ in range(self.places):
            pose, _ = surroundings.sample_free_pose(pose_in_shell)
            seen.append(
                [
                    self._surface.seen_from(pose[:3, 3], self._target, poses, instant, threads=surroundings.num_threads)
                    for poses in _chunks(vehicle_T_target)
                ]
            )
        # Some of none, where the vehicle is everywhere.
        none = np.empty((0, SAMPLES // 8), dtype=np.uint8)
        return np.stack([np.concatenate([none, *of_place]) for of_place in seen])


def free_places(
    instant: SceneSnapshot, target: Target, surface: Surface, vehicle_T_target: Float64
) -> tuple[Float64, Bools]:
    """Where the ground is, 0 where there is none, and where there is some, with room for a target on it: (P,) each."""
    z_m = ground_under(instant, vehicle_T_target[:, :2, 3])
    there, z_m = np.isfinite(z_m), np.nan_to_num(z_m)
    upright = _chunks(standing(vehicle_T_target, z_m))
    taken = [blocked(instant, target.solid.bounding_box, surface.points_m, some) for some in upright]
    return z_m, there & ~np.concatenate([np.empty(0, dtype=bool), *taken])


def pose_in_shell(ego: BoundingBox, generator: np.random.Generator) -> Float64:
    """A (4, 4) random place of a reference sensor."""
    return build_transform(np.eye(3), sample_position_in_shell(ego, SHELL_M, generator))


def _chunks(poses: Float64) -> list[Float64]:
    return [poses[first : first + POSITIONS_AT_ONCE] for first in range(0, len(poses), POSITIONS_AT_ONCE)]


# Positions that are cast at together. A constant, so that nothing depends on threads.
CHUNK = 128
# More than any count.
NEVER = np.iinfo(np.int64).max


class Sums(NamedTuple):
    """Sums over the steps in which there was room, for P positions.

    `points` (sensors, P), `sensors` (P,) how many had enough points, `seen` (P,) steps with enough points, `steps` (P,)
    with room, `visible` and `near` (P,) pairs of a place and a point of the surface that it sees, and those of them
    that are within the threshold of a measured point. No sums but the fewest in any of these steps: `least_points` and
    `least_sensors` (P,), `NEVER` where there was no room.
    """

    points: Int64
    sensors: Int64
    seen: Int64
    steps: Int64
    visible: Int64
    near: Int64
    least_points: Int64
    least_sensors: Int64

    @classmethod
    def none(cls, sensors: int, positions: int) -> Self:
        """Those of no step."""
        zeros = np.zeros((5, positions), dtype=np.int64)
        never = np.full((2, positions), NEVER)
        return cls(np.zeros((sensors, positions), dtype=np.int64), *zeros, *never)


class Met(NamedTuple):
    """Where the rays of one sensor meet the target, were it alone, in the order of positions and rays.

    `position`, `ray`, `range_m` and `triangle` (N,), `direction` (N, 3).
    """

    position: Int64
    ray: Int64
    range_m: Float32
    triangle: Int32
    direction: Float32


class Beams(NamedTuple):
    """The rays of a sensor by the beam in which they are measured together.

    `of_ray` (rays,) the number of each ray's beam; `ray` (rays,) all rays, beam by beam, ascending in each; `first`
    (beams + 1,) where those of each beam begin in it.
    """

    of_ray: Int64
    ray: Int64
    first: Int64

    @classmethod
    def of(cls, mounted: MountedSensor) -> Self | None:
        """Those of a sensor; None if each ray is measured alone."""
        beams = mounted.sensor.compute_beam_indices()
        if beams is None:
            return None
        of_ray = beams.ravel()[mounted.ray_pixel_indices]
        first = np.concatenate([[0], np.cumsum(np.bincount(of_ray))])
        return cls(of_ray, np.argsort(of_ray, kind="stable"), first)

    def filled(self, hits: RayHits, ends: RayEnds) -> tuple[RayHits, Int64]:
        """All hits of each beam in which a target has some, at each position.

        `hits`: N hits on the target, by ascending position and ray; `ends`: where the rays end without it. Returns M
        hits, by position, beam and ray, and (M,) which of the N each is, -1 if it is on something else.
        """
        assert hits.position_indices is not None  # the positions
        rays, beams = len(self.of_ray), len(self.first) - 1
        place, beam = np.divmod(np.unique(hits.position_indices * beams + self.of_ray[hits.ray_indices]), beams)
        length = np.diff(self.first)[beam]
        begins = np.cumsum(length) - length
        ray = self.ray[np.arange(length.sum()) + (self.first[beam] - begins).repeat(length)]
        place = place.repeat(length)
        number, asked = hits.position_indices * rays + hits.ray_indices, place * rays + ray
        of_target = np.minimum(np.searchsorted(number, asked), len(number) - 1)
        of_target = np.where(number[of_target] == asked, of_target, -1)
        range_m = ends.range_m[ray]
        on_target = of_target >= 0
        range_m[on_target] = hits.range_m[of_target[on_target]]
        there = np.flatnonzero(on_target | ends.is_hit[ray])
        return RayHits(ray[there], range_m[there], hits.ray_pixel_indices, place[there]), of_target[there]


def count(
    target: Target,
    surface: Surface,
    vehicle_T_target: Float64,
    mounted: Sequence[MountedSensor],
    steps: Sequence[Step],
    *,
    hits: int,
    threshold_m: float,
) -> Sums:
    """Count what a rig gets from a target at P places, whatever the number of threads.

    `vehicle_T_target` (P, 4, 4) is where it stands, but for the height of the ground there, which is that of the step;
    `hits` are how many points are enough, `threshold_m` how near one must be to a point of the surface.
    """
    farthest_m = [np.max([step.sensors[k].ends.range_m for step in steps], axis=0) for k in range(len(mounted))]
    beams = [Beams.of(sensor) for sensor in mounted]

    def count_some(first: int) -> Sums:
        some = slice(first, first + CHUNK)
        poses, sums = vehicle_T_target[some], Sums.none(len(mounted), len(vehicle_T_target[some]))
        on_ground: _OnGround | None = None
        for step in steps:
            z_m = step.ground_z_m[some]
            if on_ground is None or not np.array_equal(on_ground.placed.vehicle_T_part[:, 2, 3], z_m):
                standing_there = standing(poses, z_m)
                # No bodies of the scene: their numbers say so.
                placed = MovingBodies.from_geometries(
                    [target.solid] * len(poses), standing_there, np.full(len(poses), -1)
                )
                met = [meetings(placed, *sensor) for sensor in zip(mounted, farthest_m, strict=True)]
                near = [
                    surface.near(_in_target(sensor, some_met, standing_there), threshold_m)
                    for sensor, some_met in zip(mounted, met, strict=True)
                ]
                on_ground = _OnGround(placed, met, near)
            cut = Step(step.sensors, z_m, step.free[some], step.visible[:, some])
            _count_step(sums, on_ground, mounted, beams, cut, hits, threshold_m)
        return sums

    parts = run_in_threads(torch.get_num_threads(), count_some, range(0, max(len(vehicle_T_target), 1), CHUNK))
    return Sums._make(np.concatenate(column, axis=-1) for column in zip(*parts, strict=True))


def meetings(placed: MovingBodies, mounted: MountedSensor, farthest_m: Float32) -> Met:
    """Where the rays of a sensor meet each of some bodies, were it alone, if no farther off than (rays,) ranges."""
    origin_m, vehicle_R_sensor = mounted.vehicle_T_sensor[:3, 3], mounted.vehicle_T_sensor[:3, :3]
    bodies, first, parts = compute_outlines(placed.box_corners_m, origin_m), 0, []
    for tile in mounted.tiles:
        rays = tile.directions.shape[1]
        directions = rotate(vehicle_R_sensor, tile.directions)
        limit_m = farthest_m[first : first + rays]
        met, _ = placed.find_body_hits(origin_m, vehicle_R_sensor, tile, directions, limit_m, bodies)
        towards = directions.take(met.ray_indices, axis=1).T
        parts.append(Met(met.part_indices, first + met.ray_indices, met.range_m, met.triangle_indices, towards))
        first += rays
    together = Met._make(np.concatenate(column) for column in zip(*parts, strict=True))
    # A ray that fills up the block of a tile is cast more than once.
    _, once = np.unique(together.position * first + together.ray, return_index=True)
    return Met._make(column[once] for column in together)


class _OnGround(NamedTuple):
    """What the rays meet of the target at some positions, where the ground is as it is: the same for many steps.

    `placed` has P bodies; `met` is by each sensor, and of that the points of the surface that are near: `near`.
    """

    placed: MovingBodies
    met: Sequence[Met]
    near: Sequence[NDArray[np.uint8]]


def _count_step(
    sums: Sums,
    there: _OnGround,
    mounted: Sequence[MountedSensor],
    beams: Sequence[Beams | None],
    step: Step,
    hits: int,
    threshold_m: float,
) -> None:
    count = len(there.placed)
    points = np.zeros_like(sums.points)
    near = np.zeros((count, step.visible.shape[2]), dtype=np.uint8)
    for k, (sensor, one, seen) in enumerate(zip(mounted, there.met, step.sensors, strict=True)):
        measured = measured_points(sensor, beams[k], one, seen, there.placed, threshold_m)
        points[k] = sensor.sensor.pixels_per_sample * np.bincount(one.position[measured], minlength=count)
        near |= _any_of_each(one.position[measured], there.near[k][measured], count)
    _add(sums, step, points, near, hits)


def measured_points(
    mounted: MountedSensor, beams: Beams | None, met: Met, seen: SensorStep, placed: MovingBodies, within_m: float
) -> Int64:
    """Which of N meetings give a point that is no farther off along its ray, by position: nothing else is in the way.

    Where the rays of a beam are measured together, the point may be one of what stands next to the target.
    """
    arrived = np.flatnonzero(met.range_m <= seen.ends.range_m[met.ray])
    hits = RayHits(
        met.ray[arrived],
        met.range_m[arrived],
        mounted.ray_pixel_indices,
        met.position[arrived],
        lambda: placed.compute_hit_attributes(met.position[arrived], met.triangle[arrived], met.direction[arrived].T),
        mounted.weather,
    )
    of_target = np.arange(len(arrived))
    if beams is not None:
        hits, of_target = beams.filled(hits, seen.ends)
    hit, error_m = mounted.sensor.measure(hits, seen.draws)
    of_target = of_target if hit is None else of_target[hit]
    counts = of_target >= 0 if error_m is None else (of_target >= 0) & (np.abs(error_m) <= within_m)
    return arrived[of_target[counts]]


def _in_target(mounted: MountedSensor, met: Met, vehicle_T_target: Float64) -> Float64:
    """(N, 3) the points in the frame of the target."""
    range_m = met.range_m.astype(np.float64)
    from_origin_m = mounted.vehicle_T_sensor[:3, 3] + met.direction * range_m[:, None]
    from_origin_m -= vehicle_T_target[met.position, :3, 3]
    return np.asarray(np.einsum("nji,nj->ni", vehicle_T_target[met.position, :3, :3], from_origin_m))


def _any_of_each(position: Int64, bits: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """(count, bytes) all bits of each position's rows together; positions ascend."""
    together = np.zeros((count, bits.shape[1]), dtype=np.uint8)
    first = np.flatnonzero(np.diff(position, prepend=-1))
    if len(first):
        together[position[first]] = np.bitwise_or.reduceat(bits, first, axis=0)
    return together


def _add(sums: Sums, step: Step, points: Int64, near: NDArray[np.uint8], hits: int) -> None:
    free, together, sensors = step.free, points.sum(axis=0), (points >= hits).sum(axis=0)
    sums.points[:] += points * free
    sums.sensors[:] += sensors * free
    sums.seen[:] += (together >= hits) & free
    sums.least_points[free] = np.minimum(sums.least_points, together)[free]
    sums.least_sensors[free] = np.minimum(sums.least_sensors, sensors)[free]
    sums.steps[:] += free
    sums.visible[:] += np.unpackbits(step.visible, axis=2).sum(axis=(0, 2), dtype=np.int64) * free
    sums.near[:] += np.unpackbits(step.visible & near, axis=2).sum(axis=(0, 2), dtype=np.int64) * free
