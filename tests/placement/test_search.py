"""A search: two arms with one budget, the same candidates whatever ends it, and words for all that goes wrong."""

from itertools import pairwise

import numpy as np
import pytest

from tests.placement.surfaces import Surface, near_far, plan, space
from torchcover.evaluation.checking import Checked
from torchcover.evaluation.checkpoint import read_header, read_state
from torchcover.evaluation.requirements import Verdict
from torchcover.placement import OPTIMISERS, PlacementSearch, SearchPlan, SearchSpace, run_search
from torchcover.placement.running import CHECKPOINT
from torchcover.simulation import Rig


def searched(out=None, *, of=None, resume=False, **settings):
    search = PlacementSearch(space() if of is None else of, plan(**settings))
    return run_search(search, out, resume=resume)


def told(search):
    """What was asked for and what came of it."""
    return [
        (one.number, one.arm, one.values, one.infeasible, [each.estimate.value.tolist() for each in one.prefixes])
        for one in search.evaluations
    ]


def evaluations_in(folder):
    """What its checkpoint has."""
    path = folder / CHECKPOINT
    return read_state(path, read_header(path), "search")["evaluations"] if path.exists() else []


class Ended(Exception):  # noqa: N818
    """What ends a process at any moment."""


class EndsAfter(Surface):
    """Ends when it was asked for the score of so many instants."""

    def prefixes(self, rig):
        for prefix in super().prefixes(rig):
            if len(self.scored) > self.most:
                raise Ended
            yield prefix


def ending_after(count):
    def makes(space, plan, seed, worlds):
        surface = EndsAfter(seed, worlds, plan.per_world)
        surface.most = count
        return surface

    return makes


def test_both_arms_begin_at_the_start_and_spend_the_same():
    result = searched(evaluations=24)
    evaluations, arms = result.search.evaluations, result.search.arms
    assert len(evaluations) == 25
    assert evaluations[0].arm == "start"
    assert result.search.instants.closed
    assert arms["optimiser"].evaluations[0] is arms["random"].evaluations[0] is evaluations[0]
    spent = {"optimiser": 0, "random": 0}
    for one in evaluations[1:]:
        assert one.arm == min(spent, key=spent.get)
        spent[one.arm] += one.instants
    assert abs(spent["optimiser"] - spent["random"]) <= 18
    assert 0.3 < result.search.share_saved < 0.9


def test_the_winner_is_better_on_fresh_worlds_and_so_is_what_random_search_found():
    result = searched(evaluations=24)
    best, random = result.picks
    assert result.best is best
    assert abs(best.evaluation.values["roof.pitch_deg"] - 4) < 1.5
    for pick in (best, random):
        gain, by_cells = pick.gains
        assert [gain.estimate, by_cells.estimate] == ["area", "known"]
        assert gain.t > 4
        assert gain.test.blocks == 16
        assert gain.optimism == gain.search_gain - gain.test.gain
    assert best.gains[0].test.gain > random.gains[0].test.gain
    assert result.sentence.startswith("near: gained ")
    assert "Random search with the same budget: near: gained" in result.sentence


def test_what_must_not_be_worse_is_not_sold():
    """Near likes the nose down, far likes it up: what is best near loses far."""
    free, kept = (searched(of=space(not_worse=not_worse), evaluations=24) for not_worse in ((), ({"region": "80m"},)))
    assert free.best.evaluation.values["roof.pitch_deg"] > 2
    assert kept.best.evaluation.values["roof.pitch_deg"] < 0.5
    arm = kept.search.arms["optimiser"]
    start, best = (one.prefixes[-1].estimate.value for one in (arm.evaluations[0], kept.best.evaluation))
    assert best[0] >= start[0]
    assert best[1] >= start[1]
    assert [gain.objective for gain in kept.best.gains] == ["near", "not worse: 80m"] * 2
    worse = [at for at in arm.complete if arm.lacks[at] > 0]
    assert not set(worse) & set(arm.front)
    for at in worse:
        assert (arm.evaluations[at].prefixes[-1].estimate.value < start).any()
    # What is clearly worse far is dropped, however good it is near.
    assert any(one.instants < 18 and one.values["roof.pitch_deg"] > 4 for one in kept.search.evaluations)
    assert "No candidate keeps" not in kept.sentence


def required(*bounds, **target):
    regions = [{"region": "20m", "height": "ground", "number": "detection_0.4m", **bound} for bound in bounds]
    child = [{"target": "child", "at": {"points_m": [[5.0, 0.0]]}, **target}] if target else []
    return {"requirements": [*regions, *child]}


def test_what_no_candidate_keeps_ends_with_the_least_bad_and_by_how_much():
    """The second number of a surface likes the nose up, and is 0.4 at most."""
    result = searched(of=space(requirements=required({"least": 0.5})), evaluations=24)
    arm = result.search.arms["optimiser"]
    found = arm.lacks[arm.best]
    assert found == min(arm.lacks[at] for at in arm.complete) > 0
    assert found < arm.lacks[0]
    assert result.best.evaluation.values["roof.pitch_deg"] < -1
    (name,) = arm.lacking(arm.best)
    assert name == "required: 20m, ground, detection_0.4m >= 0.5"
    assert f"keeps all that must be kept; this one lacks the least: {found:.2%} of {name}." in result.sentence
    assert f"{found:.2%} of {name}" in [row[-1] for row in result.report.rows["evaluations.csv"]]


def needing(pitch_deg, checked):
    """What looks for a child that needs the nose so far down."""

    def looks(rig, asked, world, **settings):
        margin = rig.sensors[0].mount.pitch_deg - pitch_deg
        checked.append(rig.name)
        (one,) = asked.requirements
        (bound,) = one.bounds
        counts = 1, int(margin < 0), 0, ()
        verdict = Verdict(one.words, bound, "kept" if margin >= 0 else "not kept", 0, 0, 0, margin, *counts)
        return Checked(asked, {rig.name: [verdict]}, {})

    return looks


def test_what_bodies_require_is_looked_at_where_it_decides_and_ends_the_choice_of_what_lacks_it(monkeypatch):
    """A child needs the nose at least 5 degrees down, as one would have it; so it costs near what it must."""
    checked = []
    monkeypatch.setattr("torchcover.placement.objective.check", needing(5.0, checked))
    result = searched(of=space(requirements=required(points=5)), evaluations=30)
    assert result.search.evaluations[0].lacks == {"child_110cm, points_m [[5.0, 0.0]], points >= 5": 1}
    assert 5 <= result.best.evaluation.values["roof.pitch_deg"] < 9
    assert result.best.evaluation.lacks == {}
    assert len(checked) < 20


def test_where_nobody_keeps_what_bodies_require_who_lacks_more_is_dropped_at_once(monkeypatch):
    """A child needs the nose farther down than it goes: the farthest down lacks the least, whatever it gains."""
    checked = []
    monkeypatch.setattr("torchcover.placement.objective.check", needing(50.0, checked))
    search = searched(of=space(requirements=required(points=5)), evaluations=30).search
    assert len(checked) == len(search.evaluations) == 31
    for arm in search.arms.values():
        assert len(arm.evaluations) > 8
        for at, one in enumerate(arm.evaluations):
            dropped = one.instants < 18
            assert one.instants in (3, 18)
            assert dropped == (at > 0 and arm.lacks[at] > arm.lacks[:at].min())
        assert arm.lacks[arm.best] == arm.lacks.min()
    assert search.share_saved > 0.3


def test_a_child_is_looked_for_around_the_vehicle_of_the_space():
    of = space(requirements=required(points=5))
    search = PlacementSearch(of, plan(evaluations=1))
    start = search.ask()
    search.evaluate(start)
    assert search.evaluations[0].lacks == {}
    search = PlacementSearch(space(requirements=required(points=10**6)), plan(evaluations=1))
    search.evaluate(search.ask())
    assert 0.9 < sum(search.evaluations[0].lacks.values()) < 1


def test_a_bound_in_the_wrong_direction_is_refused_with_the_space():
    with pytest.raises(ValueError, match=r"most: of detection_0\.4m more is better; least is meant"):
        space(requirements=required({"least": 0.9}, {"most": 0.5}))


def test_a_band_that_is_none_of_the_search_is_refused_with_the_space():
    """What a search measured between other heights would be none of what is required."""
    asked = required({"least": 0.4})
    assert space(requirements=asked | {"heights": {"ground": [-0.5, 0.5], "low": [0.0, 0.2]}}).floors
    asked["heights"] = {"ground": [-0.2, 0.2]}
    with pytest.raises(ValueError, match=r"'ground' is \(-0\.2, 0\.2\) there"):
        space(requirements=asked)
    asked["requirements"][0]["height"] = "low"
    with pytest.raises(ValueError, match="no height band is called 'low'"):
        space(requirements=asked)
    with pytest.raises(ValueError, match=r"'low' is \(0\.0, 0\.3\) there"):
        space(requirements=asked | {"heights": {"low": [0.0, 0.3]}})


def only_x(rig):
    mount = rig.sensors[0].mount
    return np.full(2, 0.5 + 0.1 * mount.x_m - 1e-3 * (mount.pitch_deg - 3) ** 2)


def test_numbers_that_ended_on_their_bounds_are_named():
    result = searched(evaluations=20, worth=only_x)
    assert "On the bounds of their ranges ended roof.x_m (0.8):" in result.sentence
    assert "ended roof.pitch" not in result.sentence


def test_a_candidate_is_dropped_only_two_errors_below_its_incumbent():
    result = searched(evaluations=24)
    for arm in result.search.arms.values():
        best = arm.gains[arm.best, 0]
        for at, one in enumerate(arm.evaluations):
            assert one.instants in (3, 6, 9, 12, 15, 18)
            if one.instants < 18:
                assert arm.gains[at, 0] < best
                assert arm.left[at, 0] > 0
            else:
                assert arm.left[at, 0] == 0
                assert arm.gains[at, 0] == pytest.approx(arm.against_start(at)[0][0], abs=1e-12)


def test_random_search_draws_the_same_beside_any_optimiser():
    draws = []
    for optimiser in ("random", "gp"):
        search = searched(evaluations=16, optimiser=optimiser).search
        draws.append([one.values for one in search.evaluations if one.arm == "random"])
    shortest = min(map(len, draws))
    assert shortest > 3
    assert draws[0][:shortest] == draws[1][:shortest]
    # And what it draws is not what the optimiser draws, where that is random search too.
    search = searched(evaluations=6, optimiser="random").search
    assert len({one.values["roof.x_m"] for one in search.evaluations}) == 7


@pytest.mark.parametrize(("optimiser", "objectives"), [("gp", ("near",)), ("gp", ("near", "far"))])
def test_a_search_that_was_ended_goes_on_to_the_same_candidates(tmp_path, optimiser, objectives):
    of = space(objectives=objectives)
    settings = {"evaluations": 14, "optimiser": optimiser}
    whole = searched(tmp_path / "whole", of=of, **settings)
    out = tmp_path / "ended"
    lengths = []
    for most in (0, 40, 90):
        if objectives == ("near",):
            with pytest.raises(Ended):
                searched(out, of=of, resume=True, instants=ending_after(most), **settings)
        else:
            searched(out, of=of, resume=True, **{**settings, "evaluations": 1 + most // 20})
        lengths.append(len(evaluations_in(out)))
    assert lengths == sorted(lengths)
    assert lengths[-1] > 2
    resumed = searched(out, of=of, resume=True, **settings)
    assert told(resumed.search) == told(whole.search)
    assert [pick.evaluation.number for pick in resumed.picks] == [pick.evaluation.number for pick in whole.picks]
    strip = [[{**one, "seconds": 0} for one in evaluations_in(folder)] for folder in (out, tmp_path / "whole")]
    assert strip[0] == strip[1]


def test_a_budget_that_is_too_small_takes_nothing_away(tmp_path):
    searched(tmp_path, evaluations=3)
    before = (tmp_path / CHECKPOINT).read_bytes()
    with pytest.raises(ValueError, match="less than one evaluation"):
        searched(tmp_path, budget_s=1e-6)
    assert (tmp_path / CHECKPOINT).read_bytes() == before


def test_a_longer_search_goes_on_from_a_shorter_one(tmp_path):
    shorter = searched(tmp_path, evaluations=5)
    longer = searched(tmp_path, evaluations=12, resume=True)
    assert told(longer.search)[:6] == told(shorter.search)
    assert told(longer.search) == told(searched(evaluations=12).search)


def test_evaluations_of_another_search_are_refused(tmp_path):
    searched(tmp_path, evaluations=2)
    with pytest.raises(ValueError, match=r"another run: optimiser \(gp there, random here\), seed \(0 there, 3 here\)"):
        searched(tmp_path, evaluations=2, seed=3, optimiser="random", resume=True)
    with pytest.raises(ValueError, match="the start scores something else than it did"):
        searched(tmp_path, evaluations=2, worth=lambda rig: near_far(rig) + 1e-9, resume=True)


class Clock:
    """Seconds that pass when something is scored or built."""

    def __init__(self, build_s=10.0, instant_s=0.1):
        self.now, self.build_s, self.instant_s = 0.0, build_s, instant_s

    def __call__(self):
        return self.now

    def makes(self, space, plan, seed, worlds, more=()):
        clock = self
        clock.now += self.build_s * worlds / 6

        class Slow(Surface):
            def prefixes(self, rig):
                for prefix in super().prefixes(rig):
                    clock.now += clock.instant_s * 3
                    yield prefix

            def estimates(self, rig):
                clock.now += clock.instant_s * len(self)
                return super().estimates(rig)

            def anew(self, seed, worlds, more):
                return clock.makes(space, plan, seed, worlds, more)

        return Slow(seed, worlds, plan.per_world, objectives={**space.asked, **dict(more)})


def timed(budget_s, monkeypatch):
    clock = Clock()
    monkeypatch.setattr("torchcover.placement.search.time.perf_counter", clock)
    monkeypatch.setattr("torchcover.placement.search.time.monotonic", clock)
    search = PlacementSearch(space(), plan(budget_s=budget_s, instants=clock.makes))
    return run_search(search, clock=clock), clock


def test_a_budget_of_seconds_is_kept_with_the_test_and_asks_for_what_a_number_of_evaluations_would(monkeypatch):
    # 10 s for 18 instants, 1.8 s a candidate; 48 fresh instants and three rigs there and here: 46.5 s.
    result, clock = timed(80.0, monkeypatch)
    assert 65 < clock.now < 80
    count = len(result.search.evaluations) - 1
    assert count > 10
    assert told(result.search) == told(searched(evaluations=count).search)


def test_a_budget_below_one_evaluation_says_what_one_takes(monkeypatch):
    told_s = r"budget: 30 s are less than one evaluation: .* 11\.8 s, .* 1\.8 s .* 46\.5 s; give 62 s"
    with pytest.raises(ValueError, match=told_s):
        timed(30.0, monkeypatch)
    timed(62.0, monkeypatch)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget_s": 3.0, "evaluations": 3}, "seconds or a number of evaluations is needed; got both"),
        ({"evaluations": 0}, "evaluations: 1 or more is needed; got 0"),
        ({"budget_s": 0.0}, "more than 0 s is needed"),
        ({"optimiser": "luck"}, "one of gp, random is needed; got 'luck'"),
        ({"estimate": "mean"}, "one of area, known is needed"),
    ],
)
def test_a_plan_that_makes_no_sense(settings, message):
    with pytest.raises(ValueError, match=message):
        plan(**settings)
    with pytest.raises(ValueError, match="got neither"):
        SearchPlan()


def test_one_candidate_only():
    result = searched(evaluations=1)
    assert [one.arm for one in result.search.evaluations] == ["start", "optimiser"]
    assert "Nothing better than front_roof_32 was found in 1 candidates." in result.sentence
    assert "found nothing better in 0 candidates" in result.sentence
    assert result.rig == result.search.space.start


def test_where_no_candidate_can_be_the_start_stays_and_the_words_say_so():
    def nowhere(rig):
        if rig.name != "front_roof_32":
            raise ValueError("inside the wall")
        return np.array([0.5, 0.5])

    result = searched(evaluations=8, worth=nowhere)
    assert [one.infeasible for one in result.search.evaluations] == ["", *["inside the wall"] * 8]
    assert [one.arm for one in result.search.evaluations[1:]] == ["optimiser", "random"] * 4
    assert result.best.is_start
    assert result.sentence == "None of 8 candidates can be, the last for this reason: inside the wall."


def test_a_start_that_cannot_be_is_compared_with_but_does_not_win():
    with pytest.warns(UserWarning, match="'tilted' is none of the space"):
        of = space(constraints={"max_self_hits": 0.2}, start=tilted())
    result = searched(of=of, evaluations=12)
    start = result.search.evaluations[0]
    assert start.infeasible == "30.0% of its rays end on the vehicle; max_self_hits is 20.0%"
    assert not result.best.is_start
    assert result.best.evaluation.values["roof.pitch_deg"] <= 20


def tilted():
    content = {
        "name": "tilted",
        "sensors": [
            {
                "name": "roof",
                "mount": {"x_m": 0.4, "z_m": 1.8, "pitch_deg": 30.0},
                "channels": 4,
                "vertical_fov_deg": [-20, 0],
                "columns": 30,
                "horizontal_fov_deg": 360.0,
                "max_range_m": 60.0,
            }
        ],
    }
    return Rig.model_validate(content)


def test_too_many_rays_on_the_vehicle_end_a_race_after_its_first_instants():
    of = space(constraints={"max_self_hits": 0.05})
    search = searched(of=of, evaluations=20).search
    refused = [one for one in search.evaluations if one.infeasible]
    assert refused
    assert all(one.values["roof.pitch_deg"] > 5 and not one.prefixes for one in refused)
    assert "of its rays end on the vehicle; max_self_hits is 5.0%" in refused[0].infeasible


def test_an_objective_that_is_unknown_is_refused():
    why = "one of its regions and bands is never seen; "
    with pytest.raises(ValueError, match=rf"objectives\.near: unknown at all 18 instants: {why}"):
        searched(of=space(objectives={"near": {"region": "20m"}}), evaluations=10, blind=True)


def test_one_world_has_no_error_drops_nothing_and_claims_nothing():
    result = searched(evaluations=6, worlds=1, fresh_worlds=1)
    assert all(one.instants == 3 for one in result.search.evaluations)
    assert "no gain is shown" in result.sentence or "Nothing better" in result.sentence


def test_noise_alone_is_not_called_a_gain():
    result = searched(evaluations=20, worth=lambda rig: np.array([0.5, 0.5]), seed=4)
    assert "gained" not in result.sentence
    gain = result.best.gains[0]
    assert gain.test.significant is False
    assert gain.optimism > 0


def test_of_several_objectives_the_ends_of_the_front_and_its_middle_are_tested():
    result = searched(of=space(objectives=("near", "far")), evaluations=30)
    picks = [pick for pick in result.picks if pick.arm == "optimiser"]
    assert [pick.role for pick in picks] == ["middle", "near", "far"]
    arm = result.search.arms["optimiser"]
    gains = {pick.role: arm.gains[arm.evaluations.index(pick.evaluation)] for pick in picks}
    assert gains["near"][0] == arm.gains[arm.complete, 0].max()
    assert gains["far"][1] == arm.gains[arm.complete, 1].max()
    pitches = [arm.evaluations[at].values["roof.pitch_deg"] for at in arm.front]
    assert min(pitches) < 0 < max(pitches)
    assert "Hypervolume of the fronts" in result.sentence


def test_an_optimiser_of_ones_own_plugs_in():
    class Halving:
        def __init__(self, cube, seed):
            self.low, self.high = np.zeros(len(cube.levels)), np.ones(len(cube.levels))

        def ask(self):
            return (self.low + self.high) / 2

        def tell(self, unit, value, error):
            self.high = (self.low + self.high) / 2

    search = searched(evaluations=8, optimiser=Halving).search
    asked = [one.unit[0] for one in search.evaluations if one.arm == "optimiser"]
    assert all(later == earlier / 2 for earlier, later in pairwise(asked))
    assert search.plan.optimiser_name == "Halving"


def test_what_random_search_found_is_the_best_if_it_is_better():
    class Corner:
        def __init__(self, cube, seed):
            self.asked = 0

        def ask(self):
            return np.array([1.0, 1.0 - self.asked / 1000])

        def tell(self, unit, value, error):
            self.asked += 1

    result = searched(evaluations=24, optimiser=Corner)
    arms = result.search.arms
    assert result.best.arm == "random"
    assert arms["random"].gains[arms["random"].best, 0] > arms["optimiser"].gains[arms["optimiser"].best, 0]
    assert result.rig.sensors[0].mount.x_m == result.best.evaluation.values["roof.x_m"]
    assert "Random search found that, and the optimiser with the same budget found nothing better" in result.sentence


def test_asking_and_telling_is_what_a_run_does():
    run = searched(evaluations=9).search
    search = PlacementSearch(space(), plan(evaluations=9))
    while (candidate := search.ask()) is not None:
        search.evaluate(candidate)
    assert told(search) == told(run)
    search = PlacementSearch(space(), plan(evaluations=2))
    start = search.ask()
    with pytest.raises(ValueError, match="the start, front_roof_32, cannot be scored: no"):
        search.refuse(start, "no")
    with pytest.raises(ValueError, match="scored at all 18 instants; got 3"):
        search.tell(start, tuple(search.instants.prefixes(start.rig))[:1])
    search.tell(start, tuple(search.instants.prefixes(start.rig)))
    with pytest.raises(ValueError, match="candidate 1 is to be told next; got candidate 0"):
        search.tell(start, tuple(search.instants.prefixes(start.rig)))


def test_each_choice_is_tried_once_and_the_search_ends_when_all_were():
    of = space(free={"roof": {"model": ("hesai_pandar64", "ouster_os1_64", "ouster_os1_128")}})
    result = searched(of=of, evaluations=50)
    tried = [one.values["roof.model"] for one in result.search.evaluations if one.arm == "optimiser"]
    assert sorted(tried) == ["hesai_pandar64", "ouster_os1_128", "ouster_os1_64"]
    assert len(result.search.evaluations) < 12


def test_every_optimiser_searches():
    for name in OPTIMISERS:
        assert len(searched(evaluations=4, optimiser=name).search.evaluations) == 5


def test_a_real_search_does_not_depend_on_the_number_of_workers(tmp_path):
    (tmp_path / "lot.yaml").write_text(
        "name: lot\nego: {shape: {type: box, size_m: [4, 2, 1.5]}}\n"
        "traffic: {type: parking, duration_s: 1.0, time_step_s: 0.2, crossings: 0, parked_share: 0.3}\n"
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
    small = {"worlds": 3, "fresh_worlds": 3, "per_world": 2, "every_s": 0.4, "rays": 512}
    results = [run_search(PlacementSearch(of, evaluations=3, workers=workers, **small)) for workers in (0, 1)]
    assert told(results[0].search) == told(results[1].search)
    assert results[0].sentence == results[1].sentence
    assert 0 < results[0].search.evaluations[0].prefixes[-1].estimate.value[0] < 1
