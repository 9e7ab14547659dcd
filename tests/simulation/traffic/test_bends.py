"""Streets with bends, turns and slopes: alignments, scenery and traffic along them."""

import numpy as np
import pytest
import shapely
import trimesh

from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.traffic import UrbanTraffic
from torchcover.simulation.traffic.alignment import Alignment, OffsetPath, StreetCorridor
from torchcover.simulation.traffic.city import CityBuilder
from torchcover.simulation.traffic.fleet import Fleet, load_bodies
from torchcover.simulation.traffic.flow import SPEED_LIMIT_SPACING_M
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.main_street import MainStreetParams, sample_main_street
from torchcover.simulation.traffic.scenery import build_slab
from torchcover.simulation.traffic.streets import STREETS, CrossSection, sample_street_plan

RADIUS_M, REACH_M = 20.0, 1500.0
STATIONS_M = np.arange(-300.0, 1200.0, 0.37)


def sample_street(seed, bend_deg=30.0, turn_share=0.5):
    generator = np.random.default_rng(seed)
    junctions = np.cumsum(generator.uniform(80, 130, 14)) - 250.0
    return sample_main_street(junctions, np.full(14, 5.0), bend_deg, turn_share, RADIUS_M, REACH_M, generator)


@pytest.fixture(scope="module", params=[0, 1, 2])
def street(request):
    return sample_street(request.param).alignment


def test_straight_alignments_change_nothing():
    x, y = STATIONS_M, np.linspace(-50.0, 50.0, len(STATIONS_M))
    poses = Alignment([0.0], [0.0]).compute_poses(x, y)
    np.testing.assert_array_equal(poses, np.stack([x, y, np.zeros_like(x)], axis=1))


def test_constant_curvature_is_a_circle():
    # Between its short transitions; the center lies to the left.
    arc = Alignment([0.0, 1e-3, 60.0, 60.001], [0.0, 1 / RADIUS_M, 1 / RADIUS_M, 0.0])
    places = arc.compute_poses(np.linspace(0.1, 59.0, 50), 3.0)[:, :2]
    np.testing.assert_allclose(np.linalg.norm(places - [5e-4, RADIUS_M], axis=1), RADIUS_M - 3.0, atol=1e-6)


def test_alignment_length_and_heading_match_its_positions(street):
    # Derivatives by central differences.
    step = 1e-3
    before, after = (street.compute_poses(STATIONS_M + shift, 0.0) for shift in (-step, step))
    moved = (after - before)[:, :2] / (2 * step)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1.0, atol=1e-8)
    heading = street.compute_headings_rad(STATIONS_M)
    np.testing.assert_allclose(moved, np.stack([np.cos(heading), np.sin(heading)], axis=1), atol=1e-6)
    curvature = (street.compute_headings_rad(STATIONS_M + step) - street.compute_headings_rad(STATIONS_M - step)) / (
        2 * step
    )
    np.testing.assert_allclose(curvature, street.compute_curvatures_per_m(STATIONS_M), atol=1e-5)
    assert np.allclose(street.compute_poses(0.0, 0.0), 0.0, atol=1e-9)


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("left_m", [-12.0, 9.0])
def test_offset_paths_have_exact_arc_lengths(street, left_m, way):
    line = OffsetPath(street, left_m, way, REACH_M)
    places = np.arange(REACH_M - 700.0, REACH_M + 700.0, 0.05)
    poses = line.compute_poses(places)
    steps = np.diff(poses[:, :2], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.05, rtol=2e-4)
    turned = np.deg2rad((poses[:-1, 2] + poses[1:, 2]) / 2)
    ahead = steps[:, 0] * np.cos(turned) + steps[:, 1] * np.sin(turned)
    assert ahead.min() > 0.0499
    np.testing.assert_allclose(
        line.convert_stations_to_distances_m(line.convert_distances_to_stations_m(places)), places, atol=0.02
    )
    there = street.compute_poses(line.convert_distances_to_stations_m(places), left_m)[:, :2]
    np.testing.assert_allclose(poses[:, :2], there, atol=0.02)


@pytest.mark.parametrize("seed", range(8))
def test_main_streets_keep_limits_and_distance(seed):
    found = sample_street(seed)
    assert found.turn_directions.any()
    assert not found.turn_directions[[0, -1]].any()
    assert (np.abs(np.cumsum(found.turn_directions)) <= 1).all()
    curvature = np.abs(found.alignment.compute_curvatures_per_m(STATIONS_M))
    assert curvature.max() <= 1 / RADIUS_M + 1e-9
    junctions = np.cumsum(np.random.default_rng(seed).uniform(80, 130, 14)) - 250.0
    in_turn = (
        np.abs(STATIONS_M[:, None] - junctions[found.turn_directions != 0])
        < found.junction_half_lengths_m[found.turn_directions != 0]
    ).any(axis=1)
    assert curvature[~in_turn].max() <= 1 / MainStreetParams.min_radius_m + 1e-9
    # Junctions without a turn lie on straights, with their crossings.
    for middle, half in zip(
        junctions[found.turn_directions == 0], found.junction_half_lengths_m[found.turn_directions == 0], strict=True
    ):
        assert not found.alignment.compute_curvatures_per_m(middle + np.linspace(-half - 7.0, half + 7.0, 9)).any()
    places = found.alignment.compute_poses(np.arange(-REACH_M, REACH_M, 20.0), 0.0)[:, :2]
    away = np.linalg.norm(places[:, None] - places, axis=2)
    far = np.abs(np.subtract.outer(np.arange(len(places)), np.arange(len(places)))) * 20.0 > MainStreetParams.neighbor_m
    assert away[far].min() >= MainStreetParams.min_clearance_m


def test_main_street_without_bends_is_straight():
    assert sample_street(0, bend_deg=0.0, turn_share=0.0).alignment.is_straight


def test_corridors_do_not_overlap(street):
    # Each position belongs to the nearest stretch only.
    territory = StreetCorridor(street, (-400.0, 1300.0))
    station, left = np.meshgrid(np.arange(-200.0, 1100.0, 9.0), [-80.0, -40.0, 40.0, 80.0])
    station, left = station.ravel(), left.ravel()
    owned = territory.is_inside(station, left)
    assert owned.any()
    assert not owned.all()
    places = street.compute_poses(station, left)[:, :2]
    fine = street.compute_poses(np.arange(-400.0, 1300.0, 0.5), 0.0)[:, :2]
    nearest = np.array([np.linalg.norm(fine - place, axis=1).min() for place in places])
    assert (nearest[owned] > np.abs(left[owned]) - 1.5).all()
    assert (nearest[~owned] < np.abs(left[~owned])).all()


def test_speed_limits_are_comfortable_and_reached_gently():
    section = CrossSection(2, 3.4)
    generator, shapes = np.random.default_rng(3), np.random.default_rng(4)
    streets = sample_street_plan(section, 25.0, 0.5, (-120.0, 900.0), 1400.0, generator, shapes)
    assert streets.main_street.turn_directions.any()
    lane = streets.build_traffic_lanes()[0]
    places = SPEED_LIMIT_SPACING_M * np.arange(len(lane.speed_limits_mps))
    yaw = np.unwrap(np.deg2rad(lane.centerline.compute_poses(places)[:, 2]))
    across = np.abs(np.gradient(yaw, places)) * lane.speed_limits_mps**2
    in_curves = (
        lane.centerline.street.compute_curvatures_per_m(lane.centerline.convert_distances_to_stations_m(places)) != 0.0
    )
    assert across[in_curves & (lane.speed_limits_mps < 15.0)].max() < 1.1 * STREETS.lateral_mps2
    assert lane.speed_limits_mps.min() < 8.0
    braking = -np.diff(lane.speed_limits_mps**2) / (2 * SPEED_LIMIT_SPACING_M)
    assert braking.max() < 1.001 * STREETS.braking_mps2
    # A bus does not touch the bus on the next lane.
    inner = section.min_turn_radius_m - (section.lanes_per_direction - 0.5) * section.lane_width_m
    corner = np.hypot(inner + 2.55 / 2, 6.0)
    assert corner < inner + section.lane_width_m - 2.55 / 2


def test_hill_slopes_and_mesh_match_their_heights():
    hills = Hills(1.5, np.random.default_rng(1))
    places = np.random.default_rng(2).uniform(-200, 200, (500, 2))
    yaw_deg = np.linspace(0, 360, 500)
    height, pitch, roll = hills.compute_heights_and_tilts(places, yaw_deg).T
    np.testing.assert_allclose(height, hills.compute_heights_m(places), atol=1e-5)
    yaw = np.deg2rad(yaw_deg)
    ahead = 0.5 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    left = 0.5 * np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    for way, angle in ((ahead, -pitch), (left, roll)):
        rise = hills.compute_heights_m(places + way) - hills.compute_heights_m(places - way)
        np.testing.assert_allclose(np.rad2deg(np.arctan(rise)), angle, atol=0.02)
    way_m = np.stack([np.linspace(-200, 200, 11), np.zeros(11)], axis=1)
    mesh = hills.build_mesh(way_m, 250.0)
    down = np.tile(np.array([[0.0], [0.0], [-1.0]], dtype=np.float32), 500)
    starts = np.column_stack([places, np.full(500, 50.0)]).astype(np.float32)
    hits = RayCaster([mesh]).cast_from_each(starts, down, np.full(500, 100.0, dtype=np.float32))
    np.testing.assert_allclose(50.0 - hits.range_m, height, atol=0.03)
    assert np.diff(np.unique(mesh.vertices_m[:, 0])).min() == 10.0


def test_motorway_grades_are_limited():
    hills = Hills(100.0, np.random.default_rng(1), (1000.0, 2500.0), 0.04)
    places = np.random.default_rng(2).uniform(-5000, 5000, (20_000, 2))
    _, pitch, _ = hills.compute_heights_and_tilts(places, np.linspace(0, 360, 20_000)).T
    assert np.deg2rad(np.abs(pitch).max()) == pytest.approx(0.04, rel=0.2)
    assert np.deg2rad(np.abs(pitch).max()) <= 0.04
    assert np.ptp(hills.compute_heights_m(places)) > 10.0


def test_slab_over_a_bent_grid_is_closed():
    x, y = np.meshgrid(np.linspace(0, 30, 7), np.linspace(0, 8, 3), indexing="ij")
    net = Alignment([0.0, 5.0, 25.0, 30.0], [0.0, 0.04, 0.04, 0.0]).compute_poses(x, y)[..., :2]
    mesh = build_slab(net, (0.0, 0.15))
    solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    assert solid.is_volume
    assert solid.volume == pytest.approx(0.15 * (30 * 8 - 0.04 * 25 * 8**2 / 2), rel=0.01)


@pytest.mark.parametrize("built_share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_sidewalks_leave_no_narrow_gaps(seed, built_share):
    generator, shapes = np.random.default_rng(seed), np.random.default_rng(seed)
    seen_m, span_m = (-120.0, 700.0), (-440.0, 1020.0)
    streets = sample_street_plan(CrossSection(2), 25.0, 0.5, span_m, 1200.0, generator, shapes)
    densities = built_share, 0.0, 0.0  # houses, parked cars and roadside objects
    territory, level, fleet = (
        StreetCorridor(streets.main_alignment, span_m),
        Hills(0.0, shapes),
        Fleet(load_bodies(), None, generator),
    )
    city = CityBuilder(streets, territory, level, fleet, *densities, generator, shapes)
    _, pavement, *_ = city.build_static_scenery(seen_m)[0]
    triangles_m = pavement.vertices_m[pavement.faces]
    up = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])[:, 2] > 1e-6
    paved = shapely.union_all(shapely.polygons(triangles_m[up][..., :2])).buffer(0.02)
    lines = [(streets.main_alignment, np.arange(*span_m, 2.0), streets.cross_section.curb_offset_m)]
    for street, lanes in zip(streets.cross_streets, streets.cross_lanes_per_direction, strict=True):
        lines.append(
            (street, np.arange(-150.0, 150.0, 2.0), lanes * streets.cross_section.lane_width_m + STREETS.gutter_m)
        )
    driven = shapely.union_all([
        shapely.LineString(street.compute_poses(along_m, 0.0)[:, :2]).buffer(half_m, cap_style="flat", quad_segs=32)
        for street, along_m, half_m in lines
    ])  # fmt: skip
    assert (
        streets.main_street.turn_directions[
            (streets.junction_stations_m > seen_m[0]) & (streets.junction_stations_m < seen_m[1])
        ]
        != 0
    ).any()
    known = paved.union(driven.buffer(0.3))
    along_m, left_m = np.meshgrid(np.arange(*seen_m), streets.cross_section.curb_offset_m + np.array([0.5, 1.5, 2.8]))
    for side in (1, -1):
        assert shapely.contains_xy(
            known, streets.main_alignment.compute_poses(along_m, side * left_m)[..., :2].reshape(-1, 2)
        ).all()
    # Also along the streets that cross the main street.
    for (street, _, half_m), station_m, turn in zip(
        lines[1:], streets.junction_stations_m, streets.main_street.turn_directions, strict=True
    ):
        if not turn and seen_m[0] < station_m < seen_m[1]:
            away_m, left_m = np.meshgrid(
                streets.cross_section.curb_offset_m + np.arange(0.5, 17.0), half_m + np.array([0.5, 2.8])
            )
            for way, side in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                places_m = street.compute_poses(way * away_m, side * left_m)[..., :2]
                assert shapely.contains_xy(known, places_m.reshape(-1, 2)).all()
    between = paved.buffer(9.0, join_style="mitre").buffer(-9.0, join_style="mitre").difference(known)
    assert between.buffer(-1.5).is_empty


@pytest.mark.parametrize("kind", ["hilly", "motorway"])
def test_scenery_on_hills_is_closed_and_grounded(kind, world):
    w = world(kind, 0)
    for mesh in w.static_meshes[1:]:
        assert trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).is_volume
    ground = RayCaster(w.static_meshes[:1])

    def height(places):
        starts = np.column_stack([places, np.full(len(places), 90.0)]).astype(np.float32)
        down = np.tile(np.array([[0.0], [0.0], [-1.0]], dtype=np.float32), len(places))
        hits = ground.cast_from_each(starts, down, np.full(len(places), 200.0, dtype=np.float32))
        assert (hits.body_indices >= 0).all()
        return 90.0 - hits.range_m

    for actor in (w.ego, *w.actors, *w.static_actors):
        positions = actor.trajectory.positions_m[::20]
        near = np.linalg.norm(positions[:, :2] - w.ego.trajectory.positions_m[0, :2], axis=1) < 200.0
        above = positions[near, 2] - height(positions[near, :2])
        assert (above > -0.05).all()
        assert (above < (0.2 if actor.category == "pedestrian" else 0.05)).all()
        # The wheels stand on the ground.
        if actor.category in ("car", "bus"):
            angles = np.deg2rad(actor.trajectory.angles_deg[::20][near])
            front = positions[near] + 1.4 * np.column_stack(
                [np.cos(angles[:, 0]), np.sin(angles[:, 0]), -np.sin(angles[:, 1])]
            )
            assert np.abs(front[:, 2] - height(front[:, :2])).max(initial=0.0) < (0.12 if actor is w.ego else 0.06)


def test_city_without_bends_is_straight(world):
    w = world("straight", 0)
    assert np.ptp(w.ego.trajectory.positions_m[:, 1:]) == -w.ego.trajectory.positions_m[0, 1]
    assert not any(actor.trajectory.is_transient for actor in w.actors)


def test_ego_turns_at_junctions(world):
    assert max(np.ptp(world("winding", seed).ego.trajectory.angles_deg[:, 0]) for seed in (0, 1)) > 60.0
    assert np.ptp(world("straight", 0).ego.trajectory.angles_deg[:, 0]) == 0.0


def test_open_country_has_no_houses():
    w = UrbanTraffic(duration_s=2.0, built_share=0.0, hill_height_std_m=0.0).build_scene(1)
    assert len(w.static_meshes) == 3
    assert max(mesh.vertices_m[:, 2].max() for mesh in w.static_meshes) < 12.0
