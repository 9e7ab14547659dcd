"""Surface of a scene, cut into patches once and indexed, so that each frame selects the patches near the vehicle."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry import invert, transform_points
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.local_ground import SLACK_M as HEIGHT_SLACK_M
from torchcover.simulation.local_ground import TOLERANCE_M, GroundHeightPyramid, round_height_bounds_m
from torchcover.simulation.patches import HeightFunction, Patches, UprightBoxes
from torchcover.simulation.rays import rotate_each
from torchcover.simulation.scene_snapshot import SceneSnapshot
from torchcover.simulation.shapes import Mesh

# Boxes are extended by this margin because coordinates are float32.
MARGIN_M = 0.01


class PatchGroups(NamedTuple):
    """G groups of consecutive patches.

    Args:
        first_patches: (G + 1,) index of the first patch of each group, and number of all patches.
        bounds: Bounding boxes of the G groups.
    """

    first_patches: Int64
    bounds: UprightBoxes

    def list_members(self, group_indices: Int64) -> Int64:
        """List the patches of selected groups, group by group.

        Args:
            group_indices: (K,) selected groups.
        """
        first, count = self.first_patches[group_indices], np.diff(self.first_patches)[group_indices]
        return np.repeat(first - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())


class HeightFilter(NamedTuple):
    """Selection of surfaces by their height above the local ground.

    Args:
        height_pyramid: Bounds of ground heights.
        pyramid_T_static: (4, 4) transform from the static frame to that of the pyramid.
        ground_masks: For each static mesh (F,) True for faces that are ground.
        downward_masks: For each static mesh (F,) True for faces that face down and are visible only from below.
        min_height_m: Smallest height that is needed.
        max_height_m: Largest height that is needed.
        is_without_ground: Select surfaces without ground at or below them instead, such as in a pit; their heights
            are 0.
    """

    height_pyramid: GroundHeightPyramid
    pyramid_T_static: Float64
    ground_masks: Sequence[Bools]
    downward_masks: Sequence[Bools]
    min_height_m: float
    max_height_m: float
    is_without_ground: bool = False

    def build_mesh_filter(self, mesh_index: int) -> HeightFunction:
        """Build the height function of a static mesh.

        Heights of ground faces are about 0 (other ground may be a few centimeters above). Surfaces below the ground are
        occluded by it, and so are faces that lie on the ground and face down.

        Args:
            mesh_index: Index of the mesh.
        """
        is_ground, is_down = self.ground_masks[mesh_index], self.downward_masks[mesh_index]
        ground_bounds_m = np.array([[-TOLERANCE_M - HEIGHT_SLACK_M], [HEIGHT_SLACK_M]], dtype=np.float32)
        # Bounds are wider than the surface; faces on the ground have upper bounds up to this height.
        on_ground_m = 3 * HEIGHT_SLACK_M

        def compute_heights(triangles_m: Float64, face: Int64) -> tuple[Float32, Bools]:
            heights_m = ground_bounds_m.repeat(len(face), axis=1)
            raised = np.flatnonzero(~is_ground[face])
            is_needed = np.full(len(face), self.min_height_m <= ground_bounds_m[1, 0])
            if len(raised):
                raised_triangles_m = triangles_m if len(raised) == len(face) else triangles_m.take(raised, axis=2)
                corners_m = self.pyramid_T_static[:3, :3] @ raised_triangles_m + self.pyramid_T_static[:3, 3:]
                heights_m[:, raised] = raised_heights_m = self.height_pyramid.compute_height_bounds_m(corners_m)
                if self.is_without_ground:
                    is_needed = np.zeros(len(face), dtype=bool)
                    is_needed[raised] = raised_heights_m[1] < -TOLERANCE_M
                    return np.zeros_like(heights_m), is_needed
                min_height_m = np.maximum(self.min_height_m, np.where(is_down[face[raised]], on_ground_m, 0.0))
                is_needed[raised] = (raised_heights_m[1] > min_height_m) & (raised_heights_m[0] <= self.max_height_m)
            return heights_m, is_needed & (not self.is_without_ground)

        return compute_heights

    def add_height_bounds(
        self, patches: Patches, static_T_patches: Float64, corners_m: Float64, patch_counts: Int64
    ) -> Patches:
        """Add height bounds to patches of objects, relative to all ground below the box of the object.

        Args:
            patches: Patches of J objects, object by object.
            static_T_patches: (4, 4) transform from the frame of the patches to the static frame.
            corners_m: (J, 8, 3) corners of boxes around the objects, in the frame of the patches.
            patch_counts: (J,) number of patches of each object.
        """
        pyramid_T_patches = self.pyramid_T_static @ static_T_patches
        corners_m = transform_points(pyramid_T_patches, corners_m.reshape(-1, 3)).reshape(-1, 8, 3)
        lowest_m, highest_m = self.height_pyramid.compute_ground_bounds_m(
            corners_m.min(axis=1).T[:2], corners_m.max(axis=1).T[:2]
        )
        up = pyramid_T_patches[2]
        corner_z_m, first_z_m = up[:3] @ patches.corner_m, up[:3] @ patches.first_edge_m
        second_z_m = up[:3] @ patches.second_edge_m
        low_m = corner_z_m + np.minimum(np.minimum(first_z_m, second_z_m), 0.0) + up[3] - highest_m.repeat(patch_counts)
        high_m = corner_z_m + np.maximum(np.maximum(first_z_m, second_z_m), 0.0) + up[3] - lowest_m.repeat(patch_counts)
        return patches._replace(height_bounds_m=round_height_bounds_m(low_m, high_m))


class SceneSurface:
    """Surface of the static scene, ordered by position on the ground, and of all objects.

    Args:
        scenery: Static meshes that are no objects, in the static frame.
        objects: Patches of each object in its own frame.
        resting: Index of each static object -> `static_T_object`.
        moving: Body index in a `SceneSnapshot` of each moving object -> its object index.
        bounds: Boxes in the static frame outside of which no scenery is ever needed.
        outward_masks: For each static mesh (F,) result of `find_outward_faces`.
        height_filter: Selection by height above the ground; None for all surfaces.
        coincident_faces: For each static mesh (F,) indices of faces that coincide with others, else -1; empty if no
            faces coincide.
    """

    def __init__(
        self,
        scenery: Sequence[Mesh],
        objects: Sequence[Patches],
        resting: Mapping[int, Float64],
        moving: Mapping[int, int],
        bounds: UprightBoxes,
        outward_masks: Sequence[Bools],
        height_filter: HeightFilter | None = None,
        coincident_faces: Sequence[Int32] = (),
    ) -> None:
        self._height_filter = height_filter
        self._moving = {body: (objects[index], index) for body, index in moving.items()}
        poses = np.array(list(resting.values())).reshape(-1, 4, 4)
        resting_patches = place_patches([(objects[index], index) for index in resting], poses)
        if height_filter is not None:
            counts = np.array([len(objects[index].is_outward) for index in resting], dtype=np.int64)
            corners_m = _compute_box_corners_m(resting_patches, counts)
            resting_patches = height_filter.add_height_bounds(resting_patches, np.eye(4), corners_m, counts)
        parts = []
        for index, mesh in enumerate(scenery):
            compute_heights = height_filter.build_mesh_filter(index) if height_filter else None
            faces = coincident_faces[index] if coincident_faces else None
            parts.append(Patches.from_mesh(mesh, bounds, compute_heights, faces, outward_masks[index]))
        patches = Patches.concatenate([*parts, resting_patches])
        order, cell = _sort_by_position(patches)
        self._static = patches.select(order)
        self._cells = _build_groups(self._static, cell)
        object_patches = np.flatnonzero(self._static.object_indices >= 0)
        object_order = np.argsort(self._static.object_indices[object_patches], kind="stable")
        self._resting = object_patches[object_order]
        self._objects = _build_groups(self._static.select(self._resting), self._static.object_indices[self._resting])

    @property
    def num_bytes(self) -> int:
        """Memory of the static patches; patches of objects are shared with other surfaces."""
        return sum(column.nbytes for column in self._static)

    def select_patches(
        self, snapshot: SceneSnapshot, boxes: UprightBoxes, max_object_distance_m: float = -np.inf
    ) -> Patches:
        """Select the patches near some boxes in one frame.

        Args:
            snapshot: Scene at the time of the frame.
            boxes: Boxes in the vehicle frame.
            max_object_distance_m: All patches of objects that may be within this distance of the vehicle's origin are
                selected as well.

        Returns:
            Patches in the vehicle frame: all that overlap the boxes, and others close to them.
        """
        vehicle_T_static = invert(snapshot.static_T_vehicle)
        is_needed = np.zeros(len(self._static.is_outward), dtype=bool)
        overlaps = boxes.mask_overlaps(*_transform_bounds(vehicle_T_static, self._cells.bounds))
        is_needed[self._cells.list_members(np.flatnonzero(overlaps))] = True
        lower_m, upper_m = _transform_bounds(vehicle_T_static, self._objects.bounds)
        is_close = np.linalg.norm(np.clip(0.0, lower_m, upper_m), axis=1) <= max_object_distance_m
        is_needed[self._resting[self._objects.list_members(np.flatnonzero(is_close))]] = True
        static_patches = self._static.select(np.flatnonzero(is_needed)).transform(vehicle_T_static)
        return Patches.concatenate([static_patches, self._select_moving(snapshot, boxes, max_object_distance_m)])

    def _select_moving(self, snapshot: SceneSnapshot, boxes: UprightBoxes, max_object_distance_m: float) -> Patches:
        """Select the patches of moving objects whose bounding spheres overlap the boxes or are within the distance."""
        moving = snapshot.moving_bodies
        radii_m = moving.radius_m[:, None]
        is_needed = boxes.mask_overlaps(moving.center_m - radii_m, moving.center_m + radii_m)
        is_needed |= np.linalg.norm(moving.center_m, axis=1) - moving.radius_m <= max_object_distance_m
        is_needed &= np.isin(moving.body_indices, list(self._moving))
        parts = np.flatnonzero(is_needed & (moving.body_indices != snapshot.ego_index))
        objects = [self._moving[body] for body in moving.body_indices[parts].tolist()]
        patches = place_patches(objects, moving.vehicle_T_part[parts])
        if self._height_filter is None:
            return patches
        counts = np.array([len(patches.is_outward) for patches, _ in objects], dtype=np.int64)
        corners_m = moving.box_corners_m[parts]
        return self._height_filter.add_height_bounds(patches, snapshot.static_T_vehicle, corners_m, counts)


def place_patches(objects: Sequence[tuple[Patches, int]], destination_T_source: Float64) -> Patches:
    """Transform the patches of objects to a common frame, see `Patches.transform`.

    Args:
        objects: Patches of each of J objects in its own frame, and its object index.
        destination_T_source: (J, 4, 4) transform from the frame of each object.
    """
    parts = [patches for patches, _ in objects]
    counts = [len(patches.is_outward) for patches in parts]
    pose = destination_T_source.repeat(counts, axis=0)
    rotation, merged = pose[:, :3, :3].astype(np.float32), Patches.concatenate(parts)
    corner_m = rotate_each(pose[:, :3, :3], merged.corner_m.astype(np.float64)) + pose[:, :3, 3].T
    return Patches(
        corner_m=corner_m.astype(np.float32),
        first_edge_m=rotate_each(rotation, merged.first_edge_m),
        second_edge_m=rotate_each(rotation, merged.second_edge_m),
        is_outward=merged.is_outward,
        object_indices=np.array([index for _, index in objects], dtype=np.int32).repeat(counts),
        height_bounds_m=merged.height_bounds_m,
        coincident_faces=merged.coincident_faces,
    )


def compute_swept_bounds(static_T_vehicle: Float64, box: UprightBoxes, section_length_m: float = 100.0) -> UprightBoxes:
    """Compute boxes that contain all positions of a box that moves with a vehicle.

    Args:
        static_T_vehicle: (T, 4, 4) poses of the vehicle along its trajectory.
        box: One box in the vehicle frame.
        section_length_m: Length of the sections of the trajectory that get one box each.

    Returns:
        Boxes in the static frame.
    """
    rotation, half_size_m = static_T_vehicle[:, :3, :3], (box.upper_m - box.lower_m)[0] / 2
    center_m = rotation @ (box.lower_m + half_size_m)[0] + static_T_vehicle[:, :3, 3]
    lower_m, upper_m = center_m - np.abs(rotation) @ half_size_m, center_m + np.abs(rotation) @ half_size_m
    distance_m = np.cumsum(np.linalg.norm(np.diff(static_T_vehicle[:, :3, 3], axis=0, prepend=0), axis=1))
    first = np.flatnonzero(np.diff(distance_m // section_length_m, prepend=-1))
    lower_m, upper_m = np.minimum.reduceat(lower_m, first), np.maximum.reduceat(upper_m, first)
    return UprightBoxes(lower_m - MARGIN_M, upper_m + MARGIN_M)


def _sort_by_position(patches: Patches) -> tuple[Int64, Int64]:
    """Sort patches along a curve through the ground plane.

    Returns:
        (N,) order in which neighbors on the ground follow each other, and (N,) 16 m x 16 m cell of each sorted patch.
    """
    if patches.is_outward.size == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    centroid_m = (patches.corner_m + (patches.first_edge_m + patches.second_edge_m) / 3)[:2]
    # Positions are rounded to 1 m; 2^20 m suffice for each drive.
    offset_m = np.clip(centroid_m - centroid_m.min(axis=1, keepdims=True), 0, 2**20).astype(np.int64)
    code = _interleave_bits(offset_m)
    order = np.argsort(code, kind="stable")
    cell_side_m = 16  # a power of 2, so that the integer division of the code merges squares of this side
    return order, code[order] // cell_side_m**2


def _interleave_bits(coordinates: Int64) -> Int64:
    """Compute (N,) Morton codes of (2, N) coordinates below 2^21: close positions mostly have close codes."""
    bits = coordinates
    for shift, mask in (
        (16, 0x0000FFFF0000FFFF),
        (8, 0x00FF00FF00FF00FF),
        (4, 0x0F0F0F0F0F0F0F0F),
        (2, 0x3333333333333333),
        (1, 0x5555555555555555),
    ):
        bits = (bits | (bits << shift)) & mask
    return np.asarray(bits[0] | (bits[1] << 1))


def _build_groups(patches: Patches, group: Int64 | Int32) -> PatchGroups:
    """Build groups of N patches that are sorted by their (N,) group."""
    first = np.flatnonzero(np.diff(group, prepend=-1))
    if len(first) == 0:
        return PatchGroups(np.zeros(1, dtype=np.int64), UprightBoxes(np.empty((0, 3)), np.empty((0, 3))))
    lower_m = np.minimum.reduceat(patches.lower_m, first, axis=1).T.astype(np.float64)
    upper_m = np.maximum.reduceat(patches.upper_m, first, axis=1).T.astype(np.float64)
    return PatchGroups(np.append(first, len(group)), UprightBoxes(lower_m - MARGIN_M, upper_m + MARGIN_M))


def _compute_box_corners_m(patches: Patches, counts: Int64) -> Float64:
    """Compute (J, 8, 3) corners of the bounding boxes of J objects with (J,) numbers of patches."""
    first = np.cumsum(counts) - counts
    lower_m, upper_m = np.minimum.reduceat(patches.lower_m, first, 1), np.maximum.reduceat(patches.upper_m, first, 1)
    corner = np.indices((2, 2, 2)).reshape(3, -1).T
    return np.stack([lower_m.T, upper_m.T], axis=1).astype(np.float64)[:, corner, np.arange(3)]


def _transform_bounds(destination_T_source: Float64, bounds: UprightBoxes) -> tuple[Float64, Float64]:
    """Compute upright boxes in another frame that contain boxes of this frame."""
    center_m = transform_points(destination_T_source, (bounds.lower_m + bounds.upper_m) / 2)
    half_size_m = (bounds.upper_m - bounds.lower_m) / 2 @ np.abs(destination_T_source[:3, :3]).T
    return center_m - half_size_m, center_m + half_size_m
