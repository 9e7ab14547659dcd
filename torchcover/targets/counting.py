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
from torchcover.targets.placing import compute_ground_heights_m, is_blocked, set_pose_heights
from torchcover.targets.surface import SAMPLES, Target, TargetSurface

# From so many random places in all the visible surface is looked at, and from one at each step at least.
PLACES = 8
# The shell of the reference sensors.
SHELL_M = 0.5
POSITIONS_AT_ONCE = 4096
RIG = "rig"


class SensorFrame(NamedTuple):
    """One sensor at one step: where its rays end without a target, and the random numbers of each."""

    ray_ends: RayEnds
    noise: SensorNoise

    @classmethod
    def from_ray_ends(cls, ray_ends: Sequence[RayEnds], seed: int, frame_index: int) -> "list[SensorFrame]":
        """The sensors of a rig, with the numbers of each ray: all places see the same rays err and drop out."""
        return [
            cls(one, SensorNoise(np.random.default_rng([seed, frame_index, k]), num_rays=len(one.range_m)))
            for k, one in enumerate(ray_ends, 1)
        ]


class TargetFrame(NamedTuple):
    """One step.

    `sensor_frames` of the rig; `ground_z_m` (P,) where the target stands, in the vehicle frame; `free_mask` (P,) where there is
    ground, and room; `visible_bits` (places, P, bytes) as `seen_from`.
    """

    sensor_frames: Sequence[SensorFrame]
    ground_z_m: Float64
    free_mask: Bools
    visible_bits: NDArray[np.uint8]


class TargetFrames:
    """The steps of a run, `every_steps` time steps of the scenario apart.

    `vehicle_T_target` (P, 4, 4) is where the target stands, but for the height of the ground there.
    """

    def __init__(
        self,
        rig: Rig,
        scenario: Scenario,
        target: Target,
        surface: TargetSurface,
        vehicle_T_target: Float64,
        *,
        num_frames: int,
        frame_stride: int,
        seed: int,
    ) -> None:
        self._scenario, self._target, self._surface, self._poses = scenario, target, surface, vehicle_T_target
        self._steps, self._every_steps, self._seed = num_frames, frame_stride, seed
        self.viewpoints_per_frame = max(1, -(-PLACES // num_frames))
        self._stages = MountedRigStore(SceneStore(scenario, seed), {RIG: rig})
        sensor_reach_m = [
            float(np.linalg.norm(s.mount.to_matrix()[:3, 3])) + scenario.compute_max_range_m(s) for s in rig.sensors
        ]
        raster_reach_m = float(np.linalg.norm(vehicle_T_target[:, :3, 3], axis=1).max(initial=0.0))
        self._within_m = max([raster_reach_m + target.solid.reach_m, *sensor_reach_m])

    @property
    def mounted_sensors(self) -> Sequence[MountedSensor]:
        """The sensors; their rays are the same at every step."""
        return self._stages.get_mounted_rigs(self._scenario.locate(0)[0]).sensors_by_rig[RIG]

    def __iter__(self) -> Iterator[TargetFrame]:
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
                *find_free_positions(instant, self._target, self._surface, self._poses),
            )
            if not stage.scene_geometry.has_motion and self._scenario.is_repeating:
                resting = ends, ground_z_m, free
            visible = self._visible(stage.scene_geometry, instant, set_pose_heights(self._poses, ground_z_m), index)
            yield TargetFrame(SensorFrame.from_ray_ends(ends, self._seed, index), ground_z_m, free, visible)

    def _visible(
        self, scene: SceneGeometry, instant: SceneSnapshot, vehicle_T_target: Float64, index: int
    ) -> NDArray[np.uint8]:
        generator = np.random.default_rng([self._seed, index])
        surroundings = ReferenceContext(
            scene, instant, generator, f"{self._scenario.name} step {index}", torch.get_num_threads()
        )
        seen = []
        for _ in range(self.viewpoints_per_frame):
            pose, _ = surroundings.sample_free_pose(sample_reference_pose)
            seen.append(
                [
                    self._surface.find_visible_samples(
                        pose[:3, 3], self._target, poses, instant, num_threads=surroundings.num_threads
                    )
                    for poses in _chunks(vehicle_T_target)
                ]
            )
        # Some of none, where the vehicle is everywhere.
        none = np.empty((0, SAMPLES // 8), dtype=np.uint8)
        return np.stack([np.concatenate([none, *of_place]) for of_place in seen])


def find_free_positions(
    instant: SceneSnapshot, target: Target, surface: TargetSurface, vehicle_T_target: Float64
) -> tuple[Float64, Bools]:
    """Where the ground is, 0 where there is none, and where there is some, with room for a target on it: (P,) each."""
    z_m = compute_ground_heights_m(instant, vehicle_T_target[:, :2, 3])
    there, z_m = np.isfinite(z_m), np.nan_to_num(z_m)
    upright = _chunks(set_pose_heights(vehicle_T_target, z_m))
    taken = [is_blocked(instant, target.solid.bounding_box, surface.points_m, some) for some in upright]
    return z_m, there & ~np.concatenate([np.empty(0, dtype=bool), *taken])


def sample_reference_pose(ego_box: BoundingBox, generator: np.random.Generator) -> Float64:
    """A (4, 4) random place of a reference sensor."""
    return build_transform(np.eye(3), sample_position_in_shell(ego_box, SHELL_M, generator))


def _chunks(poses: Float64) -> list[Float64]:
    return [poses[first : first + POSITIONS_AT_ONCE] for first in range(0, len(poses), POSITIONS_AT_ONCE)]


# Positions that are cast at together. A constant, so that nothing depends on threads.
CHUNK = 128
# More than any count.
NEVER = np.iinfo(np.int64).max


class TargetVisibilitySums(NamedTuple):
    """Sums over the steps in which there was room, for P positions.

    `sensor_points` (sensors, P), `detecting_sensors` (P,) how many had enough points, `detected_frames` (P,) steps with enough points, `free_frames` (P,)
    with room, `visible_samples` and `detected_samples` (P,) pairs of a place and a point of the surface that it sees, and those of them
    that are within the threshold of a measured point. No sums but the fewest in any of these steps: `min_points` and
    `min_sensors` (P,), `NEVER` where there was no room.
    """

    sensor_points: Int64
    detecting_sensors: Int64
    detected_frames: Int64
    free_frames: Int64
    visible_samples: Int64
    detected_samples: Int64
    min_points: Int64
    min_sensors: Int64

    @classmethod
    def create_empty(cls, num_sensors: int, num_positions: int) -> Self:
        """Those of no step."""
        zeros = np.zeros((5, num_positions), dtype=np.int64)
        never = np.full((2, num_positions), NEVER)
        return cls(np.zeros((num_sensors, num_positions), dtype=np.int64), *zeros, *never)


class TargetHits(NamedTuple):
    """Where the rays of one sensor meet the target, were it alone, in the order of positions and rays.

    `position_indices`, `ray_indices`, `ranges_m` and `triangle_indices` (N,), `directions` (N, 3).
    """

    position_indices: Int64
    ray_indices: Int64
    ranges_m: Float32
    triangle_indices: Int32
    directions: Float32


class SensorBeams(NamedTuple):
    """The rays of a sensor by the beam in which they are measured together.

    `beam_indices` (rays,) the number of each ray's beam; `rays_by_beam` (rays,) all rays, beam by beam, ascending in each; `beam_offsets`
    (beams + 1,) where those of each beam begin in it.
    """

    beam_indices: Int64
    rays_by_beam: Int64
    beam_offsets: Int64

    @classmethod
    def from_sensor(cls, mounted_sensor: MountedSensor) -> Self | None:
        """Those of a sensor; None if each ray is measured alone."""
        beams = mounted_sensor.sensor.compute_beam_indices()
        if beams is None:
            return None
        of_ray = beams.ravel()[mounted_sensor.ray_pixel_indices]
        first = np.concatenate([[0], np.cumsum(np.bincount(of_ray))])
        return cls(of_ray, np.argsort(of_ray, kind="stable"), first)

    def fill_beams(self, hits: RayHits, ray_ends: RayEnds) -> tuple[RayHits, Int64]:
        """All hits of each beam in which a target has some, at each position.

        `hits`: N hits on the target, by ascending position and ray; `ray_ends`: where the rays end without it. Returns M
        hits, by position, beam and ray, and (M,) which of the N each is, -1 if it is on something else.
        """
        assert hits.position_indices is not None  # the positions
        rays, beams = len(self.beam_indices), len(self.beam_offsets) - 1
        place, beam = np.divmod(np.unique(hits.position_indices * beams + self.beam_indices[hits.ray_indices]), beams)
        length = np.diff(self.beam_offsets)[beam]
        begins = np.cumsum(length) - length
        ray = self.rays_by_beam[np.arange(length.sum()) + (self.beam_offsets[beam] - begins).repeat(length)]
        place = place.repeat(length)
        number, asked = hits.position_indices * rays + hits.ray_indices, place * rays + ray
        of_target = np.minimum(np.searchsorted(number, asked), len(number) - 1)
        of_target = np.where(number[of_target] == asked, of_target, -1)
        range_m = ray_ends.range_m[ray]
        on_target = of_target >= 0
        range_m[on_target] = hits.range_m[of_target[on_target]]
        there = np.flatnonzero(on_target | ray_ends.is_hit[ray])
        return RayHits(ray[there], range_m[there], hits.ray_pixel_indices, place[there]), of_target[there]


def count_target_points(
    target: Target,
    surface: TargetSurface,
    vehicle_T_target: Float64,
    mounted_sensors: Sequence[MountedSensor],
    frames: Sequence[TargetFrame],
    *,
    detection_points: int,
    threshold_m: float,
) -> TargetVisibilitySums:
    """Count what a rig gets from a target at P places, whatever the number of threads.

    `vehicle_T_target` (P, 4, 4) is where it stands, but for the height of the ground there, which is that of the step;
    `detection_points` are how many points are enough, `threshold_m` how near one must be to a point of the surface.
    """
    farthest_m = [
        np.max([step.sensor_frames[k].ray_ends.range_m for step in frames], axis=0) for k in range(len(mounted_sensors))
    ]
    beams = [SensorBeams.from_sensor(sensor) for sensor in mounted_sensors]

    def count_some(first: int) -> TargetVisibilitySums:
        some = slice(first, first + CHUNK)
        poses, sums = (
            vehicle_T_target[some],
            TargetVisibilitySums.create_empty(len(mounted_sensors), len(vehicle_T_target[some])),
        )
        on_ground: _OnGround | None = None
        for step in frames:
            z_m = step.ground_z_m[some]
            if on_ground is None or not np.array_equal(on_ground.placed.vehicle_T_part[:, 2, 3], z_m):
                standing_there = set_pose_heights(poses, z_m)
                # No bodies of the scene: their numbers say so.
                placed = MovingBodies.from_geometries(
                    [target.solid] * len(poses), standing_there, np.full(len(poses), -1)
                )
                met = [find_target_hits(placed, *sensor) for sensor in zip(mounted_sensors, farthest_m, strict=True)]
                near = [
                    surface.find_nearby_samples(_in_target(sensor, some_met, standing_there), threshold_m)
                    for sensor, some_met in zip(mounted_sensors, met, strict=True)
                ]
                on_ground = _OnGround(placed, met, near)
            cut = TargetFrame(step.sensor_frames, z_m, step.free_mask[some], step.visible_bits[:, some])
            _count_step(sums, on_ground, mounted_sensors, beams, cut, detection_points, threshold_m)
        return sums

    parts = run_in_threads(torch.get_num_threads(), count_some, range(0, max(len(vehicle_T_target), 1), CHUNK))
    return TargetVisibilitySums._make(np.concatenate(column, axis=-1) for column in zip(*parts, strict=True))


def find_target_hits(placed_bodies: MovingBodies, mounted_sensor: MountedSensor, max_ranges_m: Float32) -> TargetHits:
    """Where the rays of a sensor meet each of some bodies, were it alone, if no farther off than (rays,) ranges."""
    origin_m, vehicle_R_sensor = mounted_sensor.vehicle_T_sensor[:3, 3], mounted_sensor.vehicle_T_sensor[:3, :3]
    bodies, first, parts = compute_outlines(placed_bodies.box_corners_m, origin_m), 0, []
    for tile in mounted_sensor.tiles:
        rays = tile.directions.shape[1]
        directions = rotate(vehicle_R_sensor, tile.directions)
        limit_m = max_ranges_m[first : first + rays]
        met, _ = placed_bodies.find_body_hits(origin_m, vehicle_R_sensor, tile, directions, limit_m, bodies)
        towards = directions.take(met.ray_indices, axis=1).T
        parts.append(TargetHits(met.part_indices, first + met.ray_indices, met.range_m, met.triangle_indices, towards))
        first += rays
    together = TargetHits._make(np.concatenate(column) for column in zip(*parts, strict=True))
    # A ray that fills up the block of a tile is cast more than once.
    _, once = np.unique(together.position_indices * first + together.ray_indices, return_index=True)
    return TargetHits._make(column[once] for column in together)


class _OnGround(NamedTuple):
    """What the rays meet of the target at some positions, where the ground is as it is: the same for many steps.

    `placed` has P bodies; `met` is by each sensor, and of that the points of the surface that are near: `near`.
    """

    placed: MovingBodies
    met: Sequence[TargetHits]
    near: Sequence[NDArray[np.uint8]]


def _count_step(
    sums: TargetVisibilitySums,
    there: _OnGround,
    mounted: Sequence[MountedSensor],
    beams: Sequence[SensorBeams | None],
    step: TargetFrame,
    hits: int,
    threshold_m: float,
) -> None:
    count = len(there.placed)
    points = np.zeros_like(sums.sensor_points)
    near = np.zeros((count, step.visible_bits.shape[2]), dtype=np.uint8)
    for k, (sensor, one, seen) in enumerate(zip(mounted, there.met, step.sensor_frames, strict=True)):
        measured = find_measured_hits(sensor, beams[k], one, seen, there.placed, threshold_m)
        points[k] = sensor.sensor.pixels_per_sample * np.bincount(one.position_indices[measured], minlength=count)
        near |= _any_of_each(one.position_indices[measured], there.near[k][measured], count)
    _add(sums, step, points, near, hits)


def find_measured_hits(
    mounted_sensor: MountedSensor,
    beams: SensorBeams | None,
    target_hits: TargetHits,
    sensor_frame: SensorFrame,
    placed_bodies: MovingBodies,
    max_error_m: float,
) -> Int64:
    """Which of N meetings give a point that is no farther off along its ray, by position: nothing else is in the way.

    Where the rays of a beam are measured together, the point may be one of what stands next to the target.
    """
    arrived = np.flatnonzero(target_hits.ranges_m <= sensor_frame.ray_ends.range_m[target_hits.ray_indices])
    hits = RayHits(
        target_hits.ray_indices[arrived],
        target_hits.ranges_m[arrived],
        mounted_sensor.ray_pixel_indices,
        target_hits.position_indices[arrived],
        lambda: placed_bodies.compute_hit_attributes(
            target_hits.position_indices[arrived],
            target_hits.triangle_indices[arrived],
            target_hits.directions[arrived].T,
        ),
        mounted_sensor.weather,
    )
    of_target = np.arange(len(arrived))
    if beams is not None:
        hits, of_target = beams.fill_beams(hits, sensor_frame.ray_ends)
    hit, error_m = mounted_sensor.sensor.measure(hits, sensor_frame.noise)
    of_target = of_target if hit is None else of_target[hit]
    counts = of_target >= 0 if error_m is None else (of_target >= 0) & (np.abs(error_m) <= max_error_m)
    return arrived[of_target[counts]]


def _in_target(mounted: MountedSensor, met: TargetHits, vehicle_T_target: Float64) -> Float64:
    """(N, 3) the points in the frame of the target."""
    range_m = met.ranges_m.astype(np.float64)
    from_origin_m = mounted.vehicle_T_sensor[:3, 3] + met.directions * range_m[:, None]
    from_origin_m -= vehicle_T_target[met.position_indices, :3, 3]
    return np.asarray(np.einsum("nji,nj->ni", vehicle_T_target[met.position_indices, :3, :3], from_origin_m))


def _any_of_each(position: Int64, bits: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """(count, bytes) all bits of each position's rows together; positions ascend."""
    together = np.zeros((count, bits.shape[1]), dtype=np.uint8)
    first = np.flatnonzero(np.diff(position, prepend=-1))
    if len(first):
        together[position[first]] = np.bitwise_or.reduceat(bits, first, axis=0)
    return together


def _add(sums: TargetVisibilitySums, step: TargetFrame, points: Int64, near: NDArray[np.uint8], hits: int) -> None:
    free, together, sensors = step.free_mask, points.sum(axis=0), (points >= hits).sum(axis=0)
    sums.sensor_points[:] += points * free
    sums.detecting_sensors[:] += sensors * free
    sums.detected_frames[:] += (together >= hits) & free
    sums.min_points[free] = np.minimum(sums.min_points, together)[free]
    sums.min_sensors[free] = np.minimum(sums.min_sensors, sensors)[free]
    sums.free_frames[:] += free
    sums.visible_samples[:] += np.unpackbits(step.visible_bits, axis=2).sum(axis=(0, 2), dtype=np.int64) * free
    sums.detected_samples[:] += np.unpackbits(step.visible_bits & near, axis=2).sum(axis=(0, 2), dtype=np.int64) * free
