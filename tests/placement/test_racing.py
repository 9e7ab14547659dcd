"""Pairs, races and the fresh test."""

import numpy as np
import pytest
from scipy import stats

from tests.placement.worlds import estimate_of, held, lidar, prefixes_of, rig, yard
from torchcover.placement import Objective, fresh
from torchcover.placement.fresh import SideEffect, _others, fresh_test, holm
from torchcover.placement.racing import gains, race, racing_order

WORLDS, PER_WORLD = 6, 3
WORLD = np.repeat(np.arange(WORLDS), PER_WORLD)


def test_gains_are_those_of_a_paired_t_test_and_have_the_direction_of_the_number():
    generator = np.random.default_rng(0)
    one, other = generator.normal(size=(2, 18, 2))
    lower = {"lower_is_better": ["o1"]}
    gain, error = gains(estimate_of(one, WORLD, **lower), estimate_of(other, WORLD, **lower))
    of_worlds = (one - other).reshape(6, 3, 2).mean(axis=1)
    expected = stats.ttest_1samp(of_worlds, 0.0)
    np.testing.assert_allclose(gain, of_worlds.mean(axis=0) * [1, -1])
    np.testing.assert_allclose(gain / error, expected.statistic * [1, -1])


def test_two_worlds_have_no_error_however_many_instants():
    values = np.random.default_rng(0).normal(size=12)
    gain, error = gains(estimate_of(values, [0, 1] * 6), estimate_of(np.zeros(12), [0, 1] * 6))
    assert np.isnan(error[0])
    assert gain[0] == pytest.approx(values.mean())


def test_pairing_takes_out_what_a_world_does_to_all():
    generator = np.random.default_rng(1)
    city = generator.normal(0, 0.07, (400, 1))
    own = generator.normal([0.5, 0.51], 0.009, (400, 2))
    one, other = (city + own[:, :1])[:, 0], (city + own[:, 1:])[:, 0]
    _, error = gains(estimate_of(other, range(400)), estimate_of(one, range(400)))
    unpaired = np.sqrt((one.var(ddof=1) + other.var(ddof=1)) / 400)
    assert (unpaired / error[0]) ** 2 > 30


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
    """One new candidate at a time against the best so far, all in one order."""
    spent, loss, kept = [], [], []
    for repeat in range(12):
        true, values = field(np.random.default_rng(repeat))
        order = racing_order(WORLD, repeat)
        best, incumbent, instants = 0, tuple(prefixes_of(values[0][order], WORLD[order])), 18
        for candidate in range(1, 70):
            raced = race(prefixes_of(values[candidate][order], WORLD[order]), [incumbent])
            instants += raced[-1].instants
            if raced[-1].instants == 18 and gains(raced[-1].estimate, incumbent[-1].estimate)[0][0] > 0:
                best, incumbent = candidate, raced
        of_all = values.mean(axis=1)[:, 0].argmax()
        spent.append(instants / 18 / 70)
        loss.append(true[of_all, 0] - true[best, 0])
        kept.append(best == of_all)
    assert np.mean(spent) < 0.5
    assert np.mean(loss) < 0.001
    assert np.mean(kept) > 0.8


@pytest.mark.parametrize(("errors_below", "dropped"), [(1.95, False), (2.05, True)])
def test_two_errors_below_is_too_much(errors_below, dropped):
    spread = np.tile([-1.0, 0.0, 1.0], 2)
    values = 0.01 * (spread - errors_below / np.sqrt(3))
    world = np.tile([0, 1, 2], 2)
    best = tuple(prefixes_of(np.zeros(6), world))
    assert (len(race(prefixes_of(values, world), [best])) == 1) == dropped
    # Of a number that is better the lower it is, two errors above.
    lower = {"lower_is_better": ["o0"]}
    best = tuple(prefixes_of(np.zeros(6), world, **lower))
    assert (len(race(prefixes_of(-values, world, **lower), [best])) == 1) == dropped


def test_nobody_is_dropped_before_there_is_an_error_or_for_one_of_two_objectives():
    generator = np.random.default_rng(0)
    worse = generator.normal(-1.0, 0.01, (18, 2))
    order = racing_order(WORLD, 0)
    world = WORLD[order]
    best = tuple(prefixes_of(np.zeros((18, 2)), world))
    below, aside = (race(prefixes_of(worse * [1.0, sign], world), [best]) for sign in (1.0, -1.0))
    assert below[-1].instants == 3
    assert aside[-1].instants == 18
    assert len(race(prefixes_of(worse, world))) == 6
    # Three instants of two worlds have no error.
    few = np.array([0, 0, 1, *(k for k in range(2, 6) for _ in range(3))])
    zeros = tuple(prefixes_of(np.zeros((15, 2)), few))
    assert race(prefixes_of(worse[:15], few), [zeros])[-1].instants > 3


def test_no_more_is_scored_than_is_needed():
    asked = []

    def scored():
        for prefix in prefixes_of(np.random.default_rng(0).normal(-1.0, 0.01, 18), np.tile(np.arange(6), 3)):
            asked.append(prefix.instants)
            yield prefix

    race(scored(), [tuple(prefixes_of(np.zeros(18), np.tile(np.arange(6), 3)))])
    assert asked == [3]


def test_a_number_that_is_by_no_choice_of_estimate_is_tested_once():
    low, high = rig(lidar(mount={"z_m": 1.6}), name="low"), rig(lidar(mount={"z_m": 2.4}), name="high")
    keys = {"near": "radius_m", "largest": "radius_maximum_m", "cells": "known_radius_m"}
    objectives = {name: Objective(number=key, region="20m") for name, key in keys.items()}
    with held(objectives=objectives, estimate="known", worlds=2) as searched:
        found = fresh_test({"higher": high}, low, searched, test_seed=1, worlds=2).gains["higher"]
    said = [("near", "known"), ("largest", "-"), ("cells", "known"), ("near", "area")]
    assert [(gain.objective, gain.estimate) for gain in found] == said


def test_the_fresh_test_is_about_other_worlds_and_says_what_was_optimism(instants):
    low, high = rig(lidar(mount={"z_m": 1.6}), name="low"), rig(lidar(mount={"z_m": 2.4}), name="high")
    test = fresh_test({"higher": high}, low, instants, test_seed=1, worlds=8)
    found, others = test.gains["higher"], _others(instants.objectives, failures=False)[0]
    anew = held(seed=1, worlds=8, objectives={**instants.objectives, **others})
    assert [(gain.objective, gain.estimate) for gain in found] == [
        (name, measure) for measure in ("area", "known") for name in ("near", "far", "bay")
    ]
    by_test, by_search = ([of.estimates(one) for one in (high, low)] for of in (anew, instants))
    for gain in found:
        expected = by_test[0][gain.estimate].differences(by_test[1][gain.estimate])
        in_search = by_search[0][gain.estimate].minus(by_search[1][gain.estimate])
        column = ["near", "far", "bay"].index(gain.objective)
        np.testing.assert_equal(gain.test, expected[gain.objective])
        assert gain.search_gain == float(in_search.value[column])
        np.testing.assert_equal(gain.optimism, gain.search_gain - expected[gain.objective].value)
    assert found[1].test.p < 0.5
    assert {change.what for change in test.changes} == others.keys()
    # What a gain is made of sums up to it, whatever else the parts are; a loss has no share of a gain.
    for name in ("near", "far", "bay"):
        shares = [change.shares[name] for change in test.changes if name in change.shares]
        assert len(shares) == len(instants.objectives[name].places)
        assert sum(shares) == pytest.approx(1)
    lost = fresh_test({"lower": low}, high, instants, test_seed=1, worlds=2)
    assert not any(change.shares for change in lost.changes)
    with pytest.raises(ValueError, match="seed: another one than that of these worlds is needed; got 0 for both"):
        instants.anew(0, 4, {})
    with pytest.raises(ValueError, match="one whose worlds are drawn is needed; 'yard' is the same for any seed"):
        held([yard()], {"far": instants.objectives["far"]}).anew(1, 4, {})


def test_of_twenty_searches_that_change_nothing_at_most_one_says_that_something_got_worse():
    draws, alarms = np.random.default_rng(0), 0
    for _ in range(200):
        shared = draws.normal(0.0, 1.0, (16, 4)) @ draws.normal(0.0, 1.0, (4, 33))  # regions overlap
        one, other = (estimate_of(shared + draws.normal(0.0, 0.5, (16, 33)), np.arange(16)) for _ in range(2))
        tests = list(one.differences(other).values())
        changes = [
            SideEffect("a", test, p, {}) for test, p in zip(tests, holm([test.p for test in tests]), strict=True)
        ]
        alarms += any(change.is_worse for change in changes)
    assert alarms <= 10


def test_targets_are_counted_around_the_vehicle(instants, monkeypatch):
    monkeypatch.setattr(fresh, "TARGETS", ("child",))
    low, high = rig(lidar(mount={"z_m": 1.6}), name="low"), rig(lidar(mount={"z_m": 2.4}), name="high")
    (change,) = fresh._of_targets(high, low, instants).values()
    assert change.gain > 0
    assert change.p < 0.05
    assert change.blocks == 16
