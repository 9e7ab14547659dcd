"""Trailers and encounters from very slow to very fast motion."""

from functools import lru_cache, partial

import mpmath
import numpy as np

from tests.targets.scenes import EGO, FLOOR, build_lidar
from torchcover.encounters import Criterion, Encounter, StagedEncounter, detect_encounter
from torchcover.encounters.detection import MountedRig
from torchcover.encounters.encounter import EncounterPath
from torchcover.encounters.staging import compute_path_poses
from torchcover.simulation import Rig, Scenario
from torchcover.simulation.moving_bodies import BodyGeometry
from torchcover.simulation.shapes import Box
from torchcover.simulation.traffic.idm import Driver, compute_acceleration_mps2, compute_gap_ratio, integrate_motion
from torchcover.simulation.traffic.trailers import compute_tractrix_yaw_rad

from .case import Case, most

ROD_M, RADIUS_M, SPEED_MPS = 2.7, 6.0, 8.0
EGO_M, OTHER_M = (4.0, 2.0, 1.5), (0.02, 0.04, 1.0)
SPEEDS_KMH = (0.1, 5.0, 50.0, 300.0)
FASTEST_KMH = 300.0


def drawn_along(way_m, yaw):
    """Compute (T,) headings of a rod along a (T, 2) path."""
    return compute_tractrix_yaw_rad(np.asarray(way_m)[:, None], np.array([ROD_M]), np.array([yaw]))[:, 0]


def by_steps(way_m, yaw):
    """Integrate naively: yaw rate at the previous angle times the step."""
    result = [yaw]
    for x_m, y_m in np.diff(way_m, axis=0):
        result.append(result[-1] + (y_m * np.cos(result[-1]) - x_m * np.sin(result[-1])) / ROD_M)
    return np.array(result)


def circle(step_s, offset_m):
    """Twenty rounds by chords of `step_s`, the turn of each, and its length."""
    turn = SPEED_MPS * step_s / RADIUS_M
    angle = turn * np.arange(int(20 * 2 * np.pi / turn) + 1)
    way_m = RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1) + offset_m
    return way_m, turn, 2 * RADIUS_M * np.sin(turn / 2)


@lru_cache
def steady(turn, chord_m):
    """The angle between a rod and a chord at its end, where a round changes nothing: tan(a/2) = f tan((a + turn)/2)."""
    with mpmath.workdps(40):
        fall, half = mpmath.exp(-mpmath.mpf(chord_m) / mpmath.mpf(ROD_M)), mpmath.tan(mpmath.mpf(turn) / 2)
        # t (1 - t h) = f (t + h), the smaller root.
        p = 1 - fall
        root = (p - mpmath.sqrt(p * p - 4 * half * half * fall)) / (2 * half)
        return float(2 * mpmath.atan(root))


def circling(drawn, step_s, offset_m):
    """Off the heading after twenty rounds, leaps included."""
    way_m, turn, chord_m = circle(step_s, offset_m)
    chords = np.pi / 2 + turn * (np.arange(len(way_m) - 1) + 0.5)
    return most(drawn(way_m, np.pi / 2)[-1] - (chords[-1] - steady(turn, chord_m)))


def straight(drawn):
    """A rod that is pushed almost straight back by its front, and turns around."""
    along_m = np.append(0.0, np.geomspace(1e-3, 60.0, 2000))
    yaw = np.pi - 1e-3
    with mpmath.workdps(40):
        half = mpmath.tan(mpmath.mpf(yaw) / 2)
        exact = [float(2 * mpmath.atan(half * mpmath.exp(-mpmath.mpf(s) / mpmath.mpf(ROD_M)))) for s in along_m]
    return most(drawn(np.stack([along_m, 0 * along_m], axis=1), yaw) - exact)


def corner(drawn, step_s):
    """20 m ahead, 179 degrees to the left within no length, and 20 m on, by steps; to where one piece leads."""
    turn = np.deg2rad(179.0)
    along_m = np.append(np.arange(0.0, 20.0, SPEED_MPS * step_s), 20.0)
    towards = np.array([np.cos(turn), np.sin(turn)])
    ahead_m = np.stack([along_m, 0 * along_m], axis=1)
    way_m = np.concatenate([ahead_m, ahead_m[-1] + along_m[1:, None] * towards])
    with mpmath.workdps(40):
        half, fall = mpmath.tan(mpmath.mpf(turn) / 2), mpmath.exp(-mpmath.mpf(20) / mpmath.mpf(ROD_M))
        exact = float(mpmath.mpf(turn) - 2 * mpmath.atan(half * fall))
    return most(drawn(way_m, 0.0)[-1] - exact)


# Bends and contacts


def of_bends(places):
    """Off a way of 100 m along bends of 100 m to 1e15 m."""
    errors = []
    for radius_m in np.geomspace(100.0, 1e15, 14):
        with mpmath.workdps(50):
            turned = mpmath.mpf(100) / mpmath.mpf(radius_m)
            exact = [float(mpmath.mpf(radius_m) * part) for part in (mpmath.sin(turned), 1 - mpmath.cos(turned))]
        errors.append(np.array(places(radius_m)) - exact)
    return most(errors)


def along_bend(radius_m):
    way = EncounterPath(speed_kmh=3.6, radius_m=radius_m, turn_deg=180.0)
    return compute_path_poses(way, np.array([100.0]), (0.0, 0.0), 0.0)[0, :2, 3]


def by_cosine(radius_m):
    turned = 100.0 / radius_m
    return radius_m * np.sin(turned), radius_m * (1 - np.cos(turned))


@lru_cache
def contacts():
    """Seconds of contact as found and as they are, of a box that crosses at each speed, or stands, before an ego."""
    ego = BodyGeometry(Box.model_validate({"type": "box", "size_m": EGO_M}).build_mesh())
    result = []
    for ego_kmh in SPEEDS_KMH:
        for other_kmh in (0.0, *SPEEDS_KMH):
            other = {"body": {"type": "box", "size_m": OTHER_M}, "speed_kmh": other_kmh}
            staged = StagedEncounter(
                Encounter.model_validate(
                    {"name": "e", "ego": {"speed_kmh": ego_kmh}, "road_user": other, "max_lead_time_s": 2.0}
                ),
                ego,
            )
            # The other heads along y: its width is before the ego's front, its length beside its sides.
            ahead_s = OTHER_M[1] / 2 / (ego_kmh / 3.6)
            aside_s = (EGO_M[1] + OTHER_M[0]) / 2 / (other_kmh / 3.6) if other_kmh else np.inf
            result.append((staged.contact_time_s, 2.0 - min(ahead_s, aside_s)))
    return np.array(result).T


def contact():
    found_s, exact_s = contacts()
    return most(found_s - exact_s)


def contact_in_milliseconds():
    _, exact_s = contacts()
    return most(np.ceil(exact_s * 1000) / 1000 - exact_s)


@lru_cache
def sights():
    """Seconds before the meeting at which a thin walker comes into sight past the corner of a wall; found, and are."""
    scenario = Scenario.model_validate({"name": "s", "ego": EGO, "bodies": [FLOOR]})
    scanner = {
        "name": "front", "mount": {"x_m": 1.5, "z_m": 1.5}, "channels": 1, "vertical_fov_deg": [0, 0],
        "horizontal_fov_deg": 10, "columns": 5000, "max_range_m": 200, "rate_hz": 1000,
    }  # fmt: skip
    one_rig = MountedRig(Rig.model_validate({"name": "r", "sensors": [build_lidar(**scanner)]}), scenario)
    walls = [{"body": {"type": "box", "size_m": [3.0, 0.5, 3.0]}, "lateral_gap_m": 0.6, "longitudinal_gap_m": 1.0}]
    other = {"body": {"type": "box", "size_m": [0.02, 0.02, 2.0]}, "speed_kmh": 5.4, "approach_distance_m": 2.1}
    one = {"name": "e", "ego": {"speed_kmh": FASTEST_KMH}, "road_user": other, "obstacles": walls}
    sighting = detect_encounter(
        one_rig,
        StagedEncounter(Encounter.model_validate(one), one_rig.ego_solid),
        Criterion(points=1, consecutive_scans=1),
        num_start_offsets=1,
    )
    before_s = np.linspace(0.0, 1.39, 1_000_001)
    sensor_m = -0.5 - FASTEST_KMH / 3.6 * before_s
    # The line past the corner of the wall, 1.01 m before and 1.6 m aside, meets the far one of the walker.
    ahead_m = np.minimum(sensor_m + 1.01, -1e-9)
    seen = 0.01 - 1.5 * before_s >= -1.6 * (sensor_m - 0.01) / ahead_m
    return sighting.ttc_s[0] + 0.01 / (FASTEST_KMH / 3.6), before_s[seen].max()


def sight_error():
    """A column of the scanner is 4 mm wide there, which is 2 ms; a look takes 1 ms."""
    found_s, exact_s = sights()
    return most(found_s - exact_s)


def sight_at_10_hz():
    _, exact_s = sights()
    return most(np.floor(exact_s * 10) / 10 - exact_s)


def run_into(step):
    """200 drivers at 0 to 70 m/s behind one who stops, closer than any of them likes, by steps of 0.05 to 3 s."""
    generator, hit = np.random.default_rng(9), 0
    for step_s in (0.05, 0.5, 3.0):
        driver = Driver(generator.uniform(1e-3, 70.0, 200), standstill_gap_m=generator.uniform(0.0, 2.0, 200))
        place_m, speed_mps = -np.cumsum(10.0 ** generator.uniform(-3, 2, 200)), generator.uniform(0.0, 70.0, 200)
        for _ in range(200):
            ahead_m, ahead_mps = np.append(0.0, place_m[:-1]), np.append(0.0, speed_mps[:-1])
            longitudinal_gap_m = ahead_m - place_m
            tight = compute_gap_ratio(driver, speed_mps, longitudinal_gap_m, speed_mps - ahead_mps)
            wanted_mps2 = compute_acceleration_mps2(driver, speed_mps, tight, driver.desired_speed_mps)
            way_m, speed_mps = step(speed_mps, wanted_mps2, longitudinal_gap_m, step_s)
            place_m = place_m + way_m
        hit += int((np.append(0.0, place_m[:-1]) < place_m - 1e-9).sum())
    return hit


def without_room(speed_mps, wanted_mps2, _, step_s):
    return speed_mps * step_s, np.maximum(speed_mps + wanted_mps2 * step_s, 0.0)


CASES = [
    *(
        Case(f"{where} by steps of {step_s:g} s", "40 digits (mpmath)", "rad", bound, partial(law, drawn_along, step_s),
             "yaw rate times step", partial(law, by_steps, step_s))
        for where, law, bound in (
            ("twenty rounds of 6 m", partial(circling, offset_m=0.0), 1e-12),
            ("twenty rounds of 6 m, 1e6 m from the origin,", partial(circling, offset_m=1e6), 1e-8),
            ("a corner of 179 degrees", corner, 1e-12),
        )
        for step_s in (0.1, 1.0)
    ),
    Case("a rod pushed back, 0.001 rad from straight", "40 digits (mpmath)", "rad", 1e-9,
         partial(straight, drawn_along), "yaw rate times step", partial(straight, by_steps)),
    Case("100 m along bends of 100 m to 1e15 m", "50 digits (mpmath)", "m", 1e-12, partial(of_bends, along_bend),
         "1 - cos", partial(of_bends, by_cosine)),
    Case("contact at 0.1 to 300 km/h", "closed form", "s", 1e-12, contact,
         "whole milliseconds", contact_in_milliseconds),
    Case("a walker of 2 cm past the corner of a wall, at 300 km/h", "closed form", "s", 5e-3, sight_error,
         "looks at 10 Hz", sight_at_10_hz),
    Case("drivers much too close and fast, by steps of 0.05 to 3 s", "nobody runs into another", "of 600", 0,
         partial(run_into, integrate_motion), "speed times step", partial(run_into, without_room)),
]  # fmt: skip
