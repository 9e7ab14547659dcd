"""Reference sensor that samples visible surfaces evenly, from random positions around the ego vehicle."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self, get_args

import numpy as np

from torchcover.coverage.grid import PAPER_HEIGHTS, BandFrame
from torchcover.geometry import BoundingBox, build_transform
from torchcover.geometry.arrays import Float64
from torchcover.simulation.local_ground import TOLERANCE_M
from torchcover.simulation.mesh_checks import START_DISTANCE_M
from torchcover.simulation.mounted_sensor import Visibility, compute_visibility
from torchcover.simulation.patches import UprightBoxes
from torchcover.simulation.reference_sensor import (
    ReferenceContext,
    ReferenceScan,
    check_ranges,
    sample_position_in_shell,
)
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME, Areas, Bands, QueryPlan
from torchcover.simulation.surface_strata import SurfacePoints, SurfaceStrata

# Rays end at this height above the surface, so that they do not hit it; surfaces closer to it coincide with it.
ABOVE_M = 1e-3


@dataclass(frozen=True)
class SurfaceReference:
    """Reference sensor that samples points evenly over surfaces and keeps those that are visible from random positions.

    Positions are those of the reference sensor of the paper: uniform in the shell between the bounding box of the ego
    vehicle and that box extended sideways and upwards. Each area and height band gets about the same number of points,
    evenly over all surfaces but the ego vehicle; a ray from the position tests whether each point is visible. Objects
    can get additional points. The weight of a point is the area in m² that it represents, given all sampled points, so
    that the sum of w f over the points has the expectation

        E_position[ integral of f over the surface that is visible from the position ]

    for any number of rays and positions. Faces of closed bodies are visible from outside, faces of open meshes (such as
    planes) from both sides. Of static faces within 1 mm of each other, one counts. Outside of all areas and bands, only
    objects get points.

    Args:
        areas: Rectangles ((x_low, x_high), (y_low, y_high)) in the vehicle frame in meters. Areas may overlap; a small
            area inside a large one gets more points.
        num_rays: Approximate number of rays per frame, one for each sampled point.
        num_poses: Number of positions per frame that share the rays.
        bands_m: Height bands (low, high) in meters; half-open, as areas are; they may overlap.
        shell_m: Thickness of the shell; with `is_over_areas`, largest distance of a position from the ego vehicle.
        max_range_m: Farther points are not visible.
        points_per_object: Minimum number of additional points on each object (`Scene.objects`) within range, in any
            area and at any height, over all positions together; they are not part of `num_rays`.
        band_frame: Frame of the height bands: "ground" for the local ground (`LocalGround`), "vehicle" for z = 0 of the
            vehicle frame.
        is_over_areas: Sample positions uniformly over all areas, up to the height of the ego vehicle, as for a rig on a
            mast: the shell around such a rig would share its occlusions, which would then appear in no number.

    Raises:
        ValueError: No area or no band, inverted or infinite bounds, a band below the ground, fewer than one ray or
            position, a shell or a range that is not positive, or a negative number of points per object.

    Example:
        >>> from torchcover.simulation import Scenario, Simulator
        >>> sensor = SurfaceReference(areas=(((0.0, 20.0), (-5.0, 5.0)),), num_rays=1024)
        >>> observation = Simulator(Scenario.load("courtyard"), {}, sensor).simulate_frame(0)
        >>> bool(100 < observation.reference_weights.sum() < 400)  # m²
        True
    """

    name: ClassVar[str] = "surface"
    has_area_weights: ClassVar[bool] = True

    areas: Areas
    num_rays: int = 16_384
    num_poses: int = 4
    bands_m: Bands = tuple(PAPER_HEIGHTS.values())
    shell_m: float = 0.5
    max_range_m: float = 250.0
    points_per_object: int = 0
    band_frame: BandFrame = DEFAULT_BAND_FRAME
    is_over_areas: bool = False

    def __post_init__(self) -> None:
        if not self.areas:
            raise ValueError("areas: at least one rectangle ((x_low, x_high), (y_low, y_high)) is needed")
        for area in self.areas:
            if not all(-math.inf < low < high < math.inf for low, high in area):
                raise ValueError(f"areas: finite bounds, lower first, are needed; got {area}")
        if not self.bands_m or not all(-math.inf < low < high < math.inf for low, high in self.bands_m):
            raise ValueError(f"bands_m: at least one (low, high) with finite bounds is needed; got {self.bands_m}")
        for name, minimum in (("num_rays", 1), ("num_poses", 1), ("points_per_object", 0)):
            if getattr(self, name) < minimum:
                raise ValueError(f"{name}: at least {minimum} is needed; got {getattr(self, name)}")
        if self.band_frame not in get_args(BandFrame):
            raise ValueError(f"band_frame: ground or vehicle is needed; got {self.band_frame!r}")
        below_ground = [band for band in self.bands_m if self.band_frame == "ground" and band[1] <= -TOLERANCE_M]
        if below_ground:
            raise ValueError(
                f"bands_m: nothing is visible below the ground, and {below_ground[0]} m lies there; use other bands"
            )
        check_ranges(self.shell_m, self.max_range_m)

    @classmethod
    def from_query_plan(cls, query_plan: QueryPlan, num_rays: int | None) -> Self:
        """Create the sensor for the areas and height bands of a query plan.

        Args:
            query_plan: Areas, height bands and their frame.
            num_rays: Approximate number of rays per frame; None for 16,384.

        Raises:
            ValueError: See the class.
        """
        sensor = cls(query_plan.areas, bands_m=query_plan.bands_m, band_frame=query_plan.grid.band_frame)
        return sensor if num_rays is None else replace(sensor, num_rays=num_rays)

    def extend_to_areas(self) -> Self:
        """Copy the sensor with positions over all areas, see `is_over_areas`."""
        return replace(self, is_over_areas=True, shell_m=float(np.hypot(*np.abs(self.areas).max(axis=(0, 2)))))

    def scan(self, context: ReferenceContext, relative_offset: float = 5e-7) -> ReferenceScan:
        """Sample points and keep those that are visible.

        Args:
            context: Vehicle, scene and random numbers.
            relative_offset: Minimum height at which rays end, relative to the coordinates in the static frame, whose
                float32 rounding limits the accuracy of rays.

        Returns:
            Visible points with area weights.

        Raises:
            ValueError: No position outside of bodies was found.
        """
        bounds = np.array([(*area, band) for area in self.areas for band in self.bands_m], dtype=np.float64)
        boxes = UprightBoxes(*bounds.transpose(2, 0, 1))
        snapshot = context.snapshot
        # Positions are sampled before the first point, so that they are the same for any number of rays.
        samples = [context.sample_free_pose(self._sample_pose) for _ in range(self.num_poses)]
        positions_m = [pose[:3, 3] for pose, _ in samples]
        lower_m, upper_m = boxes.lower_m.min(axis=0), boxes.upper_m.max(axis=0)
        if self.band_frame == "vehicle":
            surface = context.scene_geometry.get_surface(lower_m, upper_m)
            search_boxes, compute_heights_m = boxes, None
        else:
            search_boxes = self._build_full_height_boxes(boxes, context.scene_geometry.ego_box)
            compute_heights_m = snapshot.compute_heights_m
            lower_search_m, upper_search_m = search_boxes.lower_m.min(axis=0), search_boxes.upper_m.max(axis=0)
            height_range_m = float(lower_m[2]), float(upper_m[2])
            surface = context.scene_geometry.get_surface(lower_search_m, upper_search_m, height_range_m)
        # Objects that may be in range of a position, by their distance from the origin of the vehicle frame.
        farthest_position_m = max(float(np.linalg.norm(position_m)) for position_m in positions_m)
        max_object_distance_m = self.max_range_m + farthest_position_m if self.points_per_object else -math.inf
        patches = surface.select_patches(snapshot, search_boxes, max_object_distance_m)
        strata = SurfaceStrata(patches, boxes, compute_heights_m)
        pit_strata = self._build_pit_strata(context, search_boxes) if self.band_frame == "ground" else None
        offset_m = max(ABOVE_M, relative_offset * float(np.abs(snapshot.static_T_vehicle[:3, 3]).max()))
        points_per_object = math.ceil(self.points_per_object / self.num_poses)
        points_per_box = self.num_rays / (self.num_poses * len(self.areas) * len(self.bands_m))
        views = []
        for position_m in positions_m:
            points = strata.sample_points(position_m, points_per_box, context.rng, points_per_object=points_per_object)
            if pit_strata is not None:
                # A separate generator, so that points in the bands do not depend on pits.
                pit_points = pit_strata.sample_points(position_m, points_per_box, *context.rng.spawn(1))
                no_heights_m = np.full_like(pit_points.heights_m, np.nan)
                points = points.concatenate(pit_points._replace(heights_m=no_heights_m))
            points = _remove_covered_points(points, context)
            is_in_range = np.linalg.norm(points.points_m - position_m, axis=1) <= self.max_range_m
            points = points if is_in_range.all() else points.select(is_in_range)
            ends_m = points.points_m + np.float32(offset_m) * points.normals
            visibility = compute_visibility(snapshot, position_m, ends_m, num_threads=context.num_threads)
            views.append((points, visibility))
        num_objects = len(context.scene_geometry.scene.objects)
        return self._merge_views(views, num_objects, num_rejected=sum(num_rejected for _, num_rejected in samples))

    def _build_pit_strata(self, context: ReferenceContext, boxes: UprightBoxes) -> SurfaceStrata | None:
        """Build a stratum per area for surfaces without ground at or below them; None if there are none."""
        lower_m, upper_m = boxes.lower_m.min(axis=0), boxes.upper_m.max(axis=0)
        surface = context.scene_geometry.get_surface_without_ground(lower_m, upper_m)
        patches = surface.select_patches(context.snapshot, boxes)
        return SurfaceStrata(patches, boxes) if len(patches.is_outward) else None

    def _build_full_height_boxes(self, boxes: UprightBoxes, ego_box: BoundingBox) -> UprightBoxes:
        """Build boxes over the same areas that contain all heights that may be visible from a position."""
        max_height_m = self.max_range_m + self.shell_m + float(np.abs(ego_box.corners_m).max())
        areas = np.unique(np.stack([boxes.lower_m[:, :2], boxes.upper_m[:, :2]], axis=1), axis=0)
        heights_m = np.broadcast_to(np.array([[[-max_height_m], [max_height_m]]]), (len(areas), 2, 1))
        return UprightBoxes(*np.concatenate([areas, heights_m], axis=2).swapaxes(0, 1))

    def _sample_pose(self, ego_box: BoundingBox, rng: np.random.Generator) -> Float64:
        if self.is_over_areas:
            areas_m = np.array(self.areas)
            lower_m, upper_m = areas_m[:, :, 0].min(axis=0), areas_m[:, :, 1].max(axis=0)
            return build_transform(np.eye(3), rng.uniform([*lower_m, 0.0], [*upper_m, ego_box.upper_m[2]]))
        return build_transform(np.eye(3), sample_position_in_shell(ego_box, self.shell_m, rng))

    def _merge_views(
        self, views: list[tuple[SurfacePoints, Visibility]], num_objects: int, num_rejected: int
    ) -> ReferenceScan:
        """Merge the points that are visible from each position."""
        visible = [points.select(visibility.is_visible) for points, visibility in views]
        # The mean over positions: each position samples the surface independently.
        weights = [1.0 / (self.num_poses * points.density_per_m2) for points in visible]
        object_indices = np.concatenate([points.object_indices for points, _ in views])
        heights_m = np.concatenate([points.heights_m for points in visible])
        return ReferenceScan(
            points=np.concatenate([points.points_m for points in visible]),
            weights=np.concatenate(weights).astype(np.float32),
            num_rays=len(object_indices),
            self_hits=sum(visibility.self_hits for _, visibility in views),
            num_body_casts=sum(visibility.num_body_casts for _, visibility in views),
            num_resampled_poses=num_rejected,
            sampled_point_counts=np.bincount(object_indices[object_indices >= 0], minlength=num_objects),
            num_poses=self.num_poses,
            heights_m=heights_m if self.band_frame == "ground" else None,
        )


def _remove_covered_points(points: SurfacePoints, context: ReferenceContext) -> SurfacePoints:
    """Remove points whose face is covered by a coincident face."""
    if len(points.coincident_faces) == 0:
        return points
    tested = np.flatnonzero(points.coincident_faces[0] >= 0)
    if len(tested) == 0:
        return points
    faces = points.coincident_faces[0, tested]
    first_faces = context.snapshot.find_first_faces(points.points_m[tested], points.normals[tested], START_DISTANCE_M)
    # Rounding decides between adjacent faces of one surface; these do not cover each other.
    coincident_faces = np.concatenate(context.scene_geometry.coincident_faces)
    is_adjacent_face = ~np.isin(first_faces, coincident_faces[coincident_faces >= 0])
    is_uncovered = np.ones(len(points.points_m), dtype=bool)
    is_uncovered[tested] = (first_faces == faces) | (first_faces < 0) | is_adjacent_face
    return points.select(is_uncovered)
