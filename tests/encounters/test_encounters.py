"""Detection in encounters: equal to geometry, and to exhaustive search."""

import math
from itertools import islice

import numpy as np
import pytest
import torch
import yaml
from matplotlib.text import Text

from tests.targets.scenes import EGO, FLOOR, build_lidar, count_points_on_target
from torchcover.encounters import Criterion, Encounter, EncounterSet, StagedEncounter, detect_encounter
from torchcover.encounters.detection import (
    NEVER,
    EncounterPointCounter,
    MountedRig,
    compute_scan_frames,
    find_first_run,
    group_sensors,
)
from torchcover.evaluation import build_flat_ground, encounter_evaluation, evaluate_encounters, plot_encounter_animation
from torchcover.geometry import convert_rotation_to_euler, find_overlaps
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, set_ego
from torchcover.simulation.bodies import get_shape_name
from torchcover.simulation.moving_bodies import BodyGeometry
from torchcover.targets import Target

torch.set_num_threads(1)

BOX = {"type": "box", "size_m": [2.0, 1.0, 0.5]}
WALKER = {"type": "box", "size_m": [0.02, 0.02, 1.0]}
WALL = {"type": "box", "size_m": [3.0, 0.5, 3.0]}
SOLID = BodyGeometry(Scenario.model_validate({"name": "s", "ego": EGO, "bodies": [FLOOR]}).build_ego_mesh())


def build_crossing(speed_kmh=36.0, other=None, **keys):
    other = {"body": "child_120cm", "speed_kmh": 5.4, "approach_distance_m": 1.5} | (other or {})
    return Encounter.model_validate({"name": "e", "ego": {"speed_kmh": speed_kmh}, "road_user": other, **keys})


def build_rig(*sensors):
    return Rig.model_validate({"name": "small", "sensors": list(sensors) or [build_lidar()]})


def mount_rig(*sensors):
    world = build_flat_ground().model_copy(update={"ego": Scenario.model_validate(
        {"name": "s", "ego": EGO, "bodies": [FLOOR]}).ego})  # fmt: skip
    return MountedRig(build_rig(*sensors), set_ego(world, {}))


def detect(mounted_rig, case, criterion, **keys):
    return detect_encounter(mounted_rig, StagedEncounter(case, mounted_rig.ego_solid), criterion, **keys)


def build_front_lidar(name="ahead", **keys):
    """Build a dense LiDAR at the center of the front."""
    return build_lidar(
        name, mount={"x_m": 1.9, "z_m": 1.2}, columns=900, channels=11, vertical_fov_deg=[-12, 0], **keys
    )


def build_roof_lidar(name, **keys):
    return build_lidar(name, **{"mount": {"x_m": 1.0, "z_m": 1.9}, "columns": 900, "vertical_fov_deg": [-20, 0]} | keys)


@pytest.mark.parametrize("speed_kmh", [18.0, 36.0])
def test_detection_begins_when_the_wall_no_longer_occludes(speed_kmh):
    scanner = {
        "name": "front", "mount": {"x_m": 1.5, "z_m": 1.5}, "channels": 1, "vertical_fov_deg": [-6, -6],
        "horizontal_fov_deg": 40, "columns": 4000, "max_range_m": 90, "rate_hz": 500,
    }  # fmt: skip
    walls = [{"body": WALL, "lateral_gap_m": 0.6, "longitudinal_gap_m": 1.0}]
    walker = {"body": WALKER, "approach_distance_m": 2.1}
    one = detect(
        mount_rig(scanner),
        build_crossing(speed_kmh, walker, obstacles=walls),
        Criterion(points=1, consecutive_scans=1),
        num_start_offsets=1,
    )
    # Seconds before the ego front reaches the path of the walker, which the line past (-1.01, -1.6) crosses at y.
    before_s = np.linspace(0.3, 1.39, 100_001)
    sensor_m = -0.5 - speed_kmh / 3.6 * before_s
    opens_s = before_s[-1.5 * before_s + 0.01 >= -1.6 * sensor_m / (sensor_m + 1.01)].max()
    assert 1.1 < opens_s < 1.35
    assert one.ttc_s[0] == pytest.approx(opens_s - 0.01 / (speed_kmh / 3.6), abs=0.005)


@pytest.mark.parametrize("kmh", [(50, 0), (50, 50), (20, 90), (90, 3), (90, -54), (0, 30), (-15, 20), (-15, -6)])
def test_braking_time_equals_a_simulated_stop(kmh):
    ego, other = kmh
    case = build_crossing(
        float(ego), {"yaw_deg": 0 if other < 0 else 180, "speed_kmh": abs(other) * math.copysign(1.0, ego)}
    )
    criterion = Criterion(deceleration_mps2=6.0, latency_s=0.4)
    speed_mps, towards_mps = abs(ego) / 3.6, case.approach_speed_mps
    assert towards_mps == pytest.approx(other / 3.6)
    # The smallest gap that remains until the ego vehicle stops, or is no faster than the vehicle ahead.
    times_s = np.linspace(0.0, 0.4 + speed_mps / 6, 100_001)
    own_mps = np.maximum(speed_mps - 6 * np.maximum(times_s - 0.4, 0.0), 0.0)
    lost_m = np.cumsum(own_mps + towards_mps) * times_s[1]
    expected_s = lost_m.max() / (speed_mps + towards_mps)
    assert criterion.compute_braking_time_s(speed_mps, towards_mps) == pytest.approx(expected_s, abs=1e-4)


def test_contact_time_is_when_outlines_touch():
    assert StagedEncounter(build_crossing(36.0, {"body": BOX}), SOLID).contact_time_s == pytest.approx(
        1.0 - 0.5 / 10, abs=2e-6
    )
    oncoming = {"body": BOX, "yaw_deg": 180, "speed_kmh": 18, "approach_distance_m": 5}
    assert StagedEncounter(build_crossing(36.0, oncoming), SOLID).contact_time_s == pytest.approx(
        1.0 - 1.0 / 15, abs=2e-6
    )
    behind = StagedEncounter(build_crossing(-36.0, {"body": BOX}), SOLID)
    assert behind.contact_time_s == pytest.approx(1.0 - 0.5 / 10, abs=2e-6)
    assert behind.compute_vehicle_T_road_user(np.array([1.0]))[0, :2, 3] == pytest.approx([-2.0, 0.0])
    standing = build_crossing(0.0, {"body": BOX, "approach_distance_m": 3})
    assert StagedEncounter(standing, SOLID).contact_time_s == pytest.approx(2.0 - (1.0 + 1.0) / 1.5, abs=2e-6)


def build_grazing_encounter(overlap_m, **ego):
    """Build an encounter in which the rear of a straight vehicle overlaps the corner of the ego vehicle."""
    box = {"type": "box", "size_m": [2.0, 1.009, 0.5]}
    other = {
        "body": box,
        "speed_kmh": 36,
        "approach_distance_m": 15,
        "impact_location": (1 - overlap_m + 0.5045 + 1 + 1) / 2,
    }
    return Encounter.model_validate({"name": "g", "ego": {"speed_kmh": 36} | ego, "road_user": other})


def test_contacts_shorter_than_a_millisecond_are_found():
    staged = StagedEncounter(build_grazing_encounter(0.004), SOLID)
    assert staged.contact_time_s == pytest.approx(1.5 - 0.05045, abs=1e-9)
    whole_s = np.arange(2000) / 1000
    assert not find_overlaps(
        staged.road_user_solid.bounding_box, staged.compute_vehicle_T_road_user(whole_s), SOLID.bounding_box.corners_m
    ).any()
    bent = StagedEncounter(build_grazing_encounter(0.4, radius_m=8), SOLID)
    finely_s = np.linspace(bent.contact_time_s - 1e-3, bent.contact_time_s + 1e-3, 20_001)
    touching = find_overlaps(
        bent.road_user_solid.bounding_box, bent.compute_vehicle_T_road_user(finely_s), SOLID.bounding_box.corners_m
    )
    assert finely_s[touching.argmax()] == pytest.approx(bent.contact_time_s, abs=2e-7)


@pytest.mark.parametrize("speed_kmh", [36.0, -36.0])
def test_obstacles_lie_before_or_beyond_the_meeting_point(speed_kmh):
    rows = [{"body": BOX, "longitudinal_gap_m": 0.5}, {"body": WALL, "lateral_gap_m": 2.0, "longitudinal_gap_m": 0.4}]
    beyond = {
        "body": BOX,
        "side": "left",
        "position": "beyond",
        "yaw_deg": 90,
        "longitudinal_gap_m": 0.3,
        "lateral_gap_m": 0.7,
    }
    staged = StagedEncounter(build_crossing(speed_kmh, {"body": BOX}, obstacles=[*rows, beyond]), SOLID)
    back = -math.copysign(1.0, speed_kmh)
    placed = {
        get_shape_name(one.body) + one.side + str(one.longitudinal_gap_m): pose[:2, 3] for one, pose in staged.obstacles
    }
    # The road user is 1 m wide along x, the ego vehicle 2 m along y.
    assert placed["boxright0.5"] == pytest.approx([back * (0.5 + 0.5 + 1.0), -1.0 - 1.0 - 0.5])
    assert placed["boxright0.4"] == pytest.approx([back * (0.5 + 0.5 + 2.0 + 0.4 + 1.5), -1.0 - 2.0 - 0.25])
    assert placed["boxleft0.3"] == pytest.approx([-back * (0.5 + 0.3 + 0.5), 1.0 + 0.7 + 1.0])


@pytest.mark.parametrize("speed_kmh", [36.0, -31.7])
@pytest.mark.parametrize("yaw_deg", [0.0, 17.0])
def test_touching_obstacles_are_valid(speed_kmh, yaw_deg):
    row = [
        {"body": body, "longitudinal_gap_m": 0.0, "lateral_gap_m": 0.0, "yaw_deg": yaw_deg}
        for body in ("van", "suv", WALL, BOX)
    ]
    assert (
        len(StagedEncounter(build_crossing(speed_kmh, {"approach_distance_m": 0.7}, obstacles=row), SOLID).obstacles)
        == 4
    )


def test_bends_end_at_the_meeting_point():
    turning = Encounter.model_validate(
        {"name": "t", "ego": {"speed_kmh": 18, "radius_m": 8, "turn_deg": 90}, "max_lead_time_s": 4,
         "road_user": {"body": "child_120cm", "speed_kmh": 5, "approach_distance_m": 4}}
    )  # fmt: skip
    staged = StagedEncounter(turning, SOLID)
    bend_s = 8 * math.pi / 2 / 5
    poses = staged.compute_world_T_ego(turning.lead_time_s - np.array([0.0, bend_s, bend_s + 0.1]))
    yaw_deg = [convert_rotation_to_euler(pose[:3, :3])[0] for pose in poses]
    assert yaw_deg == pytest.approx([0.0, -90.0, -90.0], abs=1e-6)
    assert poses[:, :2, 3] == pytest.approx(np.array([[-2.0, 0.0], [-10.0, 8.0], [-10.0, 8.5]]))


@pytest.mark.parametrize("looks", [1, 2, 3, 5])
def test_first_run_equals_exhaustive_search_with_fewer_tests(looks):
    generator = np.random.default_rng(looks)
    for chance in (0.2, 0.6, 0.9):
        steps = 10 * np.arange(40) + np.arange(7)[:, None]
        steps[3:, 35:] = NEVER
        enough = generator.random((7, 40)) < chance
        asked = []

        def is_enough(some, asked=asked, enough=enough):
            asked.extend(some.tolist())
            return enough[some % 10, some // 10]

        expected = []
        for phase in range(7):
            ends = [j for j in range(looks - 1, 40) if enough[phase, j - looks + 1 : j + 1].all()]
            expected.append(steps[phase, ends[0]] if ends and steps[phase, ends[0]] < NEVER else NEVER)
        assert find_first_run(is_enough, steps, looks).tolist() == expected
        assert len(asked) == len(set(asked))
    dark = []
    find_first_run(lambda some: dark.extend(some) or np.zeros(len(some), dtype=bool), steps, looks)
    assert len(dark) <= 7 * (40 // looks)


CAMERA = {
    "type": "camera", "name": "cam", "mount": {"x_m": 2.05, "z_m": 0.9}, "width": 240, "height": 160, "fov_deg": 90,
    "stride": 2, "max_range_m": 60, "rate_hz": 20,
}  # fmt: skip
RADAR = {
    "type": "radar", "name": "radar", "mount": {"x_m": 2.05, "z_m": 0.5}, "horizontal_fov_deg": 90,
    "vertical_fov_deg": [-8, 8], "azimuth_cell_deg": 6, "range_cell_m": 0.4, "max_range_m": 40,
}  # fmt: skip
HIDDEN = [
    {"body": WALL, "lateral_gap_m": 0.4, "longitudinal_gap_m": 0.5},
    {"body": BOX, "side": "left", "position": "beyond"},
]


def test_points_equal_a_simulation_with_the_road_user():
    case = build_crossing(obstacles=HIDDEN)
    small = mount_rig(build_front_lidar(), CAMERA, RADAR)
    staged = StagedEncounter(case, small.ego_solid)
    looks, child = EncounterPointCounter(small, staged, 0), Target.load("child")
    child = Target("child", staged.road_user_solid.mesh)
    seen = np.zeros(3)
    for step in (200, 500, 620, 800, 930):
        vehicle_T_other = staged.compute_vehicle_T_road_user(np.array([step / 1000]))[0]
        vehicle_T_world = np.linalg.inv(staged.compute_world_T_ego(np.array([step / 1000]))[0])
        shapes = [("wall", WALL), ("box", BOX)]
        poses = {"left": BOX, "right": WALL}
        bodies = [FLOOR]
        for one, pose in staged.obstacles:
            x_m, y_m, _ = (vehicle_T_world @ pose)[:3, 3].tolist()
            bodies.append({"name": one.side, "shape": poses[one.side], "poses": [{"x_m": x_m, "y_m": y_m}]})
        assert len(bodies) == 1 + len(shapes)
        x_m, y_m, _ = vehicle_T_other[:3, 3].tolist()
        yaw_deg = float(convert_rotation_to_euler(vehicle_T_other[:3, :3])[0])
        actor = {"name": "c", "category": "child", "shape": {"type": "vehicle", "vehicle": "child_120cm"},
                 "pose": {"x_m": x_m, "y_m": y_m, "yaw_deg": yaw_deg}}  # fmt: skip
        world = Scenario.model_validate({"name": "s", "ego": EGO, "bodies": bodies, "actors": [actor]})
        scans = Simulator(world, {"r": small.rig}, PaperReference(rows=2, columns=2)).simulate_frame(0).scans["r"]
        for k, (sensor, scan) in enumerate(zip(small.rig.sensors, scans, strict=True)):
            points = int(looks.count_points([k], np.array([step]))[0])
            assert points == sensor.pixels_per_sample * count_points_on_target(
                scan.points, child, x_m, y_m, math.radians(yaw_deg)
            )
            seen[k] += points
    assert (seen > 0).all()


def test_results_equal_exhaustive_search():
    case, criterion = build_crossing(obstacles=HIDDEN), Criterion(points=12, pixels=150)
    small = mount_rig(build_front_lidar(dropout=0.3), build_front_lidar("noisy", rate_hz=20, range_noise_m=0.3), CAMERA)
    found = detect(small, case, criterion, num_start_offsets=4, seed=3)
    staged = StagedEncounter(case, small.ego_solid)
    looks, sensors = EncounterPointCounter(small, staged, 3), small.rig.sensors
    for k, sensor in enumerate(sensors):
        steps = compute_scan_frames(sensor.rate_hz, 4, staged.contact_time_s)
        need = criterion.pixels if sensor.name == "cam" else criterion.points
        for phase, of_phase in enumerate(steps):
            known = of_phase[of_phase < NEVER]
            enough = looks.count_points([k], known) >= need
            runs = enough[:-2] & enough[1:-1] & enough[2:]
            expected = staged.contact_time_s - known[2:][runs][0] / 1000 if runs.any() else 0.0
            assert found.sensor_ttc_s[k, phase] == pytest.approx(expected)
    assert (found.sensor_ttc_s > 0).any(axis=1).all()
    again, another = (EncounterPointCounter(small, staged, seed).count_points([1], known) for seed in (3, 4))
    assert (again == looks.count_points([1], known)).all()
    assert (another != again).any()
    assert (found.ttc_s == found.sensor_ttc_s.max(axis=0)).all()  # each is counted alone
    assert (found.ttc_without_sensor_s[0] == found.sensor_ttc_s[1:].max(axis=0)).all()


def test_lidars_are_counted_together_and_failures_never_help():
    assert group_sensors([0.1, None, 0.05, 0.1, None, 0.2], range(6)) == [(1,), (4,), (0, 3, 2), (2,), (5, 0, 3, 2)]
    assert group_sensors([2, None, 1], [2]) == [(2,)]
    few = build_lidar("few", columns=180, channels=8, vertical_fov_deg=[-20, 0])
    found = detect(mount_rig(few, few | {"name": "same"}), build_crossing(), Criterion(points=6), num_start_offsets=3)
    assert (found.ttc_without_sensor_s <= found.ttc_s).all()
    assert (found.ttc_without_sensor_s == found.sensor_ttc_s[::-1]).all()
    assert (found.ttc_s > found.sensor_ttc_s[0]).any()
    for rate_hz in (10.001, 13, 20):
        faster = detect(
            mount_rig(few, few | {"name": "fast", "rate_hz": rate_hz}),
            build_crossing(),
            Criterion(points=6),
            num_start_offsets=3,
        )
        assert (faster.ttc_s >= found.ttc_s).all()


def test_slow_sensors_are_too_late_with_a_warning():
    with pytest.warns(UserWarning, match=r"3 scans of sensor 'top' take 3 s, .* ends after 0.98"):
        found = detect(mount_rig(build_lidar(rate_hz=1)), build_crossing(), Criterion(), num_start_offsets=2)
    assert not found.ttc_s.any()
    assert found.ttc_s.max() < found.censoring_ttc_s
    unseen = build_crossing(20.0, {"approach_distance_m": None, "speed_kmh": 0}, max_lead_time_s=2)
    with pytest.warns(UserWarning, match="always too late"):
        found = detect(mount_rig(build_lidar(rate_hz=1)), unseen, Criterion(), num_start_offsets=2)
    assert not found.ttc_s.any()
    assert found.ttc_s.max() < found.censoring_ttc_s


def test_fog_delays_detection_and_early_detections_are_censored():
    far = build_crossing(72.0, {"approach_distance_m": None, "speed_kmh": 0}, max_lead_time_s=3)
    sensor = build_lidar(channels=60, vertical_fov_deg=[-4, 0], columns=7200, max_range_m=80)
    found = [detect(mount_rig(sensor), case, Criterion(points=1), num_start_offsets=2) for case in (
        far, far.model_copy(update={"weather": build_crossing(weather="fog_50m").weather}))]  # fmt: skip
    assert found[0].ttc_s.min() >= found[0].censoring_ttc_s
    assert found[0].ttc_s.min() > 2.5
    assert found[1].ttc_s.max() < found[1].censoring_ttc_s
    assert found[1].ttc_s.max() < 2.5


FAMILY = {
    "name": "f", "ego": {"speed_kmh": [20, 40]}, "road_user": {"body": "child_120cm", "speed_kmh": {"from": 3, "to": 7},
    "impact_location": {"from": 0.2, "to": 0.8}, "approach_distance_m": 1.5},
    "obstacles": [{"body": ["hatchback", "van"]}],
}  # fmt: skip


def test_lists_are_combined_and_ranges_sampled_evenly():
    these = EncounterSet.model_validate({"name": "s", "num_samples": 8, "encounters": [FAMILY]}).encounters
    assert len(these) == 2 * 2 * 8
    assert [one.name for one in these[::8]] == ["f: hatchback", "f: van"] * 2
    assert [one.ego.speed_kmh for one in these[::8]] == [20, 20, 40, 40]
    for first in range(0, 32, 8):
        share = np.array([one.road_user.impact_location for one in these[first : first + 8]])
        assert sorted(np.floor((share - 0.2) / 0.6 * 8).tolist()) == list(range(8))
        assert share.tolist() == [one.road_user.impact_location for one in these[:8]]


def test_rows_have_intervals_over_samples():
    these = EncounterSet.model_validate({"name": "s", "num_samples": 8, "encounters": [FAMILY | {"obstacles": []}]})
    two = build_rig(build_roof_lidar("ahead"), build_roof_lidar("top", columns=40))
    found = evaluate_encounters([two], these, Criterion(points=3), num_start_offsets=3, vehicle="suv")
    rows = found.rows
    assert [(row.speed_kmh, row.sample_count, row.first_sensor) for row in rows] == [(20, 8, "ahead"), (40, 8, "ahead")]
    for row in rows:
        of_draws_s = [one.ttc_s.mean() for one in found.detections if one.encounter.ego.speed_kmh == row.speed_kmh]
        margin_s = 2.36462 * np.std(of_draws_s, ddof=1) / math.sqrt(8)
        assert (row.ttc_s, row.interval_high) == pytest.approx((np.mean(of_draws_s), row.ttc_s + margin_s), rel=1e-5)
        assert row.min_ttc_s <= row.ttc_s <= row.max_ttc_s
        assert row.braking_time_s == pytest.approx(row.speed_kmh / 3.6 / 18 + 0.5)
        assert row.most_critical_sensor == "ahead"
        of_speed = [one for one in found.detections if one.encounter.speed_kmh == row.speed_kmh]
        assert row.ttc_without_most_critical_s == min(one.ttc_without_sensor_s[0].min() for one in of_speed)
    slow = [one.ttc_s for one in found.detections if one.encounter.ego.speed_kmh == 20]
    assert rows[0].in_time_share == np.mean(np.stack(slow) >= rows[0].braking_time_s)
    ((name, of_rigs, needed),) = found.compute_plot_bands()
    bands = of_rigs["small"]
    assert (name, [band[0] for band in bands]) == ("f", [20, 40])
    assert [at for _, at in needed] == [row.braking_time_s for row in rows]
    assert bands[0][1:] == (rows[0].min_ttc_s, rows[0].max_ttc_s)


def test_highest_timely_speed_includes_all_lower_speeds():
    these = EncounterSet.model_validate(
        {"name": "s", "encounters": [FAMILY | {"ego": {"speed_kmh": [50, 10, 30]}, "obstacles": [], "road_user":
         {"body": "child_120cm", "speed_kmh": 5, "approach_distance_m": 1.5}}]}
    )  # fmt: skip
    partly = evaluate_encounters(build_rig(build_roof_lidar("ahead")), these, num_start_offsets=5)
    ttc_s = np.sort(partly.detections[0].ttc_s)
    between = Criterion(deceleration_mps2=50 / 3.6 / 2 / (ttc_s[2] - 0.1), latency_s=0.1)
    found = evaluate_encounters(build_rig(build_roof_lidar("ahead")), these, between, num_start_offsets=5)
    assert [row.in_time_share for row in found.rows][-1] == 0.6
    assert list(found.find_max_speeds_kmh().values()) == [30.0]
    for brakes, expected, words in ((1e6, 50.0, "50"), (1.0, math.nan, "none")):
        found = evaluate_encounters(
            build_rig(build_roof_lidar("ahead")),
            these,
            Criterion(deceleration_mps2=brakes, latency_s=0.1),
            num_start_offsets=5,
        )
        assert list(found.find_max_speeds_kmh().values()) == pytest.approx([expected], nan_ok=True)
        assert found.build_tables()[0].rows[0][1].text == words
    standing = [build_crossing(float(kmh), {"approach_distance_m": 3}) for kmh in (-50, 0, -20)]
    both = EncounterSet(name="s", encounters=tuple(standing))
    found = evaluate_encounters(
        build_rig(build_roof_lidar("ahead")), both, Criterion(deceleration_mps2=1.0), num_start_offsets=2
    )
    assert (list(found.find_max_speeds_kmh().values()), found.build_tables()[0].rows[0][1].text) == ([0.0], "0")
    assert [row.speed_kmh for row in found.rows] == [0, -20, -50]


def test_animation_shows_vehicles_and_points():
    other = {"body": "child_120cm", "speed_kmh": 5, "approach_distance_m": 2.0}
    these = EncounterSet.model_validate(
        {"name": "s", "encounters": [FAMILY | {"ego": {"speed_kmh": [20, 90]}, "road_user": other}]}
    )
    two = build_rig(build_roof_lidar("ahead"), build_roof_lidar("top", columns=40))
    pictures = list(
        islice(
            plot_encounter_animation(
                two, evaluate_encounters([two], these, num_start_offsets=2, vehicle="suv"), vehicle="suv"
            ),
            2,
        )
    )
    picture, (axes,) = pictures[0], pictures[0].axes
    child, parked, ego = (patch.get_xy() for patch in axes.patches)
    for (low_m, high_m), of_axis in zip((axes.get_xlim(), axes.get_ylim()), range(2), strict=True):
        assert all(low_m < patch[:, of_axis].min() < patch[:, of_axis].max() < high_m for patch in (child, parked, ego))
    assert {(one.axes[0].get_xlim(), one.axes[0].get_ylim()) for one in pictures} == {
        (axes.get_xlim(), axes.get_ylim())
    }
    words = " ".join(text.get_text() for text in picture.findobj(Text))
    assert "s to the collision; points on the road user: ahead 1, top 0" in words
    for told in (
        "at 90 km/h: detected",
        "first sensor ahead, without ahead",
        "in time up to 20 km/h",
        "child_120cm (1)",
        "hatchback (1)",
    ):
        assert told in words
    assert "reference points" not in words


MISTAKES = [
    ({"ego": {"speed_kmh": 0}, "road_user": {"body": "child_120cm", "speed_kmh": 0}}, "neither vehicle moves"),
    ({"road_user": {"body": "child_12cm", "speed_kmh": 5}}, "is 'child_120cm' or 'child_110cm' meant"),
    ({"road_user": {"body": "child_120cm", "speed_kmh": 5, "approach_distance_m": -1}}, "approach_distance_m"),
    ({"ego": {"speed_kmh": []}}, "encounters.0: ego.speed_kmh: a list of values is empty"),
    ({"ego": {"speed_kmh": {"from": 5, "to": 5}}}, "encounters.0: ego.speed_kmh: from 5 must be below to 5"),
    ({"ego": {"speed_kmh": {"from": 5, "to": "x"}}}, "two numbers from and to"),
    ({"ego": {"speed_kmh": [10, 20], "radius_m": 0.1}}, "radius_m: at least 1 m"),
    ({"weather": "fog"}, "is 'fog_50m' meant|fog_100m"),
    ({"ego": {"speed_kmh": list(range(1, 201))}, "max_lead_time_s": list(range(1, 60))},
     "encounters.0: 11,800 encounters of a family exceed the limit of 10,000"),
    ({"obstacle": []}, "obstacle"),
    (
        {"name": None, "ego": {"speed_kmh": 10, "radius_m": [8, 9]}},
        "encounters.0: name: a text is needed",
    ),
    ({"name": ["f", "g"]}, "encounters.0: name: a text is needed"),
    ({"ego": {"speed_kmh": [-10, 0, 10]}}, "'f' has speeds forward and in reverse"),
    ({"ego": {"speed_kmh": {"from": -10, "to": 10}}}, "'f' has speeds forward and in reverse"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "told"), MISTAKES)
def test_invalid_families_are_refused_once(keys, told, tmp_path):
    family = {"name": "f", "ego": {"speed_kmh": 10}, "road_user": {"body": "child_120cm", "speed_kmh": 5}} | keys
    path = tmp_path / "set.yaml"
    path.write_text(yaml.safe_dump({"name": "s", "encounters": [family]}))
    with pytest.raises((ValueError, FileNotFoundError), match=told) as failure:
        evaluate_encounters(build_rig(build_roof_lidar("top")), path, num_start_offsets=1)
    assert len(str(failure.value)) < 1000


def test_families_with_equal_names_are_refused():
    families = [
        {"name": "f", "ego": {"speed_kmh": kmh}, "road_user": {"body": "child_120cm", "speed_kmh": 5}}
        for kmh in (10, 20)
    ]
    with pytest.raises(ValueError, match=r"encounters.1: the name 'f' is already used by encounters.0"):
        EncounterSet.model_validate({"name": "s", "encounters": families})


@pytest.mark.parametrize(
    ("case", "told"),
    [
        (build_crossing(36, {"impact_location": 3.0, "yaw_deg": 0, "approach_distance_m": 4}), "never touch"),
        (build_crossing(5.4, {"yaw_deg": 0}), "overlap from the beginning|never touch"),
        (build_crossing(36, {"body": BOX, "yaw_deg": 0, "speed_kmh": 36}), "overlap from the beginning"),
        (build_crossing(36, obstacles=[{"body": WALL, "lateral_gap_m": -1.0}]), "'box' is in the path of the ego"),
        (
            build_crossing(36, {"approach_distance_m": 3}, obstacles=[{"body": WALL, "longitudinal_gap_m": -1.0}]),
            "'box' is in the path of the road user",
        ),
        (
            build_crossing(36, obstacles=[{"body": WALL}, {"body": "van", "longitudinal_gap_m": -0.1}]),
            "'box' and 'van' are inside one anot",
        ),
    ],
)
def test_impossible_encounters_are_refused(case, told):
    with pytest.raises(ValueError, match=told):
        StagedEncounter(case, SOLID)


def test_invalid_encounters_are_refused_before_the_first_scan(monkeypatch):
    monkeypatch.setattr(MountedRig, "get_mounted_sensors", None)
    both = build_crossing(), build_crossing(36, {"impact_location": 3.0, "yaw_deg": 0, "approach_distance_m": 4})
    with pytest.raises(ValueError, match="never touch"):
        evaluate_encounters(build_rig(), EncounterSet(name="s", encounters=both))


def test_preparation_of_many_encounters_shows_progress(monkeypatch):
    class CountingProgress:
        def __init__(self, total, title, *, is_shown):
            bars.append((total, title, is_shown))

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def advance(self, expected_total):
            pass

    bars = []
    monkeypatch.setattr(encounter_evaluation, "Progress", CountingProgress)
    for name in ("StagedEncounter", "detect_encounter", "EncounterResults"):
        monkeypatch.setattr(encounter_evaluation, name, lambda *_, **__: None)
    road_user = {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2}
    for num_encounters in (2, 100):
        crossing = {"name": "a", "ego": {"speed_kmh": [30] * num_encounters}, "road_user": road_user}
        encounters = EncounterSet.model_validate({"name": "crossings", "encounters": [crossing]})
        evaluate_encounters("front_roof_32", encounters, progress=True)
    assert [(bar[1], bar[2]) for bar in bars if bar[0] == 2] == [("preparing", False), ("encounters", True)]
    assert [(bar[1], bar[2]) for bar in bars if bar[0] == 100] == [("preparing", True), ("encounters", True)]
