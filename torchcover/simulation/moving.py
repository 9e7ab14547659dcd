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
from torchcover.simulation.raycaster import Hits, RayCaster, Struck
from torchcover.simulation.rays import (
    SLACK_M,
    SLACK_SHARE,
    Outlines,
    Tile,
    blocks_towards,
    boxes_in_cone,
    rays_towards,
    rotate_each,
)
from torchcover.simulation.shapes import Mesh


class Solid:
    """The geometry of one kind of body in its own frame.

    `outline_m` (9, 3) has the corners of its box, grown a little, and the centre; no vertex is farther from that than
    `radius_m`, nor from the origin of the frame than `reach_m`.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.box = BoundingBox.from_points(mesh.vertices_m)
        centre_m = (np.array(self.box.lower_m) + np.array(self.box.upper_m)) / 2
        self.radius_m = float(np.linalg.norm(mesh.vertices_m - centre_m, axis=1).max())
        # Of the corners as they are cast: in float32.
        slack_m = SLACK_M + SLACK_SHARE * float(np.abs(self.box.corners_m).max())
        grown_m = self.box.corners_m + slack_m * np.sign(self.box.corners_m - centre_m)
        self.outline_m: Float64 = np.vstack([grown_m, centre_m])
        self.reach_m = float(np.linalg.norm(centre_m)) + self.radius_m

    @cached_property
    def caster(self) -> RayCaster:
        """It alone, to cast rays at."""
        return RayCaster([self.mesh])

    @cached_property
    def patches(self) -> Patches:
        """All of its surface, cut small."""
        return Patches.cut(self.mesh)


class Solids:
    """The solids of meshes, each made when first asked for and kept: one for each mesh object, whoever shares it."""

    def __init__(self) -> None:
        self._of: dict[int, tuple[Mesh, Solid]] = {}

    def of(self, mesh: Mesh) -> Solid:
        """That of a mesh."""
        if id(mesh) not in self._of:
            self._of[id(mesh)] = mesh, Solid(mesh)  # with the mesh, so that no other one gets its id
        return self._of[id(mesh)][1]


class Meetings(NamedTuple):
    """L times that a ray meets a body: (L,) number of the body in `Moving`, of the ray in its tile, and where.

    `triangle` (L,) says on which face of the body.
    """

    part: Int64
    ray: Int64
    range_m: Float32
    triangle: Int32


@dataclass(frozen=True, eq=False)
class Moving:
    """P bodies that move, placed at one instant: casters in their own frames, which one kind shares, and numbers.

    In the vehicle frame, `corners_m` (P, 8, 3) are of boxes around them; of balls around them `centre_m` is (P, 3),
    `radius_m` (P,).
    """

    casters: Sequence[RayCaster]
    vehicle_T_part: Float64
    body: Int64
    corners_m: Float64
    centre_m: Float64
    radius_m: Float64

    @classmethod
    def placed(cls, solids: Sequence[Solid], vehicle_T_part: Float64, body: Int64) -> Self:
        """Bodies of these kinds, (P,), where they are, (P, 4, 4), with their numbers, (P,)."""
        outlines_m = np.array([solid.outline_m for solid in solids]).reshape(-1, 9, 3)
        outlines_m = outlines_m @ vehicle_T_part[:, :3, :3].swapaxes(1, 2) + vehicle_T_part[:, None, :3, 3]
        return cls(
            casters=[solid.caster for solid in solids],
            vehicle_T_part=vehicle_T_part,
            body=body,
            corners_m=outlines_m[:, :8],
            centre_m=outlines_m[:, 8],
            radius_m=np.array([solid.radius_m for solid in solids]),
        )

    def __len__(self) -> int:
        return len(self.casters)

    @cached_property
    def part_T_vehicle(self) -> Float64:
        """(P, 4, 4) from the vehicle frame to theirs."""
        return invert(self.vehicle_T_part)

    @cached_property
    def kinds(self) -> tuple[Sequence[RayCaster], Int64]:
        """The different casters, and (P,) which of them each body has."""
        different = list(dict.fromkeys(self.casters))
        number = {caster: k for k, caster in enumerate(different)}
        return different, np.array([number[caster] for caster in self.casters], dtype=np.int64)

    def touched_by(self, place_m: Float64, places_m: Float64) -> Bools:
        """(P,) whether a (3,) place of the vehicle frame, `places_m` (P, 3) from there, lies on a face of each body."""
        touched: Bools = np.linalg.norm(self.centre_m - place_m, axis=1) <= self.radius_m + SLACK_M
        for k in np.flatnonzero(touched).tolist():
            touched[k] = len(self.casters[k].touched(places_m[k])) > 0
        return touched

    def from_there_m(self, place_m: Float64) -> Float64:
        """(P, 3) a (3,) place of the vehicle frame in the frame of each body, as `transform` has it."""
        rotation, translation = self.part_T_vehicle[:, :3, :3], self.part_T_vehicle[:, :3, 3:]
        back = rotation.swapaxes(1, 2)
        return np.asarray(((place_m + (back @ translation)[..., 0])[:, None] @ back)[:, 0])

    def pairs(
        self,
        vehicle_R_sensor: Float64,
        tile: Tile,
        directions: Float32,
        limit_m: Float32,
        bodies: Outlines,
        *,
        leaving_out: int | None = None,
    ) -> tuple[Int64, Int64]:
        """Which rays of a tile may meet which body before their (n,) limits: (K,) bodies and (K,) rays.

        `directions` (3, n) are those of the tile in the vehicle frame, `bodies` what they look like from there, from
        `outlines`; `leaving_out` is the number of a body that they are not cast at.
        """
        near = boxes_in_cone(bodies, vehicle_R_sensor @ tile.axis, tile.half_angle, float(limit_m.max(initial=0.0)))
        if leaving_out is not None:
            near = near[self.body[near] != leaving_out]
        if len(near) == 0:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        of_near, block = np.nonzero(blocks_towards(bodies.kept(near), tile, vehicle_R_sensor, limit_m))
        return rays_towards(bodies, near[of_near], tile.blocks[block], directions, limit_m)

    def meetings(
        self,
        origin_m: Float64,
        vehicle_R_sensor: Float64,
        tile: Tile,
        directions: Float32,
        limit_m: Float32,
        bodies: Outlines,
        *,
        leaving_out: int | None = None,
    ) -> tuple[Meetings, int]:
        """Where the rays of one tile meet each body, as if it were alone, and of how many pairs; as `pairs`."""
        part, ray = self.pairs(vehicle_R_sensor, tile, directions, limit_m, bodies, leaving_out=leaving_out)
        if len(ray) == 0:
            return Meetings(part, ray, np.empty(0, dtype=np.float32), np.empty(0, dtype=np.int32)), 0
        places_m = self.from_there_m(origin_m)
        towards = rotate_each(self.part_T_vehicle[:, :3, :3].astype(np.float32)[part], directions.take(ray, axis=1))
        hits = self.cast_pairs(part, places_m.astype(np.float32)[part], towards, limit_m[ray], (origin_m, places_m))
        met = hits.body >= 0
        return Meetings(part[met], ray[met], hits.range_m[met], hits.triangle[met]), len(met)

    def struck(self, part: Int64, triangle: Int32, directions: Float32) -> Struck:
        """What the rays hit that met some of the bodies, as `RayCaster.struck`."""
        towards = rotate_each(self.part_T_vehicle[:, :3, :3].astype(np.float32)[part], directions)
        casters, kind = self.kinds
        cosine, material = np.empty(len(part), dtype=np.float32), np.empty(len(part), dtype=np.uint8)
        for number in np.unique(kind[part]).tolist():
            some = np.flatnonzero(kind[part] == number)
            alone = casters[number].struck(np.zeros(len(some), dtype=np.int32), triangle[some], towards[:, some])
            cosine[some], material[some] = alone.cos_incidence, alone.material
        return Struck(self.body[part].astype(np.int32), triangle, cosine, material)

    def cast_pairs(
        self,
        part: Int64,
        starts_m: Float32,
        towards: Float32,
        limit_m: Float32,
        common: tuple[Float64, Float64] | None = None,
    ) -> Hits:
        """Cast K pairs of a ray and a body, each as if it were alone.

        Starts (K, 3) and directions (3, K) are in the frames of the (K,) bodies, `limit_m` (K,) is where rays end. If
        they start at one place, which may lie on a face, `common` is that, (3,), and the same in the frame of each
        body, (P, 3).
        """
        casters, kind = self.kinds
        touched = np.zeros(len(self), dtype=bool) if common is None else self.touched_by(*common)
        # Bodies of one kind are cast at together. A ray that starts on a face is cast as one that leaves it.
        group = np.where(touched, len(casters) + np.arange(len(self)), kind)[part]
        order = np.argsort(group, kind="stable")
        part, group = part[order], group[order]
        starts_m, towards, limit_m = starts_m[order], towards[:, order], limit_m[order]
        first, answers = np.flatnonzero(np.diff(group, prepend=-1)).tolist(), []
        for start, end in pairwise([*first, len(group)]):
            some, body = slice(start, end), part[start]
            if common is not None and touched[body]:
                answers.append(self.casters[body].cast(common[1][body], towards[:, some], limit_m[some]))
            else:
                caster = casters[group[start]]
                answers.append(caster.cast_from_each(starts_m[some], towards[:, some], limit_m[some]))
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        return Hits._make(np.concatenate(column)[back] for column in zip(*answers, strict=True))

    def nearer(self, hits: Hits, met: Meetings) -> None:
        """Bring the hits of all rays of a tile up to date with what they meet of the bodies."""
        # The nearest counts; of two that coincide, the last in the order of the bodies.
        part, ray, range_m, triangle = met
        nearest_m = np.full(len(hits.range_m), np.inf, dtype=np.float32)
        np.minimum.at(nearest_m, ray, range_m)
        first = range_m == nearest_m[ray]
        hits.range_m[ray[first]] = range_m[first]
        hits.body[ray[first]], hits.triangle[ray[first]] = self.body[part[first]], triangle[first]
