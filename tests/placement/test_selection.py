"""A choice of candidates: points reproduce the scores of rigs, and invalid candidates are refused."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.placement.worlds import BAY, EGO, FLOOR, LOT, WALL, create_frames, lidar, rig
from torchcover import Rig
from torchcover.placement import Objective, SelectionSpace, run_selection
from torchcover.placement.selection import compute_point_weights, observe_points

SENSOR = {"type": "lidar", "channels": 16, "vertical_fov_deg": [-40, 2], "columns": 91, "horizontal_fov_deg": 180,
          "max_range_m": 60}  # fmt: skip
PLACES = {
    "front": {"x_m": 1.5, "z_m": 1.9},
    "rear": {"x_m": -1.5, "z_m": 1.9, "yaw_deg": 180},
    "left": {"y_m": 0.8, "z_m": 1.9, "yaw_deg": 90},
    "inside": {"z_m": 0.7},
}
SPACE = {
    "name": "ends",
    "scenario": "lot.yaml",
    "candidates": {"wide": {"sensor": SENSOR, "mounts": PLACES}},
    "constraints": {"max_sensors": 2},
    "objectives": {"around": {"band": "ground", "region": ["front_3m", "rear_3m"]}},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("choice")
    traffic = {"type": "parking", "duration_s": 1.0, "time_step_s": 0.2, "crossings_per_aisle": 0, "parked_share": 0.3}
    (path / "lot.yaml").write_text(yaml.safe_dump({"name": "lot", "ego": EGO, "traffic": traffic}))
    return path


def load_space(folder, **changes):
    path = folder / "space.yaml"
    path.write_text(yaml.safe_dump({**SPACE, **changes}))
    return SelectionSpace.load(path)


CHOSEN_BY = [Objective(threshold_m=0.3, region=["80m", "20m"]), Objective(region=BAY, band="ground")]


@pytest.mark.parametrize("measure", ["area", "cells"])
@pytest.mark.parametrize("objective", CHOSEN_BY)
def test_point_weights_reproduce_evaluate(objective, measure):
    """The OR of what sensors see, in bits, and the coverage of all of them."""
    sensors = [
        lidar("a", mount={"x_m": 2.2, "z_m": 0.6}, horizontal_fov_deg=100),
        lidar("b", mount={"y_m": 1.2, "z_m": 0.9, "yaw_deg": 70}, channels=24, horizontal_fov_deg=200),
        lidar("c"),
    ]
    with create_frames(objectives={"a": objective}, average=measure) as instants:
        weights = compute_point_weights(instants)
        assert weights.sum() == pytest.approx(1.0, rel=1e-12)
        seen = [observe_points(rig(sensor), instants)[0] for sensor in sensors]
        for each in ([0], [1, 2], [0, 1, 2]):
            expected = float(instants.score(rig(*(sensors[one] for one in each))).estimate.value[0])
            assert weights[0] @ np.any([seen[one] for one in each], axis=0) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("measure", ["area", "cells"])
def test_scenes_without_a_region_do_not_count(measure):
    yard = {"name": "yard", "ego": EGO, "bodies": [FLOOR]}
    walled = {"name": "walled", "ego": EGO, "bodies": [FLOOR, WALL]}
    scenarios = [type(LOT).model_validate(one) for one in (yard, walled)]
    asked = {"a": Objective(region="20m", band="obstacle")}
    with create_frames(scenarios, asked, frames_per_scene=1, frame_interval_s=0.1, average=measure) as two:
        value = float(two.score(rig()).estimate.value[0])
        assert compute_point_weights(two)[0] @ observe_points(rig(), two)[0] == pytest.approx(value, rel=1e-12)
    with (
        create_frames(scenarios[:1], asked, frames_per_scene=1, frame_interval_s=0.1) as one,
        pytest.raises(ValueError, match="no frame contains a visible surface of obstacle in 20m"),
    ):
        compute_point_weights(one)


def test_selection_is_the_best_scored_rig(folder):
    space = load_space(folder, baseline=["wide_left"])
    with create_frames(space.scenarios, space.scored_objectives, num_scenes=2) as instants:
        found = run_selection(space, instants, test_seed=5, num_held_out_scenes=3)
        pairs = [("front", "rear"), ("front", "left"), ("rear", "left")]
        named = {sensor.name: sensor for sensor in space.sensors}
        scores = {
            pair: float(
                instants.score(space.build_rig(tuple(named[f"wide_{one}"] for one in pair), "x")).estimate.value[0]
            )
            for pair in pairs
        }
    best = max(scores, key=lambda pair: scores[pair])
    assert set(found.get_sensor_names(found.best.selected)) == {f"wide_{one}" for one in best}
    assert found.best.values[0] == pytest.approx(scores[best], rel=1e-12)
    assert found.numbers["around"].value == scores[best]
    assert f"{100 * found.numbers['around'].value:.2f} %" in found.summary
    assert found.best.is_proven
    assert list(found.excluded) == ["wide_inside"]
    assert found.improvements[0].difference.block_count == 3
    assert found.improvements[0].search_improvement == pytest.approx(
        found.best.values[0] - found.coverage.compute_values(found.baseline)[0], rel=1e-6
    )
    written = {path.name for path in found.save(folder / "out")}
    assert written == {
        "best.yaml", "candidates.csv", "sizes.csv", "search.json", "sizes.png", "report.html", "summary.json",
    }  # fmt: skip
    assert Rig.load(folder / "out" / "best.yaml").sensors == found.rig.sensors
    rows = list(csv.DictReader((folder / "out" / "candidates.csv").read_text().splitlines()))
    assert [row["name"] for row in rows if row["selected"] == "True"] == sorted(
        found.get_sensor_names(found.best.selected)
    )
    assert "inside" in rows[-1]["reason"]
    assert found.to_dataframe()["name"].tolist() == [row["name"] for row in rows]
    assert found.summary in repr(found)
    assert json.loads((folder / "out" / "search.json").read_text())["selections"][0]["is_proven"] is True


def test_best_selection_meets_not_worse_bounds(folder):
    objectives = {side: {"band": "ground", "region": f"{side}_3m", "threshold_m": 0.3} for side in ("front", "rear")}
    space = load_space(folder, objectives=objectives, baseline=["wide_left"], not_worse=["left_3m"])
    with create_frames(space.scenarios, space.scored_objectives, num_scenes=2) as instants:
        found = run_selection(space, instants, test_seed=5, num_held_out_scenes=3)
        kept = found.coverage.compute_values(found.baseline)[2]
        # The thresholds differ: the weight of a point depends on both.
        values = instants.score(found.rig).estimate.value.tolist()
    assert found.best.values == pytest.approx(values, rel=1e-12)
    assert list(space.scored_objectives) == ["front", "rear", "not worse: left_3m"]
    assert all(
        one.values[2] >= kept - 2e-6 and "wide_left" in found.get_sensor_names(one.selected) for one in found.selections
    )
    assert [one.values[at] for at, one in enumerate(found.selections[1:])] == [
        max(one.values[at] for one in found.selections) for at in range(2)
    ]
    assert "compromise between front, rear" in found.summary
    written = {path.name for path in found.save(folder / "several", files=["numbers"])}
    assert {"best.yaml", "best_front.yaml", "best_rear.yaml"} < written


def test_infeasible_bounds_report_the_smallest_shortfall(folder):
    space = load_space(
        folder, constraints={"max_sensors": 1}, baseline=["wide_front", "wide_rear"], not_worse=["front_3m", "rear_3m"]
    )
    with create_frames(space.scenarios, space.scored_objectives, num_scenes=1) as instants:
        found = run_selection(space, instants, test_seed=5, num_held_out_scenes=1)
        each = {at: found.coverage.compute_values([at])[1:] for at in range(len(found.sensors))}
        kept = found.coverage.compute_values(found.baseline)[1:]
    short = {at: (kept - values).clip(0).sum() for at, values in each.items()}
    assert found.best.shortfall == pytest.approx(min(short.values()))
    assert found.best.shortfall > 0.01
    assert short[found.best.selected[0]] == min(short.values())
    lost = kept - each[found.best.selected[0]]
    names = [name for name in space.scored_objectives if name not in space.objectives]
    told = [f"{100 * lack:.2f} points of {name}" for lack, name in zip(lost, names, strict=True) if lack > 1e-6]
    assert f"meets all bounds, and this one has the smallest shortfall: {'; '.join(told)}" in found.summary


def test_candidates_with_many_self_hits_are_refused(folder):
    low = {"front": PLACES["front"], "flat": {"z_m": 1.51}}
    candidates, limits = {"wide": {"sensor": SENSOR, "mounts": low}}, {"max_sensors": 1, "max_self_hit_share": 0.4}
    space = load_space(folder, candidates=candidates, constraints=limits)
    with create_frames(space.scenarios, space.scored_objectives, num_scenes=1) as instants:
        found = run_selection(space, instants, test_seed=5, num_held_out_scenes=1)
    assert "of its rays hit the vehicle; max_self_hit_share is 40.0%" in found.excluded["wide_flat"]


def test_mount_grid_lies_on_the_region(tmp_path):
    grid = {"region": ["roof", "hood"], "spacing_m": 0.6, "height_m": 0.2, "yaw_deg": [0, 90]}
    candidates = {"wide": {"sensor": SENSOR, "grid": grid}}
    space = load_space(tmp_path, scenario="courtyard", vehicle="suv", candidates=candidates)
    names = [sensor.name for sensor in space.sensors]
    assert len(set(names)) == len(names) > 10
    assert all(name.startswith(("wide_roof_", "wide_hood_")) for name in names)
    assert {round(sensor.mount.yaw_deg) for sensor in space.sensors} == {0, 90}
    body = space.scenarios[0].build_ego_mesh()
    top_m = body.vertices_m[:, 2].max()
    assert all(0.9 < sensor.mount.z_m <= top_m + 0.2 + 1e-6 for sensor in space.sensors)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"constraints": {}}, "max_sensors, max_cost_eur: got neither"),
        ({"constraints": {"max_cost_eur": 500}}, "prices_eur: wide has no price"),
        (
            {"constraints": {"max_cost_eur": 500}, "prices_eur": {"wide": 600}},
            "got 500, but the cheapest candidate costs 600",
        ),
        ({"prices_eur": {"narrow": 1}}, "prices_eur: narrow is no group of candidates"),
        ({"baseline": ["wide_top"]}, "baseline: wide_top is no candidate"),
        ({"baseline": ["wide_left", "wide_left"]}, "baseline: wide_left is named twice"),
        ({"fixed_rig": "front_roof_32", "baseline": ["roof"]}, "baseline: roof is no candidate; they are wide_front"),
        ({"scenario": "moon"}, "'moon' is neither"),
        ({"candidates": {"wide": {"sensor": SENSOR}}}, "mounts, grid: got neither"),
        (
            {"candidates": {"wide": {"sensor": {**SENSOR, "name": "x"}, "mounts": PLACES}}},
            "name: mounts and grid define them",
        ),
        (
            {"candidates": {"wide": {"sensor": SENSOR, "grid": {"region": ["wing"], "spacing_m": 1}}}},
            "candidates.wide.grid.region: .* has no 'wing'",
        ),
        ({"objectives": {"a": {"band": "sky", "region": "20m"}}}, "sky"),
        (
            {"objectives": {"a": {"number": "radius_m", "region": "20m"}}},
            "got 'radius_m', but a selection needs a detection rate",
        ),
        ({"objectives": {"a": {"region": "behind"}}}, "behind"),
        ({"not_worse": ["20m"]}, "not_worse: there is no baseline"),
        ({"candidates": {}}, "candidates"),
    ],
)
def test_invalid_selection_is_refused_in_one_line(folder, changes, message):
    with pytest.raises(ValueError, match=message) as error:
        load_space(folder, **changes)
    assert "space.yaml" in str(error.value)


def test_candidates_that_are_all_inside_are_refused(folder):
    space = load_space(folder, candidates={"wide": {"sensor": SENSOR, "mounts": {"a": {"z_m": 0.7}}}})
    with (
        create_frames(space.scenarios, space.scored_objectives, num_scenes=1) as instants,
        pytest.raises(ValueError, match=r"none of 1 can be mounted; wide_a: .* inside the ego"),
    ):
        run_selection(space, instants, test_seed=5, num_held_out_scenes=1)


def test_candidates_that_see_nothing_that_counts_are_refused(folder):
    up = {**SENSOR, "vertical_fov_deg": [60, 80]}
    space = load_space(folder, candidates={"wide": {"sensor": up, "mounts": PLACES}})
    with (
        create_frames(space.scenarios, space.scored_objectives, num_scenes=1) as instants,
        pytest.raises(ValueError, match="none of the 3 that can be mounted improves"),
    ):
        run_selection(space, instants, test_seed=5, num_held_out_scenes=1)


def test_few_held_out_scenes_show_no_improvement(folder):
    space = load_space(folder, baseline=["wide_left"])
    with create_frames(space.scenarios, space.scored_objectives, num_scenes=1) as instants:
        found = run_selection(space, instants, test_seed=5, num_held_out_scenes=1)
    assert "no significant improvement" in found.summary
    assert "nan" not in found.summary
    found.save(folder / "few")
    assert json.loads((folder / "few" / "search.json").read_text())["improvements"]["around, area"]["error"] is None


def test_example_budget_excludes_two_wide_sensors():
    space = SelectionSpace.load(Path(__file__).parents[2] / "examples" / "placement" / "robot_corners.yaml")
    limits = space.build_limits(list(range(12)))
    assert len(space.sensors) == 12
    assert limits.can_add([0], 7)
    assert not limits.can_add([0], 1)
