"""A search: the same candidates whatever ends it, constraints that hold, and words for all that goes wrong."""

import json
import sys

import numpy as np
import pytest

from tests.placement.surfaces import Surface, compute_near_far, plan, space
from torchcover.evaluation.check_result import CheckResult
from torchcover.evaluation.verdicts import Verdict
from torchcover.files import BadFileError
from torchcover.placement import OptimizerParams, PlacementSearch, SearchPlan, SearchSpace, run_search
from torchcover.placement.running import JOURNAL
from torchcover.simulation import Rig

RANDOM_ONLY = OptimizerParams(num_startup_candidates=0, random_interval=1)


def run_small_search(out=None, *, of=None, resume=False, **settings):
    search = PlacementSearch(space() if of is None else of, plan(**settings))
    return run_search(search, out, resume=resume)


def dump_evaluations(search):
    """All evaluations without their times, for comparison."""
    return [json.dumps({**each.to_record(), "duration_s": 0}) for each in search.evaluations]


class Ended(Exception):  # noqa: N818
    """Ends a process at any moment."""


def make_ending_frames(count):
    class EndsAfter(Surface):
        def score(self, rig):
            if len(self.scored) > count:
                raise Ended
            return super().score(rig)

    return lambda space, plan, seed, worlds: EndsAfter(
        seed, worlds, plan.frames_per_scene, objectives=space.scored_objectives
    )


def test_start_is_first_and_random_candidates_are_control():
    result = run_small_search(num_evaluations=24)
    evaluations = result.search.evaluations
    assert [each.number for each in evaluations] == list(range(25))
    strategies = [each.strategy for each in evaluations]
    assert strategies[:7] == ["start", *["random"] * 6]
    assert result.strategy_counts == {"optimizer": 12, "random": 12}
    assert result.search.frames.closed
    assert len(set(map(str, (each.values for each in evaluations)))) == 25


def test_startup_covers_all_options_and_range_ends():
    models = ("hesai_pandar64", "ouster_os1_64", "ouster_os1_128", "velodyne_vlp16", "velodyne_hdl32e")
    of = space(free={"roof": {"model": models, "x_m": (-0.6, 0.8)}})
    startup = run_small_search(of=of, num_evaluations=5).search.evaluations[1:]
    assert {each.values["roof.model"] for each in startup} == set(models)
    assert sorted((each.values["roof.x_m"] + 0.6) // 0.28 for each in startup) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("seed", range(3))
def test_optimizer_beats_random_on_held_out_scenes(seed):
    result, random = (
        run_small_search(num_evaluations=20, seed=seed),
        run_small_search(num_evaluations=20, seed=seed, optimizer_params=RANDOM_ONLY),
    )
    best, control = result.finalists
    assert abs(best.evaluation.values["roof.pitch_deg"] - 4) < 1.5
    (gain,) = best.improvements
    assert gain.average == "area"
    assert gain.t_statistic > 4
    assert gain.difference.block_count == 16
    assert gain.optimism == gain.search_improvement - gain.difference.improvement
    assert gain.search_improvement >= max(
        control.improvements[0].search_improvement, np.nanmax(random.search.improvements)
    )
    assert result.summary.startswith("near: improved by ")
    assert "Control, the best of 10 random candidates: near: improved by" in result.summary
    assert random.strategy_counts == {"optimizer": 0, "random": 20}


def test_what_must_not_be_worse_is_kept():
    """Near likes the nose down, far likes it up: what is best near loses far."""
    free, kept = (
        run_small_search(of=space(not_worse=not_worse), num_evaluations=24) for not_worse in ((), ({"region": "80m"},))
    )
    assert free.best.evaluation.values["roof.pitch_deg"] > 2
    assert kept.best.evaluation.values["roof.pitch_deg"] < 0.8
    search = kept.search
    start, best = search.evaluations[0].estimate.value, kept.best.evaluation.estimate.value
    assert (best >= start).all()
    assert [gain.objective for gain in kept.best.improvements] == ["near", "not worse: 80m"]
    for each in search.evaluations:
        assert bool(search.find_shortfalls(each)) == bool(each.estimate.value[1] < start[1] - 1e-9)
    keeps = {name: [] for name in ("start", "random", "optimizer")}
    for each in search.evaluations:
        keeps[each.strategy].append(not search.find_shortfalls(each))
    assert np.mean(keeps["optimizer"]) > np.mean(keeps["random"])
    assert "No candidate meets" not in kept.summary


def required(*bounds, **target):
    regions = [{"region": "20m", "band": "ground", "number": "detection_0.4m", **bound} for bound in bounds]
    child = [{"target": "child", "positions": {"points_m": [[5.0, 0.0]]}, **target}] if target else []
    return {"requirements": [*regions, *child]}


def test_unmet_bounds_end_with_the_smallest_shortfall():
    """The second number of a surface likes the nose up, and is 0.4 at most."""
    result = run_small_search(of=space(requirements=required({"min_value": 0.5})), num_evaluations=24)
    search = result.search
    missing = [sum(search.find_shortfalls(each).values()) for each in search.evaluations]
    best = missing[result.best.evaluation.number]
    assert missing[0] > best == min(missing) > 0
    assert result.best.evaluation.values["roof.pitch_deg"] < -1
    (name,) = search.find_shortfalls(result.best.evaluation)
    assert name == "required: 20m, ground, detection_0.4m >= 0.5"
    assert f"meets all bounds; this one has the smallest shortfall: {best:.2%} of {name}." in result.summary
    assert f"{best:.2%} of {name}" in [row[-1] for row in result.report.csv_tables["evaluations.csv"]]


def require_pitch(pitch_deg):
    """A check of a child that is seen only with the nose so far down."""

    def check(rig, required, world, **settings):
        margin = rig.sensors[0].mount.pitch_deg - pitch_deg
        (requirement,) = required.requirements
        (bound,) = requirement.bounds
        counts = 1, int(margin < 0), 0, ()
        state = "met" if margin >= 0 else "not met"
        verdict = Verdict(requirement.text, bound, state, 0, 0, 0, margin, *counts)
        return CheckResult(required, {rig.name: [verdict]}, {})

    return check


@pytest.mark.parametrize(("needed_deg", "lowest", "highest"), [(5.0, 5.0, 9.0), (50.0, 12.0, 15.0)])
def test_target_requirements_are_met_or_nearly_met(monkeypatch, needed_deg, lowest, highest):
    """The best near is 4 degrees; a child needs 5, or more than the range has."""
    monkeypatch.setattr("torchcover.placement.objective.check", require_pitch(needed_deg))
    result = run_small_search(of=space(requirements=required(points=5)), num_evaluations=24)
    assert list(result.search.evaluations[0].shortfalls) == ["child_110cm, points_m [[5.0, 0.0]], points >= 5"]
    assert lowest <= result.best.evaluation.values["roof.pitch_deg"] <= highest
    assert bool(result.best.evaluation.shortfalls) == (needed_deg > 15)


def test_targets_stand_around_the_vehicle_of_the_space():
    for points, is_kept in ((5, True), (10**6, False)):
        search = PlacementSearch(space(requirements=required(points=points)), plan(num_evaluations=1))
        search.evaluate(search.ask())
        assert (search.evaluations[0].shortfalls == {}) == is_kept


def test_requirements_in_other_bands_or_directions_are_refused():
    with pytest.raises(ValueError, match=r"max_value: of detection_0\.4m more is better; min_value is meant"):
        space(requirements=required({"min_value": 0.9}, {"max_value": 0.5}))
    asked = required({"min_value": 0.5}) | {"heights": {"ground": [-0.2, 0.2]}}
    with pytest.raises(ValueError, match=r"'ground' is \(-0\.2, 0\.2\)"):
        space(requirements=asked)
    asked["requirements"][0]["band"] = "low"
    with pytest.raises(ValueError, match="no height band is called 'low'"):
        space(requirements=asked)
    with pytest.raises(ValueError, match=r"'low' is \(0\.0, 0\.3\)"):
        space(requirements=asked | {"heights": {"low": [0.0, 0.3]}})


def test_numbers_that_ended_on_their_bounds_are_named():
    def only_x(rig):
        mount = rig.sensors[0].mount
        return np.full(2, 0.5 + 0.1 * mount.x_m - 1e-3 * (mount.pitch_deg - 3) ** 2)

    result = run_small_search(num_evaluations=20, compute_values=only_x)
    assert "Variables at the end of their range: roof.x_m (0.8);" in result.summary
    assert "roof.pitch_deg (" not in result.summary


@pytest.mark.parametrize("objectives", [("near",), ("near", "far")])
def test_resumed_search_proposes_the_same_candidates(tmp_path, objectives):
    of = space(objectives=objectives)
    whole = run_small_search(tmp_path / "whole", of=of, num_evaluations=14)
    out = tmp_path / "ended"
    for most in (0, 4, 9):
        with pytest.raises(Ended):
            run_small_search(out, of=of, resume=True, num_evaluations=14, make_frames=make_ending_frames(most))
    if (out / JOURNAL).exists():
        with (out / JOURNAL).open("ab") as file:
            file.write(b'{"op_code":4,"wor')  # torn by the end of the process
    resumed = run_small_search(out, of=of, resume=True, num_evaluations=14)
    assert dump_evaluations(resumed.search) == dump_evaluations(whole.search)
    assert [each.role for each in resumed.finalists] == [each.role for each in whole.finalists]
    assert dump_evaluations(run_small_search(out, of=of, resume=True, num_evaluations=14).search) == dump_evaluations(
        whole.search
    )
    longer = run_small_search(out, of=of, resume=True, num_evaluations=16)
    assert dump_evaluations(longer.search) == dump_evaluations(run_small_search(of=of, num_evaluations=16).search)


def test_too_small_budget_deletes_nothing(tmp_path):
    run_small_search(tmp_path, num_evaluations=3)
    before = (tmp_path / JOURNAL).read_bytes()
    with pytest.raises(ValueError, match="too short for two evaluations"):
        run_small_search(tmp_path, budget_s=1e-6)
    assert (tmp_path / JOURNAL).read_bytes() == before


def test_the_journal_of_another_search_is_refused(tmp_path):
    run_small_search(tmp_path, num_evaluations=2)
    before = (tmp_path / JOURNAL).read_bytes()
    with pytest.raises(
        ValueError,
        match=r"the journal belongs to another search: num_scenes \(6 there, 4 here\), seed \(0 there, 3 here",
    ):
        run_small_search(tmp_path, num_evaluations=2, seed=3, num_scenes=4, resume=True)
    with pytest.raises(BadFileError, match="the start has a different score now"):
        run_small_search(
            tmp_path, num_evaluations=2, compute_values=lambda rig: compute_near_far(rig) + 1e-9, resume=True
        )
    with pytest.raises(ValueError, match="journal belongs to another search: "):
        run_small_search(tmp_path, of=space(objectives=("near", "far")), num_evaluations=2, resume=True)
    assert (tmp_path / JOURNAL).read_bytes() == before


def damaged(text):
    lines = text.splitlines(keepends=True)
    yield ""
    yield "\n\n"
    yield "[]\n"
    yield '{"op_code": 99}\n'
    yield "\0" * 4096
    yield text.replace('"number": 1', '"number": 7').replace('"number":1,', '"number":7,')
    yield "".join(lines[:1])  # ended while it was made
    yield "".join([*lines[:-1], "{" + lines[-1]]) + lines[-1]
    yield text.replace('"op_code":4', '"op_code":"4"')
    yield text.replace('"settings"', '"setting"')


def test_a_damaged_journal_is_one_line(tmp_path):
    run_small_search(tmp_path, num_evaluations=2)
    path = tmp_path / JOURNAL
    for text in damaged(path.read_text()):
        path.write_text(text)
        with pytest.raises(BadFileError, match=JOURNAL) as error:
            run_small_search(tmp_path, num_evaluations=2, resume=True)
        assert "\n" not in str(error.value)


def test_journal_ignores_stale_locks_and_refuses_links(tmp_path):
    out = tmp_path / "out"
    (tmp_path / "out").mkdir()
    (out / f"{JOURNAL}.lock").symlink_to("nothing")  # a killed process leaves one; Optuna would wait for its end
    run_small_search(out, num_evaluations=2)
    (out / JOURNAL).rename(tmp_path / "mine")
    with (tmp_path / "mine").open("a") as file:
        file.write("a line that was not finished")
    before = (tmp_path / "mine").read_bytes()
    (out / JOURNAL).symlink_to(tmp_path / "mine")
    with pytest.raises(ValueError, match=rf"{JOURNAL}: a symbolic link; nothing is written through links"):
        run_small_search(out, num_evaluations=3, resume=True)
    (out / JOURNAL).unlink()
    (out / JOURNAL).hardlink_to(tmp_path / "mine")
    assert len(run_small_search(out, num_evaluations=3, resume=True).search.evaluations) == 4
    assert (tmp_path / "mine").read_bytes() == before


def test_a_search_without_optuna_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ImportError, match=r"needs Optuna: pip install 'torchcover\[search\]'"):
        PlacementSearch(space(), plan())


class Clock:
    """Seconds that pass when something is scored or built."""

    def __init__(self, build_s=10.0, frame_s=0.1):
        self.now, self.build_s, self.frame_s = 0.0, build_s, frame_s

    def __call__(self):
        return self.now

    def makes(self, space, plan, seed, worlds, more=()):
        clock = self
        clock.now += self.build_s * worlds / 6

        class Slow(Surface):
            def score(self, rig):
                clock.now += clock.frame_s * len(self)
                return super().score(rig)

            def resample(self, seed, num_scenes, extra_objectives):
                return clock.makes(space, plan, seed, num_scenes, extra_objectives)

        return Slow(seed, worlds, plan.frames_per_scene, objectives={**space.scored_objectives, **dict(more)})


def run_timed_search(budget_s, monkeypatch):
    clock = Clock()
    monkeypatch.setattr("torchcover.placement.search.time.perf_counter", clock)
    monkeypatch.setattr("torchcover.placement.search.time.monotonic", clock)
    search = PlacementSearch(space(), plan(budget_s=budget_s, make_frames=clock.makes))
    return run_search(search, clock=clock), clock


def test_time_budget_proposes_the_same_candidates(monkeypatch):
    # 10 s for 18 frames, 1.8 s a candidate; 48 held-out frames, and three rigs there and here: 46.5 s.
    result, clock = run_timed_search(80.0, monkeypatch)
    assert 65 < clock.now < 80
    count = len(result.search.evaluations) - 1
    assert count > 10
    assert dump_evaluations(result.search) == dump_evaluations(run_small_search(num_evaluations=count).search)


def test_too_short_time_budget_names_the_costs(monkeypatch):
    with pytest.raises(
        ValueError, match=r"30 s is too short for two .* 11\.8 s, .* 1\.8 s, .* 46\.5 s; give at least 62"
    ):
        run_timed_search(30.0, monkeypatch)
    run_timed_search(62.0, monkeypatch)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget_s": 3.0, "num_evaluations": 3}, "budget, num_evaluations: got both"),
        ({"num_evaluations": 0}, "num_evaluations: got 0; give 1 or more"),
        ({"budget_s": 0.0}, "budget: got 0 s; give more than 0 s"),
        ({"average": "mean"}, "average: got 'mean'; give area or cells"),
    ],
)
def test_a_plan_that_makes_no_sense(settings, message):
    with pytest.raises(ValueError, match=message):
        plan(**settings)
    with pytest.raises(ValueError, match="got neither"):
        SearchPlan()


def only_the_start(rig):
    if rig.name != "front_roof_32":
        raise ValueError("inside the wall")
    return np.array([0.5, 0.5])


def test_start_remains_if_all_candidates_are_infeasible():
    result = run_small_search(num_evaluations=8, compute_values=only_the_start)
    assert [each.infeasible_reason for each in result.search.evaluations] == ["", *["inside the wall"] * 8]
    assert result.best.is_start
    assert result.rig == result.search.space.start
    assert result.summary == "All 8 candidates are infeasible; reason of the last: inside the wall."


def test_impossible_rigs_are_avoided_after_some_of_them():
    """A rig is impossible behind x = 0, where it would be best."""

    def compute_values(rig):
        if rig.sensors[0].mount.x_m < 0.0:
            raise ValueError("behind")
        return compute_near_far(rig) - 0.1 * rig.sensors[0].mount.x_m

    search = run_small_search(num_evaluations=24, compute_values=compute_values).search
    modeled = [each for each in search.evaluations if each.strategy == "optimizer"]
    assert np.mean([not each.infeasible_reason for each in modeled[-6:]]) > 0.5
    assert 0 <= search.evaluations[search.find_best()[0]].values["roof.x_m"] < 0.15


def tilted():
    lidar = {
        "name": "roof", "mount": {"x_m": 0.4, "z_m": 1.8, "pitch_deg": 30.0}, "channels": 4, "columns": 30,
        "vertical_fov_deg": [-20, 0], "horizontal_fov_deg": 360.0, "max_range_m": 60.0,
    }  # fmt: skip
    return Rig.model_validate({"name": "tilted", "sensors": [lidar]})


def test_infeasible_start_does_not_win():
    with pytest.warns(UserWarning, match="'tilted' is outside the space"):
        of = space(constraints={"max_self_hit_share": 0.2}, start=tilted())
    result = run_small_search(of=of, num_evaluations=12)
    start = result.search.evaluations[0]
    assert start.infeasible_reason == "30.0% of its rays hit the vehicle; max_self_hit_share is 20.0%"
    assert not result.best.is_start
    assert result.best.evaluation.values["roof.pitch_deg"] <= 20


def test_too_many_rays_on_the_vehicle_are_infeasible():
    search = run_small_search(of=space(constraints={"max_self_hit_share": 0.05}), num_evaluations=12).search
    refused = [each for each in search.evaluations if each.infeasible_reason]
    assert {each.number for each in refused} == {
        each.number for each in search.evaluations if each.values["roof.pitch_deg"] > 5
    }
    assert "of its rays hit the vehicle; max_self_hit_share is 5.0%" in refused[0].infeasible_reason


def test_an_objective_that_is_unknown_is_refused():
    with pytest.raises(
        ValueError, match=r"objectives\.near: unknown in all 18 frames: a region and band is never visible"
    ):
        run_small_search(num_evaluations=10, blind=True)


def test_noise_is_not_reported_as_improvement():
    result = run_small_search(num_evaluations=12, compute_values=lambda rig: np.array([0.5, 0.5]), seed=4)
    assert "gained" not in result.summary
    assert result.best.improvements[0].difference.is_significant is False
    assert result.best.improvements[0].optimism > 0
    assert (
        "no significant improvement" in run_small_search(num_evaluations=6, num_scenes=1, num_held_out_scenes=1).summary
    )


def test_pareto_ends_and_compromise_are_validated():
    result = run_small_search(of=space(objectives=("near", "far")), num_evaluations=24)
    assert [each.role for each in result.finalists] == ["compromise", "near", "far"]
    gains = {each.role: result.improvements[each.evaluation.number] for each in result.finalists}
    assert gains["near"][0] == result.improvements[:, 0].max()
    assert gains["far"][1] == result.improvements[:, 1].max()
    front = result.search.find_best()
    pitches = [result.search.evaluations[at].values["roof.pitch_deg"] for at in front]
    assert min(pitches) < 0 < max(pitches)
    assert f" of {len(front)} rigs of the front are random candidates (12)" in result.summary


def test_asking_and_telling_is_what_a_run_does():
    run = run_small_search(num_evaluations=9).search
    search = PlacementSearch(space(), plan(num_evaluations=9))
    while (candidate := search.ask()) is not None:
        search.tell(candidate, search.frames.score(candidate.rig))
    assert dump_evaluations(search) == dump_evaluations(run)
    search = PlacementSearch(space(), plan(num_evaluations=2))
    start = search.ask()
    with pytest.raises(ValueError, match="the start, front_roof_32, cannot be scored: no"):
        search.reject(start, "no")
    search.tell(start, search.frames.score(start.rig))
    with pytest.raises(ValueError, match="candidate: got number 0; give the last of `ask`, 1"):
        search.tell(start, search.frames.score(start.rig))


def test_search_ends_after_all_choices():
    of = space(free={"roof": {"model": ("hesai_pandar64", "ouster_os1_64", "ouster_os1_128")}})
    evaluations = run_small_search(of=of, num_evaluations=50).search.evaluations
    tried = [each.values["roof.model"] for each in evaluations[1:]]
    assert sorted(tried) == ["hesai_pandar64", "ouster_os1_128", "ouster_os1_64"]


def test_search_is_independent_of_workers(tmp_path):
    (tmp_path / "lot.yaml").write_text(
        "name: lot\nego: {shape: {type: box, size_m: [4, 2, 1.5]}}\n"
        "traffic: {type: parking, duration_s: 1.0, time_step_s: 0.2, crossings_per_aisle: 0, parked_share: 0.3}\n"
    )
    of = SearchSpace.model_validate(
        {
            "name": "lot",
            "start": tilted(),
            "scenario": str(tmp_path / "lot.yaml"),
            "free": {"roof": {"pitch_deg": (0.0, 30.0)}},
            "objectives": {"near": {"region": "20m"}},
        }
    )
    small = {"num_scenes": 3, "num_held_out_scenes": 3, "frames_per_scene": 2, "frame_interval_s": 0.4, "num_rays": 512}
    results = [run_search(PlacementSearch(of, num_evaluations=3, num_workers=workers, **small)) for workers in (0, 1)]
    assert dump_evaluations(results[0].search) == dump_evaluations(results[1].search)
    assert results[0].summary == results[1].summary
    assert 0 < results[0].search.evaluations[0].estimate.value[0] < 1
