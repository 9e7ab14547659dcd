"""A target: a body that is put beside the vehicle, and the points of its surface."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.bodies import build_actor_mesh, create_body_shape
from torchcover.simulation.instant import ALL_AROUND_RAYS, SceneSnapshot
from torchcover.simulation.moving import BodyGeometry
from torchcover.simulation.patches import find_outward_faces
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sight import SHORTER, compute_visibility
from torchcover.simulation.surface_reference import ABOVE_M
from torchcover.simulation.surface_strata import PLANE_STEPS

# What people say -> the built-in body that is meant, whose name has its size.
TARGETS = {"child": "child_110cm", "adult": "adult", "dog": "dog_57cm", "cyclist": "cyclist", "pole": "pole_100cm"}


@dataclass(frozen=True, eq=False)
class Target:
    """A body that is asked about. It keeps the height above the ground at which its file places it.

    Args:
        name: What tables call it: the name of the body, with its size where it is built in for this.
        mesh: Its form; origin on the ground under the center of its bounding box, x ahead, z up.

    Example:
        >>> child = Target.load("child")
        >>> child.name, round(child.solid.bounding_box.size_m[2], 2)
        ('child_110cm', 1.1)
    """

    name: str
    mesh: Mesh

    @cached_property
    def solid(self) -> BodyGeometry:
        """Its geometry, to cast rays at."""
        return BodyGeometry(self.mesh)

    def __getstate__(self) -> dict[str, object]:
        return {"name": self.name, "mesh": self.mesh}  # Embree's scenes cannot be pickled

    @property
    def bottom_m(self) -> float:
        """Height of its lowest point above the ground, in meters."""
        return self.solid.bounding_box.lower_m[2]

    @classmethod
    def load(cls, name_or_path: str | Path) -> Self:
        """One of `TARGETS`, a built-in vehicle by its name, the YAML file of one, or a mesh file in meters.

        The ground is z = 0 of the file: what lies above stays there, and what reaches below is put on the ground.

        Raises:
            FileNotFoundError: No such file or name.
            ValueError: The file is neither a vehicle nor a mesh, or is flat.
        """
        name = TARGETS.get(str(name_or_path), str(name_or_path))
        mesh = build_actor_mesh(f"target {name!r}", create_body_shape(name), "target", keep_height=True)
        return cls(Path(name).stem if Path(name).suffix else name, mesh)


PackedBits = NDArray[np.uint8]

# A byte of bits has 8 of them.
SAMPLES = 64
# Drawn for each that is kept: what lies inside another part of the body is nobody's surface.
DRAWN_FOR_EACH = 16
# Rows of distances that are held at once: no more than a cache has room for.
HITS_AT_ONCE = 512


class TargetSurface(NamedTuple):
    """Points that stand for equal shares of a target's outer surface.

    `points_m` (M, 3) in the target's frame; `normals` (M, 3) of length one; `is_two_sided` (M,) whether both sides may be
    looked at, as of what is not closed; `sample_area_m2` the square metres that each stands for.
    """

    points_m: Float64
    normals: Float64
    is_two_sided: Bools
    sample_area_m2: float

    @classmethod
    def from_target(cls, target: Target) -> Self:
        """Spread the points: equal steps of area over all faces, less what lies within another part of the body."""
        corners_m = target.mesh.vertices_m[target.mesh.faces]
        across = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
        twice_m2 = np.linalg.norm(across, axis=1)
        drawn = SAMPLES * DRAWN_FOR_EACH
        up_to = np.cumsum(twice_m2)
        face = np.searchsorted(up_to, (np.arange(drawn) + 0.5) / drawn * up_to[-1], side="right")
        a, b = (np.arange(drawn) * np.array(PLANE_STEPS)[:, None] + 0.5) % 1
        a, b = np.where(a + b > 1, 1 - a, a)[:, None], np.where(a + b > 1, 1 - b, b)[:, None]
        points_m = (1 - a - b) * corners_m[face, 0] + a * corners_m[face, 1] + b * corners_m[face, 2]
        normals, two_sided = across[face] / twice_m2[face][:, None], ~find_outward_faces(target.mesh)[face]
        outer = np.flatnonzero(two_sided | ~_enclosed(target, points_m + ABOVE_M * normals))
        kept = outer[(np.arange(SAMPLES) + 0.5).astype(np.int64) * len(outer) // SAMPLES]
        m2_each = float(up_to[-1]) / 2 * len(outer) / drawn / SAMPLES
        return cls(points_m[kept], normals[kept], two_sided[kept], m2_each)

    def find_visible_samples(
        self,
        viewpoint_m: Float64,
        target: Target,
        vehicle_T_target: Float64,
        instant: SceneSnapshot,
        *,
        num_threads: int = 1,
    ) -> PackedBits:
        """(P, M / 8) bits: which of the points a (3,) place sees, the target itself and everything else in the way.

        The target stands at (P, 4, 4) poses in the instant, which is without it. Threads do not change the result.
        """
        target_R_vehicle = vehicle_T_target[:, :3, :3].swapaxes(1, 2)
        there_m = (target_R_vehicle @ (viewpoint_m - vehicle_T_target[:, :3, 3])[..., None])[..., 0]
        above = np.einsum("pmi,mi->pm", there_m[:, None] - self.points_m, self.normals)
        position, sample = np.nonzero((above > 0) | self.is_two_sided)
        side = np.where(self.is_two_sided[sample], np.sign(above[position, sample]), 1.0)
        ends_m = self.points_m[sample] + ABOVE_M * side[:, None] * self.normals[sample]
        ways_m = ends_m - there_m[position]
        length_m = np.linalg.norm(ways_m, axis=1)
        hits = target.solid.caster.cast_from_each(
            there_m[position].astype(np.float32),
            (ways_m / length_m[:, None]).T.astype(np.float32),
            (length_m * (1 - SHORTER)).astype(np.float32),
        )
        open_ways = np.flatnonzero(hits.body_indices < 0)
        position, sample = position[open_ways], sample[open_ways]
        in_vehicle_m = np.einsum("nij,nj->ni", vehicle_T_target[position, :3, :3], ends_m[open_ways])
        in_vehicle_m += vehicle_T_target[position, :3, 3]
        seen = np.zeros((len(vehicle_T_target), SAMPLES), dtype=bool)
        seen[position, sample] = compute_visibility(
            instant, viewpoint_m, in_vehicle_m.astype(np.float32), num_threads=num_threads
        ).is_visible
        return np.packbits(seen, axis=1)

    def find_nearby_samples(self, hit_points_m: Float64, max_distance_m: float) -> PackedBits:
        """(N, M / 8) bits: which of the points are within a distance of each of (N, 3) points in the target's frame."""
        near = np.empty((len(hit_points_m), SAMPLES // 8), dtype=np.uint8)
        own = (self.points_m**2).sum(axis=1)
        for first in range(0, len(hit_points_m), HITS_AT_ONCE):
            some = hit_points_m[first : first + HITS_AT_ONCE]
            # In float64 nothing is lost where it could matter: both are within metres of the target's origin.
            squared = (some**2).sum(axis=1)[:, None] + own - 2 * some @ self.points_m.T
            near[first : first + HITS_AT_ONCE] = np.packbits(squared <= max_distance_m**2, axis=1)
        return near


def _enclosed(target: Target, points_m: Float64) -> Bools:
    """(N,) whether no ray gets out from a place."""
    left = np.arange(len(points_m))
    for towards in ALL_AROUND_RAYS.T:  # most get out at once
        directions, far_m = np.tile(towards[:, None], len(left)), np.full(len(left), np.inf, dtype=np.float32)
        hits = target.solid.caster.cast_from_each(points_m[left].astype(np.float32), directions, far_m)
        left = left[hits.body_indices >= 0]
    return np.asarray(np.isin(np.arange(len(points_m)), left))
