"""Test targets and the sample points of their surface."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.bodies import build_actor_mesh, create_body_shape
from torchcover.simulation.mounted_sensor import RANGE_ROUNDING, compute_visibility
from torchcover.simulation.moving_bodies import BodyGeometry
from torchcover.simulation.patches import find_outward_faces
from torchcover.simulation.scene_snapshot import ALL_AROUND_RAYS, SceneSnapshot
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.surface_reference import ABOVE_M
from torchcover.simulation.surface_strata import PLANE_STEPS

PackedBits = NDArray[np.uint8]

# Short names of test targets and the built-in bodies that they stand for; the names of the bodies include their size.
TARGETS = {"child": "child_110cm", "adult": "adult", "dog": "dog_57cm", "cyclist": "cyclist", "pole": "pole_100cm"}
# Sample points on the surface of a target, a multiple of 8 because their visibility is stored as packed bits.
NUM_SAMPLES = 64


@dataclass(frozen=True, eq=False)
class Target:
    """Body whose visibility is tested. It keeps the height above the ground at which its file places it.

    Args:
        name: Name in tables: the name of the body, which includes the size for the built-in test targets.
        mesh: Shape; the origin is on the ground below the center of the bounding box, x points ahead, z up.

    Example:
        >>> child = Target.load("child")
        >>> child.name, round(child.solid.bounding_box.size_m[2], 2)
        ('child_110cm', 1.1)
    """

    name: str
    mesh: Mesh

    @cached_property
    def solid(self) -> BodyGeometry:
        """Geometry for ray casting."""
        return BodyGeometry(self.mesh)

    def __getstate__(self) -> dict[str, object]:
        return {"name": self.name, "mesh": self.mesh}  # Embree's scenes cannot be pickled

    @property
    def bottom_m(self) -> float:
        """Height of the lowest point above the ground, in meters."""
        return self.solid.bounding_box.lower_m[2]

    @classmethod
    def load(cls, name_or_path: str | Path) -> Self:
        """Load a test target.

        Args:
            name_or_path: One of `TARGETS`, the name of a built-in vehicle, the YAML file of a vehicle, or a mesh file
                in meters. The ground is z = 0 of the file. A mesh above it keeps its height; a mesh that reaches
                below it is lifted onto it.

        Returns:
            The target.

        Raises:
            FileNotFoundError: No such file or name.
            ValueError: The file is neither a vehicle nor a mesh, or the mesh is flat.
        """
        name = TARGETS.get(str(name_or_path), str(name_or_path))
        mesh = build_actor_mesh(f"target {name!r}", create_body_shape(name), "target", keep_height=True)
        return cls(Path(name).stem if Path(name).suffix else name, mesh)


class TargetSurface(NamedTuple):
    """Sample points that represent equal shares of the outer surface of a target.

    Args:
        points_m: (M, 3) points in the target frame.
        normals: (M, 3) unit normals.
        is_two_sided: (M,) True for faces of an open mesh, of which both sides can be observed.
        sample_area_m2: Area that each point represents.
    """

    points_m: Float64
    normals: Float64
    is_two_sided: Bools
    sample_area_m2: float

    @classmethod
    def from_target(cls, target: Target) -> Self:
        """Spread `NUM_SAMPLES` points evenly over the outer surface of a target.

        Args:
            target: The target; surface inside another part of its body is excluded.

        Returns:
            The sample points.
        """
        corners_m = target.mesh.vertices_m[target.mesh.faces]
        scaled_normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
        doubled_areas_m2 = np.linalg.norm(scaled_normals, axis=1)
        cumulated_m2 = np.cumsum(doubled_areas_m2)
        # Enough candidates remain after those inside another part of the body are excluded.
        num_candidates = 16 * NUM_SAMPLES
        face = np.searchsorted(
            cumulated_m2, (np.arange(num_candidates) + 0.5) / num_candidates * cumulated_m2[-1], side="right"
        )
        a, b = (np.arange(num_candidates) * np.array(PLANE_STEPS)[:, None] + 0.5) % 1
        # Points of the unit square beyond its diagonal are mirrored into the triangle.
        a, b = np.where(a + b > 1, 1 - a, a)[:, None], np.where(a + b > 1, 1 - b, b)[:, None]
        points_m = (1 - a - b) * corners_m[face, 0] + a * corners_m[face, 1] + b * corners_m[face, 2]
        normals = scaled_normals[face] / doubled_areas_m2[face][:, None]
        is_two_sided = ~find_outward_faces(target.mesh)[face]
        is_enclosed = find_enclosed_points(target, points_m + ABOVE_M * normals)
        outer = np.flatnonzero(is_two_sided | ~is_enclosed)
        selection = outer[(np.arange(NUM_SAMPLES) + 0.5).astype(np.int64) * len(outer) // NUM_SAMPLES]
        area_m2 = float(cumulated_m2[-1]) / 2 * len(outer) / num_candidates / NUM_SAMPLES
        return cls(points_m[selection], normals[selection], is_two_sided[selection], area_m2)

    def find_visible_samples(
        self,
        viewpoint_m: Float64,
        target: Target,
        vehicle_T_target: Float64,
        snapshot: SceneSnapshot,
        *,
        num_threads: int = 1,
    ) -> PackedBits:
        """Find the sample points that are visible from a viewpoint, with occlusion by the target and by the scene.

        Args:
            viewpoint_m: (3,) viewpoint in the vehicle frame.
            target: The target.
            vehicle_T_target: (P, 4, 4) poses of the target; each is tested alone.
            snapshot: Scene without the target.
            num_threads: Threads that may cast rays; the result does not depend on it.

        Returns:
            (P, M / 8) packed bits, 1 for a visible sample point.
        """
        target_R_vehicle = vehicle_T_target[:, :3, :3].swapaxes(1, 2)
        viewpoints_m = (target_R_vehicle @ (viewpoint_m - vehicle_T_target[:, :3, 3])[..., None])[..., 0]
        height_m = np.einsum("pmi,mi->pm", viewpoints_m[:, None] - self.points_m, self.normals)
        position, sample = np.nonzero((height_m > 0) | self.is_two_sided)
        side = np.where(self.is_two_sided[sample], np.sign(height_m[position, sample]), 1.0)
        ends_m = self.points_m[sample] + ABOVE_M * side[:, None] * self.normals[sample]
        rays_m = ends_m - viewpoints_m[position]
        length_m = np.linalg.norm(rays_m, axis=1)
        hits = target.solid.caster.cast_from_each(
            viewpoints_m[position].astype(np.float32),
            (rays_m / length_m[:, None]).T.astype(np.float32),
            (length_m * (1 - RANGE_ROUNDING)).astype(np.float32),
        )
        unoccluded = np.flatnonzero(hits.body_indices < 0)
        position, sample = position[unoccluded], sample[unoccluded]
        points_in_vehicle_m = np.einsum("nij,nj->ni", vehicle_T_target[position, :3, :3], ends_m[unoccluded])
        points_in_vehicle_m += vehicle_T_target[position, :3, 3]
        is_visible = np.zeros((len(vehicle_T_target), NUM_SAMPLES), dtype=bool)
        is_visible[position, sample] = compute_visibility(
            snapshot, viewpoint_m, points_in_vehicle_m.astype(np.float32), num_threads=num_threads
        ).is_visible
        return np.packbits(is_visible, axis=1)

    def find_nearby_samples(self, hit_points_m: Float64, max_distance_m: float) -> PackedBits:
        """Find the sample points within a distance of hit points.

        Args:
            hit_points_m: (N, 3) points in the target frame.
            max_distance_m: Largest distance.

        Returns:
            (N, M / 8) packed bits, 1 for a sample point within the distance of the hit point.
        """
        chunk_size = 512  # distances of one chunk fit into the cache of a processor
        is_near = np.empty((len(hit_points_m), NUM_SAMPLES // 8), dtype=np.uint8)
        squared_norms = (self.points_m**2).sum(axis=1)
        for first in range(0, len(hit_points_m), chunk_size):
            chunk_m = hit_points_m[first : first + chunk_size]
            # The expanded square loses no relevant digits: all points are within meters of the origin of the target.
            squared_m2 = (chunk_m**2).sum(axis=1)[:, None] + squared_norms - 2 * chunk_m @ self.points_m.T
            is_near[first : first + chunk_size] = np.packbits(squared_m2 <= max_distance_m**2, axis=1)
        return is_near


def find_enclosed_points(target: Target, points_m: Float64) -> Bools:
    """Find the points from which no ray leaves the body of a target.

    Args:
        target: The target.
        points_m: (N, 3) points in the target frame.

    Returns:
        (N,) True for enclosed points.
    """
    enclosed = np.arange(len(points_m))
    for direction in ALL_AROUND_RAYS.T:  # the first directions already exclude most points
        directions = np.tile(direction[:, None], len(enclosed))
        limits_m = np.full(len(enclosed), np.inf, dtype=np.float32)
        hits = target.solid.caster.cast_from_each(points_m[enclosed].astype(np.float32), directions, limits_m)
        enclosed = enclosed[hits.body_indices >= 0]
    return np.asarray(np.isin(np.arange(len(points_m)), enclosed))
