"""The surface of a world, cut small once; what is near the vehicle is looked up at every step."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry import invert, transform_points
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.instant import SceneSnapshot
from torchcover.simulation.local_ground import SLACK_M as HEIGHT_SLACK_M
from torchcover.simulation.local_ground import TOLERANCE_M, GroundHeightPyramid, round_height_bounds_m
from torchcover.simulation.patches import Patches, UprightBoxes
from torchcover.simulation.rays import rotate_each
from torchcover.simulation.shapes import Mesh

# Between which heights above the ground the ground itself lies.
OF_GROUND_M = np.array([[-TOLERANCE_M - HEIGHT_SLACK_M], [HEIGHT_SLACK_M]], dtype=np.float32)
# What is nowhere higher above it, by bounds that are wider than it is, lies on it.
ON_GROUND_M = 3 * HEIGHT_SLACK_M
# Side of the squares of the ground by which patches are looked up.
CELL_M = 16  # a power of two
# A drive is followed by boxes around stretches of it of this length.
STRETCH_M = 100.0
# Boxes are grown by this much for the rounding of float32 coordinates.
SLACK_M = 0.01


class PatchGroups(NamedTuple):
    """G groups of patches that follow each other.

    `first_patches` (G + 1,) number of the first patch of each, and of all; `bounds` (G boxes) what they fill.
    """

    first_patches: Int64
    bounds: UprightBoxes

    def list_members(self, group_indices: Int64) -> Int64:
        """The numbers of the patches of some groups, one after the other."""
        first, count = self.first_patches[group_indices], np.diff(self.first_patches)[group_indices]
        return np.repeat(first - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())


class HeightFilter(NamedTuple):
    """What is asked about the surface by height above the local ground.

    `height_pyramid` of the ground; `pyramid_T_static` (4, 4) from the frame of what never moves to theirs; for each mesh that
    never moves (F,) which of its faces are `ground_masks`, and which look `downward_masks` and are seen from below only; `min_height_m` and
    `max_height_m` of all heights that are wanted. With `is_without_ground`, surfaces without ground at or below them are wanted
    instead, such as those of a pit that is no ground; their heights are 0.
    """

    height_pyramid: GroundHeightPyramid
    pyramid_T_static: Float64
    ground_masks: Sequence[Bools]
    downward_masks: Sequence[Bools]
    min_height_m: float
    max_height_m: float
    is_without_ground: bool = False

    def build_mesh_filter(self, mesh_index: int) -> Callable[[Float64, Int64], tuple[Float32, Bools]]:
        """From triangles of a mesh that never moves and their faces to (2, N) heights, and (N,) whether any is wanted.

        That of the ground itself is none, but for other ground a few centimetres above it. What lies below the ground
        is hidden by it, and so is what lies on it and looks down.
        """
        is_ground, is_down = self.ground_masks[mesh_index], self.downward_masks[mesh_index]

        def heights(triangles_m: Float64, face: Int64) -> tuple[Float32, Bools]:
            heights_m = OF_GROUND_M.repeat(len(face), axis=1)
            others = np.flatnonzero(~is_ground[face])
            wanted = np.full(len(face), self.min_height_m <= OF_GROUND_M[1, 0])
            if len(others):
                of_others_m = triangles_m if len(others) == len(face) else triangles_m.take(others, axis=2)
                corners_m = self.pyramid_T_static[:3, :3] @ of_others_m + self.pyramid_T_static[:3, 3:]
                heights_m[:, others] = others_m = self.height_pyramid.compute_height_bounds_m(corners_m)
                if self.is_without_ground:
                    return np.zeros_like(heights_m), _scattered(others_m[1] < -TOLERANCE_M, others, len(face))
                least_m = np.maximum(self.min_height_m, np.where(is_down[face[others]], ON_GROUND_M, 0.0))
                wanted[others] = (others_m[1] > least_m) & (others_m[0] <= self.max_height_m)
            return heights_m, wanted & (not self.is_without_ground)

        return heights

    def add_height_bounds(
        self, patches: Patches, static_T_patches: Float64, corners_m: Float64, patch_counts: Int64
    ) -> Patches:
        """Patches of objects, one after the other, with heights above the ground anywhere below the object.

        `static_T_patches` is where their frame is, in which `corners_m` (J, 8, 3) are of boxes around the objects;
        `patch_counts` (J,) how many patches each has.
        """
        squares_T_patches = self.pyramid_T_static @ static_T_patches
        corners_m = transform_points(squares_T_patches, corners_m.reshape(-1, 3)).reshape(-1, 8, 3)
        lowest_m, highest_m = self.height_pyramid.compute_ground_bounds_m(
            corners_m.min(axis=1).T[:2], corners_m.max(axis=1).T[:2]
        )
        up, columns = squares_T_patches[2], (patches.corner_m, patches.first_edge_m, patches.second_edge_m)
        corner_m, first_m, second_m = (up[:3] @ column for column in columns)
        low_m = corner_m + np.minimum(np.minimum(first_m, second_m), 0.0) + up[3] - highest_m.repeat(patch_counts)
        high_m = corner_m + np.maximum(np.maximum(first_m, second_m), 0.0) + up[3] - lowest_m.repeat(patch_counts)
        return patches._replace(height_bounds_m=round_height_bounds_m(low_m, high_m))


class SceneSurface:
    """The surface of what never moves, in the order of places on the ground, and of each object that moves.

    `scenery` is what never moves and is no object, in the frame of the ray caster of that, `objects` the patches of
    each object's surface in its own frame. `resting` has `static_T_object` by the number of those that never move,
    `moving` the others' numbers by that of the body in an instant. Outside of `bounds` no scenery is ever asked for.
    For each mesh of the scenery (F,) are what `find_outward_faces` says, and numbers of its faces that coincide with others,
    -1 for the rest.
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
        self._above = height_filter
        self._moving = {body: (objects[number], number) for body, number in moving.items()}
        poses = np.array(list(resting.values())).reshape(-1, 4, 4)
        placed = place_patches([(objects[number], number) for number in resting], poses)
        if height_filter is not None:
            count = np.array([len(objects[number].is_outward) for number in resting], dtype=np.int64)
            placed = height_filter.add_height_bounds(placed, np.eye(4), _boxes_around(placed, count), count)
        cut = [
            Patches.from_mesh(
                mesh,
                bounds,
                height_filter and height_filter.build_mesh_filter(number),
                coincident_faces[number] if coincident_faces else None,
                outward_masks[number],
            )
            for number, mesh in enumerate(scenery)
        ]
        patches = Patches.concatenate([*cut, placed])
        order, cell = _by_place(patches)
        self._static = patches.select(order)
        self._cells = _groups(self._static, cell)
        of_objects = np.flatnonzero(self._static.object_indices >= 0)
        self._resting = of_objects[np.argsort(self._static.object_indices[of_objects], kind="stable")]
        self._objects = _groups(self._static.select(self._resting), self._static.object_indices[self._resting])

    @property
    def num_bytes(self) -> int:
        """How much memory it takes, without the objects' patches, which others share."""
        return sum(column.nbytes for column in self._static)

    def select_patches(
        self, snapshot: SceneSnapshot, boxes: UprightBoxes, max_object_distance_m: float = -np.inf
    ) -> Patches:
        """The patches that may meet boxes of the vehicle frame at an instant, in that frame, and some that do not.

        All patches of an object are there, too, if it may come within `max_object_distance_m` of the vehicle's origin.
        """
        vehicle_T_static = invert(snapshot.static_T_vehicle)
        wanted = np.zeros(len(self._static.is_outward), dtype=bool)
        cells = boxes.mask_overlaps(*_moved_bounds(vehicle_T_static, self._cells.bounds))
        wanted[self._cells.list_members(np.flatnonzero(cells))] = True
        lower_m, upper_m = _moved_bounds(vehicle_T_static, self._objects.bounds)
        objects = np.linalg.norm(np.clip(0.0, lower_m, upper_m), axis=1) <= max_object_distance_m
        wanted[self._resting[self._objects.list_members(np.flatnonzero(objects))]] = True
        near = [self._static.select(np.flatnonzero(wanted)).transform(vehicle_T_static)]
        moving = snapshot.moving_bodies
        radii_m = moving.radius_m[:, None]
        meets = boxes.mask_overlaps(moving.center_m - radii_m, moving.center_m + radii_m)
        meets |= np.linalg.norm(moving.center_m, axis=1) - moving.radius_m <= max_object_distance_m
        meets &= np.isin(moving.body_indices, list(self._moving))
        bodies = np.flatnonzero(meets & (moving.body_indices != snapshot.ego_index))
        placed = [self._moving[number] for number in moving.body_indices[bodies].tolist()]
        of_moving = place_patches(placed, moving.vehicle_T_part[bodies])
        if self._above is not None:
            count = np.array([len(patches.is_outward) for patches, _ in placed], dtype=np.int64)
            corners_m = moving.box_corners_m[bodies]
            of_moving = self._above.add_height_bounds(of_moving, snapshot.static_T_vehicle, corners_m, count)
        return Patches.concatenate([*near, of_moving])


def _scattered(mask: Bools, numbers: Int64, count: int) -> Bools:
    """(count,) mask that is false but at (N,) numbers."""
    whole = np.zeros(count, dtype=bool)
    whole[numbers] = mask
    return whole


def place_patches(kinds: Sequence[tuple[Patches, int]], destination_T_source: Float64) -> Patches:
    """Patches of bodies, with the number of the object that each is, moved to where they are; see `Patches.moved`."""
    parts = [patches for patches, _ in kinds]
    count = [len(patches.is_outward) for patches in parts]
    pose = destination_T_source.repeat(count, axis=0)
    rotation, all_parts = pose[:, :3, :3].astype(np.float32), Patches.concatenate(parts)
    corner_m = rotate_each(pose[:, :3, :3], all_parts.corner_m.astype(np.float64)) + pose[:, :3, 3].T
    return Patches(
        corner_m=corner_m.astype(np.float32),
        first_edge_m=rotate_each(rotation, all_parts.first_edge_m),
        second_edge_m=rotate_each(rotation, all_parts.second_edge_m),
        is_outward=all_parts.is_outward,
        object_indices=np.array([number for _, number in kinds], dtype=np.int32).repeat(count),
        height_bounds_m=all_parts.height_bounds_m,
        coincident_faces=all_parts.coincident_faces,
    )


def compute_swept_bounds(static_T_vehicle: Float64, box: UprightBoxes) -> UprightBoxes:
    """Upright boxes around all places of a box that a vehicle carries along its drive, (T, 4, 4) poses in a row."""
    rotation, half_m = static_T_vehicle[:, :3, :3], (box.upper_m - box.lower_m)[0] / 2
    middle_m = rotation @ (box.lower_m + half_m)[0] + static_T_vehicle[:, :3, 3]
    lower_m, upper_m = middle_m - np.abs(rotation) @ half_m, middle_m + np.abs(rotation) @ half_m
    way_m = np.cumsum(np.linalg.norm(np.diff(static_T_vehicle[:, :3, 3], axis=0, prepend=0), axis=1))
    first = np.flatnonzero(np.diff(way_m // STRETCH_M, prepend=-1))
    lower_m, upper_m = np.minimum.reduceat(lower_m, first), np.maximum.reduceat(upper_m, first)
    return UprightBoxes(lower_m - SLACK_M, upper_m + SLACK_M)


def _by_place(patches: Patches) -> tuple[Int64, Int64]:
    """The order in which neighbours on the ground follow each other, and the cell of each patch in that order."""
    if patches.is_outward.size == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    middle_m = (patches.corner_m + (patches.first_edge_m + patches.second_edge_m) / 3)[:2]
    # To a metre: a million on a side are enough for any drive.
    place = _interleaved(np.clip(middle_m - middle_m.min(axis=1, keepdims=True), 0, 2**20).astype(np.int64))
    order = np.argsort(place, kind="stable")
    # Halving both coordinates is a shift by two.
    return order, place[order] // CELL_M**2


def _interleaved(place: Int64) -> Int64:
    """(N,) numbers along a curve on which (2, N) places with coordinates below 2^21 are near what is near to them."""
    spread = place
    for bits, mask in ((16, 0x0000FFFF0000FFFF), (8, 0x00FF00FF00FF00FF), (4, 0x0F0F0F0F0F0F0F0F)):
        spread = (spread | (spread << bits)) & mask
    for bits, mask in ((2, 0x3333333333333333), (1, 0x5555555555555555)):
        spread = (spread | (spread << bits)) & mask
    return np.asarray(spread[0] | (spread[1] << 1))


def _groups(patches: Patches, group: Int64 | Int32) -> PatchGroups:
    """The groups of (N,) patches that are in their order."""
    first = np.flatnonzero(np.diff(group, prepend=-1))
    if len(first) == 0:
        return PatchGroups(np.zeros(1, dtype=np.int64), UprightBoxes(np.empty((0, 3)), np.empty((0, 3))))
    lower_m = np.minimum.reduceat(patches.lower_m, first, axis=1).T.astype(np.float64)
    upper_m = np.maximum.reduceat(patches.upper_m, first, axis=1).T.astype(np.float64)
    return PatchGroups(np.append(first, len(group)), UprightBoxes(lower_m - SLACK_M, upper_m + SLACK_M))


def _boxes_around(patches: Patches, count: Int64) -> Float64:
    """(J, 8, 3) corners of J upright boxes, each around as many patches as (J,) say."""
    first = np.cumsum(count) - count
    lower_m, upper_m = np.minimum.reduceat(patches.lower_m, first, 1), np.maximum.reduceat(patches.upper_m, first, 1)
    corner = np.indices((2, 2, 2)).reshape(3, -1).T
    return np.stack([lower_m.T, upper_m.T], axis=1).astype(np.float64)[:, corner, np.arange(3)]


def _moved_bounds(destination_T_source: Float64, bounds: UprightBoxes) -> tuple[Float64, Float64]:
    """Upright boxes in another frame around boxes that were upright in theirs."""
    middle_m = transform_points(destination_T_source, (bounds.lower_m + bounds.upper_m) / 2)
    half_m = (bounds.upper_m - bounds.lower_m) / 2 @ np.abs(destination_T_source[:3, :3]).T
    return middle_m - half_m, middle_m + half_m
