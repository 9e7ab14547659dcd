"""A reference sensor that asks the surface itself: points drawn evenly over it, seen from beside and above the ego."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self, get_args

import numpy as np

from torchcover.coverage.grid import PAPER_HEIGHTS, BandFrame
from torchcover.geometry import BoundingBox, build_transform
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.local_ground import SLACK_M as HEIGHT_SLACK_M
from torchcover.simulation.local_ground import TOLERANCE_M
from torchcover.simulation.patches import Patches, UprightBoxes
from torchcover.simulation.reference_sensor import (
    ReferenceContext,
    ReferenceScan,
    check_ranges,
    sample_position_in_shell,
)
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME, Areas, Bands, QueryPlan
from torchcover.simulation.sight import Visibility, compute_visibility
from torchcover.simulation.sound import UPON_M

# Patches are looked up with this much to spare: drawn points are rounded to float32.
SLACK_M = 1e-3
# Steps of a sequence in the plane whose points keep apart, whatever their number (Roberts 2018, "R2").
PLANE_STEPS = (0.7548776662466927, 0.5698402909980532)
# Where a stratum holds little of its patches, at most this many points are drawn for one that is wanted.
MOST_DRAWN = 16.0


class SurfacePoints(NamedTuple):
    """K points of a surface.

    `points_m` (K, 3) where; `heights_m` (K,) above what bands are measured from; `normals` (K, 3) of length one on the
    side from which they are looked at; `density_per_m2` (K,) how many points a square metre was given there, from all strata
    together; `object_indices` (K,) number of the object that they are on, -1 for none; `coincident_faces` (1, K) or (0, K) as in
    `Patches`.
    """

    points_m: Float32
    heights_m: Float32
    normals: Float32
    density_per_m2: Float64
    object_indices: Int32
    coincident_faces: Int32

    def select(self, mask: Bools) -> Self:
        """Those of them for which (K,) is true."""
        turned = self._replace(coincident_faces=self.coincident_faces.T)
        some = type(self)._make(part[mask] for part in turned)
        return some._replace(coincident_faces=some.coincident_faces.T)

    def concatenate(self, other_points: "SurfacePoints") -> "SurfacePoints":
        """These and others, one after the other."""
        rows = max(len(self.coincident_faces), len(other_points.coincident_faces))
        faces = [np.full((rows, len(part.points_m)), -1, dtype=np.int32) for part in (self, other_points)]
        for face, part in zip(faces, (self, other_points), strict=True):
            face[: len(part.coincident_faces)] = part.coincident_faces
        return SurfacePoints(
            np.concatenate([self.points_m, other_points.points_m]),
            np.concatenate([self.heights_m, other_points.heights_m]),
            np.concatenate([self.normals, other_points.normals]),
            np.concatenate([self.density_per_m2, other_points.density_per_m2]),
            np.concatenate([self.object_indices, other_points.object_indices]),
            np.concatenate(faces, axis=1),
        )


class Stratum(NamedTuple):
    """The patches that may meet one box: numbers, whole areas, and about what lies within, judged by their own boxes.

    All three are (K,).
    """

    patch_indices: Int64
    area_m2: Float64
    inside_area_m2: Float64


class ObjectPatches(NamedTuple):
    """The patches that belong to objects: `patch_indices` (K,) numbers, object by object; `area_m2` (K,) their areas.

    `object_indices` (J,) of each object, and `first_positions` (J,) of its patches among these.
    """

    patch_indices: Int64
    area_m2: Float64
    object_indices: Int32
    first_positions: Int64


class SurfaceStrata:
    """A surface, ready to draw points from: evenly within each of some boxes, which may overlap, and on each object.

    Boxes are half-open, in the frame of the patches; their third bounds are about what `heights_m` makes of (K, 3)
    points, (K,), NaN for none, as `Patches.heights_m` are, or about z if it is not given.
    """

    def __init__(
        self, patches: Patches, boxes: UprightBoxes, heights_m: Callable[[Float32], Float32] | None = None
    ) -> None:
        self._patches = patches
        self._boxes = boxes
        self._heights_m = heights_m
        normals = patches.normals_m2
        twice_m2 = np.sqrt((normals**2).sum(axis=0))
        self._normals = normals / np.maximum(twice_m2, np.finfo(np.float32).tiny)
        self._plane_m = (self._normals * patches.corner_m).sum(axis=0)
        lower_m, upper_m = patches.lower_m - np.float32(SLACK_M), patches.upper_m + np.float32(SLACK_M)
        if heights_m is not None:
            lower_m[2], upper_m[2] = patches.height_bounds_m
        self._strata = _strata(twice_m2 / 2, lower_m, upper_m, boxes)
        self._objects = _objects(patches.object_indices, twice_m2 / 2)

    def sample_points(
        self, position_m: Float64, points_per_box: float, rng: np.random.Generator, *, points_per_object: int = 0
    ) -> SurfacePoints:
        """Points on patches that a place is in front of, about `points_per_box` a box; below 1, one with that probability.

        Each object gets `points_per_object` more, wherever it is. One that turns no face to the place gets them on the outer
        side of all its faces, which hide them.
        """
        x, y, z = position_m.tolist()
        height_m = x * self._normals[0] + y * self._normals[1] + z * self._normals[2] - self._plane_m
        front = (height_m > 0) | (~self._patches.is_outward & (height_m < 0))
        drawn = [_drawn(stratum, front, points_per_box, rng) for stratum in self._strata]
        number = np.repeat(np.arange(len(drawn)), [len(patch) for patch, _ in drawn])
        of_objects, object_per_m2 = _drawn_on_objects(self._objects, front, points_per_object, rng)
        patch = np.concatenate([*(patch for patch, _ in drawn), of_objects])
        points_m = self._points(patch, rng)
        heights_m = self._heights_of(points_m, patch)
        placed_m = points_m[0], points_m[1], heights_m
        inside = np.stack([_inside(placed_m, low, high) for low, high in zip(*self._boxes, strict=True)])
        # Points of the areas that have no ground below are in no band: the metric counts them.
        no_ground = np.isnan(heights_m)
        inside[:, no_ground] = self._in_areas(points_m[:2, no_ground])
        kept = np.ones(len(patch), dtype=bool)
        kept[: len(number)] = inside[number, np.arange(len(number))]
        patch, of_object = patch[kept], self._patches.object_indices[patch[kept]]
        # A face of something closed is looked at from its outer side only, whatever side the place is on.
        side = np.where(self._patches.is_outward[patch], np.float32(1), np.sign(height_m[patch]))
        return SurfacePoints(
            np.ascontiguousarray(points_m[:, kept].T),
            heights_m[kept],
            (self._normals[:, patch] * side).T,
            np.array([density for _, density in drawn]) @ inside[:, kept] + object_per_m2[of_object],
            of_object,
            self._patches.coincident_faces.take(patch, axis=1),
        )

    def _in_areas(self, places_m: Float32) -> Bools:
        """(boxes, K) which boxes (2, K) places lie in, whatever their height."""
        boxes = zip(self._boxes.lower_m[:, :2], self._boxes.upper_m[:, :2], strict=True)
        return np.stack([_inside(places_m, low, high) for low, high in boxes])

    def _heights_of(self, points_m: Float32, patch: Int64) -> Float32:
        """(K,) what the third bounds of the boxes are about, of (3, K) points on the patches."""
        if self._heights_m is None:
            return np.asarray(points_m[2])
        asked = np.flatnonzero(
            self._patches.height_bounds_m[1].take(patch) > HEIGHT_SLACK_M
        )  # the others are the ground
        heights_m = np.zeros(len(patch), dtype=np.float32)
        heights_m[asked] = self._heights_m(points_m.take(asked, axis=1).T)
        return heights_m

    def _points(self, patch: Int64, generator: np.random.Generator) -> Float32:
        """(3, K) one point on each of the patches."""
        start = generator.random((2, 1))
        a, b = ((start + np.arange(len(patch)) * np.array(PLANE_STEPS)[:, None]) % 1).astype(np.float32)
        beyond = a + b > 1
        a, b = np.where(beyond, 1 - a, a), np.where(beyond, 1 - b, b)
        taken = self._patches.select(patch)
        return np.asarray(taken.corner_m + a * taken.first_edge_m + b * taken.second_edge_m)


def _inside(placed_m: Sequence[Float32] | Float32, low: Float64, high: Float64) -> Bools:
    inside = np.ones(len(placed_m[0]), dtype=bool)
    for along_m, least_m, most_m in zip(placed_m, low, high, strict=True):
        inside &= (along_m >= least_m) & (along_m < most_m)
    return inside


def _strata(m2: Float32, lower_m: Float32, upper_m: Float32, boxes: UprightBoxes) -> list[Stratum]:
    # What lies in an area, whatever its height, and how much of it: several bands ask about it.
    above: dict[bytes, tuple[Int64, Float32, Float32]] = {}
    strata = []
    for low, high in zip(*boxes, strict=True):
        area = np.stack([low[:2], high[:2]]).tobytes()
        if area not in above:
            (x_low, y_low, _), (x_high, y_high, _) = low.tolist(), high.tolist()
            meets = (upper_m[0] >= x_low) & (lower_m[0] <= x_high) & (upper_m[1] >= y_low) & (lower_m[1] <= y_high)
            patch = np.flatnonzero(meets)
            inside_m2 = m2.take(patch) * _share(lower_m[0].take(patch), upper_m[0].take(patch), x_low, x_high)
            inside_m2 *= _share(lower_m[1].take(patch), upper_m[1].take(patch), y_low, y_high)
            above[area] = patch, m2.take(patch), inside_m2
        patch, whole_m2, inside_m2 = above[area]
        from_m, to_m, z_low, z_high = lower_m[2].take(patch), upper_m[2].take(patch), float(low[2]), float(high[2])
        in_band = np.flatnonzero((to_m >= z_low) & (from_m <= z_high))
        inside_m2 = inside_m2.take(in_band) * _share(from_m.take(in_band), to_m.take(in_band), z_low, z_high)
        stratum = Stratum(patch.take(in_band), whole_m2.take(in_band).astype(np.float64), inside_m2.astype(np.float64))
        strata.append(stratum)
    return strata


def _share(from_m: Float32, to_m: Float32, low: float, high: float) -> Float32:
    """Which share of each stretch lies between two bounds, of those that meet them."""
    return np.asarray((np.minimum(to_m, high) - np.maximum(from_m, low)) / (to_m - from_m))


def _drawn(stratum: Stratum, front: Bools, each: float, generator: np.random.Generator) -> tuple[Int64, float]:
    """Patches, drawn by their area so that about `each` points lie in the stratum, and points per square metre."""
    seen = front.take(stratum.patch_indices)
    up_to_m2 = np.cumsum(stratum.area_m2 * seen)
    whole_m2 = float(up_to_m2[-1]) if len(up_to_m2) else 0.0
    if whole_m2 == 0:
        return np.empty(0, dtype=np.int64), 0.0
    inside_m2 = max(float((stratum.inside_area_m2 * seen).sum()), whole_m2 / MOST_DRAWN)
    wanted = each * whole_m2 / inside_m2
    expected = float(round(wanted)) if wanted >= 1 else wanted
    count = int(expected + generator.random())
    # One in each of as many equal parts of the area: the order of patches is one of places.
    at_m2 = (np.arange(count) + generator.random(count)) / max(count, 1) * whole_m2
    # Rounding must not take the last one beyond the end, where patches may follow that are not seen.
    number = np.searchsorted(up_to_m2, np.minimum(at_m2, np.nextafter(whole_m2, 0.0)), side="right")
    return stratum.patch_indices[number], expected / whole_m2


def _objects(of_object: Int32, m2: Float32) -> ObjectPatches:
    patch = np.flatnonzero(of_object >= 0)
    patch = patch[np.argsort(of_object[patch], kind="stable")]
    number, first = np.unique(of_object[patch], return_index=True)
    return ObjectPatches(patch, m2[patch].astype(np.float64), number, first)


def _drawn_on_objects(
    objects: ObjectPatches, front: Bools, each: int, generator: np.random.Generator
) -> tuple[Int64, Float64]:
    """Patches, `each` for every object, drawn by their area, and points per square metre by the object's number.

    The last density is for what is no object.
    """
    per_m2 = np.zeros(objects.object_indices.max(initial=-1) + 2)
    if each == 0 or len(objects.object_indices) == 0:
        return np.empty(0, dtype=np.int64), per_m2
    facing = front[objects.patch_indices]
    away = ~np.logical_or.reduceat(facing, objects.first_positions)
    facing |= away.repeat(np.diff(objects.first_positions, append=len(facing)))
    up_to_m2 = np.cumsum(objects.area_m2 * facing)
    end_m2 = up_to_m2[np.append(objects.first_positions[1:], len(facing)) - 1]
    start_m2 = np.append(0.0, end_m2[:-1])
    per_m2[objects.object_indices] = each / (end_m2 - start_m2)
    # One in each of as many equal parts of the object's area; rounding must not take the last one to the next object.
    parts = (np.arange(each) + generator.random((len(end_m2), each))) / each
    at_m2 = start_m2[:, None] + parts * (end_m2 - start_m2)[:, None]
    at_m2 = np.minimum(at_m2, np.nextafter(end_m2, 0.0)[:, None])
    return objects.patch_indices[np.searchsorted(up_to_m2, at_m2.ravel(), side="right")], per_m2


DEFAULT_RAYS = 16_384
# How far above the surface a ray to it ends, in metres, and as a share of the coordinates that casting rounds. What
# lies there coincides with it.
ABOVE_M = 1e-3
ABOVE_SHARE = 5e-7


@dataclass(frozen=True)
class SurfaceReference:
    """Points drawn evenly over the surface near the vehicle, of which those are kept that a random place sees.

    The place is that of the paper's sensor: uniform in the shell between the ego's bounding box and that box grown
    sideways and upwards. In every area and height band about the same number of points is drawn, evenly over the
    surface of everything but the ego, and a ray from the place asks whether each is seen. Objects may get points of
    their own beside these. A point's weight is the square metres that it stands for, given all the points that were
    drawn, so that the sum of w f over the points has the expectation

        E_place[ integral of f over the surface that the place sees ],

    whatever the number of rays and of places. A face of a closed body is seen from its outer side; a face of anything
    open, such as a plane, from both. Of faces that never move and lie within 1 mm of each other, one counts. Outside
    of all areas and bands there are points on objects only.

    Args:
        areas: Rectangles x, y in the vehicle frame in metres, ((x_low, x_high), (y_low, y_high)) each. They may
            overlap: small ones inside of large ones get more points.
        num_rays: About how many rays there are in all, one for each point drawn.
        num_poses: How many places share the rays of a step.
        bands_m: Height bands (low, high) in metres; half-open, as areas are. They may overlap too.
        shell_m: Thickness of the shell around the ego in which the places are; `is_over_areas`, how far they lie from the
            ego at most.
        max_range_m: Farther points are not seen.
        band_frame: What heights are measured from: "ground", the local ground (`LocalGround`), or "vehicle", z = 0 of
            the vehicle frame.
        points_per_object: How many more points at least are drawn on each object (`World.objects`) whose surface lies
            within that range of the places, in any area and at any height, from all places together; in addition to
            `num_rays`.
        is_over_areas: Whether the places are uniform over all areas instead, up to the height of the ego, as for a rig on
            a mast: from there the shell sees the same as the rig, and what is hidden from both is in no number.

    Raises:
        ValueError: No area or no band, one with inverted or infinite bounds or below the ground, no ray, no place, a
            shell or a range that is not positive, fewer than no points on objects.

    Example:
        >>> from torchcover.simulation import Scenario, Simulator
        >>> sensor = SurfaceReference(areas=(((0.0, 20.0), (-5.0, 5.0)),), rays=1024)
        >>> seen = Simulator(Scenario.load("courtyard"), {}, sensor).step(0)
        >>> bool(100 < seen.reference_weights.sum() < 400)  # square metres
        True
    """

    name: ClassVar[str] = "surface"
    has_area_weights: ClassVar[bool] = True

    areas: Areas
    num_rays: int = DEFAULT_RAYS
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
        for name, least in (("num_rays", 1), ("num_poses", 1), ("points_per_object", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: at least {least} is needed; got {getattr(self, name)}")
        if self.band_frame not in get_args(BandFrame):
            raise ValueError(f"band_frame: ground or vehicle is needed; got {self.band_frame!r}")
        below = [band for band in self.bands_m if self.band_frame == "ground" and band[1] <= -TOLERANCE_M]
        if below:
            raise ValueError(f"bands_m: nothing is seen below the ground, and {below[0]} m lies there; use others")
        check_ranges(self.shell_m, self.max_range_m)

    @classmethod
    def from_query_plan(cls, query_plan: QueryPlan, num_rays: int | None) -> Self:
        """One that asks about some areas, with 16,384 rays if it is not told how many."""
        num_rays = DEFAULT_RAYS if num_rays is None else num_rays
        return cls(query_plan.areas, num_rays, bands_m=query_plan.bands_m, band_frame=query_plan.grid.band_frame)

    def extend_to_areas(self) -> Self:
        """The same sensor with places over all areas."""
        return replace(self, is_over_areas=True, shell_m=float(np.hypot(*np.abs(self.areas).max(axis=(0, 2)))))

    def scan(self, context: ReferenceContext) -> ReferenceScan:
        """Draw points, and keep those that are seen; see `ReferenceSensor.scan`."""
        sides = np.array([(*area, band) for area in self.areas for band in self.bands_m], dtype=np.float64)
        boxes = UprightBoxes(*sides.transpose(2, 0, 1))
        instant = context.snapshot
        # All places before the first point: they are the same for any number of rays.
        drawn = [context.sample_free_pose(self._pose) for _ in range(self.num_poses)]
        places_m = [pose[:3, 3] for pose, _ in drawn]
        lower_m, upper_m = boxes.lower_m.min(axis=0), boxes.upper_m.max(axis=0)
        if self.band_frame == "vehicle":
            surface, around, heights_m = context.scene_geometry.get_surface(lower_m, upper_m), boxes, None
        else:
            around, heights_m = self._at_any_height(boxes, context.scene_geometry.ego_box), instant.compute_heights_m
            surface = context.scene_geometry.get_surface(
                around.lower_m.min(axis=0), around.upper_m.max(axis=0), (float(lower_m[2]), float(upper_m[2]))
            )
        # How near an object must come to the vehicle's origin to get points of its own.
        farthest_m = max(float(np.linalg.norm(place_m)) for place_m in places_m)
        within_m = self.max_range_m + farthest_m if self.points_per_object else -math.inf
        patches = surface.select_patches(instant, around, within_m)
        strata = SurfaceStrata(patches, boxes, heights_m)
        pits = self._pits(context, around) if self.band_frame == "ground" else None
        above_m = max(ABOVE_M, ABOVE_SHARE * float(np.abs(instant.static_T_vehicle[:3, 3]).max()))
        on_objects, looks = math.ceil(self.points_per_object / self.num_poses), []
        each = self.num_rays / (self.num_poses * len(self.areas) * len(self.bands_m))
        for place_m in places_m:
            found = strata.sample_points(place_m, each, context.rng, points_per_object=on_objects)
            if pits is not None:
                # Numbers of their own, so that those of the bands do not depend on pits.
                of_pits = pits.sample_points(place_m, each, *context.rng.spawn(1))
                found = found.concatenate(of_pits._replace(heights_m=np.full_like(of_pits.heights_m, np.nan)))
            found = _uncovered(found, context)
            near = np.linalg.norm(found.points_m - place_m, axis=1) <= self.max_range_m
            found = found if near.all() else found.select(near)
            targets_m = found.points_m + np.float32(above_m) * found.normals
            looks.append((found, compute_visibility(instant, place_m, targets_m, num_threads=context.num_threads)))
        objects = len(context.scene_geometry.scene.objects)
        return self._gathered(looks, objects, redrawn=sum(redrawn for _, redrawn in drawn))

    def _pits(self, surroundings: ReferenceContext, around: UprightBoxes) -> SurfaceStrata | None:
        """Prepare the surface that has no ground at or below it, a stratum for each area, if there is any."""
        lower_m, upper_m = around.lower_m.min(axis=0), around.upper_m.max(axis=0)
        surface = surroundings.scene_geometry.get_surface_without_ground(lower_m, upper_m)
        patches = surface.select_patches(surroundings.snapshot, around)
        return SurfaceStrata(patches, around) if len(patches.is_outward) else None

    def _at_any_height(self, boxes: UprightBoxes, ego: BoundingBox) -> UprightBoxes:
        """The same areas, as far up and down in the vehicle frame as a point can be seen from a place."""
        reach_m = self.max_range_m + self.shell_m + float(np.abs(ego.corners_m).max())
        areas = np.unique(np.stack([boxes.lower_m[:, :2], boxes.upper_m[:, :2]], axis=1), axis=0)
        ends_m = np.broadcast_to(np.array([[[-reach_m], [reach_m]]]), (len(areas), 2, 1))
        return UprightBoxes(*np.concatenate([areas, ends_m], axis=2).swapaxes(0, 1))

    def _pose(self, ego: BoundingBox, generator: np.random.Generator) -> Float64:
        if self.is_over_areas:
            areas_m = np.array(self.areas)
            lower_m, upper_m = areas_m[:, :, 0].min(axis=0), areas_m[:, :, 1].max(axis=0)
            return build_transform(np.eye(3), generator.uniform([*lower_m, 0.0], [*upper_m, ego.upper_m[2]]))
        return build_transform(np.eye(3), sample_position_in_shell(ego, self.shell_m, generator))

    def _gathered(self, looks: list[tuple[SurfacePoints, Visibility]], objects: int, redrawn: int) -> ReferenceScan:
        # One place stands for one of so many: every place's points are a surface of their own.
        weights = [1.0 / (self.num_poses * found.density_per_m2[look.is_visible]) for found, look in looks]
        of_object = np.concatenate([found.object_indices for found, _ in looks])
        heights_m = np.concatenate([found.heights_m[look.is_visible] for found, look in looks])
        return ReferenceScan(
            points=np.concatenate([found.points_m[look.is_visible] for found, look in looks]),
            weights=np.concatenate(weights).astype(np.float32),
            num_rays=sum(len(found.points_m) for found, _ in looks),
            self_hits=sum(look.self_hits for _, look in looks),
            num_body_casts=sum(look.num_body_casts for _, look in looks),
            num_resampled_poses=redrawn,
            sampled_point_counts=np.bincount(of_object[of_object >= 0], minlength=objects),
            num_poses=self.num_poses,
            heights_m=heights_m if self.band_frame == "ground" else None,
        )


def _uncovered(found: SurfacePoints, surroundings: ReferenceContext) -> SurfacePoints:
    """The points but those whose face is not the first from above of faces that coincide."""
    asked = (
        np.flatnonzero(found.coincident_faces[0] >= 0) if len(found.coincident_faces) else np.empty(0, dtype=np.int64)
    )
    if len(asked) == 0:
        return found
    uncovered = np.ones(len(found.points_m), dtype=bool)
    first = surroundings.snapshot.find_first_faces(found.points_m[asked], found.normals[asked], UPON_M)
    # Between two faces of one surface rounding decides; these are not covered by another.
    coincident = np.concatenate(surroundings.scene_geometry.coincident_faces)
    uncovered[asked] = (
        (first == found.coincident_faces[0, asked]) | (first < 0) | ~np.isin(first, coincident[coincident >= 0])
    )
    return found.select(uncovered)
