"""What is required of bodies and in encounters, as an objective: the share that is kept, the same in all worlds."""

import json

import numpy as np
import pytest

from tests.placement.worlds import EGO, LOT, create_frames, lidar, rig
from torchcover.evaluation.requirements import Requirements
from torchcover.evaluation.requirements_check import check
from torchcover.evaluation.target_visibility import build_flat_ground
from torchcover.placement import Objective, PlacementSearch, SearchPlan, SearchSpace, run_search
from torchcover.targets import Target, measure_visibility_at_positions

# Ahead of an ego that is 4 m long; the last is within it, so that it has no room and is not checked.
PLACES = [[4.5, 0.0], [6.5, 0.0], [9.0, 0.0], [0.0, 0.0]]
CHILD = {"target": "child", "positions": {"points_m": PLACES}, "points": 1}
CROSSING = {
    "name": "a",
    "ego": {"speed_kmh": 30},
    "road_user": {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2},
}
ENCOUNTERS = {"name": "some", "encounters": [CROSSING, {**CROSSING, "name": "b", "ego": {"speed_kmh": 70}}]}
SPAN = {"channels": 4, "vertical_fov_deg": [-4, 4], "columns": 361}
LEVEL = rig(lidar(**SPAN), name="level")
DOWN = rig(lidar(**SPAN, mount={"z_m": 1.9, "pitch_deg": 15.0}), name="down")


def child(**changes):
    return Objective.model_validate({"requirement": {**CHILD, **changes}})


@pytest.fixture(scope="module")
def lot(tmp_path_factory):
    """Its file: a space names its worlds."""
    path = tmp_path_factory.mktemp("scenes") / "lot.yaml"
    traffic = {"type": "parking", "duration_s": 1.0, "time_step_s": 0.2, "crossings_per_aisle": 0, "parked_share": 0.3}
    path.write_text(json.dumps({"name": "lot", "ego": EGO, "traffic": traffic}))
    return str(path)


def run_small_search(lot, out=None, *, objectives=None, resume=False, num_evaluations=8, **changes):
    content = {
        "name": "nose", "start": LEVEL, "scenario": lot,
        "free": {"top": {"pitch_deg": (0.0, 30.0)}}, "objectives": objectives or {"child": child()}, **changes,
    }  # fmt: skip
    plan = SearchPlan(
        num_evaluations=num_evaluations,
        num_scenes=3,
        frames_per_scene=2,
        frame_interval_s=0.4,
        num_held_out_scenes=2,
        num_rays=512,
    )
    return run_search(PlacementSearch(SearchSpace.model_validate(content), plan), out, resume=resume)


def test_objective_is_the_share_of_detected_positions():
    some = create_frames(objectives={"near": Objective(region="20m"), "child": child(), "far": Objective(region="80m")})
    without = create_frames(objectives={"near": Objective(region="20m"), "far": Objective(region="80m")})
    empty, shares = build_flat_ground().model_copy(update={"ego": some._host_scenarios[0].ego}), []
    for each in (LEVEL, DOWN):
        estimate = some.score(each).estimate
        points = measure_visibility_at_positions(each, empty, Target.load("child"), np.array(PLACES)).min_points
        assert np.isnan(points[3])
        assert estimate.value[1] == np.mean(points >= 1)
        assert (estimate.jackknife_values[:, 1] == estimate.value[1]).all()
        assert estimate.quantities[1][0] == "child"
        assert estimate.quantities[1][2:] == ("share", False)
        # The others are what they are without it.
        assert estimate.value[[0, 2]].tolist() == without.score(each).estimate.value.tolist()
        shares.append(float(estimate.value[1]))
    assert shares[0] < shares[1] <= 0.75


def test_encounters_count_if_met_at_all_offsets():
    asked = {"requirement": {"encounters": ENCOUNTERS, "braking": {}}}
    some = create_frames(
        [LOT.model_copy(update={"ego": None})],
        objectives={"crossings": Objective.model_validate(asked)},
        vehicle="van",
        num_scenes=1,
    )
    of_rig = rig(lidar(channels=32, mount={"z_m": 3.2}), vehicle="suv")  # which is not what carries it there
    required = Requirements.model_validate({"requirements": [asked["requirement"]]})
    (verdict,) = check(of_rig, required, vehicle="van").verdicts["small"]
    assert verdict.total_count == 2
    assert some.score(of_rig).estimate.value.tolist() == [(2 - verdict.not_met_count - verdict.undecided_count) / 2]


def test_resumed_search_finds_the_same_rig(lot, tmp_path):
    run_small_search(lot, tmp_path, num_evaluations=2)
    resumed, found = (run_small_search(lot, out, resume=out is not None) for out in (tmp_path, None))
    values = [[one.values for one in of.search.evaluations] for of in (resumed, found)]
    assert values[0] == values[1]
    start, best = (one.estimate.value[0] for one in (found.search.evaluations[0], found.best.evaluation))
    assert (start, best) == (0.0, 0.75)
    assert found.summary.startswith("child: improved by +75.0 points in any scene, optimism +0.00. ")
    (gain,) = found.best.improvements
    assert (gain.average, gain.difference.p_value, gain.difference.error, gain.difference.is_significant) == (
        "-",
        0.0,
        0.0,
        True,
    )
    assert gain.difference.value == gain.search_improvement == best - start
    resumed.save(tmp_path)
    record = json.loads((tmp_path / "search.json").read_text())["finalists"][0]
    assert record["improvements"]["child"]["-"]["p_value"] == 0.0


def test_requirement_objectives_change_without_standard_error(lot):
    """Of the ground ahead more is seen with the nose down, and of an adult far ahead with the nose up."""
    level = {"requirement": {"target": "adult", "positions": {"points_m": [[20.0, 0.0]]}, "points": 1}}
    objectives = {"near": {"region": ("front_3m", "20m"), "band": "ground"}}
    free, kept = (
        run_small_search(lot, objectives=objectives, num_evaluations=16, not_worse=worse) for worse in ((), (level,))
    )
    (name,) = kept.search.space.scored_objectives.keys() - {"near"}
    assert kept.search.evaluations[0].estimate.value.tolist()[1] == 1.0
    assert free.best.evaluation.values["top.pitch_deg"] > 8 > kept.best.evaluation.values["top.pitch_deg"]
    (row,) = (one for one in kept.test.side_effects if one.name == name)
    assert (row.p_value, row.difference.value, row.difference.error) == (1.0, 0.0, 0.0)


def test_where_nothing_is_ever_seen_nothing_is_unknown(lot, tmp_path):
    never = child(points=10**6)
    found = run_small_search(lot, objectives={"near": {"region": "20m"}, "never": never}, num_evaluations=6)
    assert not np.isnan(found.improvements).any()
    assert (found.improvements[:, 1] == 0).all()
    assert "never: no significant improvement: 0 points in any scene" in found.summary
    alone = run_small_search(lot, objectives={"never": never}, num_evaluations=6)
    assert alone.best.is_start
    alone.save(tmp_path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"requirement": CHILD, "region": "20m", "band": "ground"},
            "requirement: it needs no other keys; remove band, region",
        ),
        (
            {"requirement": {"region": "20m", "band": "ground", "number": "radius_m", "max_value": 0.3}},
            "requirement: got one of a region; give number, band and region instead",
        ),
        ({"requirement": {**CHILD, "share": 0.3}}, "requirement: got points >= 1, share >= 0.3; give one bound"),
        ({"requirement": {**CHILD, "positions": "kerb"}}, "requirement.positions: got the name 'kerb'"),
        ({"requirement": {"points": 5}}, "give target, region or encounters"),
    ],
)
def test_what_cannot_be_an_objective_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Objective.model_validate(given)


def test_occupied_positions_are_refused_with_the_start(lot):
    inside = child(positions={"x_m": [-0.5, 0.5], "y_m": [-0.3, 0.3]})
    with pytest.raises(ValueError, match=r"objectives.child: .* no position is free for the target"):
        run_small_search(lot, objectives={"child": inside})
