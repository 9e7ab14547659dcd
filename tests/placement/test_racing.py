"""Pairs, races and the fresh test."""

import numpy as np
import pytest
from scipy import stats

from tests.placement.worlds import held, lidar, made_up, rig, yard
from torchcover.placement import fresh_test, paired, race, racing_order
from torchcover.placement.fresh import student_p

WORLDS, PER_WORLD = 6, 3
WORLD = np.repeat(np.arange(WORLDS), PER_WORLD)


def test_pairs_are_those_of_a_paired_t_test():
    generator = np.random.default_rng(0)
    one, other = generator.normal(size=(2, 18, 2))
    found = paired(made_up(one, WORLD), made_up(other, WORLD))
    of_worlds = (one - other).reshape(6, 3, 2).mean(axis=1)
    expected = stats.ttest_1samp(of_worlds, 0.0)
    np.testing.assert_allclose(found.gain, of_worlds.mean(axis=0))
    np.testing.assert_allclose(found.gain / found.error, expected.statistic)
    np.testing.assert_array_equal(found.better, (of_worlds > 0).sum(axis=0))
    p = [student_p(float(t), 5) for t in found.gain / found.error]
    np.testing.assert_allclose(p, expected.pvalue, rtol=1e-9)


@pytest.mark.parametrize("freedom", [1, 2, 3, 6, 15, 40])
def test_the_probability_of_t_is_students(freedom):
    for t in (0.0, 0.3, -2.0, 7.0):
        assert student_p(t, freedom) == pytest.approx(2 * stats.t.sf(abs(t), freedom), abs=1e-12)
    assert np.isnan(student_p(float("nan"), freedom))


def test_worlds_that_do_not_know_an_objective_are_in_no_pair():
    values = np.arange(8.0).reshape(4, 2)
    one = values + np.array([[0.3, 0.0], [0.1, 0.1], [0.2, 0.0], [0.9, 0.2]])
    values[3, 0] = one[3, 0] = np.nan
    found = paired(made_up(one, range(4)), made_up(values, range(4)), "known")
    np.testing.assert_allclose(found.gain, [0.2, 0.075])
    assert found.worlds.tolist() == [3, 4]
    np.testing.assert_allclose(found.error, [stats.sem([0.3, 0.1, 0.2]), stats.sem([0.0, 0.1, 0.0, 0.2])])
    none = paired(made_up(one[3:], [0]), made_up(values[3:], [0]))
    assert np.isnan(none.gain[0])
    assert np.isnan(none.error).all()
    assert none.worlds.tolist() == [0, 1]


def test_two_worlds_have_no_error_however_many_instants():
    values = np.random.default_rng(0).normal(size=12)
    found = paired(made_up(values, [0, 1] * 6), made_up(np.zeros(12), [0, 1] * 6))
    assert np.isnan(found.error[0])
    assert found.worlds[0] == 2


def test_pairs_are_of_the_same_instants():
    generator = np.random.default_rng(0)
    one, other = made_up(generator.normal(size=18), WORLD), made_up(generator.normal(size=18), WORLD)
    some = [2, 17, 9, 10, 4]
    expected = (one.at(some).area - other.at(some).area)[:, 0]
    of_worlds = [expected[[0]].mean(), expected[[4]].mean(), expected[[2, 3]].mean(), expected[[1]].mean()]
    assert paired(one.at(some), other).gain[0] == pytest.approx(np.mean(of_worlds))


def test_pairing_takes_out_what_a_world_does_to_all():
    generator = np.random.default_rng(1)
    city = generator.normal(0, 0.07, (400, 1))
    own = generator.normal([0.5, 0.51], 0.009, (400, 2))
    one, other = (city + own[:, :1])[:, 0], (city + own[:, 1:])[:, 0]
    error = paired(made_up(other, range(400)), made_up(one, range(400))).error[0]
    unpaired = np.sqrt((one.var(ddof=1) + other.var(ddof=1)) / 400)
    assert (unpaired / error) ** 2 > 30


def test_an_order_goes_round_the_worlds():
    orders = [racing_order(WORLD, seed) for seed in range(20)]
    for order in orders:
        assert sorted(order.tolist()) == list(range(18))
        for start in range(0, 18, WORLDS):
            assert sorted(WORLD[order[start : start + WORLDS]].tolist()) == list(range(WORLDS))
    np.testing.assert_array_equal(orders[3], racing_order(WORLD, 3))
    assert len({tuple(order.tolist()) for order in orders}) == 20
    assert 0 in racing_order([0, 1, 1, 1], 0)[:2]


def field(generator, candidates=70, objectives=1):
    """True values, and (candidates, instants, objectives) scores around them: 0.009 is the spread over worlds of a
    difference to another rig, as it was measured in city traffic."""
    true = generator.normal(0.55, 0.012, (candidates, 1, objectives))
    city = generator.normal(0, 0.05, (WORLDS, objectives))[WORLD]
    of_rig = generator.normal(0, 0.0055, (candidates, WORLDS, objectives))[:, WORLD]
    return true[:, 0], true + city + of_rig + generator.normal(0, 0.006, (candidates, 18, objectives))


def test_a_race_finds_the_best_with_half_of_the_instants():
    """One new candidate at a time against the best so far."""
    spent, loss, kept = [], [], []
    for repeat in range(12):
        true, values = field(np.random.default_rng(repeat))
        order = racing_order(WORLD, repeat)
        calls = []

        def score(candidate, instants, values=values, calls=calls):
            calls.append(len(instants))
            return made_up(values[candidate][instants], WORLD[instants], instants)

        best, incumbent = 0, score(0, order)
        for candidate in range(1, 70):
            (raced,) = race(score, [candidate], order, incumbents=[incumbent])
            if not raced.dropped and paired(raced.scores, incumbent).gain[0] > 0:
                best, incumbent = candidate, raced.scores
        of_all = values.mean(axis=1)[:, 0].argmax()
        spent.append(sum(calls) / 18 / 70)
        loss.append(true[of_all, 0] - true[best, 0])
        kept.append(best == of_all)
    assert np.mean(spent) < 0.5
    assert np.mean(loss) < 0.001
    assert np.mean(kept) > 0.8


def test_several_race_at_once_and_against_each_other():
    _, values = field(np.random.default_rng(5), candidates=12)

    def score(candidate, instants):
        return made_up(values[candidate][instants], WORLD[instants], instants)

    found = race(score, range(12), racing_order(WORLD, 5))
    finished = [k for k, raced in enumerate(found) if not raced.dropped]
    assert values.mean(axis=1)[:, 0].argmax() in finished
    assert sum(len(raced.scores.instants) for raced in found) < 12 * 18 / 2
    for raced in found:
        assert (len(raced.scores.instants) == 18) == (not raced.dropped)
        assert len(raced.scores.instants) % 3 == 0


@pytest.mark.parametrize(("errors_below", "dropped"), [(1.95, False), (2.05, True)])
def test_two_errors_below_is_too_much(errors_below, dropped):
    spread = np.tile([-1.0, 0.0, 1.0], 2)
    values = 0.01 * (spread - errors_below / np.sqrt(3))
    world = np.tile([0, 1, 2], 2)

    def score(candidate, instants):
        return made_up(values[instants], world[instants], instants)

    (raced,) = race(score, ["one"], range(6), incumbents=[made_up(np.zeros(6), world)])
    assert raced.dropped == dropped


def test_nobody_is_dropped_before_there_is_an_error_or_for_one_of_two_objectives():
    def score(candidate, instants):
        return made_up(worse[instants] * [1.0, candidate], WORLD[instants], instants)

    generator = np.random.default_rng(0)
    best = made_up(np.zeros((18, 2)), WORLD)
    worse = generator.normal(-1.0, 0.01, (18, 2))
    order = racing_order(WORLD, 0)
    below, aside = race(score, [1.0, -1.0], order, incumbents=[best])
    assert below.dropped
    assert not aside.dropped
    assert len(below.scores.instants) == 3
    assert len(race(score, [1.0], order, incumbents=[best], together=2)[0].scores.instants) == 4
    # Three instants of two worlds have no error.
    by_world = [0, 1, 3, *(k for k in range(18) if k not in (0, 1, 3))]
    assert len(race(score, [1.0], by_world, incumbents=[best])[0].scores.instants) > 3
    with pytest.raises(ValueError, match="an instant, and one at a time"):
        race(score, [1.0], [])


def test_the_fresh_test_is_about_other_worlds_and_says_what_was_optimism(instants):
    low, high = rig(lidar(mount={"z_m": 1.6}), name="low"), rig(lidar(mount={"z_m": 2.4}), name="high")
    found = fresh_test({"higher": high}, low, instants, test_seed=1, worlds=3)["higher"]
    assert (found.search_seed, found.test_seed, found.instants) == (0, 1, 6)
    fresh = held(seed=1, worlds=3)
    for measure in ("area", "known"):
        expected = paired(fresh.score(high), fresh.score(low), measure)
        in_search = paired(instants.score(high), instants.score(low), measure).gain
        for column, name in enumerate(("near", "far", "bay")):
            gain = found.gains[name][measure]
            t = expected.gain[column] / expected.error[column]  # NaN where fewer than three worlds know a bay
            one = [gain.gain, gain.error, gain.worlds, gain.better, gain.t, gain.p, gain.optimism]
            of_pairs = [each[column] for each in (expected.gain, expected.error, expected.worlds, expected.better)]
            further = [t, student_p(float(t), gain.worlds - 1), in_search[column] - expected.gain[column]]
            np.testing.assert_array_equal(one, [*of_pairs, *further])
    assert found.gains["far"]["area"].p < 0.5
    with pytest.raises(ValueError, match="seed: another one than that of these worlds is needed; got 0 for both"):
        instants.anew(0, worlds=4)
    with pytest.raises(ValueError, match="one whose worlds are drawn is needed; 'yard' is the same for any seed"):
        held([yard()], {"far": instants.objectives["far"]}).anew(1, worlds=4)
