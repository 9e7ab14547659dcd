"""Scenes from given networks and floating car data."""

import numpy as np
import pytest
import shapely

from tests.simulation.traffic.test_separation import iterate_pieces
from torchcover import Scenario
from torchcover.simulation.sumo import SumoTraffic
from torchcover.simulation.traffic.fleet import REAR_OF
from torchcover.simulation.traffic.kind import ProceduralTraffic

from .towns import DRIVE, WALK, drive, edge, fcd, street, together, vehicle, write_net

UTM = (512_345.0, 5_405_678.0)


def make_traffic(folder, *edges, steps=None, **options):
    net = write_net(folder / "a.net.xml", *(edges or (street(),)))
    (folder / "fcd.xml").write_text(fcd(steps or together(drive())))
    options = {"duration_s": 4.0, **options}
    return SumoTraffic(net=net, fcd=folder / "fcd.xml", **options)


def test_ego_follows_its_track(tmp_path):
    world = make_traffic(tmp_path, ego_id="ego").build_scene(0)
    assert world.num_time_steps == 41
    positions_m = world.ego.trajectory.positions_m
    np.testing.assert_allclose(np.diff(positions_m[:, 0]), 1.0, atol=1e-9)
    np.testing.assert_array_equal(positions_m[:, 1:], 0.0)
    # The origin has whole meters: the front is at 50 m on the street, the center of a car of 5 m is behind it.
    assert positions_m[0, 0] == pytest.approx(0.5)


def test_utm_coordinates_change_nothing(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    worlds = []
    for folder, shift in ((here, (0.0, 0.0)), (there, UTM)):
        folder.mkdir()
        steps = together(drive(shift=shift), drive("b", y=3.0, start=70.0, shift=shift))
        worlds.append(make_traffic(folder, street(z=(0.0, 8.0), shift=shift), steps=steps, ego_id="ego").build_scene(3))
    for one, other in zip(worlds[0].static_meshes, worlds[1].static_meshes, strict=True):
        np.testing.assert_allclose(one.vertices_m, other.vertices_m, atol=1e-6)
    for one, other in zip((worlds[0].ego, *worlds[0].actors), (worlds[1].ego, *worlds[1].actors), strict=True):
        np.testing.assert_allclose(one.trajectory.positions_m, other.trajectory.positions_m, atol=1e-6)


def test_actors_exist_only_while_present_and_near(tmp_path):
    late = {t: row for t, row in drive("late", y=3.0).items() if 1.0 <= t <= 2.0}
    world = make_traffic(tmp_path, steps=together(drive(), late, drive("far", y=260.0)), ego_id="ego").build_scene(0)
    (actor,) = world.actors
    assert (actor.category, actor.trajectory.is_transient) == ("car", True)
    there = np.isfinite(actor.trajectory.interpolate_positions_m(np.array([0.8, 1.0, 2.0, 2.2]))[:, 0])
    assert there.tolist() == [False, True, True, False]


def test_types_get_bodies_by_class_and_length(tmp_path):
    kinds = {"bus": 1, "truck": 2, "bicycle": 3, "motorcycle": 4, "pedestrian": 5, "passenger": 6, "rail": 7}
    rows = [drive()] + [drive(f"{kind}", y=5.0 * k, type=kind) for kind, k in kinds.items()]
    routes = tmp_path / "r.xml"
    routes.write_text('<routes><vType id="passenger" length="6.2"/><vType id="truck" vClass="trailer"/></routes>')
    world = make_traffic(tmp_path, steps=together(*rows), ego_id="ego", routes=(routes,)).build_scene(0)
    words = [actor.name.removeprefix(REAR_OF).split() for actor in world.actors]
    assert {name: kind.partition("_")[0] for kind, name, _ in words} == {
        "bus": "bus", "truck": "truck", "bicycle": "cyclist", "motorcycle": "motorcycle", "pedestrian": "adult",
        "passenger": "van",
    }  # fmt: skip


def test_overlapping_road_users_are_omitted_with_a_count(tmp_path):
    pair = drive("one", start=90.0), drive("other", start=92.0)
    steps = together(drive(), drive("ghost", start=52.0), *pair, drive("free", start=120.0))
    with pytest.warns(UserWarning, match=r"^2 of 4 road users .* overlap others or curbs.* \('ghost', 'other'\)"):
        world = make_traffic(tmp_path, steps=steps, ego_id="ego").build_scene(0)
    assert [actor.name.split()[1] for actor in world.actors] == ["one", "free"]
    assert world.num_omitted_road_users == 2


def test_people_walk_along_streets_without_sidewalks(tmp_path):
    bare = edge("east", (DRIVE, 3.5, [(0.0, 0.0, 0.0), (400.0, 0.0, 0.0)]))
    walker = drive("walker", speed=1.0, start=60.0, y=3.0, tag="person")
    rider = drive("rider", tag="person")  # at the position of the ego vehicle: a passenger
    world = make_traffic(tmp_path, bare, steps=together(drive(), walker, rider), ego_id="ego").build_scene(0)
    (person,) = world.actors
    assert person.category == "pedestrian"
    np.testing.assert_allclose(np.ptp(person.trajectory.positions_m, axis=0), [4.0, 0.0, 0.0], atol=1e-9)


def test_too_long_vehicles_get_the_longest_body(tmp_path):
    (tmp_path / "r.xml").write_text('<routes><vType id="train" vClass="truck" length="900"/></routes>')
    steps = together(drive(), drive("long", start=320.0, y=9.0, type="train"))
    edges = street(), street("north", y=9.0)
    world = make_traffic(tmp_path, *edges, steps=steps, ego_id="ego", routes=(tmp_path / "r.xml",)).build_scene(0)
    assert [actor.name for actor in world.actors] in ([], ["truck long 0", "rear of truck long 0"])
    assert all(np.ptp(actor.mesh.vertices_m[:, 0]) < 14.0 for actor in world.actors)


def test_vehicles_too_wide_for_a_lane_are_omitted(tmp_path):
    kerbs = [(WALK, 2.0, [(0.0, y, 0.0), (400.0, y, 0.0)]) for y in (-2.1, 2.1)]
    lane = edge("east", kerbs[0], (DRIVE, 2.2, [(0.0, 0.0, 0.0), (400.0, 0.0, 0.0)]), kerbs[1])
    steps = together(drive(), drive("bus", start=90.0, type="bus"), drive("cyclist", start=120.0, type="bicycle"))
    with pytest.warns(UserWarning, match=r"^1 of 2 road users .* \('bus'\)"):
        world = make_traffic(tmp_path, lane, steps=steps, ego_id="ego").build_scene(0)
    assert [actor.category for actor in world.actors] == ["cyclist"]


def test_people_step_down_from_sidewalks(tmp_path):
    walks = {
        t: vehicle("p", 60.0, -3.0 + 0.5 * t, 0.0, tag="person") for t in (round(0.2 * k, 1) for k in range(31))
    }  # fmt: skip
    world = make_traffic(
        tmp_path, steps=together(drive(until=6.0, y=9.0), walks), ego_id="ego", duration_s=6.0
    ).build_scene(0)
    height_m = world.actors[0].trajectory.positions_m[:, 2]
    assert height_m[0] == pytest.approx(0.15)
    assert height_m[-1] == pytest.approx(0.0)
    assert (np.diff(height_m) <= 1e-12).all()
    assert np.abs(np.diff(height_m)).max() < 0.08


def test_bodies_on_bridges_stand_on_decks(tmp_path):
    over = edge("over", ("", 7.0, [(100, -150, 0), (100, -60, 6), (100, 60, 6), (100, 150, 0)]))
    above = {t: vehicle("up", 100.0, -20 + 10 * t, 0.0, z=6.0) for t in drive()}
    world = make_traffic(
        tmp_path, street(), over, steps=together(drive(start=100.0, z=0.0), above), ego_id="ego"
    ).build_scene(0)
    np.testing.assert_allclose(world.actors[0].trajectory.positions_m[:, 2], 6.0, atol=0.15)
    np.testing.assert_allclose(world.ego.trajectory.positions_m[:, 2], 0.0, atol=0.1)


@pytest.mark.parametrize("z", [(0.0, 0.0), (0.0, 12.0)])
def test_houses_keep_off_streets_and_each_other(z, tmp_path):
    # At right angles, so that the sides of each street overlap the other one and its sides.
    north = edge("north", ("", 3.5, [(100, -200, z[1] / 4), (100, 200, z[1] / 4)]))
    world = make_traffic(tmp_path, street(z=z), north, built_share=1.0, ego_id="ego").build_scene(0)
    ground, _, houses, _ = world.static_meshes
    outlines_m = find_corners(houses)
    polygons = shapely.polygons(outlines_m)
    assert len(polygons) > 25
    assert all(polygon.exterior.is_ccw for polygon in polygons)
    # The origin is 47 m along the street.
    taken = [shapely.box(-47.0, -3.75, 353.0, 1.75), shapely.box(51.25, -200.0, 54.75, 200.0)]
    assert min(shapely.distance(polygons, piece).min() for piece in taken) > 0.4
    one, other = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    assert (one == other).all()
    middles_m = outlines_m.mean(axis=1)
    east = np.abs(middles_m[:, 0] - 53.0) > 40.0
    assert {-1.0, 1.0} == set(np.sign(middles_m[east, 1]))  # on both sides, also of a one-way street
    heights_m = houses.vertices_m[:, 2].reshape(-1, 8)
    assert heights_m[:, 4:].min() - ground.vertices_m[:, 2].min() > 4.9


def test_roadside_objects_keep_off_streets_and_houses(tmp_path):
    north = edge("north", ("", 3.5, [(100, -200, 0), (100, 200, 0)]))
    world = make_traffic(tmp_path, street(), north, built_share=0.3, ego_id="ego").build_scene(0)
    houses, others = world.static_meshes[2:]
    standing = [shapely.Polygon(outline) for outline, low_m, _ in iterate_pieces(others) if low_m < 0.1]
    assert len(standing) > 100
    around = shapely.STRtree(standing)
    streets = [shapely.box(-47.0, -3.75, 353.0, 1.75), shapely.box(51.25, -200.0, 54.75, 200.0)]
    assert len(around.query([*streets, *shapely.polygons(find_corners(houses))], predicate="intersects")[0]) == 0


def find_corners(houses):
    return houses.vertices_m.reshape(-1, 8, 3)[:, :4, :2]


def test_only_narrow_gaps_between_carriageways_are_medians(tmp_path):
    for gap, found in ((2.0, 1), (8.0, 0)):
        folder = tmp_path / str(gap)
        folder.mkdir()
        ways = [edge(name, ("", 3.5, [(0, y, 0), (400, y, 0)])) for name, y in (("a", 0.0), ("b", 3.5 + gap))]
        world = make_traffic(folder, *ways, built_share=0.0, ego_id="ego").build_scene(0)
        raised = [mesh for mesh in world.static_meshes[1:] if np.ptp(mesh.vertices_m[:, 2]) < 0.5]
        assert len(raised) == found
        if raised:
            top_m = raised[0].vertices_m[raised[0].vertices_m[:, 2] > 0.1]
            assert shapely.MultiPoint(top_m[:, :2]).convex_hull.area == pytest.approx(400.0 * gap, rel=1e-2)
            assert (raised[0].vertices_m[:, 1] > 1.7).all()
            assert top_m[:, 2] == pytest.approx(0.15)


def test_open_country_has_no_houses(tmp_path):
    world = make_traffic(tmp_path, built_share=0.0, ego_id="ego").build_scene(0)
    assert len(world.static_meshes) == 3
    assert world.static_meshes[2].vertices_m[:, 2].max() < 12.0
    assert (
        len(make_traffic(tmp_path, built_share=0.0, roadside_density=0.0, ego_id="ego").build_scene(0).static_meshes)
        == 2
    )


def test_cars_park_only_in_bays(tmp_path):
    line = [(0, 4), (400, 4)]
    bays = edge("bays", ('type="parking" disallow="all"', 2.3, line))
    far = [edge(name, (who, 2.3, line)) for name, who in (("s", 'disallow="all"'), ("d", ""))]
    parked = make_traffic(tmp_path, street(), bays, ego_id="ego", parked_share=1.0).build_scene(0).static_actors
    assert 40 < len(parked) < 80
    places_m = np.array([actor.trajectory.positions_m[0] for actor in parked])
    np.testing.assert_allclose(places_m[:, 1], 4.0)
    assert np.diff(np.sort(places_m[:, 0])).min() > 4.0
    assert not make_traffic(tmp_path, street(), bays, ego_id="ego", parked_share=0.0).build_scene(0).static_actors
    assert not make_traffic(tmp_path, street(), *far, ego_id="ego", parked_share=1.0).build_scene(0).static_actors


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ego_id": "nobody"}, "ego_id: no vehicle 'nobody' up to t = 4 s, where the data end"),
        ({"ego_id": "ego", "duration_s": 9.0}, r"ego_id: 'ego' is not present from t = 0 to 9 s"),
        (
            {"ego_id": "ego", "steps": together({t: row for t, row in drive().items() if not 1.1 < t < 2.1})},
            r"it leaves the network, teleports or has a gap after t = 1 s; shorten duration_s to 1",
        ),
        (
            {
                "ego_id": "ego",
                "steps": {t: [row.replace('y="0.0"', f'y="{90.0 * (t > 2)}"')] for t, row in drive().items()},
            },
            r"teleports or has a gap after t = 2 s",
        ),
        ({"duration_s": 9.0}, r"no car for the ego vehicle .* the longest of . drives for 4 s \(data end at t = 4 s\)"),
        ({"ego_type": "bus"}, "no vehicle of type 'bus' for the ego vehicle"),
        ({"begin_s": 3.0}, "no car for the ego vehicle"),
        (
            {"ego_id": "ego", "begin_s": 2.0, "duration_s": 2.0, "steps": together(drive(start=335.0, speed=30.0))},
            r"the ego vehicle is farther than 10 m from all streets of the network at t = 2\.6 s: it leaves them",
        ),
        ({"ego_id": "ego", "steps": together(drive(y=9000.0))}, "farther than 10 m from all streets .* t = 0 s"),
    ],
)
def test_missing_ego_is_explained(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        make_traffic(tmp_path, **options).build_scene(0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"type": "sumo"}, "give a net and its routes, a net and its fcd, or random"),
        ({"type": "sumo", "net": "a.net.xml"}, "give a net and its routes"),
        ({"type": "sumo", "random": {}, "ego_id": "a"}, "random samples all traffic; leave out ego_id"),
        (
            {"type": "sumo", "net": "a.net.xml", "random": {"max_lanes_per_direction": 1}},
            "random: max_lanes_per_direction only apply to sampled streets",
        ),
        ({"type": "sumo", "random": {"layout": "star"}}, "'rand', 'grid' or 'spider'"),
        ({"type": "somo"}, "type: traffic is one of 'urban', 'highway', 'parking', 'sumo', 'tracks'; got 'somo'"),
        ({}, "type: traffic is one of"),
    ],
)
def test_contradictory_settings_are_rejected(content, message):
    with pytest.raises(ValueError, match=message):
        Scenario.model_validate({"name": "s", "traffic": content})


def test_files_are_relative_to_the_document(tmp_path):
    make_traffic(tmp_path)
    document = tmp_path / "s.yaml"
    document.write_text("name: s\ntraffic: {type: sumo, net: a.net.xml, fcd: fcd.xml, duration_s: 4.0}")
    traffic = Scenario.load(document).traffic
    assert isinstance(traffic, ProceduralTraffic)
    before = traffic.collect_content()
    assert traffic.build_scene(0).actors == ()
    (tmp_path / "fcd.xml").write_text(fcd(together(drive(), drive("b"))))
    assert traffic.collect_content() != before
