"""Requirements: verdicts on bounds, positions of test targets, measured numbers, and invalid files."""

import re
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from tests.targets.scenes import build_lidar, build_rig, build_scenario, write_trajectory
from torchcover.encounters import Criterion
from torchcover.encounters.encounter import EncounterSet
from torchcover.evaluation import Readings, Requirements, check, evaluate, evaluate_encounters, judge_bound
from torchcover.evaluation.requirements import TargetRequirement
from torchcover.evaluation.target_positions import TargetPositions
from torchcover.geometry import BoundingBox
from torchcover.placement.selection_space import SelectionSpace
from torchcover.placement.space import SearchSpace
from torchcover.simulation import RegionsOfInterest, Rig, Scenario, document_keys, list_builtin_names
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.documents import explain_document_error
from torchcover.targets import SIDES, Raster, Target, measure_target_visibility

CAR = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
NEAR = {"region": "20m", "band": "ground"}
AHEAD = {"target": "child", "positions": {"points_m": [[5.0, 0.0]]}, "points": 5}
EXAMPLES = Path(__file__).parents[2] / "examples"


def build_requirements(*requirements, **keys):
    return Requirements.model_validate({"requirements": list(requirements), **keys})


def judge(bound, value, low=None, high=None):
    """Judge (N,) values; the locations are their indices."""
    value = np.array(value, dtype=np.float64)
    ends = (np.array(value if end is None else end, dtype=np.float64) for end in (low, high))
    readings = Readings(value, *ends, [str(k) for k in range(len(value))])
    key, min_value, max_value = bound
    requirement = {"region": "20m", "band": "ground", "number": key}
    requirement |= {"min_value": min_value} if min_value else {"max_value": max_value}
    (requirement,) = build_requirements(requirement).requirements
    (bound,) = requirement.bounds
    return judge_bound(requirement.text, bound, readings)


MINIMUM = ("detection_0.4m", 0.9, None)
MAXIMUM = ("radius_m", None, 0.5)


@pytest.mark.parametrize(
    ("bound", "value", "low", "high", "state", "worst", "locations"),
    [
        (MINIMUM, [0.9, 0.95], None, None, "met", 0, ("0", "1")),
        (MINIMUM, [0.95, 0.89], None, None, "not met", 1, ("1",)),
        (MINIMUM, [0.95], [0.91], [0.97], "met", 0, ("0",)),
        (MINIMUM, [0.95], [0.89], [0.97], "not decided", 0, ("0",)),
        (MINIMUM, [0.85], [0.80], [0.91], "not decided", 0, ("0",)),
        (MINIMUM, [0.85], [0.80], [0.89], "not met", 0, ("0",)),
        (MINIMUM, [0.95], [np.nan], [np.nan], "not decided", 0, ("0",)),
        (MINIMUM, [np.nan, 0.95], None, None, "not decided", 1, ("0",)),
        (MINIMUM, [np.nan, 0.1], None, None, "not met", 1, ("1",)),
        (MINIMUM, [], None, None, "not decided", None, ()),
        (MINIMUM, [0.95, 0.85], [0.95, 0.85], [np.inf, np.inf], "not decided", 1, ("1",)),
        (MINIMUM, [0.95], [0.95], [np.inf], "met", 0, ("0",)),
        (MINIMUM, [0.95, 0.8, 0.85], [0.95, 0.8, 0.85], [np.inf, np.inf, 0.85], "not met", 1, ("2",)),
        (MAXIMUM, [0.4], [0.3], [0.49], "met", 0, ("0",)),
        (MAXIMUM, [0.4, 0.45], [0.3, 0.4], [0.49, 0.51], "not decided", 1, ("1",)),
        (MAXIMUM, [0.4, 0.7, np.inf], None, None, "not met", 2, ("2", "1")),
    ],
)
def test_a_bound_needs_the_whole_interval(bound, value, low, high, state, worst, locations):
    verdict = judge(bound, value, low, high)
    assert (verdict.state, verdict.worst_locations, verdict.total_count) == (state, locations, len(value))
    if worst is None:
        assert np.isnan([verdict.value, verdict.margin]).all()
    else:
        sign, limit = (1, bound[1]) if bound[1] else (-1, bound[2])
        margin = np.nan if state == "not decided" else sign * (value[worst] - limit)
        np.testing.assert_allclose([verdict.value, verdict.margin], [value[worst], margin])


def test_positions_are_computed_around_the_vehicle():
    """Areas are sampled up to their border with at most the given spacing; points and lines are exact."""
    behind = TargetPositions(x_m=(-1.0, -0.2), relative_to="rear", spacing_m=0.3).compute_positions_m(CAR)
    assert behind.min(0) == pytest.approx([-3.0, -1.0])
    assert behind.max(0) == pytest.approx([-2.2, 1.0])
    assert np.diff(np.unique(behind[:, 0].round(9))).max() <= 0.3
    assert len(np.unique(behind.round(9), axis=0)) == len(behind) == 4 * 8
    left = TargetPositions(y_m=(0.5, 1.0), relative_to="left", spacing_m=1.0).compute_positions_m(CAR)
    assert left.min(0).tolist() == [-2.0, 1.5]  # along the whole vehicle
    triangle = TargetPositions(polygon_m=((0, 0), (4, 0), (0, 4)), spacing_m=1.0).compute_positions_m(CAR)
    assert len(triangle) == 15  # including its border
    assert (triangle.sum(axis=1) <= 4).all()
    line = TargetPositions(line_m=((3, -1), (3, 1), (5, 1)), spacing_m=0.6).compute_positions_m(CAR)
    assert len(line) == 8
    assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() <= 0.6
    assert TargetPositions(points_m=((1, 2),), relative_to="front").compute_positions_m(CAR).tolist() == [[3.0, 2.0]]
    around = TargetPositions(within_m=1.0, spacing_m=0.5)
    side_positions = [around.model_copy(update={"sides": (side,)}).compute_positions_m(CAR) for side in SIDES]
    positions_m = around.compute_positions_m(CAR)
    distance_m = np.linalg.norm(positions_m - np.clip(positions_m, (-2, -1), (2, 1)), axis=1)
    assert distance_m.max() <= 1.0
    inside = int((distance_m == 0).sum())
    assert sum(map(len, side_positions)) - 4 * inside == len(positions_m) - inside


@pytest.mark.parametrize(
    ("requirement", "message"),
    [
        ({**AHEAD, "target": "chlid"}, "no target is called 'chlid'; is 'child' meant?"),
        ({**AHEAD, "positions": "kreb"}, "no position set is called 'kreb'; is 'kerb' meant?"),
        ({**AHEAD, "pionts": 2}, "pionts"),
        ({**AHEAD, "points": None}, "nothing is required"),
        ({**AHEAD, "positions": {"within_m": 1, "points_m": [[1, 2]]}}, "give one of within_m"),
        ({**AHEAD, "positions": {"points_m": [[1, 2]], "sides": ["front"]}}, "sides go with within_m"),
        ({**AHEAD, "positions": {"polygon_m": [[0, 0], [1, 1], [1, 0], [0, 1]]}}, "its sides cross"),
        (
            {**AHEAD, "counted_sensors": ["a", "b"], "sensors": 3},
            "contradict each other: child_110cm, .*, by a, b: .* sensors >= 3",
        ),
        ({**AHEAD, "counted_sensors": ["a", "a"], "sensors": 2}, "contradict each other"),
        ({**AHEAD, "counted_sensors": ["a", "b"], "sensors": 2, "failing_sensors": "any"}, "contradict each other"),
        ({**AHEAD, "counted_sensors": "a", "failing_sensors": "a"}, "contradict each other"),
        ({**AHEAD, "counted_sensors": "lidar", "pixels": 3}, "contradict each other"),
        ({**AHEAD, "sensors": 1.5}, "sensors"),
        ({**AHEAD, "visual_angle_deg": 400}, "visual_angle_deg"),
        (
            {**AHEAD, "positions": {"within_m": 1000}},
            r"positions over 2004 m with a spacing of 0\.2 m are more than 1,000; use a larger spacing_m",
        ),
        ({"within_m": 1}, "give target, region or encounters"),
        ({"region": "front_3", "band": "ground", "number": "radius_m", "max_value": 1}, "is 'front_3m' meant"),
        (
            {"region": "20m", "band": "grund", "number": "radius_m", "max_value": 1},
            "no height band .* is 'ground' meant",
        ),
        ({"region": "20m", "band": "ground", "number": "radius", "max_value": 1}, "is 'radius_m' meant"),
        ({**NEAR, "number": "radius_m"}, "nothing is required"),
        (
            {**NEAR, "number": "detection_0.4m", "min_value": 90},
            r"detection_0\.4m >= 90: a value above 0 and at most 1 is needed",
        ),
        ({**NEAR, "number": "detection_0.40m", "min_value": 0.9}, r"is 'detection_0\.4m' meant"),
        ({**NEAR, "number": "radius_q0.90_m", "max_value": 1}, r"is 'radius_q0\.9_m' meant"),
        (
            {**NEAR, "number": "detection_0.4m", "max_value": 0.5},
            "max_value: of detection_0.4m more is better; min_value is meant",
        ),
        ({**NEAR, "number": "radius_maximum_m", "min_value": 0.5}, "min_value: of radius_maximum_m less is better"),
        ({**NEAR, "number": "radius_m", "max_value": -1}, "radius_m <= -1: a value above 0 is needed"),
        ({**NEAR, "number": "radius_maximum_m", "max_value": 1, "failing_sensors": "any"}, "failing_sensors: "),
        ({"encounters": "crosing_like", "ttc_s": 1}, "is 'crossing_like' meant"),
        ({"encounters": "crossing_like"}, "nothing is required"),
    ],
)
def test_incomplete_requirements_are_rejected(requirement, message):
    with pytest.raises(ValueError, match=message):
        build_requirements(requirement, position_sets={"kerb": {"points_m": [[3, 0]]}})


def test_requirements_need_different_texts():
    """Tables and JUnit files identify requirements by their texts, which contain all differences."""
    build_requirements(
        AHEAD,
        {**AHEAD, "detection_points": 3},
        {**AHEAD, "name": "again"},
        {**AHEAD, "points": 6},
        {**AHEAD, "counted_sensors": "lidar"},
    )
    late = {"encounters": "crossing_like", "braking": {"deceleration_mps2": 9}}
    requirements = build_requirements(
        {**late, "consecutive_scans": 1}, {**late, "points": 3}, {**late, "braking": {"deceleration_mps2": 4}}
    )
    assert len({requirement.text for requirement in requirements.requirements}) == 3
    with pytest.raises(ValueError, match=r"several requirements read 'child_110cm, .*: points >= 5'; give each a name"):
        build_requirements(AHEAD, {**AHEAD, "target": "child_110cm"})


@pytest.mark.parametrize(
    "requirement",
    [
        *({**AHEAD, key: 3} for key in ("by", "at", "without", "target", "shape")),
        *(
            {**AHEAD, "positions": positions}
            for positions in ({"x": 1}, {"points_m": [[1, 2, 3]]}, {"polygon_m": [[1, 2]]})
        ),
        {"encounters": 3, "ttc_s": 1},
        {"encounters": "crossing_like", "braking": True},
    ],
)
def test_messages_name_keys_of_the_file(requirement):
    with pytest.raises(ValidationError) as raised:
        build_requirements(requirement)
    message = explain_document_error(raised.value)
    assert message.startswith("requirements.0.")
    assert not re.search(r"\(place\)|tuple|literal|function|instance|validation|\.str", message.partition(" (got")[0])


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"counted_sensors": "lidra"}, "no sensor is called 'lidra'; is 'lidar' meant?"),
        ({"failing_sensors": ["tpo"]}, "no sensor is called 'tpo'; is 'top' meant?"),
        ({"positions": {"x_m": [0, 9000], "y_m": [0, 1]}}, "use a larger spacing_m"),
    ],
)
def test_unknown_sensors_and_huge_areas_are_rejected(keys, message):
    with pytest.raises(ValueError, match=message):
        check(build_rig(), build_requirements({**AHEAD, **keys}), build_scenario())


CAMERA = {"type": "camera", "name": "front", "width": 80, "height": 60, "fov_deg": 90, "stride": 2, "max_range_m": 50}
POST = {"name": "post", "shape": {"type": "box", "size_m": [0.2, 3.0, 3.0]}, "poses": [{"x_m": 0.5}]}
THREE = build_rig(
    build_lidar(mount={"x_m": -1.0, "z_m": 1.4}),
    build_lidar("mast", mount={"z_m": 1.2}, housing=[POST]),
    {**CAMERA, "mount": {"x_m": 1.8, "z_m": 1.3}},
)


def test_judged_numbers_equal_the_measured_visibility():
    """Numbers of all sensors, of some, and without a failed one whose housing still hides others."""
    raster, child = Raster((3.5, 6.5), (-1.0, 1.0), 1.0), Target.load("child")
    positions = {"points_m": raster.positions_m.tolist()}
    target_map = measure_target_visibility(THREE, build_scenario(), child, raster, detection_points=1)
    requirement = {
        "target": "child",
        "positions": positions,
        "points": 5,
        "sensors": 1,
        "share": 0.1,
        "pixels": 4,
        "visual_angle_deg": 1,
        "detection_points": 1,
    }
    requirements = build_requirements(
        requirement,
        {**requirement, "counted_sensors": ["lidar"], "pixels": None},
        {**requirement, "counted_sensors": ["top", "mast"], "pixels": None, "failing_sensors": "mast"},
    )
    found = check(THREE, requirements, build_scenario()).verdicts["small"]
    all_of, lidars, top = found[:5], found[5:9], found[9:]
    worst = {v.bound.key: v.value for v in all_of}
    assert worst["points"] == target_map.min_points.min() > 0
    assert worst["sensors"] == target_map.min_sensors.min()
    assert worst["share"] == target_map.surface_share.min()
    assert worst["pixels"] == target_map.sensor_points[2].min()  # minimum and mean of one frame are equal
    distance_m = np.hypot(*(raster.positions_m - (1.8, 0.0)).T)  # all positions are ahead of the camera
    angle = np.rad2deg(np.arctan(1.3 / distance_m) - np.arctan((1.3 - child.solid.bounding_box.size_m[2]) / distance_m))
    assert worst["visual_angle_deg"] == pytest.approx(angle.min())
    assert {v.bound.key: v.value for v in lidars}["points"] == target_map.sensor_points[:2].sum(axis=0).min()
    # The mast hides the target from the LiDAR behind it, also if the sensor on the mast has failed.
    assert {v.bound.key: v.value for v in top}["points"] == target_map.sensor_points[0].min() == 0
    assert [v.total_count for v in top] == [2 * len(raster.positions_m)] * 4  # with and without the failed sensor


def test_occupied_points_are_unknown_and_areas_exclude_them():
    inside, near = (
        {**AHEAD, "positions": {"points_m": [[0, 0], [5, 0]]}},
        {**AHEAD, "positions": {"x_m": [0, 5], "y_m": [0, 0.1]}},
    )
    nowhere = {**AHEAD, "positions": {"x_m": [-1, 1], "y_m": [0, 0.1]}}
    found = check(
        build_rig(build_lidar(channels=61)), build_requirements(inside, near, nowhere), build_scenario()
    ).verdicts["small"]
    assert [(verdict.state, verdict.undecided_count) for verdict in found] == [
        ("not decided", 1),
        ("met", 0),
        ("not decided", 0),
    ]
    assert found[0].worst_locations == ("x = 0.00, y = 0.00 m, occupied",)
    assert 0 < found[1].total_count < 2 * 26
    assert [verdict.occupied_count for verdict in found] == [0, 52 - found[1].total_count, 22]


def test_locations_name_frames_with_free_position(tmp_path):
    """A box drives over the position and occupies it in one of four frames."""
    passing = {"name": "p", "category": "car", "shape": {"type": "box", "size_m": [2.0, 1.0, 1.0]},
               "trajectory": write_trajectory(tmp_path, (0, 5, 0, 0), (2, 13, 0, 0))}  # fmt: skip
    scenario = build_scenario(actors=[passing], duration_s=2.0, time_step_s=0.5)
    (found,) = check(build_rig(build_lidar(channels=61)), build_requirements(AHEAD), scenario, num_frames=4).verdicts[
        "small"
    ]
    assert (found.state, found.worst_locations) == ("met", ("x = 5.00, y = 0.00 m, free in 3 of 4 frames",))


def test_missing_sensor_kinds_detect_nothing():
    tight = {**AHEAD, "positions": {"within_m": 0.01}}
    found = check(
        build_rig(), build_requirements({**AHEAD, "counted_sensors": "camera"}, tight), build_scenario()
    ).verdicts["small"]
    assert [(verdict.state, verdict.total_count) for verdict in found] == [("not met", 1), ("not decided", 0)]
    assert found[0].margin == -5.0
    with pytest.raises(ValueError, match="at least one rig"):
        check([], build_requirements(AHEAD))


def test_region_numbers_equal_those_of_evaluate():
    regions = {"near": {"x_m": [2.5, 8.0], "y_m": [-2.0, 2.0]}}
    keys = {"regions": regions, "grid": {"x_m": [-4, 9], "y_m": [-4, 4], "cell_m": 1.0}}
    requirement = {"region": "near", "band": "ground", "failing_sensors": ["front"]}
    detection = {**requirement, "number": "detection_0.3m", "min_value": 0.001}
    radius = {**requirement, "number": "radius_m", "max_value": 1e-6}
    requirements = build_requirements(detection, radius, **keys)
    found = check(THREE, requirements, build_scenario(), num_frames=12, num_workers=0).verdicts["small"]
    regions = RegionsOfInterest.model_validate(keys)
    result = evaluate(
        THREE, build_scenario(), num_frames=12, num_workers=0, thresholds_m=0.3, redundancy=True, regions=regions
    )
    (row,) = (row for row in result.summary if row["band"] == "ground")
    for verdict, key, worse in zip(found, ("detection_0.3m", "radius_m"), (min, max), strict=True):
        assert verdict.value == worse(row[key], row[f"{key}_without_front"]) != row[key]
        assert verdict.total_count == 2
    assert found[0].worst_locations[0] == "near ground without front"


@pytest.mark.parametrize(("more", "is_named"), [({}, True), ({"range_noise_share": 0.02}, False)])
def test_requirements_of_regions_name_cameras_with_perfect_depth(more, is_named):
    camera = {"type": "camera", "name": "eye", "mount": {"z_m": 2.0}, "width": 16, "height": 12, "fov_deg": 90.0}
    found = check(
        build_rig({**camera, "max_range_m": 50.0, **more}),
        build_requirements({**NEAR, "number": "detection_0.4m", "min_value": 0.5}),
        "courtyard",
        num_frames=1,
        num_workers=0,
    )
    for notes in (found.record["notes"], found.build_tables()[0].notes):
        assert any("Perfect depth is assumed for cameras of" in note for note in notes) == is_named


@pytest.fixture
def box(tmp_path):
    path = tmp_path / "box.yaml"
    path.write_text("name: box\nparts: [{name: b, shape: {type: box, size_m: [4, 2, 1]}}]\n")
    return path


def test_times_to_collision_are_minima_over_start_offsets(box):
    walker = {"body": "child_120cm", "speed_kmh": 5, "approach_distance_m": 4}
    crossings = {"name": "two", "encounters": [{"name": "a", "ego": {"speed_kmh": [10, 30]}, "road_user": walker}]}
    criterion = {"points": 1, "pixels": 20}
    requirement = {
        "encounters": crossings,
        **criterion,
        "consecutive_scans": 2,
        "ttc_s": 0.5,
        "braking": {"deceleration_mps2": 4, "latency_s": 1.0},
        "failing_sensors": ["mast"],
    }
    requirements = build_requirements(requirement)
    ttc, spare = check(THREE, requirements, vehicle=box).verdicts["small"]
    detections = evaluate_encounters(
        THREE, requirements.requirements[0].encounters, Criterion(**criterion, consecutive_scans=2), vehicle=box
    ).detections
    latest_s = [min(item.ttc_s.min(), item.ttc_without_sensor_s[1].min()) for item in detections]
    needed_s = [abs(item.encounter.ego.speed_mps) / 8 + 1.0 for item in detections]
    assert (ttc.value, ttc.total_count) == (min(latest_s), 4)
    assert 0.0 < ttc.value < min(item.ttc_s.max() for item in detections)
    assert spare.value == pytest.approx(min(np.subtract(latest_s, needed_s)))
    assert "at 30 km/h" in spare.worst_locations[0]


def test_detections_at_the_start_are_lower_limits(box):
    """A bound above the lower limit is not decided, also if a sensor fails."""
    encounter = {
        "name": "a",
        "ego": {"speed_kmh": 20},
        "road_user": {"body": "adult", "speed_kmh": 5},
        "max_lead_time_s": 1.2,
    }
    requirement = {
        "encounters": {"name": "short", "encounters": [encounter]},
        "points": 2,
        "consecutive_scans": 2,
        "failing_sensors": "any",
    }
    two = build_rig(build_lidar(), build_lidar("mast", mount={"z_m": 1.2}))
    brakes = {"deceleration_mps2": 9, "latency_s": 0.75}
    found = check(
        two,
        build_requirements({**requirement, "ttc_s": 0.9}, {**requirement, "ttc_s": 1.1, "braking": brakes}),
        vehicle=box,
    )
    met, ttc, spare = found.verdicts["small"]
    assert [(verdict.state, verdict.undecided_count) for verdict in (met, ttc, spare)] == [
        ("met", 0),
        *[("not decided", 3)] * 2,
    ]
    assert 0.9 < ttc.value == ttc.low < 1.1 < ttc.high == np.inf
    assert spare.value == pytest.approx(ttc.value - 20 / 3.6 / 18 - 0.75)
    (table,) = found.build_tables()
    assert [cell.text for cell in table.rows[1]][2:5] == ["not decided", f"{ttc.value:.4g} or more", "-"]
    with pytest.raises(ValueError, match=r"1\.5 s are required, and encounter 'a' at 20 km/h .* lasts 1\.1\d s"):
        check(two, build_requirements({**requirement, "ttc_s": 1.5}), vehicle=box)
    encounter["road_user"]["approach_distance_m"] = 1.65  # appears after the first scans
    assert check(two, build_requirements({**requirement, "ttc_s": 1.1}), vehicle=box).is_met is False


@pytest.mark.parametrize(
    ("name", "rig_name", "keys"),
    [("robot", EXAMPLES / "robot" / "delivery_robot.yaml", {"vehicle": EXAMPLES / "robot" / "body.ply"}),
     ("car", "kitti", {"num_frames": 16, "num_workers": 0})],
)  # fmt: skip
def test_examples_meet_their_requirements(name, rig_name, keys):
    found = check(rig_name, EXAMPLES / name / "requirements.yaml", **keys)
    assert found.is_met, found.build_tables()


def test_pixels_and_points_have_different_bounds(box):
    (reversing,) = Requirements.load("reversing_r158_cameras").requirements
    far = reversing.model_copy(update={"positions": TargetPositions(points_m=((-3.5, 0.0),), relative_to="rear")})
    coarse = {**CAMERA, "mount": {"x_m": -2.1, "z_m": 1.0, "yaw_deg": 180}, "width": 48, "height": 36, "stride": 1}
    points = far.model_copy(update={"pixels": None, "points": 5, "name": "as points"})
    pixels, as_points = check(build_rig(coarse), build_requirements(far, points), vehicle=box).verdicts["small"]
    assert (pixels.state, as_points.state, pixels.value) == ("not met", "met", as_points.value)


@pytest.mark.parametrize("name", list_builtin_names("requirements"))
def test_built_in_sets_state_source_and_limits(name):
    found = Requirements.load(name)
    assert found.name == name
    assert "geometry, no homologation" in found.description
    assert "In doubt: " in found.description
    for requirement in found.requirements:
        if isinstance(requirement, TargetRequirement):
            is_camera = requirement.counted_sensors == ("camera",)
            assert (requirement.points is None) == is_camera != (requirement.pixels is None)
    assert "memory" not in found.description


KINDS = {
    "a rig": (Rig, "sensors: []"),
    "a vehicle": (Vehicle, "parts: []"),
    "a scenario": (Scenario, "traffic: {type: city}"),
    "a search space": (SearchSpace, "scenario: urban\nobjectives: []\nfree: {}\nstart: kitti"),
    "a set of requirements": (Requirements, "requirements: []\nscenario: urban"),
    "a set of encounters": (EncounterSet, "encounters: []"),
    "a file of regions": (RegionsOfInterest, "regions: {}\ngrid: {}"),
}


@pytest.mark.parametrize(("needed", "given"), list(permutations(KINDS, 2)))
def test_files_of_other_kinds_are_recognized(tmp_path, needed, given):
    (tmp_path / "file.yaml").write_text(f"name: x\n{KINDS[given][1]}\n")
    with pytest.raises(ValueError, match=rf"file\.yaml: this is {given}; {needed} is needed$"):
        KINDS[needed][0].load(tmp_path / "file.yaml")


def test_keys_of_kinds_equal_document_fields():
    for kind, (document, _) in KINDS.items():
        documents_of_kind = (document, SelectionSpace) if document is SearchSpace else (document,)
        fields = {name for item in documents_of_kind for name in item.model_fields} - {"name", "description"}
        assert document.kind == kind
        assert set(" ".join(document_keys.KINDS[kind]).split()) == fields


@pytest.mark.parametrize(("kind", "name"), [("rigs", "urban"), ("scenarios", "kitti"), ("vehicles", "urban")])
def test_built_in_names_of_other_kinds_are_recognized(kind, name):
    document = {"rigs": Rig, "scenarios": Scenario, "vehicles": Vehicle}[kind]
    with pytest.raises(FileNotFoundError, match=rf"'{name}' is one of the built-in \w+; one of the {kind} is needed"):
        document.load(name)


def test_keys_in_other_units_get_advice():
    for key, expected in (("yaw_rad", "yaw_deg"), ("x_mm", "x_m"), ("pitch_rad", "pitch_deg"), ("max_range_km", None)):
        with pytest.raises(ValueError, match="x") as raised:
            Rig.model_validate({"name": "x", "sensors": [{"name": "s", "type": "lidar", "mount": {key: 1.0}}]})
        assert f"is {expected} meant?" in explain_document_error(raised.value) or expected is None
