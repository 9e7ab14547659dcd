"""A reference sensor that asks the surface itself: which of it is seen from beside and above the ego."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self, get_args

import numpy as np

from torchcover.coverage.grid import PAPER_HEIGHTS, BandFrame
from torchcover.geometry import BoundingBox, rigid
from torchcover.geometry.arrays import Float64
from torchcover.simulation.local_ground import TOLERANCE_M
from torchcover.simulation.patches import Bounds
from torchcover.simulation.reference_sensor import ReferenceScan, Surroundings, check_reach, position_in_shell
from torchcover.simulation.regions_of_interest import DEFAULT_BAND_FRAME, Areas, Asked, Bands
from torchcover.simulation.sight import Sight, sight
from torchcover.simulation.sound import UPON_M
from torchcover.simulation.surface_points import SurfacePoints, SurfaceStrata

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
        rays: About how many rays there are in all, one for each point drawn.
        places: How many places share the rays of a step.
        bands_m: Height bands (low, high) in metres; half-open, as areas are. They may overlap too.
        shell_m: Thickness of the shell around the ego in which the places are; `over_areas`, how far they lie from the
            ego at most.
        max_range_m: Farther points are not seen.
        band_frame: What heights are measured from: "ground", the local ground (`LocalGround`), or "vehicle", z = 0 of
            the vehicle frame.
        object_points: How many more points at least are drawn on each object (`World.objects`) whose surface lies
            within that range of the places, in any area and at any height, from all places together; in addition to
            `rays`.
        over_areas: Whether the places are uniform over all areas instead, up to the height of the ego, as for a rig on
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
    square_metres: ClassVar[bool] = True

    areas: Areas
    rays: int = DEFAULT_RAYS
    places: int = 4
    bands_m: Bands = tuple(PAPER_HEIGHTS.values())
    shell_m: float = 0.5
    max_range_m: float = 250.0
    object_points: int = 0
    band_frame: BandFrame = DEFAULT_BAND_FRAME
    over_areas: bool = False

    def __post_init__(self) -> None:
        if not self.areas:
            raise ValueError("areas: at least one rectangle ((x_low, x_high), (y_low, y_high)) is needed")
        for area in self.areas:
            if not all(-math.inf < low < high < math.inf for low, high in area):
                raise ValueError(f"areas: finite bounds, lower first, are needed; got {area}")
        if not self.bands_m or not all(-math.inf < low < high < math.inf for low, high in self.bands_m):
            raise ValueError(f"bands_m: at least one (low, high) with finite bounds is needed; got {self.bands_m}")
        if self.rays < 1:
            raise ValueError(f"rays: at least 1 is needed; got {self.rays}")
        if self.places < 1:
            raise ValueError(f"places: at least 1 is needed; got {self.places}")
        if self.object_points < 0:
            raise ValueError(f"object_points: a number >= 0 is needed; got {self.object_points}")
        if self.band_frame not in get_args(BandFrame):
            raise ValueError(f"band_frame: ground or vehicle is needed; got {self.band_frame!r}")
        below = [band for band in self.bands_m if self.band_frame == "ground" and band[1] <= -TOLERANCE_M]
        if below:
            raise ValueError(f"bands_m: nothing is seen below the ground, and {below[0]} m lies there; use others")
        check_reach(self.shell_m, self.max_range_m)

    @classmethod
    def from_rays(cls, asked: Asked, rays: int | None) -> Self:
        """One that asks about some areas, with 16,384 rays if it is not told how many."""
        rays = DEFAULT_RAYS if rays is None else rays
        return cls(asked.areas, rays, bands_m=asked.bands_m, band_frame=asked.grid.band_frame)

    def for_roadside(self) -> Self:
        """The same sensor with places over all areas."""
        return replace(self, over_areas=True, shell_m=float(np.hypot(*np.abs(self.areas).max(axis=(0, 2)))))

    def scan(self, surroundings: Surroundings) -> ReferenceScan:
        """Draw points, and keep those that are seen; see `ReferenceSensor.scan`."""
        sides = np.array([(*area, band) for area in self.areas for band in self.bands_m], dtype=np.float64)
        boxes = Bounds(*sides.transpose(2, 0, 1))
        instant = surroundings.instant
        # All places before the first point: they are the same for any number of rays.
        drawn = [surroundings.free_pose(self._pose) for _ in range(self.places)]
        places_m = [pose[:3, 3] for pose, _ in drawn]
        lower_m, upper_m = boxes.lower_m.min(axis=0), boxes.upper_m.max(axis=0)
        if self.band_frame == "vehicle":
            surface, around, heights_m = surroundings.scene.surface(lower_m, upper_m), boxes, None
        else:
            around, heights_m = self._at_any_height(boxes, surroundings.scene.ego_box), instant.heights_m
            surface = surroundings.scene.surface(
                around.lower_m.min(axis=0), around.upper_m.max(axis=0), (float(lower_m[2]), float(upper_m[2]))
            )
        # How near an object must come to the vehicle's origin to get points of its own.
        farthest_m = max(float(np.linalg.norm(place_m)) for place_m in places_m)
        within_m = self.max_range_m + farthest_m if self.object_points else -math.inf
        patches = surface.near(instant, around, within_m)
        strata = SurfaceStrata(patches, boxes, heights_m)
        above_m = max(ABOVE_M, ABOVE_SHARE * float(np.abs(instant.static_T_vehicle[:3, 3]).max()))
        on_objects, looks = math.ceil(self.object_points / self.places), []
        each = self.rays / (self.places * len(self.areas) * len(self.bands_m))
        for place_m in places_m:
            found = strata.draw(place_m, each, surroundings.generator, on_objects=on_objects)
            found = _uncovered(found, surroundings)
            near = np.linalg.norm(found.points_m - place_m, axis=1) <= self.max_range_m
            found = found if near.all() else found.some(near)
            targets_m = found.points_m + np.float32(above_m) * found.normals
            looks.append((found, sight(instant, place_m, targets_m, threads=surroundings.threads)))
        objects = len(surroundings.scene.world.objects)
        return self._gathered(looks, objects, redrawn=sum(redrawn for _, redrawn in drawn))

    def _at_any_height(self, boxes: Bounds, ego: BoundingBox) -> Bounds:
        """The same areas, as far up and down in the vehicle frame as a point can be seen from a place."""
        reach_m = self.max_range_m + self.shell_m + float(np.abs(ego.corners_m).max())
        areas = np.unique(np.stack([boxes.lower_m[:, :2], boxes.upper_m[:, :2]], axis=1), axis=0)
        ends_m = np.broadcast_to(np.array([[[-reach_m], [reach_m]]]), (len(areas), 2, 1))
        return Bounds(*np.concatenate([areas, ends_m], axis=2).swapaxes(0, 1))

    def _pose(self, ego: BoundingBox, generator: np.random.Generator) -> Float64:
        if self.over_areas:
            areas_m = np.array(self.areas)
            lower_m, upper_m = areas_m[:, :, 0].min(axis=0), areas_m[:, :, 1].max(axis=0)
            return rigid(np.eye(3), generator.uniform([*lower_m, 0.0], [*upper_m, ego.upper_m[2]]))
        return rigid(np.eye(3), position_in_shell(ego, self.shell_m, generator))

    def _gathered(self, looks: list[tuple[SurfacePoints, Sight]], objects: int, redrawn: int) -> ReferenceScan:
        # One place stands for one of so many: every place's points are a surface of their own.
        weights = [1.0 / (self.places * found.per_m2[look.seen]) for found, look in looks]
        of_object = np.concatenate([found.of_object for found, _ in looks])
        heights_m = np.concatenate([found.heights_m[look.seen] for found, look in looks])
        return ReferenceScan(
            points=np.concatenate([found.points_m[look.seen] for found, look in looks]),
            weights=np.concatenate(weights).astype(np.float32),
            rays=sum(len(found.points_m) for found, _ in looks),
            self_hits=sum(look.self_hits for _, look in looks),
            body_casts=sum(look.body_casts for _, look in looks),
            redrawn=redrawn,
            drawn=np.bincount(of_object[of_object >= 0], minlength=objects),
            places=self.places,
            heights_m=heights_m if self.band_frame == "ground" else None,
        )


def _uncovered(found: SurfacePoints, surroundings: Surroundings) -> SurfacePoints:
    """The points but those whose face is not the first from above of faces that coincide."""
    asked = np.flatnonzero(found.face[0] >= 0) if len(found.face) else np.empty(0, dtype=np.int64)
    if len(asked) == 0:
        return found
    uncovered = np.ones(len(found.points_m), dtype=bool)
    first = surroundings.instant.first_faces(found.points_m[asked], found.normals[asked], UPON_M)
    # Between two faces of one surface rounding decides; these are not covered by another.
    coincident = np.concatenate(surroundings.scene.coincident)
    uncovered[asked] = (first == found.face[0, asked]) | (first < 0) | ~np.isin(first, coincident[coincident >= 0])
    return found.some(uncovered)
