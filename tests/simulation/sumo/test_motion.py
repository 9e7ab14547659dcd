"""Motion of bodies along their tracks."""

import numpy as np
import pytest
import shapely

from torchcover.simulation.sumo.crowd import drop_colliding_users
from torchcover.simulation.sumo.floating import SumoTrack
from torchcover.simulation.sumo.ground import Sidewalks, build_ground
from torchcover.simulation.sumo.motion import PARAMS, RoadUser, compute_motions
from torchcover.simulation.sumo.network import read_network
from torchcover.simulation.sumo.paths import compute_rectangle_corners_m
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.trailers import HITCHES, compute_tractrix_yaw_rad

from .towns import DRIVE, WALK, edge, write_net

ORIGIN = np.zeros(2)


def make_user(places_m, *, step_s=0.2, begin_s=0.0, kind="sedan", size_m=(5.0, 2.0), on_foot=False, yaw_deg=0.0):
    places_m = np.asarray(places_m, dtype=np.float64)
    times_s, zeros = begin_s + step_s * np.arange(len(places_m)), np.zeros(len(places_m))
    track = SumoTrack(
        kind, kind, on_foot, times_s, np.column_stack([places_m, zeros]), np.full(len(places_m), yaw_deg), zeros
    )
    return RoadUser(track, kind, size_m[0], (size_m,))


def make_straight_path(speed_mps=10.0, seconds=10.0, x_m=0.0, y_m=0.0, step_s=0.2):
    times_s = np.arange(0.0, seconds + 1e-9, step_s)
    return np.column_stack([x_m + speed_mps * times_s, np.full(len(times_s), y_m)])


def compute_speeds(motion):
    return np.linalg.norm(np.diff(motion.poses[:, :2], axis=0), axis=1) / np.diff(motion.times_s)


def compute_accelerations(motion):
    return np.linalg.norm(np.diff(motion.poses[:, :2], 2, axis=0), axis=1) / np.diff(motion.times_s)[1:] ** 2


def make_turn(radius_m, speed_mps=5.0, begin_m=(0.0, 0.0), lead_in_m=30.0):
    """Compute positions of a path to the east, a quarter turn to the left, and to the north."""
    s = np.arange(0.0, 2 * lead_in_m + radius_m * np.pi / 2, 0.2 * speed_mps)
    bend = ((s - lead_in_m) / radius_m).clip(0.0, np.pi / 2)
    more = s - lead_in_m - radius_m * bend
    x = radius_m * np.sin(bend) + np.where(more < 0, more, 0.0)
    y = radius_m * (1 - np.cos(bend)) + np.where(more > 0, more, 0.0)
    return np.column_stack([x, y]) + begin_m


def test_straight_tracks_are_kept_and_lengths_respected():
    (motion,) = compute_motions([make_user(make_straight_path())], 10.0, ORIGIN)
    np.testing.assert_allclose(motion.poses[:, 0], 10.0 * motion.times_s - 2.5, atol=1e-9)
    np.testing.assert_allclose(motion.poses[:, 1:], 0.0, atol=1e-12)


def test_corners_and_lane_changes_are_smooth():
    corner = np.concatenate([make_straight_path(4.0, 6.0), [[24.0, 0.8 * k] for k in range(1, 30)]])
    (motion,) = compute_motions([make_user(corner)], 11.8, ORIGIN)
    assert compute_accelerations(motion).max() < 6.0
    assert compute_speeds(motion).max() < 4.01
    heading = np.arctan2(*np.diff(motion.poses[:, :2], axis=0).T[::-1])
    # The center is ahead of the rear axle and therefore slips sideways.
    assert np.abs(motion.poses[1:, 2] - heading).max() < 0.6
    drift = make_straight_path(10.0, 8.0)
    drift[:, 1] = (1.1 * (drift[:, 0] / 10.0 - 2.0)).clip(0.0, 3.3)
    (motion,) = compute_motions([make_user(drift)], 8.0, ORIGIN)
    assert compute_accelerations(motion).max() < 2.0


def test_motions_do_not_depend_on_other_users():
    bodies = [
        make_user(make_turn(8.0)),
        make_user(make_straight_path(3.0, 2.0), begin_s=4.0),
        make_user(make_straight_path(1.0, 9.0), on_foot=True),
    ]
    together = compute_motions(bodies, 14.0, ORIGIN)
    for body, motion in zip(bodies, together, strict=True):
        (alone,) = compute_motions([body], 14.0, ORIGIN)
        np.testing.assert_array_equal(alone.times_s, motion.times_s)
        np.testing.assert_allclose(alone.poses, motion.poses, atol=1e-9)
    assert together[1].times_s[[0, -1]] == pytest.approx([4.0, 6.0])


@pytest.mark.parametrize(("jump_m", "back"), [(1.5, 1.0), (1.5, -1.0), (8.0, 1.0)])
def test_jumps_of_people_are_walked(jump_m, back):
    places_m = make_straight_path(1.2, 30.0)
    places_m[75:, 1] += 0.6 * jump_m
    places_m[75:, 0] += 0.8 * jump_m * back
    (motion,) = compute_motions([make_user(places_m, on_foot=True, kind="adult", size_m=(0.3, 0.5))], 30.0, ORIGIN)
    assert compute_speeds(motion).max() < 1.2 + PARAMS.jump_extra_mps + 1e-6
    assert motion.is_plausible
    np.testing.assert_allclose(motion.poses[[0, -1], :2], places_m[[0, -1]], atol=1e-6)


def test_too_fast_pedestrians_are_not_plausible():
    (motion,) = compute_motions([make_user(make_straight_path(9.0, 10.0), on_foot=True)], 10.0, ORIGIN)
    assert not motion.is_plausible


def test_the_user_with_more_overlaps_is_dropped():
    rows = [
        make_user(make_straight_path(y_m=20.0)),
        *(make_user(make_straight_path(x_m=4.0 * k)) for k in range(3)),
        make_user(make_straight_path(y_m=2.2)),
    ]
    bodies = compute_motions(rows, 10.0, ORIGIN)
    assert [body.poses[0].round(1).tolist() for body in drop_colliding_users(bodies)] == [
        bodies[k].poses[0].round(1).tolist() for k in (0, 1, 3, 4)
    ]
    rest = compute_motions([make_user(np.tile([[x, 20.5]], (51, 1))) for x in (30.0, 50.0)], 10.0, ORIGIN)
    assert drop_colliding_users([bodies[0], *rest]) == [bodies[0]]
    (later,) = compute_motions([make_user(make_straight_path(0.1, 2.0, x_m=50.0, y_m=20.5), begin_s=7.0)], 10.0, ORIGIN)
    assert drop_colliding_users([bodies[0], later]) == [bodies[0], later]


def test_users_on_bridges_do_not_collide_below():
    below, above = (
        make_user(make_straight_path()),
        make_user(np.column_stack([np.full(51, 50.0), make_straight_path(x_m=-50.0)[:, 0]]), yaw_deg=90.0),
    )
    lifted = above._replace(
        track=above.track._replace(front_positions_m=above.track.front_positions_m + np.array([0.0, 0.0, 6.0]))
    )
    assert [len(drop_colliding_users(compute_motions([below, other], 10.0, ORIGIN))) for other in (above, lifted)] == [
        1,
        2,
    ]


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """Build sidewalks inside and outside of a turn between two streets of 7 m width."""
    ways = [
        edge("in", (WALK, 2.0, [(-90, -1, 0), (13, -1, 0)]), (DRIVE, 7.0, [(-90, 3.5, 0), (13, 3.5, 0)])),
        edge("out", (WALK, 2.0, [(14, 0, 0), (14, 90, 0)]), (DRIVE, 7.0, [(9.5, 0, 0), (9.5, 90, 0)])),
        edge("inner", (WALK, 6.0, [(3, 7, 0), (3, 90, 0)])),
    ]
    net = write_net(tmp_path_factory.mktemp("corner") / "a.net.xml", *ways)
    near = Vicinity(read_network(net), np.array([[0.0, 0.0], [10.0, 0.0]]), ORIGIN)
    return Sidewalks(near, build_ground(near)).polygons


def test_long_vehicles_swing_out_around_curbs(corner):
    bus = make_user(make_turn(5.0, 3.0, (3.5, 4.5)), size_m=(9.0, 2.4))
    (cuts,), (swings,) = (compute_motions([bus], 22.0, ORIGIN, kerbs) for kerbs in (None, corner))
    over = [
        shapely.intersection(
            shapely.polygons(compute_rectangle_corners_m(m.poses, np.tile(bus.part_sizes_m[0], (len(m.poses), 1)))),
            shapely.union_all(corner),
        )
        for m in (cuts, swings)
    ]
    assert shapely.area(over[0]).max() > 1.0
    assert shapely.area(over[1]).max() == 0.0
    assert swings.curb_overlap_m == 0.0
    assert compute_accelerations(swings).max() < 3.5


def make_semi_trailer(places_m):
    return make_user(places_m, kind="truck")._replace(length_m=16.5, part_sizes_m=((6.65, 2.55), (13.6, 2.55)))


def test_trailers_follow_kingpins_and_collide(corner):
    truck = make_semi_trailer(make_turn(14.0, 5.0, lead_in_m=40.0))
    (motion,) = compute_motions([truck], 20.0, ORIGIN)
    (front, _), (rear, size_m) = motion.parts
    assert rear[0] == pytest.approx([*(front[0, :2] - [6.375, 0.0]), 0.0], abs=1e-9)
    assert [front[0, 0] + 6.65 / 2, rear[0, 0] - 13.6 / 2] == pytest.approx([-40.0, -56.5])
    hitches_m = HITCHES["truck"].compute_hitch_positions_m(front)[:, None]
    np.testing.assert_allclose(
        compute_tractrix_yaw_rad(hitches_m, np.array([8.41]), np.zeros(1))[:, 0], rear[:, 2], atol=1e-12
    )
    # Only the trailer passes over the position of the pedestrian.
    where = len(rear) // 2
    inside_m = rear[where, :2] + (size_m[1] / 2 - 0.2) * np.array([-np.sin(rear[where, 2]), np.cos(rear[where, 2])])
    alone = motion._replace(
        road_user=truck._replace(kind="van", part_sizes_m=truck.part_sizes_m[:1]), trailer_poses=None
    )
    (rests,) = compute_motions([make_user(np.tile(inside_m, (101, 1)), on_foot=True, size_m=(0.3, 0.5))], 20.0, ORIGIN)
    (far,) = compute_motions([make_user(make_straight_path(0.1, 20.0, y_m=-50.0))], 20.0, ORIGIN)
    assert drop_colliding_users([far, motion]) == [far, motion]
    assert drop_colliding_users([motion, rests]) == [motion]
    assert drop_colliding_users([alone, rests]) == [alone, rests]
    wide = compute_motions([make_semi_trailer(make_turn(5.0, 3.0, (3.5, 4.5)))], 22.0, ORIGIN, corner)[0]
    assert not wide.is_plausible


def test_straight_paths_next_to_curbs_are_checked(corner):
    off, on = (
        compute_motions([make_user(make_straight_path(x_m=-80.0, y_m=y))], 8.0, ORIGIN, corner)[0] for y in (3.5, 0.4)
    )
    assert off.curb_overlap_m == 0.0
    assert off.poses[:, 1] == pytest.approx(3.5)
    assert on.curb_overlap_m == 0.0
    assert on.poses[5:, 1].min() > 1.0


def test_vehicles_that_cannot_turn_are_dropped(corner):
    (lorry,) = compute_motions([make_user(make_turn(5.0, 5.0, (3.5, 4.5)), size_m=(16.5, 2.55))], 15.0, ORIGIN, corner)
    assert lorry.curb_overlap_m > 0.05
    assert not lorry.is_plausible
    assert drop_colliding_users([lorry]) == [lorry]  # the first is the ego vehicle
    (walker,) = compute_motions([make_user(make_turn(5.0, 1.4), on_foot=True)], 40.0, ORIGIN, corner)
    assert walker.is_plausible


def test_people_walk_around_carriageways_along_edges():
    walked = shapely.Polygon([(0, 0), (20, 0), (20, 20), (16, 20), (16, 4), (0, 4)])
    way_m = np.concatenate(
        [make_straight_path(1.3, 10.0, y_m=3.0)[:20], [[5.2 + 0.2 * k, 3.0 + 0.26 * k] for k in range(61)]]
    )
    across = make_user(way_m, on_foot=True, kind="adult", size_m=(0.3, 0.5))
    inside = make_user(make_straight_path(1.3, 8.0, x_m=1.0, y_m=2.0), on_foot=True, kind="adult", size_m=(0.3, 0.5))
    free, led, same = (compute_motions([who], 16.0, ORIGIN, None, area)[0] for who, area in
                       ((across, None), (across, walked), (inside, walked)))  # fmt: skip
    on = [shapely.contains_xy(walked, *motion.poses[:, :2].T) for motion in (free, led)]
    assert on[0].mean() < 0.5
    assert on[1].mean() > 0.9
    assert shapely.distance(shapely.points(led.poses[:, :2]), walked).max() < 0.5
    assert led.is_plausible
    np.testing.assert_array_equal(same.poses, compute_motions([inside], 16.0, ORIGIN)[0].poses)
