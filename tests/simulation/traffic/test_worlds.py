"""Generated scenes: positions of road users, ground contact and reproducibility."""

from dataclasses import replace

import numpy as np
import pytest

from torchcover.simulation.patches import find_outward_faces
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic import HighwayTraffic, ParkingTraffic, UrbanTraffic, urban

WORLDS = ["urban", "narrow", "highway", "parking"]


def compute_leader_distance(world):
    """Compute distances (T,) to the nearest vehicle ahead of the ego vehicle, center to center; inf without one."""
    ego = world.ego.trajectory
    yaw = np.deg2rad(ego.angles_deg[:, 0])
    nearest = np.full(len(yaw), np.inf)
    for actor in world.actors:
        x, y, _ = (actor.trajectory.interpolate_positions_m(ego.times_s) - ego.positions_m).T
        ahead, left = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
        on_way = (ahead > 0) & (np.abs(left) < 1.5) & (actor.category != "pedestrian")
        nearest = np.where(on_way, np.minimum(nearest, ahead), nearest)
    return nearest


def compute_speeds(actor):
    steps = np.linalg.norm(np.diff(actor.trajectory.positions_m, axis=0), axis=1)
    return steps / np.diff(actor.trajectory.times_s)


@pytest.mark.parametrize("kind", WORLDS)
def test_scenes_depend_on_the_seed_alone(kind, bodies):
    model = {"urban": UrbanTraffic, "highway": HighwayTraffic, "parking": ParkingTraffic}.get(kind, UrbanTraffic)
    options = {"num_lanes": 2} if kind == "narrow" else {}
    first, again = (model(duration_s=3.0, **options).build_scene(seed, bodies=bodies) for seed in (5, 5))
    other = model(duration_s=3.0, **options).build_scene(6, bodies=bodies)
    for one, two in zip(first.static_meshes, again.static_meshes, strict=True):
        np.testing.assert_array_equal(one.vertices_m, two.vertices_m)
        np.testing.assert_array_equal(one.faces, two.faces)
    for one, two in zip([first.ego, *first.actors], [again.ego, *again.actors], strict=True):
        assert (one.name, one.category) == (two.name, two.category)
        np.testing.assert_array_equal(one.trajectory.positions_m, two.trajectory.positions_m)
        np.testing.assert_array_equal(one.trajectory.angles_deg, two.trajectory.angles_deg)
    assert not np.array_equal(first.ego.trajectory.positions_m, other.ego.trajectory.positions_m)


@pytest.mark.parametrize("kind", WORLDS)
def test_scenes_are_complete(kind, world):
    w = world(kind, 0)
    names = [actor.name for actor in w.actors] + [w.ego.name]
    assert len(set(names)) == len(names)
    assert len({id(actor.mesh) for actor in w.actors}) == len({actor.name.split()[0] for actor in w.actors})
    for actor in [w.ego, *w.actors]:
        # Actors on a cross street may appear or disappear at its end.
        assert actor.trajectory.is_transient or actor.trajectory.times_s[0] == 0.0
        assert actor.trajectory.is_transient or actor.trajectory.times_s[-1] == pytest.approx(w.duration_s)
        np.testing.assert_allclose(np.diff(actor.trajectory.times_s), w.time_step_s)
        # Actors do not jump.
        assert compute_speeds(actor).max() < 40.0
    assert sum(len(mesh.faces) for mesh in w.static_meshes) < 90_000
    assert {actor.category for actor in w.actors} >= {"car"}


@pytest.mark.parametrize("kind", WORLDS)
def test_ego_stays_on_the_road_with_small_tilt(kind, world):
    ego = world(kind, 0).ego.trajectory
    assert (ego.positions_m[:, 2] == 0.0).all()
    _, pitch, roll = ego.angles_deg.T
    assert 0.1 < np.abs(pitch).max() < 2.0
    assert 0.1 < np.abs(roll).max() < 1.5
    # Standing vehicles are excluded because they may stay on one bump.
    assert (
        abs(pitch[np.gradient(ego.positions_m[:, 0]) ** 2 + np.gradient(ego.positions_m[:, 1]) ** 2 > 0.01].mean())
        < 0.1
    )
    assert np.abs(np.diff(ego.angles_deg[:, 1:], axis=0)).max() < 0.4


@pytest.mark.parametrize(("kind", "known"), [("straight", 4), ("winding", 4), ("parking", 3)])
def test_stored_outward_faces_match_computed_ones(kind, known, world):
    static = [mesh for mesh in world(kind, 0).static_meshes if mesh.is_outward is not None]
    assert len(static) == known  # the ground, sidewalks, houses and small objects
    for mesh in static:
        np.testing.assert_array_equal(mesh.is_outward, find_outward_faces(mesh._replace(is_outward=None)))


@pytest.mark.parametrize("kind", [*WORLDS, "hilly", "motorway"])
def test_rays_always_hit_the_ground(kind, world):
    w = world(kind, 0)
    generator = np.random.default_rng(0)
    for time_s in (0.0, w.duration_s / 2, w.duration_s):
        pose = w.ego.trajectory.interpolate(time_s)
        yaw = np.arctan2(pose[1, 0], pose[0, 0])
        ahead, left = generator.uniform(-60.0, 160.0, 50_000), generator.uniform(-40.0, 40.0, 50_000)
        offset = np.stack([np.cos(yaw) * ahead - np.sin(yaw) * left, np.sin(yaw) * ahead + np.cos(yaw) * left])
        origin = np.array([0.0, 0.0, 100.0])
        to_ground = np.concatenate([offset, np.full((1, 50_000), -100.0)])
        directions = (to_ground / np.linalg.norm(to_ground, axis=0)).astype(np.float32)
        static = [Mesh(mesh.vertices_m - pose[:3, 3], mesh.faces) for mesh in w.static_meshes]
        limit = np.full(50_000, 1000.0, dtype=np.float32)
        hits = RayCaster(static).cast(origin, directions, limit)
        assert (hits.body_indices >= 0).all()
        # The ground alone has no holes below objects.
        on_ground = RayCaster(static[:1]).cast(origin, directions, limit)
        assert (on_ground.body_indices == 0).all()
        if kind in WORLDS:
            assert (100.0 + hits.range_m * directions[2]).min() > -0.01
            np.testing.assert_allclose(on_ground.range_m * directions[2], -100.0, atol=0.01)


@pytest.mark.parametrize("kind", WORLDS)
def test_actors_stand_on_the_ground(kind, world):
    w = world(kind, 0)
    on_pavement = np.array([0.0, 0.15])
    for actor in w.actors:
        z = actor.trajectory.positions_m[:, 2]
        if actor.category != "pedestrian":
            assert (z == 0.0).all()
        assert z.min() >= 0.0
        assert z.max() <= 0.15 + 1e-12
        # Except for steps at curbs, feet are on the road or on the sidewalk.
        assert (np.abs(z[:, None] - on_pavement).min(axis=1) < 1e-9).mean() > 0.8


def test_cities_drive_on_the_right(world):
    w = world("straight", 0)
    kerb = float(np.abs(w.static_meshes[1].vertices_m[:, 1]).min())
    middles = find_junction_gaps(w)
    for actor in w.actors:
        x, y, z = actor.trajectory.positions_m.T
        side = x[0] - middles[np.abs(middles - x[0]).argmin()]
        heading = np.round(actor.trajectory.angles_deg[0, 0]) % 360
        if actor.category == "pedestrian":
            # Pedestrians are on the carriageway of the main street only at crossings.
            on_road = np.abs(y) < kerb - 0.5
            assert (z[on_road] == 0.0).all()
            assert not on_road.any() or abs(side) < 12.0 or not middles[0] < x[0] < middles[-1]
        elif heading in (0.0, 180.0):
            assert (np.abs(y) < kerb).all()
            assert ((y < 0) if heading == 0.0 else (y > 0)).all()
        elif middles[0] - 8.0 < x[0] < middles[-1] + 8.0:
            assert 0.0 < (side if heading == 90.0 else -side) < 8.0


def find_junction_gaps(world):
    """Find the x bounds of the gaps between blocks."""
    edges = np.unique(np.round(world.static_meshes[1].vertices_m[:, 0], 6))
    return (edges[1:-1:2] + edges[2::2]) / 2


@pytest.mark.parametrize(("kind", "seed"), [("urban", 0), ("urban", 1), ("urban", 2), ("narrow", 0), ("highway", 0)])
def test_ego_usually_follows_a_vehicle(kind, seed, world):
    distance = compute_leader_distance(world(kind, seed))
    assert (distance < (80.0 if kind == "highway" else 40.0)).mean() >= 0.6
    assert distance.min() > 4.0


def test_city_traffic_stops_at_signals(world):
    share = [np.mean(compute_speeds(actor) < 0.1) for actor in world("urban", 0).actors if actor.category == "car"]
    assert 0.1 < np.mean(share) < 0.7


def compute_motion(actor):
    """Compute speeds, forward and lateral accelerations, and the slip angles in degrees (T,)."""
    own, step = actor.trajectory, 0.1
    velocity = np.gradient(own.positions_m[:, :2], step, axis=0)
    forward, left = np.gradient(velocity, step, axis=0)[3:-3].T, velocity[3:-3].T
    speed = np.hypot(*left)
    ahead, aside = (forward * left).sum(axis=0) / speed, (left[0] * forward[1] - left[1] * forward[0]) / speed
    yaw = np.deg2rad(own.angles_deg[3:-3, 0]) - np.arctan2(left[1], left[0])
    return speed, ahead, aside, np.rad2deg(np.arctan2(np.sin(yaw), np.cos(yaw)))


def test_motorway_speeds_and_directions(world):
    w = world("highway", 0)
    for actor in [w.ego, *w.actors]:
        speed, ahead, aside, off = compute_motion(actor)
        assert speed.min() > 15.0
        # Trucks have speed limiters at 90 km/h.
        assert speed.max() < (25.0 if actor.category == "truck" else 42.0)
        assert ahead.min() > -3.0
        assert np.abs(aside).max() < 2.5
        # Tolerance for the sides of curves and for the frame interval.
        assert np.abs(off).max() < 0.5
    assert sum(actor.category == "truck" for actor in w.actors) > 5
    assert sum(np.ptp(compute_motion(actor)[1]) > 0.2 for actor in w.actors) > len(w.actors) / 2
    forward = np.cos(np.deg2rad(np.array([actor.trajectory.angles_deg[0, 0] for actor in w.actors])))
    assert (np.abs(forward) > 0.9).all()
    assert (forward > 0).sum() > 20
    assert (forward < 0).sum() > 20


def test_people_cross_aisles_and_cars_are_slow(world):
    w = world("parking", 0)
    people = [actor for actor in w.actors if actor.category == "pedestrian"]
    assert sum(np.ptp(actor.trajectory.positions_m[:, 1]) > 5.0 for actor in people) > 4
    assert compute_speeds(w.ego).max() < 4.0
    assert compute_speeds(w.ego).min() > 1.0


def test_roadside_objects_surround_a_parking_lot(bodies):
    full, bare = (
        ParkingTraffic(duration_s=1.0, **keys).build_scene(0, bodies=bodies)
        for keys in ({}, {"built_share": 0, "roadside_density": 0})
    )
    *same, houses, others = full.static_meshes
    assert len(bare.static_meshes) == len(same)
    places_m = np.concatenate([houses.vertices_m, others.vertices_m])[:, :2]
    # Crowns extend over the edge by less than half of their width.
    least_m = np.abs(places_m / np.array([62.0, 36.0])).max(axis=1)[places_m[:, 1] > 0.0].min()
    assert 0.95 < least_m < 1.05
    sides = [(places_m[:, axis] * sign > 40.0).any() for axis in (0, 1) for sign in (1, -1)]
    assert all(sides)


@pytest.mark.parametrize(
    ("model", "options"),
    [
        (UrbanTraffic, {"traffic_per_km": 0, "cyclists_per_km": 0, "people_per_km": 0, "parked_share": 0}),
        (UrbanTraffic, {"traffic_per_km": 120, "parked_share": 1}),
        (UrbanTraffic, {"time_step_s": 0.5, "duration_s": 0.2}),
        (HighwayTraffic, {"traffic_per_km": 0, "ego_lane": 1}),
        (HighwayTraffic, {"traffic_per_km": 200, "ego_lane": 3, "time_step_s": 1.5}),
        (ParkingTraffic, {"num_moving_cars": 0, "crossings_per_aisle": 0, "parked_share": 0}),
        (ParkingTraffic, {"num_moving_cars": 6, "crossings_per_aisle": 8, "parked_share": 1}),
    ],
)
def test_extreme_parameters_build_scenes(model, options, bodies):
    w = model(**{"duration_s": 4.0, **options}).build_scene(0, bodies=bodies)
    assert w.static_meshes
    assert w.ego.trajectory.is_moving


@pytest.mark.parametrize(
    ("model", "options"),
    [
        (UrbanTraffic, {"num_lanes": 3}),
        (UrbanTraffic, {"parked_share": 1.5}),
        (UrbanTraffic, {"cross_traffic_share": 1.5}),
        (UrbanTraffic, {"traffic_per_km": -1}),
        (HighwayTraffic, {"ego_lane": 4}),
        (HighwayTraffic, {"duration_s": 0}),
        (HighwayTraffic, {"hill_height_std_m": 11}),
        (ParkingTraffic, {"speed_mps": 20}),
    ],
)
def test_impossible_parameters_are_rejected(model, options):
    with pytest.raises(ValueError, match=f"{model.__name__}: {next(iter(options))}: .* is needed; got"):
        model(**options)


def test_missing_bodies_are_named(bodies):
    few = {kind: mesh for kind, mesh in bodies.items() if kind not in ("bus", "adult")}
    with pytest.raises(ValueError, match="no body for adult, bus"):
        UrbanTraffic().build_scene(0, bodies=few)


def test_ego_can_have_its_own_mesh(bodies):
    w = UrbanTraffic(duration_s=2.0).build_scene(0, ego_mesh=bodies["bus"], bodies=bodies)
    assert w.ego.mesh is bodies["bus"]


def test_irrelevant_agents_change_nothing(monkeypatch, bodies):
    few = UrbanTraffic(duration_s=8.0).build_scene(3, bodies=bodies)
    monkeypatch.setattr(urban, "select_relevant_agents", lambda lanes, agents, duration_s: agents)
    monkeypatch.setattr(urban, "find_nearby_agents", lambda lanes, agents, place_m: np.arange(len(agents)))
    everybody = UrbanTraffic(duration_s=8.0).build_scene(3, bodies=bodies)
    assert [actor.name for actor in few.actors] == [actor.name for actor in everybody.actors]
    for one, other in zip((few.ego, *few.actors), (everybody.ego, *everybody.actors), strict=True):
        np.testing.assert_array_equal(one.trajectory.positions_m, other.trajectory.positions_m)
        np.testing.assert_array_equal(one.trajectory.angles_deg, other.trajectory.angles_deg)


def test_actors_stay_on_the_built_street(monkeypatch, bodies):
    # A distant part of the street may come near again.
    small = replace(urban.PARAMS, behind_m=30.0, ahead_m=60.0, corridor_margin_m=20.0)
    monkeypatch.setattr(urban, "PARAMS", small)
    city = UrbanTraffic(max_bend_deg=0.5, turn_share=0.0, duration_s=4.0, time_step_s=0.5).build_scene(0, bodies=bodies)
    first_m, last_m = city.ego.trajectory.positions_m[[0, -1], 0]
    along = [actor for actor in city.actors if abs(np.sin(np.deg2rad(actor.trajectory.angles_deg[0, 0]))) < 0.1]
    x_m = np.concatenate([actor.trajectory.positions_m[:, 0] for actor in along])
    assert len(x_m) > 20
    assert first_m - 51.0 < x_m.min()
    assert x_m.max() < last_m + 81.0


def test_cross_traffic_share_scales_cross_streets(bodies):
    def across(share):
        city = UrbanTraffic(
            max_bend_deg=0.0, turn_share=0.0, cross_traffic_share=share, duration_s=2.0, time_step_s=0.5
        )
        drivers = [actor for actor in city.build_scene(0, bodies=bodies).actors if actor.category != "pedestrian"]
        return sum(abs(np.sin(np.deg2rad(actor.trajectory.angles_deg[0, 0]))) > 0.9 for actor in drivers)

    assert across(0.0) == 0
    assert 5 < across(0.5) < across(1.0)
