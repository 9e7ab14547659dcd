"""Moving bodies: geometry of each kind of body, shared by all bodies with the same mesh, and their poses in a frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np

from torchcover.geometry import BoundingBox, invert
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.culling import (
    RELATIVE_SLACK,
    SLACK_M,
    BoxOutlines,
    find_blocks_towards_boxes,
    find_boxes_in_cone,
    find_rays_towards_boxes,
)
from torchcover.simulation.patches import Patches
from torchcover.simulation.raycaster import HitAttributes, Hits, RayCaster
from torchcover.simulation.rays import Tile, rotate_each
from torchcover.simulation.shapes import Mesh


class BodyGeometry:
    """Geometry of one kind of body in its own frame.

    Args:
        mesh: Mesh in the frame of the body.

    Attributes:
        bounding_box: Box around the mesh.
        outline_points_m: (9, 3) float64 corners of the box, enlarged for rounding, and its center.
        radius_m: Largest distance of a vertex from that center.
        reach_m: Upper bound of the distance of a vertex from the origin of the frame.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.bounding_box = BoundingBox.from_points(mesh.vertices_m)
        center_m = (np.array(self.bounding_box.lower_m) + np.array(self.bounding_box.upper_m)) / 2
        self.radius_m = float(np.linalg.norm(mesh.vertices_m - center_m, axis=1).max())
        # Rays are cast at float32 coordinates, which may lie slightly outside the box.
        slack_m = SLACK_M + RELATIVE_SLACK * float(np.abs(self.bounding_box.corners_m).max())
        enlarged_m = self.bounding_box.corners_m + slack_m * np.sign(self.bounding_box.corners_m - center_m)
        self.outline_points_m: Float64 = np.vstack([enlarged_m, center_m])
        self.reach_m = float(np.linalg.norm(center_m)) + self.radius_m

    @cached_property
    def caster(self) -> RayCaster:
        """Ray caster of this body alone."""
        return RayCaster([self.mesh])

    @cached_property
    def patches(self) -> Patches:
        """Surface of the body, divided into small patches."""
        return Patches.from_mesh(self.mesh)


class BodyGeometryCache:
    """Cache of one `BodyGeometry` per mesh object, built on first use."""

    def __init__(self) -> None:
        self._geometries: dict[int, tuple[Mesh, BodyGeometry]] = {}

    def get_geometry(self, mesh: Mesh) -> BodyGeometry:
        """Get the geometry of a mesh; the same object gives the same geometry."""
        if id(mesh) not in self._geometries:
            # The mesh is stored as well, so that no other object gets its id.
            self._geometries[id(mesh)] = mesh, BodyGeometry(mesh)
        return self._geometries[id(mesh)][1]


class BodyHits(NamedTuple):
    """L hits of rays on moving bodies; one ray may hit several bodies.

    Args:
        part_indices: (L,) body in `MovingBodies`.
        ray_indices: (L,) ray in its tile.
        range_m: (L,) float32 range.
        triangle_indices: (L,) int32 face in the mesh of the body.
    """

    part_indices: Int64
    ray_indices: Int64
    range_m: Float32
    triangle_indices: Int32


@dataclass(frozen=True, eq=False)
class MovingBodies:
    """P moving bodies with their poses in one frame.

    Args:
        casters: Ray caster of each body in its own frame; bodies of one kind share it.
        vehicle_T_part: (P, 4, 4) poses in the vehicle frame.
        body_indices: (P,) indices of the bodies in the scene.
        box_corners_m: (P, 8, 3) corners of their boxes in the vehicle frame.
        center_m: (P, 3) centers of spheres around them in the vehicle frame.
        radius_m: (P,) radii of these spheres.
    """

    casters: Sequence[RayCaster]
    vehicle_T_part: Float64
    body_indices: Int64
    box_corners_m: Float64
    center_m: Float64
    radius_m: Float64

    @classmethod
    def from_geometries(cls, geometries: Sequence[BodyGeometry], vehicle_T_part: Float64, body_indices: Int64) -> Self:
        """Place bodies.

        Args:
            geometries: Geometry of each of P bodies.
            vehicle_T_part: (P, 4, 4) poses in the vehicle frame.
            body_indices: (P,) indices of the bodies in the scene.
        """
        outlines_m = np.array([geometry.outline_points_m for geometry in geometries]).reshape(-1, 9, 3)
        outlines_m = outlines_m @ vehicle_T_part[:, :3, :3].swapaxes(1, 2) + vehicle_T_part[:, None, :3, 3]
        return cls(
            casters=[geometry.caster for geometry in geometries],
            vehicle_T_part=vehicle_T_part,
            body_indices=body_indices,
            box_corners_m=outlines_m[:, :8],
            center_m=outlines_m[:, 8],
            radius_m=np.array([geometry.radius_m for geometry in geometries]),
        )

    def __len__(self) -> int:
        return len(self.casters)

    @cached_property
    def part_T_vehicle(self) -> Float64:
        """(P, 4, 4) transforms from the vehicle frame to the frames of the bodies."""
        return invert(self.vehicle_T_part)

    @cached_property
    def unique_casters(self) -> tuple[Sequence[RayCaster], Int64]:
        """Distinct casters, and (P,) index of the caster of each body."""
        casters = list(dict.fromkeys(self.casters))
        caster_index = {caster: index for index, caster in enumerate(casters)}
        return casters, np.array([caster_index[caster] for caster in self.casters], dtype=np.int64)

    def find_touched_bodies(self, position_m: Float64, part_positions_m: Float64) -> Bools:
        """Find the bodies on whose faces a position lies.

        Args:
            position_m: (3,) position in the vehicle frame.
            part_positions_m: (P, 3) the same position in the frame of each body.

        Returns:
            (P,) True for these bodies.
        """
        is_touched: Bools = np.linalg.norm(self.center_m - position_m, axis=1) <= self.radius_m + SLACK_M
        for part in np.flatnonzero(is_touched).tolist():
            is_touched[part] = len(self.casters[part].find_touched_bodies(part_positions_m[part])) > 0
        return is_touched

    def transform_to_parts_m(self, position_m: Float64) -> Float64:
        """Transform a (3,) position from the vehicle frame to the frame of each body; (P, 3)."""
        rotation, translation = self.part_T_vehicle[:, :3, :3], self.part_T_vehicle[:, :3, 3:]
        inverse_rotation = rotation.swapaxes(1, 2)
        offset_m = position_m + (inverse_rotation @ translation)[..., 0]
        return np.asarray((offset_m[:, None] @ inverse_rotation)[:, 0])

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
        """Find the pairs of a ray of a tile and a body that may meet.

        Args:
            vehicle_R_sensor: (3, 3) orientation of the sensor.
            tile: Rays in the sensor frame.
            directions: (3, n) float32 directions of the tile in the vehicle frame.
            limit_m: (n,) largest range of each ray.
            outlines: Boxes of the bodies as seen from the sensor.
            excluded_body: Scene index of a body at which no ray is cast.

        Returns:
            (K,) bodies in this object and (K,) rays of the tile.
        """
        max_range_m = float(limit_m.max(initial=0.0))
        parts = find_boxes_in_cone(outlines, vehicle_R_sensor @ tile.axis, tile.half_angle_rad, max_range_m)
        # The ego vehicle is excluded if its hits are already known.
        if excluded_body is not None:
            parts = parts[self.body_indices[parts] != excluded_body]
        if len(parts) == 0:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        may_hit = find_blocks_towards_boxes(outlines.select(parts), tile, vehicle_R_sensor, limit_m)
        row, block = np.nonzero(may_hit)
        return find_rays_towards_boxes(outlines, parts[row], tile.block_rays[block], directions, limit_m)

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
        """Cast the rays of a tile at each body separately.

        Args:
            origin_m: (3,) origin of the rays in the vehicle frame.
            vehicle_R_sensor: See `find_candidate_pairs`, as for the arguments that follow.
            tile: Rays in the sensor frame.
            directions: (3, n) float32 directions in the vehicle frame.
            limit_m: (n,) largest range of each ray.
            outlines: Boxes of the bodies as seen from the sensor.
            excluded_body: Scene index of a body at which no ray is cast.

        Returns:
            All hits, and the number of pairs of a ray and a body that were cast.
        """
        parts, rays = self.find_candidate_pairs(
            vehicle_R_sensor, tile, directions, limit_m, outlines, excluded_body=excluded_body
        )
        if len(rays) == 0:
            return BodyHits(parts, rays, np.empty(0, dtype=np.float32), np.empty(0, dtype=np.int32)), 0
        origins_m = self.transform_to_parts_m(origin_m)
        part_directions = self._rotate_to_parts(parts, directions.take(rays, axis=1))
        starts_m = origins_m.astype(np.float32)[parts]
        hits = self.cast_pairs(parts, starts_m, part_directions, limit_m[rays], (origin_m, origins_m))
        is_hit = hits.body_indices >= 0
        return BodyHits(parts[is_hit], rays[is_hit], hits.range_m[is_hit], hits.triangle_indices[is_hit]), len(is_hit)

    def _rotate_to_parts(self, part_indices: Int64, directions: Float32) -> Float32:
        """Rotate (3, K) directions from the vehicle frame to the frames of (K,) bodies."""
        return rotate_each(self.part_T_vehicle[:, :3, :3].astype(np.float32)[part_indices], directions)

    def compute_hit_attributes(
        self, part_indices: Int64, triangle_indices: Int32, directions: Float32
    ) -> HitAttributes:
        """Compute incidence angles and materials of hits on the bodies.

        Args:
            part_indices: (N,) bodies in this object.
            triangle_indices: (N,) faces in their meshes.
            directions: (3, N) float32 unit directions of the rays in the vehicle frame.
        """
        part_directions = self._rotate_to_parts(part_indices, directions)
        casters, caster_indices = self.unique_casters
        cos_incidence = np.empty(len(part_indices), dtype=np.float32)
        material_indices = np.empty(len(part_indices), dtype=np.uint8)
        for caster_index in np.unique(caster_indices[part_indices]).tolist():
            rows = np.flatnonzero(caster_indices[part_indices] == caster_index)
            bodies = np.zeros(len(rows), dtype=np.int32)
            attributes = casters[caster_index].compute_hit_attributes(
                bodies, triangle_indices[rows], part_directions[:, rows]
            )
            cos_incidence[rows] = attributes.cos_incidence
            material_indices[rows] = attributes.material_indices
        body_indices = self.body_indices[part_indices].astype(np.int32)
        return HitAttributes(body_indices, triangle_indices, cos_incidence, material_indices)

    def cast_pairs(
        self,
        part_indices: Int64,
        starts_m: Float32,
        directions: Float32,
        limit_m: Float32,
        common_origin_m: tuple[Float64, Float64] | None = None,
    ) -> Hits:
        """Cast K pairs of a ray and a body, each as if the body were alone.

        Args:
            part_indices: (K,) bodies in this object.
            starts_m: (K, 3) float32 origins in the frames of the bodies.
            directions: (3, K) float32 unit directions in the frames of the bodies.
            limit_m: (K,) largest range of each ray.
            common_origin_m: Common origin of all rays, which may lie on a face: (3,) in the vehicle frame and (P, 3) in
                the frame of each body. None if the rays have different origins.
        """
        casters, caster_indices = self.unique_casters
        is_touched = np.zeros(len(self), dtype=bool)
        if common_origin_m is not None:
            is_touched = self.find_touched_bodies(*common_origin_m)
        # Bodies with the same caster are cast together, except bodies on whose faces the origin lies.
        groups = np.where(is_touched, len(casters) + np.arange(len(self)), caster_indices)[part_indices]
        order = np.argsort(groups, kind="stable")
        part_indices, groups = part_indices[order], groups[order]
        starts_m, directions, limit_m = starts_m[order], directions[:, order], limit_m[order]
        group_starts, group_hits = np.flatnonzero(np.diff(groups, prepend=-1)).tolist(), []
        for start, end in pairwise([*group_starts, len(groups)]):
            rows, part = slice(start, end), part_indices[start]
            if common_origin_m is not None and is_touched[part]:
                origin_m = common_origin_m[1][part]
                group_hits.append(self.casters[part].cast(origin_m, directions[:, rows], limit_m[rows]))
            else:
                caster = casters[groups[start]]
                group_hits.append(caster.cast_from_each(starts_m[rows], directions[:, rows], limit_m[rows]))
        original_order = np.empty_like(order)
        original_order[order] = np.arange(len(order))
        return Hits._make(np.concatenate(column)[original_order] for column in zip(*group_hits, strict=True))

    def update_nearest_hits(self, hits: Hits, body_hits: BodyHits) -> None:
        """Replace hits of a tile by nearer hits on the bodies, in place.

        Args:
            hits: Hits of all rays of the tile on static bodies.
            body_hits: Hits on the moving bodies, none farther than the hit of its ray.
        """
        # The nearest counts; of two that coincide, the last in the order of the bodies.
        parts, rays, range_m, triangles = body_hits
        nearest_m = np.full(len(hits.range_m), np.inf, dtype=np.float32)
        np.minimum.at(nearest_m, rays, range_m)
        is_nearest = range_m == nearest_m[rays]
        hits.range_m[rays[is_nearest]] = range_m[is_nearest]
        hits.body_indices[rays[is_nearest]] = self.body_indices[parts[is_nearest]]
        hits.triangle_indices[rays[is_nearest]] = triangles[is_nearest]
