"""Floating car data: conventions of SUMO, gaps, windows and rejected files."""

import numpy as np
import pytest

from torchcover.files import BadFileError
from torchcover.simulation.sumo.floating import TimeWindow, parse_floating_car_data, read_floating_car_data
from torchcover.simulation.sumo.motion import RoadUser, compute_motions

from .towns import drive, fcd, together, vehicle

ALL = TimeWindow(-np.inf, 100.0)


def parse_steps(steps, window=ALL):
    return parse_floating_car_data([fcd(steps).encode()], window)


@pytest.mark.parametrize(
    ("angle", "yaw", "ahead"), [(90, 0, (1, 0)), (0, 90, (0, 1)), (270, 180, (-1, 0)), (180, -90, (0, -1))]
)
def test_positions_are_fronts_and_angles_run_from_north(angle, yaw, ahead):
    row = vehicle("a", 10.0, 20.0, angle, z=3.0)
    track = parse_steps({0.0: [row], 1.0: [row]}).tracks[0]
    assert (track.yaw_deg[0] - yaw) % 360 == 0
    (body,) = compute_motions([RoadUser(track, "van", 6.0, ((5.0, 2.0),))], 1.0, np.zeros(2))
    np.testing.assert_allclose(body.poses[0, :2], np.array([10.0, 20.0]) - 3.0 * np.array(ahead), atol=1e-12)
    assert track.front_positions_m[0, 2] == 3.0


def test_gaps_and_jumps_split_tracks():
    steady, gone, jumps = drive("s"), drive("g"), drive("j")
    for time_s in (1.0, 1.2):
        del gone[time_s]
    jumps = {t: row if t < 2.0 else row.replace('y="0.0"', 'y="300.0"') for t, row in jumps.items()}
    found = parse_steps(together(steady, gone, jumps))
    spans = {
        name: [(round(t.times_s[0], 6), round(t.times_s[-1], 6)) for t in found.tracks if t.name == name]
        for name in "sgj"
    }
    assert spans == {"s": [(0.0, 4.0)], "g": [(0.0, 0.8), (1.4, 4.0)], "j": [(0.0, 1.8), (2.0, 4.0)]}
    assert [track.is_present_for(4.0) for track in found.tracks if track.name == "s"] == [True]


def test_window_starts_with_ego_and_reads_no_further():
    steps = together(drive("a"), {t: row for t, row in drive("ego").items() if t >= 1.0})
    assert parse_steps(steps, TimeWindow(0.5, 1.0)).begin_s == 0.6
    found = parse_steps(steps, TimeWindow(0.5, 1.0, "ego"))
    assert found.begin_s == 1.0
    assert all(len(track.times_s) == 6 for track in found.tracks)

    def iterate_chunks():
        text = fcd(steps)
        for start in range(0, len(text), 100):
            yield text[start : start + 100].encode()
        raise AssertionError("asked for more than the window needs")

    assert parse_floating_car_data(iterate_chunks(), TimeWindow(0.0, 1.0)).last_time_s == 1.0


def test_window_waits_for_the_vehicle_not_its_type():
    rows = {t: row.replace('type="car"', 'type="ego"') for t, row in drive("a").items()}
    steps = together(rows, {t: row for t, row in drive("ego").items() if t >= 1.0})
    assert parse_steps(steps, TimeWindow(-np.inf, 1.0, "ego")).begin_s == 1.0


def test_passengers_are_inside_vehicles():
    walk = {t: vehicle("p", 40.0, -3.0, tag="person") for t in (0.0, 0.2, 0.4)}
    ride = {t: vehicle("p", 50.0 + 10.0 * t, 0.0, tag="person") for t in drive() if 0.4 < t < 2.0}
    on = {t: vehicle("p", 70.0, -3.0, tag="person") for t in drive() if t >= 2.0}
    only = {t: vehicle("q", 50.0 + 10.0 * t, 0.0, tag="person") for t in drive()}
    found = [track for track in parse_steps(together(drive(), walk | ride | on, only)).tracks if track.is_pedestrian]
    spans = [(track.name, round(track.times_s[0], 6), round(track.times_s[-1], 6)) for track in found]
    assert spans == [("p", 0.0, 0.4), ("p", 2.0, 4.0)]


def test_rows_can_have_different_attributes():
    steps = {0.0: [vehicle("a", 0, 0, z=1.0, slope=2.0), vehicle("b", 5, 0, z=2.0)], 0.2: [vehicle("b", 5, 0)]}
    assert {track.name: track.front_positions_m[0, 2] for track in parse_steps(steps).tracks} == {"a": 1.0, "b": 2.0}


def build_geo_rows(**more):
    """Build rows of a vehicle that drives north, with longitude and latitude as SUMO writes them."""
    places = {t: ("8.402076", f"{49.00011 + 1.3e-5 * t / 0.1:.6f}") for t in (0.0, 0.2, 0.4, 0.6)}
    return {t: [vehicle("a", *place, angle="0.00", **more)] for t, place in places.items()}


def test_standing_vehicles_near_the_origin_are_accepted():
    there = [vehicle("a", "8.402076", "49.000110", angle="0.00", speed=0.0)]
    (track,) = parse_steps({0.0: there, 0.2: there}).tracks
    assert track.front_positions_m[0].tolist() == [8.402076, 49.00011, 0.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (fcd({0.0: [vehicle("a", 0, 0, angle=None)]}), "t = 0 s: a vehicle or person without angle; id, x, y"),
        (fcd({0.0: [], 0.2: [], 0.1: []}), r"must ascend; 0.1 s follows 0.2 s"),
        (fcd({0.0: [vehicle("a", 0, 0)], 0.2: [vehicle("a", 0, 0), vehicle("a", 9, 9)]}), "'a' appears twice at t = "),
        (fcd({0.0: [vehicle("a", "nan", 0)]}), "1 of 1 positions are NaN or infinite"),
        (fcd({0.0: [vehicle("a", "east", 0)]}), "east"),
        (
            fcd(build_geo_rows(speed=13.9)),
            r"x and y are degrees .* such as 8.40208, 49.0001; .* without --fcd-output.geo",
        ),
        (fcd(build_geo_rows()), "without --fcd-output.geo"),
        ("<fcd-export/>", "at least one <timestep>"),
        ("<fcd-export><timestep time='0'>", "not XML"),
        ("<!DOCTYPE a [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><a>&e;</a>", "without entities"),
    ],
)
def test_invalid_floating_car_data_are_rejected(text, message, tmp_path):
    path = tmp_path / "fcd.xml"
    path.write_text(text)
    with pytest.raises(BadFileError, match=f"fcd.xml: .*{message}"):
        read_floating_car_data(path, ALL)
