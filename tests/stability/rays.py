"""Ray casting at the extremes, against closed forms."""

from functools import lru_cache, partial
from importlib.util import find_spec

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from torchcover.geometry import build_transform, convert_euler_to_rotation, transform_points
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.culling import SearchSpheres
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rays import compute_unit_directions, split_into_tiles
from torchcover.simulation.scan_motion import compute_parabola_weights
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box, Mesh, Plane

from .case import Case, most, relative

ROOM_M = np.array([60.37, 40.59, 12.83])


def box(*size_m):
    return Box.model_validate({"type": "box", "size_m": size_m}).build_mesh()


def plane(*size_m):
    return Plane.model_validate({"type": "plane", "size_m": size_m}).build_mesh()


def at(*position_m):
    return build_transform(np.eye(3), position_m)


@lru_cache
def directions(count, seed=0):
    """Sample (3, N) float32 unit vectors in all directions."""
    rows = np.random.default_rng(seed).normal(size=(3, count))
    return (rows / np.linalg.norm(rows, axis=0)).astype(np.float32)


def cast(bodies, origin_m, towards, device=None):
    endless = np.full(towards.shape[1], np.inf, np.float32)
    return RayCaster(bodies, device).cast(np.asarray(origin_m), towards, endless)


def bare_embree(bodies, origin_m, towards, robust=True):
    """Compute (N,) distances with plain Embree; a miss is infinite."""
    scene = EmbreeScene(robust=robust)
    for body in bodies:
        TriangleMesh(scene, body.vertices_m.astype(np.float32), body.faces.astype(np.int32))
    origins = np.repeat(np.asarray(origin_m, dtype=np.float32)[None], towards.shape[1], axis=0)
    answer = scene.run(origins, towards.T, output=True)
    return np.where(answer["geomID"] >= 0, answer["tfar"], np.inf)


def moeller_trumbore(mesh, origin_m, towards, least_determinant=1e-6):
    """Compute (N,) distances by the textbook formula in float32 with the usual epsilon; a miss is infinite."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]].astype(np.float32) for k in range(3))
    d, s = towards.T[:, None], np.asarray(origin_m, dtype=np.float32) - a
    with np.errstate(all="ignore"):
        p = np.cross(d, c - a)
        determinant = ((b - a) * p).sum(-1)
        q = np.cross(s, b - a)
        u, v, t = (s * p).sum(-1) / determinant, (d * q).sum(-1) / determinant, ((c - a) * q).sum(-1) / determinant
        hit = (np.abs(determinant) > least_determinant) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)
    return np.where(hit, t, np.inf).min(axis=1)


def to_walls(towards, lower_m, upper_m):
    """(N,) distance from the origin to the walls of a room around it, for the float32 directions as they are."""
    with np.errstate(divide="ignore"):
        walls = np.where(towards.T < 0, -np.asarray(lower_m), np.asarray(upper_m)) / np.abs(
            towards.T.astype(np.float64)
        )
    return walls.min(axis=1)


def missed(range_m):
    return int((~np.isfinite(range_m)).sum())


# A room around the sensor


def far_room(offset_m):
    """Walls at UTM-like coordinates, and a vehicle among them."""
    here = np.array([offset_m, -offset_m, 0.0])
    ego = Actor("ego", "car", box(0.1, 0.1, 0.1), Trajectory.create_static(here))
    return Scene(static_meshes=(box(*ROOM_M).transform(at(*here)),), ego=ego)


def from_mid_room(caster):
    """Upward rays, which pass the vehicle by, from 2 m above the floor."""
    towards = directions(5000) * np.sign(directions(5000)[2])
    return most(caster(towards) - to_walls(towards, -ROOM_M / 2, ROOM_M * [0.5, 0.5, 1.0] - [0.0, 0.0, 2.0]))


def offset(offset_m):
    instant = SceneGeometry(far_room(offset_m)).get_snapshot(0)
    return from_mid_room(
        lambda rays: instant.render_range_image(at(0.0, 0.0, 2.0), rays[:, None].astype(np.float64))[0]
    )


def offset_in_float32(offset_m):
    return from_mid_room(partial(bare_embree, far_room(offset_m).static_meshes, [offset_m, -offset_m, 2.0]))


def scaled(scale, caster):
    """Test the room in other units, with the sensor in its center."""
    room = box(*ROOM_M).transform(at(0.0, 0.0, -ROOM_M[2] / 2))
    mesh = Mesh(room.vertices_m * scale, room.faces)
    return relative(caster(mesh), to_walls(directions(5000), -ROOM_M / 2, ROOM_M / 2) * scale)


def ours_scaled(scale, device=None):
    return scaled(scale, lambda mesh: cast([mesh], np.zeros(3), directions(5000), device).range_m)


def naive_scaled(scale):
    return scaled(scale, lambda mesh: moeller_trumbore(mesh, np.zeros(3), directions(5000)))


# Grazing, touching, coincident


def grazing(caster):
    """Elevations from -1 to -0.0005 degrees, 1.7 m above a plane of 1,000 km: hits up to 195 km away."""
    elevation = np.deg2rad(-np.geomspace(5e-4, 1.0, 2000))
    towards = np.stack([np.cos(elevation), 0 * elevation, np.sin(elevation)]).astype(np.float32)
    height_m = np.float32(1.7).astype(np.longdouble)
    return relative(caster(plane(1e6, 1e6), [0.0, 0.0, 1.7], towards), height_m / -towards[2].astype(np.longdouble))


@lru_cache
def tilted_floor_and_ceiling():
    """Two planes 3 m apart in general position, places on the lower one, directions away from it, and the ranges."""
    rotation = convert_euler_to_rotation(37.0, 21.0, -13.0)
    floor_T = build_transform(rotation, [1.0, 2.0, 3.0])
    floor = plane(200.0, 200.0).transform(floor_T)
    ceiling = plane(4000.0, 4000.0).transform(floor_T @ at(0.0, 0.0, 3.0))
    generator = np.random.default_rng(3)
    places = np.append(generator.uniform(-80, 80, size=(20, 2)), np.zeros((20, 1)), axis=1)
    towards = directions(500).astype(np.float64)
    towards[2] = np.abs(towards[2]) + 0.01
    towards = (rotation @ (towards / np.linalg.norm(towards, axis=0))).astype(np.float32)
    return (floor, ceiling), transform_points(floor_T, places), towards, 3.0 / (rotation[:, 2] @ towards)


def from_a_surface(caster):
    """Count rays that miss the ceiling."""
    bodies, places, towards, expected = tilted_floor_and_ceiling()
    result = [caster(bodies, place, towards) for place in places]
    return sum(int((~(np.abs(range_m - expected) < 1e-3 * expected)).sum()) for range_m in result)


def along_a_surface(caster):
    """Rays that leave a plane in general position at slopes of 0.1 to 1e-5, and hit it."""
    generator, result = np.random.default_rng(5), 0
    for _ in range(100):
        floor_T = build_transform(
            convert_euler_to_rotation(*generator.uniform(-60, 60, 3)), generator.uniform(-50, 50, 3)
        )
        place = transform_points(floor_T, np.append(generator.uniform(-90, 90, 2), 0.0)[None])[0]
        slope, azimuth = np.geomspace(0.1, 1e-5, 100), generator.uniform(0, 2 * np.pi, 100)
        flat = np.sqrt(1 - slope**2)
        towards = floor_T[:3, :3] @ np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), slope])
        range_m = caster([plane(200.0, 200.0).transform(floor_T)], place, towards.astype(np.float32))
        result += int(np.isfinite(range_m).sum())
    return result


def coincident(caster):
    """Create two boxes with coplanar walls, one inside the outline of the other."""
    boxes = box(1.0, 1.0, 1.0).transform(at(5.0, 0.0, -0.5)), box(1.0, 3.0, 3.0).transform(at(5.0, 0.0, -1.5))
    y, z = np.random.default_rng(4).uniform(-0.49, 0.49, size=(2, 5000))
    ends = np.stack([np.full(5000, 4.5), y, z])
    towards = (ends / np.linalg.norm(ends, axis=0)).astype(np.float32)
    return most(caster(boxes, np.zeros(3), towards) - 4.5 / towards[0].astype(np.float64))


def between_slabs(held):
    """Places in the middle one of three slabs upon each other, turned about: those that are not found to be in it."""
    generator, lost = np.random.default_rng(6), 0
    slabs = (
        box(20.0, 20.0, 1.0),
        box(20.0, 20.0, 2.0).transform(at(0, 0, 1.0)),
        box(24.0, 16.0, 1.0).transform(at(0, 0, 3.0)),
    )
    for scale_m in np.repeat([1e-6, 1.0, 1e6], 200):
        turn = build_transform(
            convert_euler_to_rotation(*generator.uniform(-180, 180, 3)), generator.uniform(-50, 50, 3)
        )
        moved = [mesh.transform(turn) for mesh in slabs]
        caster = RayCaster([Mesh(mesh.vertices_m * scale_m, mesh.faces) for mesh in moved])
        place_m = transform_points(turn, np.append(generator.uniform(-6, 6, 2), generator.uniform(1.1, 2.9))[None])[0]
        lost += not held(caster, place_m * scale_m)
    return lost


def by_its_faces(caster, place_m):
    return caster.find_enclosing_bodies(place_m).tolist() == [1]


def by_a_ray(caster, place_m):
    """Return whether a ray first hits the middle slab."""
    towards = np.array([[0.6], [0.0], [0.8]], dtype=np.float32)
    return caster.cast(place_m, towards, np.array([np.inf], dtype=np.float32)).body_indices[0] == 1


# Cones


@lru_cache
def around_and_ahead():
    """A turn of 40 rows, and a narrow field of view, as tiles; and where they are mounted."""
    turn = compute_unit_directions(np.linspace(-60.0, 60.0, 40)[:, None], np.linspace(-180.0, 180.0, 180)[None])
    ahead = compute_unit_directions(np.linspace(-0.01, 0.01, 16)[:, None], np.linspace(-0.01, 0.01, 16)[None])
    return (*split_into_tiles(turn), *split_into_tiles(ahead)), build_transform(
        convert_euler_to_rotation(37.0, 11.0, -8.0), [1.7, -0.4, 1.9]
    )


def spared(met_by):
    """Rays that pass through a ball that is aimed at, and would not be cast."""
    tiles, vehicle_T_sensor = around_and_ahead()
    lost = 0
    for tile in tiles:
        rays = tile.directions.T.astype(np.longdouble)
        rays /= np.sqrt((rays**2).sum(axis=1))[:, None]
        for distance_m in (0.0, 1e-9, 1e-3, 1.0, 250.0, 1e5):
            for radius_m in (1e-9, 0.2, 2.0, 0.999 * distance_m):
                # In front of, behind and next to the sensor.
                for towards in (rays[0], -rays[0], np.roll(rays[0], 1)):
                    centre_m = transform_points(vehicle_T_sensor, (towards * distance_m).astype(np.float64)[None])
                    way_m = (centre_m[0] - vehicle_T_sensor[:3, 3]).astype(np.longdouble) @ vehicle_T_sensor[:3, :3]
                    along_m = np.maximum(rays @ way_m, 0.0)
                    through = np.sqrt(((along_m[:, None] * rays - way_m) ** 2).sum(axis=1)) <= radius_m
                    lost += int((through & ~met_by(SearchSpheres(centre_m, radius_m), tile, vehicle_T_sensor)).sum())
    return lost


def met_by_cosine(balls, tile, vehicle_T_sensor):
    """By the cosine of the angle to the middle of a ball, in float32."""
    way_m = ((balls.centers_m[0] - vehicle_T_sensor[:3, 3]) @ vehicle_T_sensor[:3, :3]).astype(np.float32)
    distance_m = np.linalg.norm(way_m)
    with np.errstate(all="ignore"):
        least = np.sqrt(1 - (np.float32(balls.radius_m) / distance_m) ** 2)
        return (way_m / distance_m) @ tile.directions >= least


def slope_from(offset_m):
    """A slope of 400 m in general position at UTM-like coordinates, under an ego."""
    here = np.array([offset_m, -offset_m, 0.0])
    slope = plane(400.0, 400.0).transform(
        build_transform(convert_euler_to_rotation(37.0, 11.0, -8.0), [*here[:2], -3.0])
    )
    return Scene(static_meshes=(slope,), ego=Actor("ego", "car", box(0.1, 0.1, 0.1), Trajectory.create_static(here)))


def incidence(cosine):
    """Off the cosine of the incidence of rays that meet the slope."""
    downwards = directions(5000) * -np.sign(directions(5000)[2])
    normal = convert_euler_to_rotation(37.0, 11.0, -8.0)[:, 2]
    expected = np.abs(normal @ downwards.astype(np.float64))
    return most((cosine(downwards) - expected)[expected > 0.02])


def incidence_ours(towards):
    (tile,) = split_into_tiles(towards[:, None].astype(np.float64), max_columns=towards.shape[1])
    scan = SceneGeometry(slope_from(1e6 + 0.3)).get_snapshot(0).scan(at(0.0, 0.0, 2.0), [tile])
    cosine = np.full(towards.shape[1], np.nan)
    cosine[scan.ray_indices] = scan.find_attributes().cos_incidence
    return np.where(np.isnan(cosine), np.abs(convert_euler_to_rotation(37.0, 11.0, -8.0)[:, 2] @ towards), cosine)


def incidence_in_float32(towards):
    (mesh,) = slope_from(1e6 + 0.3).static_meshes
    a, b, c = mesh.vertices_m.astype(np.float32)[mesh.faces[0]]
    normal = np.cross(b - a, c - a)
    return np.abs(normal / np.linalg.norm(normal) @ towards)


def turning(samples):
    """Metres that a corner 100 m from the origin of a frame is off that turns 9 degrees in a sweep of 0.1 s."""
    turn = Trajectory.from_arrays([0.0, 1.0], [[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]], [[0.0] * 3, [90.0, 0.0, 0.0]])
    times_s = np.linspace(0.2, 0.3, 101)
    samples_s = np.linspace(0.2, 0.3, samples)
    poses = np.stack([turn.interpolate(each) for each in samples_s])
    if samples == 3:
        result = np.tensordot(compute_parabola_weights(samples_s, times_s), poses, 1)
    else:
        share = ((times_s - 0.2) / 0.1)[:, None, None]
        result = (1 - share) * poses[0] + share * poses[1]
    corner = np.array([100.0, 0.0, 0.0, 1.0])
    return most(
        np.linalg.norm(np.stack([turn.interpolate(each) for each in times_s]) @ corner - result @ corner, axis=1)
    )


def ours(bodies, origin_m, towards, device=None):
    return cast(bodies, origin_m, towards, device).range_m


def alone(mesh, origin_m, towards, caster=ours):
    return caster([mesh], origin_m, towards)


def formula(bodies, origin_m, towards):
    return np.minimum.reduce([moeller_trumbore(body, origin_m, towards) for body in bodies])


FORMULA = "Möller-Trumbore, float32"

CASES = [
    Case("world 1e6 m from the origin", "closed form", "m", 2e-5, partial(offset, 1e6 + 0.3),
         "Embree in world coordinates", partial(offset_in_float32, 1e6 + 0.3)),
    Case("world 1e7 m from the origin", "closed form", "m", 2e-5, partial(offset, 1e7 + 0.3),
         "Embree in world coordinates", partial(offset_in_float32, 1e7 + 0.3)),
    Case("a room of 1e-12 m", "closed form", "relative", 1e-6, partial(ours_scaled, 1e-13),
         FORMULA + ", epsilon 1e-6", partial(naive_scaled, 1e-13)),
    Case("a room of 1e9 m", "closed form", "relative", 1e-6, partial(ours_scaled, 1e7),
         FORMULA + ", epsilon 1e-6", partial(naive_scaled, 1e7), naive_fails=False),
    Case("grazing rays, down to 0.0005 degrees", "longdouble", "relative", 1e-6, partial(grazing, alone),
         FORMULA + ", epsilon 1e-6", partial(grazing, moeller_trumbore), naive_fails=False),
    Case("rays from a surface", "closed form", "of 10,000 wrong", 0, partial(from_a_surface, ours),
         "Embree as it comes", partial(from_a_surface, bare_embree)),
    Case("rays along a surface they start on", "closed form", "of 10,000 wrong", 0, partial(along_a_surface, ours),
         "Embree as it comes", partial(along_a_surface, bare_embree)),
    Case("coincident surfaces of two bodies", "closed form", "m", 2e-6, partial(coincident, ours),
         FORMULA, partial(coincident, formula), naive_fails=False),
    Case("places between bodies that touch, of 1e-6 m to 1e6 m", "by construction", "of 600 wrong", 0,
         partial(between_slabs, by_its_faces), "what a ray meets first", partial(between_slabs, by_a_ray)),
    Case("incidence on a slope 1e6 m away", "closed form", "cosine", 3e-7, partial(incidence, incidence_ours),
         "normals of float32 corners", partial(incidence, incidence_in_float32)),
    Case("a frame that turns 9 degrees in a sweep, 100 m away", "float64 at each time", "m", 0.01, partial(turning, 3),
         "straight between two poses", partial(turning, 2)),
    Case("rays through balls of 1e-9 m to 100 km, around the sensor, beside and behind it, 100 km away", "longdouble",
         "of 536,832 spared", 0, partial(spared, SearchSpheres.find_rays_through),
         "cosine in float32", partial(spared, met_by_cosine)),
]  # fmt: skip


def of_warp(device, words):
    """Cast with Warp on one of its devices."""
    cast_there = partial(ours, device=device)
    return [
        Case(f"a room of 1e-9 m, {words}", "closed form", "relative", 1e-6, partial(ours_scaled, 1e-10, device),
             FORMULA + ", epsilon 1e-6", partial(naive_scaled, 1e-10)),
        Case(f"a room of 1e9 m, {words}", "closed form", "relative", 1e-6, partial(ours_scaled, 1e7, device),
             FORMULA + ", epsilon 1e-6", partial(naive_scaled, 1e7), naive_fails=False),
        Case(f"grazing rays, {words}", "longdouble", "relative", 1e-6,
             partial(grazing, partial(alone, caster=cast_there)),
             FORMULA + ", epsilon 1e-6", partial(grazing, moeller_trumbore), naive_fails=False),
        Case(f"rays from a surface, {words}", "closed form", "of 10,000 wrong", 0, partial(from_a_surface, cast_there),
             "Embree as it comes", partial(from_a_surface, bare_embree)),
        Case(f"rays along a surface they start on, {words}", "closed form", "of 10,000 wrong", 0,
             partial(along_a_surface, cast_there), "Embree as it comes", partial(along_a_surface, bare_embree)),
        Case(f"coincident surfaces of two bodies, {words}", "closed form", "m", 2e-6, partial(coincident, cast_there),
             FORMULA, partial(coincident, formula), naive_fails=False),
    ]  # fmt: skip


if find_spec("warp"):
    CASES += of_warp("cpu", "by Warp")
    CASES += of_warp("cuda:0", "by Warp on a GPU") if torch.cuda.is_available() else []
