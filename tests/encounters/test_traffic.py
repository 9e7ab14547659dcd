"""Approaches in traffic and their detection: equal to geometry, and to exhaustive search."""

import math

import numpy as np
import pytest
import torch

from tests.recordings.drives import CAR_SIZE_M
from tests.recordings.drives import Drive as SyntheticDrive
from tests.recordings.layouts import LAYOUTS
from tests.targets.scenes import FLOOR, build_lidar, build_rig, build_scenario, write_trajectory
from torchcover.data import SimulatedFrames
from torchcover.detection import Boxes
from torchcover.encounters import Criterion, EncounterResults
from torchcover.encounters.detection import NEVER
from torchcover.encounters.traffic import Approach, Drive, find_approaches
from torchcover.encounters.traffic_detection import ApproachPointCounter, DriveSensors, detect_approach
from torchcover.evaluation import evaluate_recorded_encounters, evaluate_traffic_encounters
from torchcover.geometry import BoundingBox, build_transform
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings import open_recording
from torchcover.recordings.objects import Track
from torchcover.simulation import PaperReference, Scenario, Simulator, write_recording

torch.set_num_threads(1)

STEP_S = 0.1
CHILD = {"type": "box", "size_m": [0.4, 0.4, 1.1]}
CAR = {"type": "box", "size_m": [4.0, 2.0, 1.5]}
WALL = {"name": "wall", "shape": {"type": "box", "size_m": [24.0, 0.2, 3.0]}, "poses": [{"x_m": 31.0, "y_m": -2.5}]}


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    """Drive at 10 m/s past a wall that occludes a walking child; cars follow, overtake and drive aside."""
    folder = tmp_path_factory.mktemp("drives")

    def actor(name, category, shape, *rows):
        way = write_trajectory(folder, *rows, name=f"{name}.csv")
        return {"name": name, "category": category, "shape": shape, "trajectory": str(way)}

    return Scenario.model_validate({
        "name": "s", "bodies": [FLOOR, WALL], "time_step_s": STEP_S, "duration_s": 3.0,
        "ego": {"shape": CAR, "trajectory": str(write_trajectory(folder, (0, 0, 0, 0), (3, 30, 0, 0), name="ego.csv"))},
        "actors": [
            actor("child", "pedestrian", CHILD, (0, 44, -5.4, 90), (3, 44, -0.9, 90)),
            actor("faster", "car", CAR, (0, -30, 0, 0), (3, 15, 0, 0)),
            actor("tailing", "car", CAR, (0, -10, 0, 0), (3, 25.5, 0, 0)),
            actor("aside", "car", CAR, (0, 30, 8, 0), (3, 31, 8, 0)),
        ],
    })  # fmt: skip


AHEAD = {"mount": {"x_m": 1.0, "z_m": 1.8}, "channels": 40, "columns": 240, "horizontal_fov_deg": 80,
         "vertical_fov_deg": [-12, 4], "max_range_m": 60}  # fmt: skip
AROUND = AHEAD | {"channels": 16, "columns": 720, "horizontal_fov_deg": 360}
CAMERA = {"type": "camera", "name": "cam", "mount": {"x_m": 2.05, "z_m": 0.9}, "width": 240, "height": 160,
          "fov_deg": 90, "stride": 2, "max_range_m": 60, "rate_hz": 10}  # fmt: skip
SENSORS = (
    build_lidar("noisy", **AHEAD, range_noise_m=0.2),
    build_lidar("slow", **AROUND, dropout=0.4, rate_hz=5),
    CAMERA,
)
TOP = build_lidar(**AHEAD)


@pytest.fixture(scope="module")
def driven(scenario):
    simulator = Simulator(scenario, {"small": build_rig(*SENSORS)}, PaperReference(rows=2, columns=2), seed=3)
    return simulator, Drive.from_scene("w", simulator.get_scene_geometry(0)[0].scene)


def test_approaches_have_geometric_times_to_collision(driven):
    child, faster = find_approaches(driven[1], Criterion())
    # The side of the child is 1.6 m from that of the ego path 2 s after 1.6 s; the front is 41.8 m away.
    times_s = STEP_S * np.arange(child.frame_index, child.frame_index + len(child.ttc_s))
    ahead_s, aside_s = (44 - 0.2 - 2 - 10 * times_s) / 10, (5.4 - 1.5 * times_s - 1.0 - 0.2) / 1.5
    assert child.ttc_s == pytest.approx(np.maximum(ahead_s, aside_s), abs=1e-9)
    assert (child.name, child.track.name) == ("on foot", "child")
    assert child.braking_times_s == pytest.approx(10 / 18 + 0.5)
    assert (faster.name, faster.frame_index, faster.braking_times_s.tolist()) == ("from behind", 12, [0.0] * 19)
    assert faster.ttc_s == pytest.approx((30 - 4 - 5 * STEP_S * np.arange(12, 31)) / 5)
    # Road users that are near from the beginning are excluded.
    assert "tailing" in [track.name for track in driven[1].tracks]
    assert [one.track.name for one in find_approaches(driven[1], Criterion(max_ttc_s=2.5))] == [
        "child",
        "faster",
        "tailing",
    ]


def test_points_equal_those_of_frames(scenario, driven):
    simulator, there = driven
    frames = SimulatedFrames(
        scenario,
        rigs=simulator.rigs,
        num_frames=31,
        seed=3,
        boxes=True,
        reference_sensor=PaperReference(rows=2, columns=2),
    )
    eyes, counted = DriveSensors.from_simulator(simulator, 0, Criterion()), 0
    for track in there.tracks:
        watch = ApproachPointCounter(there, track, eyes)
        for step in (0, 9, 21, 30):
            boxes = frames[step].boxes
            expected = int(boxes.points_in_box["small"][boxes.ids.index(track.name)])
            assert watch.count_points(range(3), np.array([step])) == [expected]
            counted += expected
    assert counted > 1000


def test_lidars_of_different_rates_are_counted_together(driven):
    simulator, there = driven
    eyes = DriveSensors.from_simulator(simulator, 0, Criterion())
    assert (eyes.scan_periods, eyes.frame_strides) == ([1, 2, None], [1, 2, 1])
    child, _ = find_approaches(there, Criterion())
    middle_m = [
        there.tracks[0].trajectory.interpolate(STEP_S * step)[:3, 3] - [10 * STEP_S * step, 0, -0.5]
        for step in range(31)
    ]

    def detected_s(*steps):
        few = DriveSensors(
            steps, [5, 5], [1, 1], steps, lambda step, _: [np.tile(middle_m[step], (3, 1)) * (step >= 20)] * 2
        )
        return detect_approach("r", there, child, few, Criterion()).ttc_s[0]

    assert detected_s(1, 1) > detected_s(2, 1) == detected_s(1, 2) == detected_s(2, 2) > 0


def test_results_equal_exhaustive_search(driven):
    simulator, there = driven
    some = {"before": 0, "later": 0, "never": 0}
    for criterion in (
        Criterion(points=4, pixels=60),
        Criterion(points=1, pixels=4, consecutive_scans=2, max_ttc_s=2.0),
    ):
        eyes = DriveSensors.from_simulator(simulator, 0, criterion)
        for one in find_approaches(there, criterion):
            found, watch = (
                detect_approach("small", there, one, eyes, criterion),
                ApproachPointCounter(there, one.track, eyes),
            )
            first = max(one.frame_index - round(criterion.max_ttc_s / STEP_S), 0)
            detected = []
            for k, need in enumerate((criterion.points, criterion.points, criterion.pixels)):
                steps = [s for s in range(first, one.frame_index + len(one.ttc_s)) if s % eyes.frame_strides[k] == 0]
                enough = watch.count_points([k], np.array(steps)) >= need
                ends = [steps[j] for j in range(criterion.consecutive_scans - 1, len(steps))
                        if enough[j - criterion.consecutive_scans + 1 : j + 1].all()]  # fmt: skip
                detected.append(max(ends[0], one.frame_index) if ends else NEVER)

            def ttc_s(step, one=one, within_s=criterion.max_ttc_s):
                past = step - one.frame_index
                return within_s if past == 0 else 0.0 if step == NEVER else one.ttc_s[: past + 1].min()

            assert found.sensor_ttc_s[:, 0].tolist() == [ttc_s(step) for step in detected]
            assert found.ttc_s[0] == ttc_s(min(detected))  # of three rates or kinds: each is counted alone
            assert found.ttc_without_sensor_s[1, 0] == ttc_s(min(detected[0], detected[2]))
            assert (found.ttc_s[0] >= found.censoring_ttc_s) == (min(detected) == one.frame_index)
            until = min(min(detected) - one.frame_index + 1, len(one.ttc_s)) if min(detected) > one.frame_index else 0
            needed = one.ttc_s < one.braking_times_s
            assert (found.in_time[0] == (not needed[:until].any())) if needed.any() else np.isnan(found.in_time[0])
            for step in detected:
                some["before" if step == one.frame_index else "never" if step == NEVER else "later"] += 1
    assert all(some.values())


def test_timeliness_is_undecided_without_need_for_braking(driven):
    _, there = driven
    blind = DriveSensors([1], [1], [1], [1], lambda step, _: [np.empty((0, 3))])
    soft = Criterion(deceleration_mps2=1.5)
    rows = {one.track.name: detect_approach("r", there, one, blind, soft) for one in find_approaches(there, soft)}
    assert [one.ttc_s[0] for one in rows.values()] == [0.0, 0.0]
    assert rows["child"].in_time[0] == 0
    assert math.isnan(rows["faster"].in_time[0])
    sightings = list(rows.values())
    found = EncounterResults("t", soft, 1, 0, {"r": ("s",)}, sightings, {"w": 1.0})
    (every,) = [row for row in found.rows if row.encounter == "all"]
    assert (every.in_time_share, every.braking_count, every.sample_count) == (0.0, 1, len(sightings))
    assert {one["name"]: one["in_time"] for one in found.to_record()["encounters"]} == {"child": False, "faster": None}
    table, *_ = found.build_tables()
    assert "1 of 1 too late" in table.rows[-1][3].text
    assert "Braking was needed in 1 encounters" in table.notes[1]


def test_rare_scans_before_the_approach_count():
    track = Track("t", "car", "passenger", (4.0, 2.0, 1.5), Trajectory.create_static([10.0, 0.0, 0.0]))
    there = Drive("w", STEP_S * np.arange(70), np.tile(np.eye(4), (70, 1, 1)), None, [track])
    one = Approach(track, 45, np.array([2.0] * 20), np.array([0.5] * 20), "cars and vans", 0.0)
    for seen_from, ttc_s in ((0, 2.5), (20, 2.0), (40, 0.0)):
        eyes = DriveSensors(
            [20], [1], [1], [20], lambda step, _, since=seen_from: [np.tile([9.0, 0.0, 1.0], (int(step >= since), 1))]
        )
        assert detect_approach("r", there, one, eyes, Criterion(max_ttc_s=2.5)).ttc_s[0] == ttc_s


def test_truck_and_trailer_are_one_road_user():
    times_s = STEP_S * np.arange(30)
    ego = np.tile(np.eye(4), (30, 1, 1))
    ego[:, 0, 3] = 20 * times_s
    way = {at_m: Trajectory.from_arrays(times_s, np.column_stack([at_m + 15 * times_s, 0 * times_s, 0 * times_s]),
                                        np.zeros((30, 3))) for at_m in (36.0, 30.0)}  # fmt: skip
    parts = [Track("truck 1", "truck", "truck", (5.0, 2.5, 3.0), way[36.0]),
             Track("rear of truck 1", "trailer", None, (12.0, 2.5, 4.0), way[30.0])]  # fmt: skip
    there = Drive("w", times_s, ego, BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5)), parts)
    for tracks in (parts, parts[::-1]):
        (one,) = find_approaches(there._replace(tracks=tracks), Criterion())
        assert (one.track, one.name) == (parts[1], "trucks and buses")
        assert 3.88 < one.ttc_s[0] <= 4.0


@pytest.mark.parametrize(
    ("ego_mps", "other_mps", "approach_distance_m", "needed_s"),
    [
        (10, (-10, 0), (50, 0), 10 / 9 * 0.75 + 0.5),
        (10, (4, 0), (50, 0), 6 / 18 + 0.5),
        (0.05, (-10, 0), (50, 0), 0.0),
        (-10, (-12, 0), (50, 0), 0.0),
        (10, (9.9, 4), (-3, -8), 0.0),
    ],
)
def test_braking_times_are_zero_without_effect(ego_mps, other_mps, approach_distance_m, needed_s):
    times_s = STEP_S * np.arange(60)
    ego = np.tile(np.eye(4), (60, 1, 1))
    ego[:, 0, 3] = ego_mps * times_s
    way_m = np.pad(np.array(approach_distance_m) + np.outer(times_s, other_mps), ((0, 0), (0, 1)))
    track = Track("t", "car", "passenger", (4.0, 2.0, 1.5), Trajectory.from_arrays(times_s, way_m, np.zeros((60, 3))))
    there = Drive("w", times_s, ego, BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5)), [track])
    (one,) = find_approaches(there, Criterion(max_ttc_s=20.0, consecutive_scans=1))
    assert one.braking_times_s[0] == pytest.approx(needed_s)


@pytest.mark.parametrize(
    ("seen_from", "ttc_s", "in_time"),
    [(0, 4.0, 1), (6, 2.0, 1), (7, 1.0, 0), (8, 1.0, 0), (9, 0.0, 0)],
)
def test_smallest_time_to_collision_until_detection_counts(seen_from, ttc_s, in_time):
    track = Track("t", "car", "passenger", (4.0, 2.0, 1.5), Trajectory.create_static([10.0, 0.0, 0.0]))
    there = Drive("w", STEP_S * np.arange(9), np.tile(np.eye(4), (9, 1, 1)), None, [track])
    one = Approach(track, 5, np.array([3.0, 2.0, 1.0, 3.5]), np.array([0.5, 0.5, 1.1, 0.5]), "cars and vans", 0.0, 0.0)
    on_it, about_it = [[9.0, 0.0, 1.0]], [[9.0, 0.0, 1.52], [9.0, 0.0, 0.0], [12.02, 0.0, 1.0], [9.0, -1.02, 1.0]]
    eyes = DriveSensors([1], [1], [1], [1], lambda step, _: [np.array(about_it + on_it * (step >= seen_from))])
    found = detect_approach("r", there, one, eyes, Criterion(points=1, consecutive_scans=1))
    assert (found.ttc_s[0], found.in_time[0], (found.ttc_s[0] >= found.censoring_ttc_s)) == (
        ttc_s,
        in_time,
        seen_from == 0,
    )
    assert found.ttc_without_sensor_s[0, 0] == 0
    # With a braking time above the limit, braking may have been needed before.
    early = one._replace(braking_times_s=np.full(4, 4.1))
    found = detect_approach("r", there, early, eyes, Criterion(points=1, consecutive_scans=1))
    assert math.isnan(found.in_time[0]) if seen_from == 0 else found.in_time[0] == 0


def test_occlusion_until_braking_time_is_too_late(scenario):
    soft, hard = (
        evaluate_traffic_encounters(
            [build_rig(TOP)], scenario, Criterion(points=4, deceleration_mps2=brakes, latency_s=0.3), num_scenes=9
        )
        for brakes in (1.5, 4.0)
    )
    child = {name: next(row for row in found.rows if row.encounter == "on foot") for name, found in
             (("soft", soft), ("hard", hard))}  # fmt: skip
    assert child["soft"].in_time_share == 0.0
    assert child["hard"].in_time_share == 1.0
    assert 1.8 < child["hard"].ttc_s == child["hard"].min_ttc_s < 2.6
    assert [(row.encounter, row.sample_count) for row in hard.rows] == [("on foot", 1), ("from behind", 1), ("all", 2)]
    assert child["hard"].encounters_per_hour == pytest.approx(3600 / 3.1)
    assert math.isnan(child["hard"].interval_low)  # a repeated scene is one scene
    (table,) = soft.build_tables()
    assert table.rows[0][3].text.endswith("too late")


def test_recorded_encounters_equal_simulated_ones(scenario, tmp_path):
    frames = SimulatedFrames(
        scenario, build_rig(TOP), num_frames=31, boxes=True, reference_sensor=PaperReference(rows=2, columns=2)
    )
    write_recording(frames, tmp_path / "drive")
    found, expected = (
        evaluate_recorded_encounters(tmp_path / "drive"),
        evaluate_traffic_encounters([build_rig(TOP)], scenario),
    )
    assert [one.encounter.track.name for one in found.detections] == ["child", "faster"]
    for one, other in zip(found.detections, expected.detections, strict=True):
        assert one.encounter.ttc_s == pytest.approx(other.encounter.ttc_s, abs=1e-5)
        assert one.ttc_s == pytest.approx(other.ttc_s, abs=1e-5)
        assert np.array_equal(one.in_time, other.in_time, equal_nan=True)
        assert (one.ttc_s[0] >= one.censoring_ttc_s) == (other.ttc_s[0] >= other.censoring_ttc_s)
    assert 0 < found.detections[0].ttc_s[0] < 4


class Closing(SyntheticDrive):
    """Drive at 15 m/s behind a car at 5 m/s, with points on it from the ninth frame on."""

    def get_world_T_vehicle(self, index):
        return build_transform(np.eye(3), [1.5 * index, 0.0, 0.0])

    def world_T_car(self, index):
        return build_transform(np.eye(3), [50.0 + 0.5 * index, 0.0, 0.75])

    def read_scan(self, sensor, index):
        back_m, self.back_m = self.back_m, self.back_m[: None if index >= 8 else 0]
        found = super().read_scan(sensor, index)
        self.back_m = back_m
        return found

    def read_boxes(self, index):
        box = super().read_boxes(index)
        return Boxes.from_rows(box.rows, ids=box.ids, categories=("car",))


@pytest.mark.parametrize("layout", ["kitti_raw", "nuscenes", "argoverse2"])
def test_recorded_road_users_are_detected_in_all_layouts(layout, tmp_path):
    recording = open_recording(LAYOUTS[layout](Closing(steps=15), tmp_path))
    (one,) = evaluate_recorded_encounters(recording).detections
    longitudinal_gap_m = 50.0 - CAR_SIZE_M[0] / 2 - recording.ego_box.upper_m[0]
    assert one.encounter.name == "cars and vans"
    assert one.encounter.ttc_s[0] == pytest.approx((longitudinal_gap_m - one.encounter.frame_index) / 10, abs=0.02)
    assert one.ttc_s[0] == pytest.approx((longitudinal_gap_m - 10) / 10, abs=0.02)
    assert one.braking_time_s == pytest.approx(10 / 18 + 0.5, abs=0.01)


@pytest.mark.parametrize(("category", "met"), [("car", 0), ("pedestrian", 1)])
def test_parked_vehicles_are_excluded_but_not_standing_people(category, met):
    class Standing(Closing):
        def world_T_car(self, index):
            return build_transform(np.eye(3), [68.0 + 0.1 * (index % 2), 0.0, 0.75])

        def read_boxes(self, index):
            box = super().read_boxes(index)
            return Boxes.from_rows(box.rows, ids=box.ids, categories=(category,))

    found = evaluate_recorded_encounters(Standing(steps=15, ego_box=BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))))
    assert len(found.detections) == met


def test_invalid_traffic_requests_are_refused(tmp_path):
    with pytest.raises(ValueError, match="nothing moves in it"):
        evaluate_traffic_encounters([build_rig()], build_scenario())
    with pytest.raises(ValueError, match="num_scenes: a number >= 1"):
        evaluate_traffic_encounters([build_rig()], num_scenes=0)
    with pytest.raises(ValueError, match="the size of the vehicle is unknown"):
        evaluate_recorded_encounters(Closing(steps=5))
    with pytest.raises(ValueError, match="none of its 1 objects is a road user, by their categories"):
        evaluate_recorded_encounters(open_recording(LAYOUTS["folder"](Closing(steps=5), tmp_path)))
    way = write_trajectory(tmp_path, (0, 0, 0, 0), (1, 9, 0, 0))
    alone = build_scenario(ego={"shape": CAR, "trajectory": str(way)}, duration_s=1.0)
    far = evaluate_traffic_encounters([build_rig(TOP)], alone)
    assert [(row.encounter, row.sample_count, row.max_ttc_s) for row in far.rows] == [("all", 0, 0.0)]
    (table,) = far.build_tables()
    assert table.rows[0][3].text == "-"
    assert "No encounters" in table.notes[-1]
