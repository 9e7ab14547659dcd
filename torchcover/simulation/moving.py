"""Bodies that move: the geometry of each kind, made once for all that share a mesh, and all placed at one instant."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np

from torchcover.geometry import BoundingBox, invert
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.patches import Patches
from torchcover.simulation.raycaster import HitAttributes, Hits, RayCaster
from torchcover.simulation.rays import (
    SLACK_M,
    SLACK_SHARE,
    BoxOutlines,
    Tile,
    find_blocks_towards_boxes,
    find_boxes_in_cone,
    find_rays_towards_boxes,
    rotate_each,
)
from torchcover.simulation.shapes import Mesh


class BodyGeometry:
    """The geometry of one kind of body in its own frame.

    `outline_points_m` (9, 3) has the corners of its box, grown a little, and the centre; no vertex is farther from that than
    `radius_m`, nor from the origin of the frame than `reach_m`.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.bounding_box = BoundingBox.from_points(mesh.vertices_m)
        centre_m = (np.array(self.bounding_box.lower_m) + np.array(self.bounding_box.upper_m)) / 2
        self.radius_m = float(np.linalg.norm(mesh.vertices_m - centre_m, axis=1).max())
        # Of the corners as they are cast: in float32.
        slack_m = SLACK_M + SLACK_SHARE * float(np.abs(self.bounding_box.corners_m).max())
        grown_m = self.bounding_box.corners_m + slack_m * np.sign(self.bounding_box.corners_m - centre_m)
        self.outline_points_m: Float64 = np.vstack([grown_m, centre_m])
        self.reach_m = float(np.linalg.norm(centre_m)) + self.radius_m

    @cached_property
    def caster(self) -> RayCaster:
        """It alone, to cast rays at."""
        return RayCaster([self.mesh])

    @cached_property
    def patches(self) -> Patches:
        """All of its surface, cut small."""
        return Patches.from_mesh(self.mesh)


class BodyGeometryCache:
    """The solids of meshes, each made when first asked for and kept: one for each mesh object, whoever shares it."""

    def __init__(self) -> None:
        self._of: dict[int, tuple[Mesh, BodyGeometry]] = {}

    def get_geometry(self, mesh: Mesh) -> BodyGeometry:
        """That of a mesh."""
        if id(mesh) not in self._of:
            self._of[id(mesh)] = mesh, BodyGeometry(mesh)  # with the mesh, so that no other one gets its id
        return self._of[id(mesh)][1]


class BodyHits(NamedTuple):
    """L times that a ray meets a body: (L,) number of the body in `Moving`, of the ray in its tile, and where.

    `triangle_indices` (L,) says on which face of the body.
    """

    part_indices: Int64
    ray_indices: Int64
    range_m: Float32
    triangle_indices: Int32


@dataclass(frozen=True, eq=False)
class MovingBodies:
    """P bodies that move, placed at one instant: casters in their own frames, which one kind shares, and numbers.

    In the vehicle frame, `box_corners_m` (P, 8, 3) are of boxes around them; of balls around them `center_m` is (P, 3),
    `radius_m` (P,).
    """

    casters: Sequence[RayCaster]
    vehicle_T_part: Float64
    body_indices: Int64
    box_corners_m: Float64
    center_m: Float64
    radius_m: Float64

    @classmethod
    def from_geometries(cls, geometries: Sequence[BodyGeometry], vehicle_T_part: Float64, body_indices: Int64) -> Self:
        """Bodies of these kinds, (P,), where they are, (P, 4, 4), with their numbers, (P,)."""
        outlines_m = np.array([solid.outline_points_m for solid in geometries]).reshape(-1, 9, 3)
        outlines_m = outlines_m @ vehicle_T_part[:, :3, :3].swapaxes(1, 2) + vehicle_T_part[:, None, :3, 3]
        return cls(
            casters=[solid.caster for solid in geometries],
            vehicle_T_part=vehicle_T_part,
            body_indices=body_indices,
            box_corners_m=outlines_m[:, :8],
            center_m=outlines_m[:, 8],
            radius_m=np.array([solid.radius_m for solid in geometries]),
        )

    def __len__(self) -> int:
        return len(self.casters)

    @cached_property
    def part_T_vehicle(self) -> Float64:
        """(P, 4, 4) from the vehicle frame to theirs."""
        return invert(self.vehicle_T_part)

    @cached_property
    def unique_casters(self) -> tuple[Sequence[RayCaster], Int64]:
        """The different casters, and (P,) which of them each body has."""
        different = list(dict.fromkeys(self.casters))
        number = {caster: k for k, caster in enumerate(different)}
        return different, np.array([number[caster] for caster in self.casters], dtype=np.int64)

    def find_touched_bodies(self, position_m: Float64, part_positions_m: Float64) -> Bools:
        """(P,) whether a (3,) place of the vehicle frame, `part_positions_m` (P, 3) from there, lies on a face of each body."""
        touched: Bools = np.linalg.norm(self.center_m - position_m, axis=1) <= self.radius_m + SLACK_M
        for k in np.flatnonzero(touched).tolist():
            touched[k] = len(self.casters[k].find_touched_bodies(part_positions_m[k])) > 0
        return touched

    def transform_to_parts_m(self, position_m: Float64) -> Float64:
        """(P, 3) a (3,) place of the vehicle frame in the frame of each body, as `transform` has it."""
        rotation, translation = self.part_T_vehicle[:, :3, :3], self.part_T_vehicle[:, :3, 3:]
        back = rotation.swapaxes(1, 2)
        return np.asarray(((position_m + (back @ translation)[..., 0])[:, None] @ back)[:, 0])

    def find_candidate_pairs(
        self,
        vehicle_R_sensor: Float64,
        tile: Tile,
        directions: Float32,
        limit_m: Float32,
        outlines: BoxOutlines,
        *,
        excluded_body: int | None = None,
    ) -> tuple[Int64, Int64]:
        """Which rays of a tile may meet which body before their (n,) limits: (K,) bodies and (K,) rays.

        `directions` (3, n) are those of the tile in the vehicle frame, `outlines` what they look like from there, from
        `outlines`; `excluded_body` is the number of a body that they are not cast at.
        """
        near = find_boxes_in_cone(
            outlines, vehicle_R_sensor @ tile.axis, tile.half_angle_rad, float(limit_m.max(initial=0.0))
        )
        if excluded_body is not None:
            near = near[self.body_indices[near] != excluded_body]
        if len(near) == 0:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        of_near, block = np.nonzero(find_blocks_towards_boxes(outlines.select(near), tile, vehicle_R_sensor, limit_m))
        return find_rays_towards_boxes(outlines, near[of_near], tile.block_rays[block], directions, limit_m)

    def find_body_hits(
        self,
        origin_m: Float64,
        vehicle_R_sensor: Float64,
        tile: Tile,
        directions: Float32,
        limit_m: Float32,
        outlines: BoxOutlines,
        *,
        excluded_body: int | None = None,
    ) -> tuple[BodyHits, int]:
        """Where the rays of one tile meet each body, as if it were alone, and of how many pairs; as `pairs`."""
        part, ray = self.find_candidate_pairs(
            vehicle_R_sensor, tile, directions, limit_m, outlines, excluded_body=excluded_body
        )
        if len(ray) == 0:
            return BodyHits(part, ray, np.empty(0, dtype=np.float32), np.empty(0, dtype=np.int32)), 0
        places_m = self.transform_to_parts_m(origin_m)
        towards = rotate_each(self.part_T_vehicle[:, :3, :3].astype(np.float32)[part], directions.take(ray, axis=1))
        hits = self.cast_pairs(part, places_m.astype(np.float32)[part], towards, limit_m[ray], (origin_m, places_m))
        met = hits.body_indices >= 0
        return BodyHits(part[met], ray[met], hits.range_m[met], hits.triangle_indices[met]), len(met)

    def compute_hit_attributes(
        self, part_indices: Int64, triangle_indices: Int32, directions: Float32
    ) -> HitAttributes:
        """What the rays hit that met some of the bodies, as `RayCaster.struck`."""
        towards = rotate_each(self.part_T_vehicle[:, :3, :3].astype(np.float32)[part_indices], directions)
        casters, kind = self.unique_casters
        cosine, material = np.empty(len(part_indices), dtype=np.float32), np.empty(len(part_indices), dtype=np.uint8)
        for number in np.unique(kind[part_indices]).tolist():
            some = np.flatnonzero(kind[part_indices] == number)
            alone = casters[number].compute_hit_attributes(
                np.zeros(len(some), dtype=np.int32), triangle_indices[some], towards[:, some]
            )
            cosine[some], material[some] = alone.cos_incidence, alone.material_indices
        return HitAttributes(self.body_indices[part_indices].astype(np.int32), triangle_indices, cosine, material)

    def cast_pairs(
        self,
        part_indices: Int64,
        starts_m: Float32,
        directions: Float32,
        limit_m: Float32,
        common_origin_m: tuple[Float64, Float64] | None = None,
    ) -> Hits:
        """Cast K pairs of a ray and a body, each as if it were alone.

        Starts (K, 3) and directions (3, K) are in the frames of the (K,) bodies, `limit_m` (K,) is where rays end. If
        they start at one place, which may lie on a face, `common_origin_m` is that, (3,), and the same in the frame of each
        body, (P, 3).
        """
        casters, kind = self.unique_casters
        touched = (
            np.zeros(len(self), dtype=bool) if common_origin_m is None else self.find_touched_bodies(*common_origin_m)
        )
        # Bodies of one kind are cast at together. A ray that starts on a face is cast as one that leaves it.
        group = np.where(touched, len(casters) + np.arange(len(self)), kind)[part_indices]
        order = np.argsort(group, kind="stable")
        part_indices, group = part_indices[order], group[order]
        starts_m, directions, limit_m = starts_m[order], directions[:, order], limit_m[order]
        first, answers = np.flatnonzero(np.diff(group, prepend=-1)).tolist(), []
        for start, end in pairwise([*first, len(group)]):
            some, body = slice(start, end), part_indices[start]
            if common_origin_m is not None and touched[body]:
                answers.append(self.casters[body].cast(common_origin_m[1][body], directions[:, some], limit_m[some]))
            else:
                caster = casters[group[start]]
                answers.append(caster.cast_from_each(starts_m[some], directions[:, some], limit_m[some]))
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        return Hits._make(np.concatenate(column)[back] for column in zip(*answers, strict=True))

    def update_nearest_hits(self, hits: Hits, body_hits: BodyHits) -> None:
        """Bring the hits of all rays of a tile up to date with what they meet of the bodies."""
        # The nearest counts; of two that coincide, the last in the order of the bodies.
        part, ray, range_m, triangle = body_hits
        nearest_m = np.full(len(hits.range_m), np.inf, dtype=np.float32)
        np.minimum.at(nearest_m, ray, range_m)
        first = range_m == nearest_m[ray]
        hits.range_m[ray[first]] = range_m[first]
        hits.body_indices[ray[first]], hits.triangle_indices[ray[first]] = (
            self.body_indices[part[first]],
            triangle[first],
        )
