"""Bodies for recorded boxes, the ground below recorded tracks, and the sides of streets around them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from torchcover.files import guard_reader
from torchcover.geometry import BoundingBox, fit_height_field
from torchcover.geometry.arrays import Bools, Float64
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
from torchcover.simulation.scene import Actor
from torchcover.simulation.shapes import Box, Mesh
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.fleet import CATEGORIES, VehicleType, load_bodies
from torchcover.simulation.traffic.frontage import StreetSide, find_street_sides


@dataclass(frozen=True)
class RecordedStreetParams:
    """Assumed geometry of streets around recorded tracks.

    Args:
        curb_distance_m: Distance from the center of a track to the curb.
        max_gap_m: The area between tracks that are closer than this is street, too.
        sidewalk_m: Width of the sidewalk.
        clearance_m: Smallest distance of scenery from the outline of a road user.
        position_noise_m: Noise of labeled positions.
    """

    curb_distance_m: float = 5.0
    max_gap_m: float = 12.0
    sidewalk_m: float = 3.0
    clearance_m: float = 0.5
    position_noise_m: float = 0.3


def fit_ground(positions_m: Float64, ego_positions_m: Float64) -> FlatGround | GroundHeightField:
    """Fit the ground around the path of the ego vehicle to the positions of road users.

    Args:
        positions_m: (N, 3) positions of other road users, some of which may be outliers.
        ego_positions_m: (T, 3) positions of the ego vehicle, which are trusted.

    Returns:
        The ground; flat if all positions have the same height.
    """
    max_body_m = 25.0  # cells beyond the horizon are built up to the length of a body, so that the edge is not visible
    margin_m = HORIZON_M + MARGIN_M
    lower_m, upper_m = ego_positions_m[:, :2].min(axis=0) - margin_m, ego_positions_m[:, :2].max(axis=0) + margin_m
    positions_m = np.concatenate([ego_positions_m, positions_m])
    is_trusted = np.arange(len(positions_m)) < len(ego_positions_m)
    base_m = float(ego_positions_m[0, 2])
    if (positions_m[:, 2] == base_m).all():
        return FlatGround(base_m, lower_m, upper_m)
    # Relative to the first corner in float64, because positions may be UTM coordinates.
    is_inside = ((positions_m[:, :2] > lower_m) & (positions_m[:, :2] < upper_m)).all(axis=1)
    relative_positions_m, heights_m = positions_m[is_inside, :2] - lower_m, positions_m[is_inside, 2] - base_m
    rows, columns = count_corners(lower_m, upper_m)
    cell_sizes_m = [CELL_M * factor for factor in (16.0, 8.0, 4.0, 2.0, 1.0)]
    field = fit_height_field(
        relative_positions_m, heights_m, upper_m - lower_m, cell_sizes_m, trusted_mask=is_trusted[is_inside]
    )
    corners_m: Float64 = CELL_M * np.indices((rows, columns))[::-1].reshape(2, -1).T.astype(np.float64)
    corner_heights_m = base_m + field.compute_heights_m(corners_m).reshape(rows, columns)
    path_m = ego_positions_m[:, :2] if len(ego_positions_m) > 1 else np.repeat(ego_positions_m[:, :2], 2, axis=0)
    path = shapely.LineString(path_m - lower_m).simplify(0.5)
    shapely.prepare(path)
    centers = shapely.points(compute_cell_centers_m(np.zeros(2), rows, columns))
    is_visible = shapely.dwithin(centers, path, HORIZON_M + max_body_m)
    return GroundHeightField(lower_m, corner_heights_m, is_visible.reshape(rows - 1, columns - 1))


def thin_stationary_positions(positions_m: Float64, min_distance_m: float = 1.0) -> Float64:
    """Thin successive positions, so that a road user at rest counts once however long it was recorded.

    Args:
        positions_m: (K, 3) successive positions.
        min_distance_m: Length of path over which positions are averaged.

    Returns:
        (N, 3) means.
    """
    steps_m = np.linalg.norm(np.diff(positions_m[:, :2], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    group = np.cumsum(np.diff(path_m // min_distance_m, prepend=0.0) > 0)
    counts = np.bincount(group)
    sums_m = [np.bincount(group, axis) for axis in (positions_m - positions_m[0]).T]
    return np.asarray(positions_m[0] + np.stack(sums_m, axis=1) / counts[:, None])


def collect_ground_positions(position_tracks: Sequence[Float64]) -> Float64:
    """Collect the thinned positions of tracks.

    Args:
        position_tracks: (K, 3) successive positions of each track.

    Returns:
        (N, 3) positions.
    """
    thinned_m = [thin_stationary_positions(positions_m) for positions_m in position_tracks]
    return np.concatenate([np.empty((0, 3)), *thinned_m])


def apply_ground_tilt(actor: Actor, ground: FlatGround | GroundHeightField) -> Actor:
    """Tilt an actor with the ground below its wheels, unless its pitch or roll was recorded; people stay upright.

    Args:
        actor: The actor.
        ground: The ground.

    Returns:
        The tilted actor.
    """
    trajectory = actor.trajectory
    if isinstance(ground, FlatGround) or actor.category == "pedestrian" or trajectory.angles_deg[:, 1:].any():
        return actor
    wheelbase_share = 0.6  # distance between wheels as a share of the body, in length and width
    length, width, _ = np.ptp(actor.mesh.vertices_m, axis=0)
    angles_deg, yaw_rad = trajectory.angles_deg.copy(), np.deg2rad(trajectory.angles_deg[:, 0])
    forward = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    left = forward @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    positions_m = trajectory.positions_m[:, :2]
    # Positive pitch lowers the front, positive roll raises the left side.
    for column, direction, distance_m, sign in (
        (1, forward, wheelbase_share * length, -1),
        (2, left, wheelbase_share * width, 1),
    ):
        front_m = ground.compute_heights_m(positions_m + distance_m / 2 * direction)
        rear_m = ground.compute_heights_m(positions_m - distance_m / 2 * direction)
        angles_deg[:, column] = sign * np.rad2deg(np.arctan((front_m - rear_m) / distance_m))
    return replace(actor, trajectory=replace(trajectory, angles_deg=angles_deg))


def find_visible_sides(
    ego: Actor,
    actors: Sequence[Actor],
    built_share: float,
    generator: np.random.Generator,
    params: RecordedStreetParams = RecordedStreetParams(),
) -> tuple[list[StreetSide], list[shapely.Geometry], list[shapely.Geometry]]:
    """Find the visible sides of the streets along recorded tracks.

    Args:
        ego: The ego vehicle.
        actors: Other road users.
        built_share: Share of the sides with houses.
        generator: Source of the random numbers.
        params: Geometry of streets.

    Returns:
        Sides of streets; areas without objects at curbs; areas without objects behind sidewalks.
    """
    road_users = (ego, *actors)
    paths, radii_m, driven_paths = [], [], []
    for road_user in road_users:
        path_m = road_user.trajectory.positions_m[:, :2]
        path = shapely.LineString(np.concatenate([path_m, path_m[-1:]])).simplify(params.position_noise_m)
        paths.append(path)
        radii_m.append(np.linalg.norm(np.ptp(road_user.mesh.vertices_m[:, :2], axis=0)) / 2 + params.clearance_m)
        is_driven = road_user.category != "pedestrian" and path.length > params.clearance_m
        if road_user is ego or is_driven:
            driven_paths.append(path)
    occupied_areas = shapely.buffer(paths, radii_m, quad_segs=4)
    street = shapely.union_all(shapely.buffer(driven_paths, params.curb_distance_m))
    street = street.buffer(params.max_gap_m / 2).buffer(-params.max_gap_m / 2)
    visible_area = paths[0].buffer(HORIZON_M)

    def is_visible(positions_m: Float64) -> Bools:
        return np.asarray(shapely.contains_xy(visible_area, *positions_m.T))

    sides = find_street_sides(street, (0.0, params.sidewalk_m), is_visible, built_share, generator)
    sidewalk = street.buffer(params.sidewalk_m - params.position_noise_m)
    return sides, [street, *occupied_areas], [sidewalk, *occupied_areas]


class BodyLibrary:
    """Built-in bodies, scaled to recorded boxes; boxes of one size share one mesh.

    Args:
        max_scale: Largest factor, or its inverse, by which a body is scaled; beyond, the box itself is the body. The
            boxes of people include their stride and arms, which the bodies do not.
        default_height_m: Height of objects without a recorded height and without a body.
    """

    def __init__(self, max_scale: float = 4.0, default_height_m: float = 1.5) -> None:
        self._max_scale, self._default_height_m = max_scale, default_height_m
        # The box of a recorded truck includes its trailer.
        self._meshes = {**load_bodies(), "truck": Vehicle.load("truck").build_mesh()}
        self._sizes_m: dict[str, Float64] = {}
        self._lengths_m: dict[str, float] = {}
        for body, mesh in self._meshes.items():
            self._sizes_m[body] = np.array(BoundingBox.from_points(mesh.vertices_m).size_m)
            self._lengths_m[body] = float(self._sizes_m[body][0])
        self._scaled_meshes: dict[tuple[str | None, tuple[float, float, float]], Mesh] = {}

    def get_category_and_mesh(self, track: Track) -> tuple[str, Mesh]:
        """Get the category and the mesh of a track.

        Args:
            track: The track; an unknown height is NaN.

        Returns:
            Category and mesh: the body of its class whose length is nearest, scaled to the box, or the box.
        """
        body = None
        if track.vehicle_class:
            body = VehicleType(track.vehicle_class, track.size_m[0]).find_body(self._lengths_m)
        length, width, height = track.size_m
        if body and math.isnan(height):
            height = float(self._sizes_m[body][2])
        if body:
            scale = np.array([length, width, height]) / self._sizes_m[body]
            if scale.max() > self._max_scale or scale.min() < 1 / self._max_scale:
                body = None
        size_m = (length, width, self._default_height_m if math.isnan(height) else height)
        if (body, size_m) not in self._scaled_meshes:
            self._scaled_meshes[body, size_m] = self._build_scaled_mesh(body, size_m)
        return CATEGORIES[body] if body else track.category.lower(), self._scaled_meshes[body, size_m]

    def _build_scaled_mesh(self, body: str | None, size_m: tuple[float, float, float]) -> Mesh:
        """Build a mesh of a size; a box without a body."""
        if body is None:
            return Box(type="box", size_m=size_m).build_mesh().assign_material("car_paint")
        mesh = self._meshes[body]
        return mesh._replace(vertices_m=mesh.vertices_m * (np.array(size_m) / self._sizes_m[body]))


@guard_reader("a file of boxes")
def read_box_actors(path: Path) -> tuple[Actor, ...]:
    """Read recorded boxes as actors; see `read_box_tracks`.

    Args:
        path: File of boxes.

    Returns:
        The actors.

    Raises:
        BadFileError: The file is invalid, or a track has a gap.
    """
    bodies, actors = BodyLibrary(), []
    for track in read_box_tracks(path):
        try:
            check_gaps(track.trajectory.times_s)
        except ValueError as error:
            raise ValueError(f"id {track.name}: {error}") from error
        actors.append(Actor(track.name, *bodies.get_category_and_mesh(track), track.trajectory))
    return tuple(actors)
