"""Ray casting with Embree. Everything that one must know about embreex is written here.

embreex computes in float32, so a scene is given in coordinates near the vehicle; it does not check that origins and
directions are equal in number; it writes into the distances it is given, and answers a miss with them; it releases the
interpreter lock, so that threads add up. An origin may lie on a face, as far as float32 can tell.

Its threads build scenes, and nothing tells it to do without. A forked process, such as a worker of a DataLoader, has
none of them but the locks that they held, and one in a thousand waits for ever. TBB counts the cores that it may use
when it is first used: so that is done with one (`_have_no_threads`).
"""

import os
from collections.abc import Sequence
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from torchcover.geometry import transform_points
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.simulation.patches import find_outward_faces
from torchcover.simulation.rays import rotate
from torchcover.simulation.shapes import PART, Mesh, compute_normals, get_corners_m, iterate_mesh_parts

# Farther from the origin float32 resolves no better than 64 m, and at 2e18 Embree drops faces without a word.
MAX_M = 1e9
# How far beyond a face that it leaves a ray goes on, in contact distances; farther each time that it hits one again.
CONTACTS_BEYOND = 2.0 ** np.arange(1, 13)
# An origin lies on a face if it is no farther from its plane than four times what rounding makes of that; as a share.
CONTACT = 4 * float(np.finfo(np.float32).eps)
# Twice that, of the largest coordinate of a face, and what rounding its box to float32 adds.
MOST_CONTACT = 3 * CONTACT
# Origins are rounded too, before they come here: in float64, as a share of the largest coordinate.
MIN_CONTACT = 1e-12
# More faces than so many are no lists: they would take some hundred bytes each.
MOST_LISTS = 2**18
# So far beside a place the line upwards starts if it would run through an edge.
BESIDE_M = ((0.0, 0.0), (1.1e-7, 2.3e-7), (-3.7e-7, 1.9e-7))


@cache
def _have_no_threads() -> None:
    """Use Embree for the first time, on one core of those that this thread may use."""
    if not hasattr(os, "sched_setaffinity"):  # where processes are started anew, not forked
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        scene = EmbreeScene()
        TriangleMesh(scene, np.eye(3, dtype=np.float32), np.arange(3, dtype=np.int32).reshape(1, 3))
        scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    finally:
        os.sched_setaffinity(0, cores)


def _embree(bodies: Sequence[Mesh]) -> EmbreeScene:
    _have_no_threads()
    # Robust: a ray through a shared edge hits one of the two faces instead of slipping between them.
    scene = EmbreeScene(robust=True)
    for body in bodies:
        TriangleMesh(scene, body.vertices_m.astype(np.float32), _as_read(body.faces))
    # embreex commits the scene when it is first used; do it before several threads do.
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return scene


def _as_read(faces: NDArray[np.integer]) -> NDArray[Any]:
    """Of (F, 3) faces what embreex, which asks for one number after another, reads soonest: lists, but of very many."""
    if len(faces) > MOST_LISTS:
        return faces.astype(np.int32)
    return np.fromiter(faces.tolist(), dtype=object, count=len(faces))


def _warp(bodies: Sequence[Mesh], device: str) -> Any:  # noqa: ANN401  (answers as Embree's scene)
    from torchcover.simulation.warp_scene import WarpScene

    return WarpScene(bodies, device)


class FaceGeometry:
    """The faces of all bodies, one after the other, and how far from each a place counts as on it.

    `normals` (3, F) are of length one, or 0 where a face has no area. What is kept of all is float32, for there may be
    ten million; what a question needs in float64 is computed for the few faces that it is about.
    """

    def __init__(self, bodies: Sequence[Mesh], reach_m: float) -> None:
        self._bodies = bodies
        self._least_contact_m = MIN_CONTACT * reach_m
        self._count = sum(len(body.faces) for body in bodies)
        # Of the boxes of places that may lie on a face: no contact distance is more than a share of its coordinates.
        self._lower_m, self._upper_m = (np.empty((3, self._count), dtype=np.float32) for _ in range(2))
        first = 0
        for body in bodies:
            vertices_m = np.ascontiguousarray(body.vertices_m.T, dtype=np.float32)
            for start in range(0, len(body.faces), PART):
                corners_m = vertices_m.take(body.faces[start : start + PART].T, axis=1)
                lower_m, upper_m = corners_m.min(axis=1), corners_m.max(axis=1)
                largest_m = np.maximum(np.abs(lower_m).max(axis=0), np.abs(upper_m).max(axis=0))
                beside_m = np.float32(MOST_CONTACT) * largest_m + np.float32(2 * self._least_contact_m)
                faces = slice(first, first + corners_m.shape[2])
                first = faces.stop
                self._lower_m[:, faces], self._upper_m[:, faces] = lower_m - beside_m, upper_m + beside_m
        self._least_m, self._most_m = (
            self._lower_m.min(axis=1, initial=np.inf),
            self._upper_m.max(axis=1, initial=-np.inf),
        )

    @cached_property
    def normals(self) -> Float32:
        """Asked where light returns."""
        normals = np.empty((3, self._count), dtype=np.float32)
        for faces, corners_m in iterate_mesh_parts(self._bodies):
            normals[:, faces] = compute_normals(corners_m)
        return normals

    def find_containing_faces(self, position_m: NDArray[np.floating]) -> Int64:
        """Numbers of those that a (3,) place lies on."""
        if ((position_m < self._least_m) | (position_m > self._most_m)).any():
            return np.empty(0, dtype=np.int64)
        x, y, z = position_m
        # One axis after the other: the first, which asks all faces, leaves few to the second. Most are near the ground.
        near = np.flatnonzero((self._lower_m[0] <= x) & (x <= self._upper_m[0]))
        for axis, coordinate_m in ((1, y), (2, z)):
            near = near[(self._lower_m[axis, near] <= coordinate_m) & (coordinate_m <= self._upper_m[axis, near])]
        if len(near) == 0:
            return near
        corners_m, within_m = get_corners_m(self._bodies, near), 2 * self.compute_contact_distances_m(near)
        apart_m = np.maximum(corners_m.min(axis=0) - position_m[:, None], position_m[:, None] - corners_m.max(axis=0))
        return np.asarray(
            near[(apart_m <= within_m).all(axis=0) & (self.compute_plane_distances_m(position_m, near) <= within_m)]
        )

    def find_faces_above(self, position_m: NDArray[np.floating]) -> Int64:
        """Numbers of those that a line upwards from a (3,) place may meet."""
        x, y, z = position_m
        near = np.flatnonzero((self._lower_m[0] <= x) & (x <= self._upper_m[0]))
        near = near[(self._lower_m[1, near] <= y) & (y <= self._upper_m[1, near])]
        return np.asarray(near[z <= self._upper_m[2, near]])

    def compute_contact_distances_m(self, face_indices: Int64) -> Float64:
        """(N,) from the planes of some of them, as far as float32 may find a place that lies on it, but of slivers."""
        return np.maximum(_contact_m(get_corners_m(self._bodies, face_indices)), self._least_contact_m)

    def compute_plane_distances_m(self, position_m: NDArray[np.floating], face_indices: Int64) -> Float64:
        """Distance of a (3,) place from the planes of some of them."""
        corners_m = get_corners_m(self._bodies, face_indices)
        return np.asarray(np.abs(((position_m[:, None] - corners_m[0]) * compute_normals(corners_m)).sum(axis=0)))


def _contact_m(corners_m: Matrix) -> Matrix:
    """(N,) how far from its plane float32 may find a place that lies on a face, of (3, 3, N) corners."""
    first, second, third = corners_m
    (ax, ay, az), (bx, by, bz) = np.abs(second - first), np.abs(third - first)
    length = np.linalg.norm(np.cross(second - first, third - first, axis=0), axis=0)
    # To first order, the roundings of n . x, where n = a x b, are the sum of all its products.
    products = np.stack([ay * bz + az * by, az * bx + ax * bz, ax * by + ay * bx])
    largest = np.abs(corners_m).max(axis=0)
    rounding_m = (products * largest).sum(axis=0) / np.where(length == 0, np.inf, length)
    # The plane of a sliver is anybody's guess, but the sliver is not far from where it is.
    return np.asarray(np.minimum(rounding_m, largest.max(axis=0)) * CONTACT)


class Hits(NamedTuple):
    """For each of N rays: `range_m` (N,) float32 where it ended, and `body_indices` (N,) int32, -1 if at its limit.

    `triangle_indices` (N,) int32 is the number of the face among those of its body.
    """

    range_m: Float32
    body_indices: Int32
    triangle_indices: Int32


class HitAttributes(NamedTuple):
    """What N rays hit: the number of the body, see `Instant`, or -1, the face of its mesh, and what that is made of.

    `cos_incidence` is the cosine of the angle between the ray and the normal of the face, on either side.
    """

    body_indices: Int32
    triangle_indices: Int32
    cos_incidence: Float32
    material_indices: NDArray[np.uint8]


class RayCaster:
    """A set of bodies that rays can be cast at, from several threads at once: a closed or open mesh each, in metres.

    Coordinates should be near the origin of the rays' frame: they become float32. ValueError: there is no body, or one
    with a vertex that is not a number or farther than 1e9 m. Warp casts on a `device` that is given, such as `cuda:0`,
    else Embree; they agree but for the last bits.
    """

    def __init__(self, bodies: Sequence[Mesh], device: str | None = None) -> None:
        if not bodies:
            raise ValueError("a scene needs at least one body")
        reach_m = float(np.max([np.abs(body.vertices_m).max(initial=0.0) for body in bodies]))  # NaN if one is
        if not reach_m <= MAX_M:
            raise ValueError(
                f"bodies within {MAX_M:g} m of the origin are needed; a vertex has the coordinate {reach_m}"
            )
        self._reach_m = reach_m
        self._first_face = np.cumsum([0] + [len(body.faces) for body in bodies])
        self._bodies = bodies
        self._closed: dict[int, Bools] = {}  # asked of few: hardly any ray meets a face from behind
        self._last_asked: tuple[bytes, Int64] = b"", np.empty(0, dtype=np.int64)
        self._scene = _embree(bodies) if device is None else _warp(bodies, device)

    @cached_property
    def _faces(self) -> FaceGeometry:
        """Asked where rays have a common origin, which may lie on a face."""
        return FaceGeometry(self._bodies, self._reach_m)

    @cached_property
    def _materials(self) -> NDArray[np.uint8]:
        """(F,) what each of all faces is made of."""
        return np.concatenate([body.filled_material_indices for body in self._bodies])

    @property
    def num_bodies(self) -> int:
        """How many there are; their numbers begin with 0."""
        return len(self._bodies)

    def cast(self, origin_m: NDArray[np.floating], directions: Float32, limit_m: Float32) -> Hits:
        """Cast (3, N) unit directions from one origin, up to (N,) limits, which may be infinite.

        A ray that starts on a face does not hit that face. What hits nothing has its limit as range, and body -1.
        """
        # One origin for all rays: an array that steps over no memory from row to row.
        origins = np.ndarray(
            (directions.shape[1], 3), np.float32, origin_m.astype(np.float32).tobytes(), strides=(0, 4)
        )
        hits = self.cast_from_each(origins, directions, limit_m)
        if len(self.find_touched_bodies(origin_m)):
            self._leave_faces(origin_m, directions, limit_m, hits)
        return hits

    def cast_from_each(self, origins_m: Float32, directions: Float32, limit_m: Float32) -> Hits:
        """Cast (3, N) unit directions from (N, 3) origins up to (N,) limits; none starts on a face, see `touched`."""
        answer = self._scene.run(origins_m, directions.T, dists=limit_m.copy(), output=True)
        return Hits(answer["tfar"], answer["geomID"], answer["primID"])

    def compute_hit_attributes(
        self, body_indices: Int32, triangle_indices: Int32, directions: Float32
    ) -> HitAttributes:
        """What N rays with (3, N) unit directions hit that ended on some faces, as `Hits` has them, none of them -1."""
        face = self._first_face.take(body_indices) + triangle_indices
        (nx, ny, nz), (x, y, z) = self._faces.normals.take(face, axis=1), directions
        cosine = np.abs(nx * x + ny * y + nz * z)
        return HitAttributes(
            body_indices, triangle_indices, np.minimum(cosine, 1.0, out=cosine), self._materials.take(face)
        )

    def find_first_faces(
        self, origins_m: NDArray[np.floating], directions: NDArray[np.floating], limit_m: float
    ) -> Int64:
        """(N,) which face each ray meets first within a limit, counted through those of all bodies; -1 for none."""
        ends_m = np.full(len(origins_m), limit_m, dtype=np.float32)
        hits = self.cast_from_each(origins_m.astype(np.float32), directions.astype(np.float32).T, ends_m)
        return np.asarray(np.where(hits.body_indices >= 0, self._numbers(hits), -1))

    def _numbers(self, hits: Hits) -> Int64:
        """(N,) which of all faces each ray hit; any number where it hit none."""
        return np.asarray(self._first_face[np.maximum(hits.body_indices, 0)] + np.maximum(hits.triangle_indices, 0))

    def find_touched_bodies(self, position_m: NDArray[np.floating]) -> Int64:
        """Numbers of the bodies on whose faces a place lies: hardly any does, and the faces are sooner asked than rays.

        The last answer is kept, for all tiles of a scan start at one place.
        """
        asked, answer = self._last_asked  # read at once: other threads may ask about other places
        if asked != position_m.tobytes():
            answer = np.searchsorted(self._first_face, self._faces.find_containing_faces(position_m), side="right") - 1
            self._last_asked = (position_m.tobytes(), answer)
        return answer

    def _leave_faces(self, origin_m: NDArray[np.floating], directions: Float32, limit_m: Float32, hits: Hits) -> None:
        """Let the rays go on that hit a face whose plane they start on: by rounding alone, as they leave it."""

        def starts_on_plane(faces: Int64) -> Bools:
            return np.asarray(
                self._faces.compute_plane_distances_m(origin_m, faces) <= self._faces.compute_contact_distances_m(faces)
            )

        rays, travelled_m, faces = np.flatnonzero(hits.body_indices >= 0), 0.0, self._numbers(hits)
        rays = rays[starts_on_plane(faces[rays])]
        range_m, faces = hits.range_m[rays], faces[rays]
        for beyond in CONTACTS_BEYOND:
            if len(rays) == 0:
                return
            # The hit is the nearest one, so nothing lies before it.
            travelled_m = travelled_m + range_m + beyond * self._faces.compute_contact_distances_m(faces)
            towards, left_m = directions.T[rays], np.maximum(limit_m[rays] - travelled_m, 0.0)
            starts_m = origin_m + travelled_m[:, None] * towards
            found = self.cast_from_each(starts_m.astype(np.float32), towards.T, left_m.astype(np.float32))
            hit, range_m, faces = found.body_indices >= 0, found.range_m, self._numbers(found)
            hits.range_m[rays] = np.where(hit, travelled_m + range_m, limit_m[rays])
            hits.body_indices[rays], hits.triangle_indices[rays] = found.body_indices, found.triangle_indices
            again = hit & starts_on_plane(faces)
            rays, travelled_m, range_m, faces = rays[again], travelled_m[again], range_m[again], faces[again]

    def find_enclosing_bodies(self, position_m: NDArray[np.floating]) -> Int64:
        """Numbers of the bodies that a (3,) place lies inside of; a sheet has no inside.

        It is inside a closed surface that is turned outwards if a line upwards leaves that more often than it enters.
        No ray is cast: which of two faces it met first where bodies touch would be up to how the processor rounds.
        """
        faces = self._faces.find_faces_above(position_m)
        body = np.searchsorted(self._first_face, faces, side="right") - 1
        bodies, of = np.unique(body, return_inverse=True)
        is_closed = np.zeros(len(faces), dtype=bool)
        for number in bodies.tolist():
            if number not in self._closed:
                self._closed[number] = find_outward_faces(self._bodies[number])
            is_closed[body == number] = self._closed[number][faces[body == number] - self._first_face[number]]
        corners_m = get_corners_m(self._bodies, faces) - position_m[:, None]
        for beside_m in BESIDE_M:
            x_m, y_m = corners_m[:, 0] - beside_m[0], corners_m[:, 1] - beside_m[1]
            # Twice the signed areas between the line and each edge: of an edge of two faces the same, to the bit.
            areas = np.roll(x_m, -1, 0) * np.roll(y_m, -2, 0) - np.roll(y_m, -1, 0) * np.roll(x_m, -2, 0)
            whole = areas.sum(axis=0)
            if not ((areas == 0).any(axis=0) & (whole != 0)).any():
                break
        with np.errstate(divide="ignore", invalid="ignore"):
            is_above = (areas * corners_m[:, 2]).sum(axis=0) / whole > self._faces.compute_contact_distances_m(faces)
        way = (areas > 0).all(axis=0).astype(np.int64) - (areas < 0).all(axis=0)
        return bodies[np.bincount(of, way * (is_above & is_closed), len(bodies)) > 0]


def cast_from_vehicle(
    caster: RayCaster, part_T_vehicle: Matrix, origin_m: Matrix, directions: Float32, limit_m: Float32
) -> Hits:
    """Cast rays of the vehicle frame at a caster in its own frame."""
    towards = rotate(part_T_vehicle[:3, :3], directions)
    return caster.cast(transform_points(part_T_vehicle, origin_m[None])[0], towards, limit_m)
