"""Stratified sampling of points on surfaces: evenly within each of several boxes, and on each object."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.local_ground import SLACK_M as HEIGHT_SLACK_M
from torchcover.simulation.patches import Patches, UprightBoxes

# Increments of a two-dimensional sequence with low discrepancy for any number of points (Roberts 2018, "R2").
PLANE_STEPS = (0.7548776662466927, 0.5698402909980532)


class SurfacePoints(NamedTuple):
    """K points on surfaces.

    Args:
        points_m: (K, 3) positions.
        heights_m: (K,) heights in the frame of the height bands.
        normals: (K, 3) unit normals on the side from which the points are observed.
        density_per_m2: (K,) number of sampled points per m² at the position, summed over all strata.
        object_indices: (K,) object that the point is on; -1 for none.
        coincident_faces: (1, K) or (0, K), see `Patches`.
    """

    points_m: Float32
    heights_m: Float32
    normals: Float32
    density_per_m2: Float64
    object_indices: Int32
    coincident_faces: Int32

    def select(self, mask: Bools) -> Self:
        """Select points.

        Args:
            mask: (K,) True for selected points.
        """
        columns = self._replace(coincident_faces=self.coincident_faces.T)
        selected = type(self)._make(column[mask] for column in columns)
        return selected._replace(coincident_faces=selected.coincident_faces.T)

    def concatenate(self, other_points: "SurfacePoints") -> "SurfacePoints":
        """Append other points.

        Args:
            other_points: Points to append.
        """
        parts = (self, other_points)
        num_face_rows = max(len(part.coincident_faces) for part in parts)
        faces = [np.full((num_face_rows, len(part.points_m)), -1, dtype=np.int32) for part in parts]
        for completed, part in zip(faces, parts, strict=True):
            completed[: len(part.coincident_faces)] = part.coincident_faces
        return SurfacePoints(
            points_m=np.concatenate([part.points_m for part in parts]),
            heights_m=np.concatenate([part.heights_m for part in parts]),
            normals=np.concatenate([part.normals for part in parts]),
            density_per_m2=np.concatenate([part.density_per_m2 for part in parts]),
            object_indices=np.concatenate([part.object_indices for part in parts]),
            coincident_faces=np.concatenate(faces, axis=1),
        )


class Stratum(NamedTuple):
    """K patches that may overlap one box.

    Args:
        patch_indices: (K,) indices of the patches.
        area_m2: (K,) areas of the patches.
        inside_area_m2: (K,) approximate areas inside the box, from the bounding boxes of the patches.
    """

    patch_indices: Int64
    area_m2: Float64
    inside_area_m2: Float64


class ObjectPatches(NamedTuple):
    """K patches of J objects, object by object.

    Args:
        patch_indices: (K,) indices of the patches.
        area_m2: (K,) areas of the patches.
        object_indices: (J,) object indices.
        first_positions: (J,) position of the first patch of each object in `patch_indices`.
    """

    patch_indices: Int64
    area_m2: Float64
    object_indices: Int32
    first_positions: Int64


@dataclass(frozen=True)
class StrataParams:
    """Parameters of stratified sampling.

    Args:
        margin_m: Patches within this distance of a box belong to its stratum, since sampled points are rounded to
            float32.
        max_oversampling: Largest number of sampled points per point inside the box, for strata whose patches are mostly
            outside of the box.
    """

    margin_m: float = 1e-3
    max_oversampling: float = 16.0


class SurfaceStrata:
    """Surface prepared for sampling: evenly within each of several boxes, which may overlap, and on each object.

    Args:
        patches: Surface.
        boxes: Half-open boxes in the frame of the patches; their third bounds are heights.
        compute_heights_m: Computes (K,) heights of (K, 3) points, NaN without ground, as in `Patches.height_bounds_m`;
            None if heights are z.
        params: Margin and oversampling.
    """

    def __init__(
        self,
        patches: Patches,
        boxes: UprightBoxes,
        compute_heights_m: Callable[[Float32], Float32] | None = None,
        params: StrataParams = StrataParams(),
    ) -> None:
        self._patches = patches
        self._boxes = boxes
        self._compute_heights_m = compute_heights_m
        self._params = params
        normals = patches.normals_m2
        double_area_m2 = np.sqrt((normals**2).sum(axis=0))
        self._normals = normals / np.maximum(double_area_m2, np.finfo(np.float32).tiny)
        self._plane_offset_m = (self._normals * patches.corner_m).sum(axis=0)
        margin_m = np.float32(params.margin_m)
        lower_m, upper_m = patches.lower_m - margin_m, patches.upper_m + margin_m
        if compute_heights_m is not None:
            lower_m[2], upper_m[2] = patches.height_bounds_m
        self._strata = _build_strata(double_area_m2 / 2, lower_m, upper_m, boxes)
        self._objects = _group_by_object(patches.object_indices, double_area_m2 / 2)

    def sample_points(
        self, position_m: Float64, points_per_box: float, rng: np.random.Generator, *, points_per_object: int = 0
    ) -> SurfacePoints:
        """Sample points on patches that face a position.

        Args:
            position_m: (3,) position of the observer.
            points_per_box: Approximate number of points in each box; below 1 the probability of one point.
            rng: Source of the random numbers.
            points_per_object: Additional points on each object, wherever it is. An object without a face that faces the
                position gets them on the outer side of all its faces, which occlude them.
        """
        x, y, z = position_m.tolist()
        distance_m = x * self._normals[0] + y * self._normals[1] + z * self._normals[2] - self._plane_offset_m
        is_facing = (distance_m > 0) | (~self._patches.is_outward & (distance_m < 0))
        samples = [_sample_stratum(stratum, is_facing, points_per_box, rng, self._params) for stratum in self._strata]
        stratum_indices = np.repeat(np.arange(len(samples)), [len(patches) for patches, _ in samples])
        patches_of_objects, object_density = _sample_objects(self._objects, is_facing, points_per_object, rng)
        patch = np.concatenate([*(patches for patches, _ in samples), patches_of_objects])
        points_m = self._sample_positions_m(patch, rng)
        heights_m = self._compute_heights(points_m, patch)
        coordinates_m = points_m[0], points_m[1], heights_m
        is_inside = np.stack([_mask_inside(coordinates_m, *bounds) for bounds in zip(*self._boxes, strict=True)])
        # Points without ground below are in no band, but the metric counts them.
        has_no_ground = np.isnan(heights_m)
        is_inside[:, has_no_ground] = self._mask_areas(points_m[:2, has_no_ground])
        is_selected = np.ones(len(patch), dtype=bool)
        is_selected[: len(stratum_indices)] = is_inside[stratum_indices, np.arange(len(stratum_indices))]
        patch = patch[is_selected]
        object_indices = self._patches.object_indices[patch]
        # Closed bodies are observed from their outer side only, whichever side the position is on.
        side = np.where(self._patches.is_outward[patch], np.float32(1), np.sign(distance_m[patch]))
        stratum_density = np.array([density for _, density in samples])
        return SurfacePoints(
            points_m=np.ascontiguousarray(points_m[:, is_selected].T),
            heights_m=heights_m[is_selected],
            normals=(self._normals[:, patch] * side).T,
            density_per_m2=stratum_density @ is_inside[:, is_selected] + object_density[object_indices],
            object_indices=object_indices,
            coincident_faces=self._patches.coincident_faces.take(patch, axis=1),
        )

    def _mask_areas(self, positions_m: Float32) -> Bools:
        """Mark (boxes, K) boxes that contain (2, K) positions at any height."""
        areas = zip(self._boxes.lower_m[:, :2], self._boxes.upper_m[:, :2], strict=True)
        return np.stack([_mask_inside(positions_m, low, high) for low, high in areas])

    def _compute_heights(self, points_m: Float32, patch: Int64) -> Float32:
        """Compute (K,) heights of (3, K) points on the patches."""
        if self._compute_heights_m is None:
            return np.asarray(points_m[2])
        # Patches with smaller bounds are the ground itself.
        is_above = self._patches.height_bounds_m[1].take(patch) > HEIGHT_SLACK_M
        above = np.flatnonzero(is_above)
        heights_m = np.zeros(len(patch), dtype=np.float32)
        heights_m[above] = self._compute_heights_m(points_m.take(above, axis=1).T)
        return heights_m

    def _sample_positions_m(self, patch: Int64, rng: np.random.Generator) -> Float32:
        """Sample (3, K) positions, one on each patch."""
        start = rng.random((2, 1))
        a, b = ((start + np.arange(len(patch)) * np.array(PLANE_STEPS)[:, None]) % 1).astype(np.float32)
        is_outside = a + b > 1  # the other half of the parallelogram
        a, b = np.where(is_outside, 1 - a, a), np.where(is_outside, 1 - b, b)
        sampled = self._patches.select(patch)
        return np.asarray(sampled.corner_m + a * sampled.first_edge_m + b * sampled.second_edge_m)


def _mask_inside(coordinates_m: Sequence[Float32] | Float32, lower_m: Float64, upper_m: Float64) -> Bools:
    is_inside = np.ones(len(coordinates_m[0]), dtype=bool)
    for coordinate_m, low_m, high_m in zip(coordinates_m, lower_m, upper_m, strict=True):
        is_inside &= (coordinate_m >= low_m) & (coordinate_m < high_m)
    return is_inside


def _build_strata(area_m2: Float32, lower_m: Float32, upper_m: Float32, boxes: UprightBoxes) -> list[Stratum]:
    # Patches of each area at any height, shared between the height bands of the area.
    patches_by_area: dict[bytes, tuple[Int64, Float32, Float32]] = {}
    strata = []
    for low, high in zip(*boxes, strict=True):
        key = np.stack([low[:2], high[:2]]).tobytes()
        if key not in patches_by_area:
            (x_low, y_low, _), (x_high, y_high, _) = low.tolist(), high.tolist()
            overlaps_x = (upper_m[0] >= x_low) & (lower_m[0] <= x_high)
            overlaps = overlaps_x & (upper_m[1] >= y_low) & (lower_m[1] <= y_high)
            patch = np.flatnonzero(overlaps)
            patch_area_m2 = area_m2.take(patch)
            inside_m2 = patch_area_m2 * _compute_share(lower_m[0].take(patch), upper_m[0].take(patch), x_low, x_high)
            inside_m2 *= _compute_share(lower_m[1].take(patch), upper_m[1].take(patch), y_low, y_high)
            patches_by_area[key] = patch, patch_area_m2, inside_m2
        patch, patch_area_m2, inside_m2 = patches_by_area[key]
        from_m, to_m, z_low, z_high = lower_m[2].take(patch), upper_m[2].take(patch), float(low[2]), float(high[2])
        in_band = np.flatnonzero((to_m >= z_low) & (from_m <= z_high))
        inside_m2 = inside_m2.take(in_band) * _compute_share(from_m.take(in_band), to_m.take(in_band), z_low, z_high)
        band_area_m2 = patch_area_m2.take(in_band).astype(np.float64)
        strata.append(Stratum(patch.take(in_band), band_area_m2, inside_m2.astype(np.float64)))
    return strata


def _compute_share(from_m: Float32, to_m: Float32, low: float, high: float) -> Float32:
    """Compute the share of each interval that lies between two bounds; the intervals must overlap them."""
    return np.asarray((np.minimum(to_m, high) - np.maximum(from_m, low)) / (to_m - from_m))


def _sample_stratum(
    stratum: Stratum, is_facing: Bools, num_points: float, rng: np.random.Generator, params: StrataParams
) -> tuple[Int64, float]:
    """Sample patches by area so that about `num_points` points are inside the box.

    Returns:
        (K,) patches, and the density of points per m².
    """
    is_visible = is_facing.take(stratum.patch_indices)
    cumulative_m2 = np.cumsum(stratum.area_m2 * is_visible)
    total_m2 = float(cumulative_m2[-1]) if len(cumulative_m2) else 0.0
    if total_m2 == 0:
        return np.empty(0, dtype=np.int64), 0.0
    inside_m2 = max(float((stratum.inside_area_m2 * is_visible).sum()), total_m2 / params.max_oversampling)
    required = num_points * total_m2 / inside_m2
    expected = float(round(required)) if required >= 1 else required
    count = int(expected + rng.random())
    # Each of `count` equal parts of the area has one sample; consecutive patches are close to each other.
    samples_m2 = (np.arange(count) + rng.random(count)) / max(count, 1) * total_m2
    # Rounding must not move the last sample beyond the end, where patches that do not face the position may follow.
    samples_m2 = np.minimum(samples_m2, np.nextafter(total_m2, 0.0))
    return stratum.patch_indices[np.searchsorted(cumulative_m2, samples_m2, side="right")], expected / total_m2


def _group_by_object(object_indices: Int32, area_m2: Float32) -> ObjectPatches:
    patch = np.flatnonzero(object_indices >= 0)
    patch = patch[np.argsort(object_indices[patch], kind="stable")]
    unique_objects, first_positions = np.unique(object_indices[patch], return_index=True)
    return ObjectPatches(patch, area_m2[patch].astype(np.float64), unique_objects, first_positions)


def _sample_objects(
    objects: ObjectPatches, is_facing: Bools, points_per_object: int, rng: np.random.Generator
) -> tuple[Int64, Float64]:
    """Sample patches of each object by area.

    Returns:
        Patches, `points_per_object` for each object, and the density of points per m² by object index; the last entry
        (index -1) is 0.
    """
    density_per_m2 = np.zeros(objects.object_indices.max(initial=-1) + 2)
    if points_per_object == 0 or len(objects.object_indices) == 0:
        return np.empty(0, dtype=np.int64), density_per_m2
    is_sampled = is_facing[objects.patch_indices]
    faces_away = ~np.logical_or.reduceat(is_sampled, objects.first_positions)
    is_sampled |= faces_away.repeat(np.diff(objects.first_positions, append=len(is_sampled)))
    cumulative_m2 = np.cumsum(objects.area_m2 * is_sampled)
    end_m2 = cumulative_m2[np.append(objects.first_positions[1:], len(is_sampled)) - 1]
    start_m2 = np.append(0.0, end_m2[:-1])
    density_per_m2[objects.object_indices] = points_per_object / (end_m2 - start_m2)
    # Each equal part of the area of an object has one sample; rounding must not move the last one to the next object.
    parts = (np.arange(points_per_object) + rng.random((len(end_m2), points_per_object))) / points_per_object
    samples_m2 = start_m2[:, None] + parts * (end_m2 - start_m2)[:, None]
    samples_m2 = np.minimum(samples_m2, np.nextafter(end_m2, 0.0)[:, None])
    return objects.patch_indices[np.searchsorted(cumulative_m2, samples_m2.ravel(), side="right")], density_per_m2
