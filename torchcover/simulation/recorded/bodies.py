"""Bodies for recorded boxes, the ground below recorded tracks, and the sides of streets around them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from torchcover.files import guard_reader
from torchcover.geometry import BoundingBox, fit_height_field
from torchcover.geometry.arrays import Float64
from torchcover.recordings.formats.tracks import check_gaps, read_box_tracks
from torchcover.recordings.objects import Track
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.height_field import (
    CELL_M,
    MARGIN_M,
    FlatGround,
    GroundHeightField,
    compute_cell_centers_m,
    count_corners,
)
from torchcover.simulation.shapes import Box, Mesh
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.fleet import CATEGORIES, VehicleType, load_bodies
from torchcover.simulation.traffic.frontage import StreetSide, find_street_sides
from torchcover.simulation.world import Actor

# Squares a little beyond what is seen are built, so that none ends in sight; bodies are as long as this.
BEYOND_M = 25.0
# Somebody who stays where it is counts once in so many metres, however long it was watched.
STAYS_M = 1.0
# Wheels are so far apart, as shares of the body; and what lies to the left of a direction.
WHEELS = 0.6
LEFT_OF = np.array([[0.0, 1.0], [-1.0, 0.0]])
SCALES_M = tuple(CELL_M * factor for factor in (16.0, 8.0, 4.0, 2.0, 1.0))


def fit_ground(positions_m: Float64, ego_positions_m: Float64) -> FlatGround | GroundHeightField:
    """The ground around the ego's way: plain if everybody stands at one height.

    The (T, 3) places on which the ego stood are believed; of the (N, 3) of others some may be wrong.
    """
    margin_m = HORIZON_M + MARGIN_M
    lower_m, upper_m = ego_positions_m[:, :2].min(axis=0) - margin_m, ego_positions_m[:, :2].max(axis=0) + margin_m
    # From the first corner, in float64: the places may be of UTM size.
    positions_m = np.concatenate([ego_positions_m, positions_m])
    trusted = np.arange(len(positions_m)) < len(ego_positions_m)
    base_m = float(ego_positions_m[0, 2])
    if (positions_m[:, 2] == base_m).all():
        return FlatGround(base_m, lower_m, upper_m)
    inside = ((positions_m[:, :2] > lower_m) & (positions_m[:, :2] < upper_m)).all(axis=1)
    across_m, over_m = positions_m[inside, :2] - lower_m, positions_m[inside, 2] - base_m
    rows, columns = count_corners(lower_m, upper_m)
    field = fit_height_field(across_m, over_m, upper_m - lower_m, SCALES_M, trusted_mask=trusted[inside])
    corners: Float64 = CELL_M * np.indices((rows, columns))[::-1].reshape(2, -1).T.astype(np.float64)
    way_m = ego_positions_m[:, :2] if len(ego_positions_m) > 1 else np.repeat(ego_positions_m[:, :2], 2, axis=0)
    way = shapely.LineString(way_m - lower_m).simplify(0.5)
    shapely.prepare(way)
    seen = shapely.dwithin(
        shapely.points(compute_cell_centers_m(np.zeros(2), rows, columns)), way, HORIZON_M + BEYOND_M
    )
    return GroundHeightField(
        lower_m, base_m + field.compute_heights_m(corners).reshape(rows, columns), seen.reshape(rows - 1, columns - 1)
    )


def thin_stationary_positions(positions_m: Float64) -> Float64:
    """(N, 3) the middle of each stay of (K, 3) places that follow each other."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions_m[:, :2], axis=0), axis=1))])
    stay = np.cumsum(np.diff(way_m // STAYS_M, prepend=0.0) > 0)
    count = np.bincount(stay)
    sums = [np.bincount(stay, axis) for axis in (positions_m - positions_m[0]).T]
    return np.asarray(positions_m[0] + np.stack(sums, axis=1) / count[:, None])


def collect_ground_positions(position_tracks: Sequence[Float64]) -> Float64:
    """(N, 3) all the places of some tracks, (K, 3) each, that say something new."""
    return np.concatenate([np.empty((0, 3)), *map(thin_stationary_positions, position_tracks)])


def apply_ground_tilt(actor: Actor, ground: FlatGround | GroundHeightField) -> Actor:
    """The body with the slope of the ground below its wheels, if its own was not recorded; people stand upright."""
    own = actor.trajectory
    if isinstance(ground, FlatGround) or actor.category == "pedestrian" or own.angles_deg[:, 1:].any():
        return actor
    angles_deg, yaw = own.angles_deg.copy(), np.deg2rad(own.angles_deg[:, 0])
    ahead, (length, width, _) = np.stack([np.cos(yaw), np.sin(yaw)], axis=1), np.ptp(actor.mesh.vertices_m, axis=0)
    for axis, way, apart_m, sign in ((1, ahead, WHEELS * length, -1), (2, ahead @ LEFT_OF, WHEELS * width, 1)):
        over_m, under_m = (
            ground.compute_heights_m(own.positions_m[:, :2] + end * apart_m / 2 * way) for end in (1, -1)
        )
        angles_deg[:, axis] = sign * np.rad2deg(np.arctan((over_m - under_m) / apart_m))
    return replace(actor, trajectory=replace(own, angles_deg=angles_deg))


# From the middle of a track to the kerb; what lies between tracks that are nearer to each other is street, too.
TO_KERB_M, BETWEEN_M, SIDEWALK_M = 5.0, 12.0, 3.0
# Nothing stands nearer to where somebody was, and labels tremble by centimetres.
CLEAR_M, TREMBLE_M = 0.5, 0.3


def find_visible_sides(
    ego: Actor, actors: Sequence[Actor], built_share: float, generator: np.random.Generator
) -> tuple[list[StreetSide], list[shapely.Geometry], list[shapely.Geometry]]:
    """The sides of what was driven, as far as the ego sees; where nothing may stand at kerbs, and behind sidewalks."""
    everybody = (ego, *actors)
    places_m = [actor.trajectory.positions_m[:, :2] for actor in everybody]
    ways = [shapely.LineString(np.concatenate([way_m, way_m[-1:]])).simplify(TREMBLE_M) for way_m in places_m]
    radius_m = [np.linalg.norm(np.ptp(actor.mesh.vertices_m[:, :2], axis=0)) / 2 + CLEAR_M for actor in everybody]
    was_m = shapely.buffer(ways, radius_m, quad_segs=4)
    driven = [
        way
        for actor, way in zip(everybody, ways, strict=True)
        if actor is ego or (actor.category != "pedestrian" and way.length > CLEAR_M)
    ]
    street = shapely.union_all(shapely.buffer(driven, TO_KERB_M)).buffer(BETWEEN_M / 2).buffer(-BETWEEN_M / 2)
    seen = ways[0].buffer(HORIZON_M)
    sides = find_street_sides(
        street, (0.0, SIDEWALK_M), lambda places_m: shapely.contains_xy(seen, *places_m.T), built_share, generator
    )
    return sides, [street, *was_m], [street.buffer(SIDEWALK_M - TREMBLE_M), *was_m]


# A body is stretched or squeezed to a box by this at most; beyond, the box itself is shown. The boxes of people hold
# their stride and their arms, which the bodies do not have.
MOST_STRETCHED = 4.0
# Of what has no recorded height and no body.
USUAL_HEIGHT_M = 1.5


class BodyLibrary:
    """The built-in bodies, scaled to recorded boxes; those of one size share one mesh."""

    def __init__(self) -> None:
        # A box is all of a truck.
        self._meshes = {**load_bodies(), "truck": Vehicle.load("truck").build_mesh()}
        self._sizes_m = {
            kind: np.array(BoundingBox.from_points(mesh.vertices_m).size_m) for kind, mesh in self._meshes.items()
        }
        self._lengths_m = {kind: float(size_m[0]) for kind, size_m in self._sizes_m.items()}
        self._made: dict[tuple[str | None, tuple[float, float, float]], Mesh] = {}

    def get_category_and_mesh(self, track: Track) -> tuple[str, Mesh]:
        """The category and the body of a track: of the kind whose length is nearest in its class, or a box."""
        kind = track.vehicle_class and VehicleType(track.vehicle_class, track.size_m[0]).find_body(self._lengths_m)
        length, width, height = track.size_m
        if kind and math.isnan(height):
            height = float(self._sizes_m[kind][2])
        if kind:
            stretch = np.array([length, width, height]) / self._sizes_m[kind]
            if stretch.max() > MOST_STRETCHED or stretch.min() < 1 / MOST_STRETCHED:
                kind = None
        size_m = (length, width, USUAL_HEIGHT_M if math.isnan(height) else height)
        if (kind, size_m) not in self._made:
            self._made[kind, size_m] = self._scaled(kind, size_m)
        return CATEGORIES[kind] if kind else track.category.lower(), self._made[kind, size_m]

    def _scaled(self, kind: str | None, size_m: tuple[float, float, float]) -> Mesh:
        if kind is None:
            return Box(type="box", size_m=size_m).build_mesh().assign_material("car_paint")
        mesh = self._meshes[kind]
        return mesh._replace(vertices_m=mesh.vertices_m * (np.array(size_m) / self._sizes_m[kind]))


@guard_reader("a file of boxes")
def read_box_actors(path: Path) -> tuple[Actor, ...]:
    """Read recorded boxes as actors; see `read_box_tracks`."""
    tracks, bodies = read_box_tracks(path), BodyLibrary()
    for track in tracks:
        try:
            check_gaps(track.trajectory.times_s)
        except ValueError as error:
            raise ValueError(f"id {track.name}: {error}") from error
    return tuple(Actor(track.name, *bodies.get_category_and_mesh(track), track.trajectory) for track in tracks)
