"""Optimisers: they stay in the cube, depend on what they were told alone, and find what there is to find."""

import math

import numpy as np
import pytest
import torch

from torchcover.placement import OPTIMISERS, Cube, Optimiser
from torchcover.placement.optimisers.gaussian_process import log_expected_improvement
from torchcover.placement.optimisers.gp_model import GaussianProcess, _learnt, _loss

MIXED = Cube(levels=(0, 3, 0, 1), start=np.array([0.2, 0.5, 0.9, 0.5]))
CHOICES = Cube(levels=(3, 4), start=np.array([0.5, 0.125]))


def hill(unit, top=0.3):
    return -float(((np.asarray(unit) - top) ** 2).sum())


def run(optimiser, turns, worth=hill, error=0.0):
    told = []
    for _ in range(turns):
        unit = optimiser.ask()
        optimiser.tell(unit, worth(unit), error)
        told.append(unit)
    return np.array(told)


def doubles(values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(("name", "cube"), [("gp", MIXED), ("random", MIXED), ("gp", CHOICES)])
def test_what_is_asked_for_depends_on_the_seed_and_on_what_was_told(name, cube):
    """So a search that is resumed tells it all again, without asking."""
    first, again = OPTIMISERS[name](cube, 7), OPTIMISERS[name](cube, 7)
    assert isinstance(first, Optimiser)
    turns = 10
    units = run(first, turns - 1, lambda unit: math.nan if unit[0] > 0.7 else hill(unit), error=1e-3)
    for unit in units:
        again.tell(unit, math.nan if unit[0] > 0.7 else hill(unit), 1e-3)
    assert np.array_equal(first.ask(), first.ask())
    assert len(np.unique(units, axis=0)) == len(units)
    assert np.array_equal(first.ask(), again.ask())
    assert np.array_equal(units, cube.snapped(units))
    assert ((units >= 0) & (units <= 1)).all()
    assert not np.array_equal(OPTIMISERS[name](cube, 8).ask(), units[0])


def test_a_gaussian_process_finds_the_top_of_a_hill_sooner_than_random_search():
    cube = Cube(levels=(0, 0, 0), start=np.array([0.9, 0.1, 0.5]))
    offset = hill(cube.start)
    best = {name: max(map(hill, run(OPTIMISERS[name](cube, 3), 20, lambda unit: hill(unit) - offset))) for name in
            ("gp", "random")}  # fmt: skip
    assert best["gp"] > -1e-3
    assert best["random"] < -1e-2


def test_a_choice_is_found_beside_a_number():
    cube = Cube(levels=(0, 4), start=np.array([0.1, 0.125]))

    def worth(unit):
        return hill(unit[:1]) + (0.5 if unit[1] == 0.625 else 0.0)

    best = max(run(OPTIMISERS["gp"](cube, 1), 16, worth), key=worth)
    assert best[1] == 0.625
    assert abs(best[0] - 0.3) < 0.1


def test_places_where_no_rig_can_be_are_avoided():
    cube = Cube(levels=(0, 0), start=np.array([0.1, 0.1]))
    units = run(OPTIMISERS["gp"](cube, 0), 20, lambda unit: math.nan if unit[0] > 0.4 else unit[0] - 0.1)
    late = units[8:]
    assert (late[:, 0] > 0.4).mean() < 0.4
    assert late[late[:, 0] <= 0.4][:, 0].max() > 0.38


def test_every_combination_is_asked_for_once_but_the_start():
    each = OPTIMISERS["gp"](CHOICES, 0)
    units = run(each, 11)
    assert each.ask() is None
    assert len(np.unique(units, axis=0)) == 11
    assert not (units == CHOICES.start).all(axis=1).any()


def twin(model, x, y, noise, at):
    """The posterior as Rasmussen and Williams write it, with an inverse."""

    def kernel(one, other):
        lengths = model.log_lengths.exp().numpy()
        far = np.sqrt(5 * (((one[:, None] - other[None]) / lengths) ** 2).sum(-1))
        return model.log_signal.exp().item() * (1 + far + far**2 / 3) * np.exp(-far)

    inverse = np.linalg.inv(kernel(x, x) + np.diag(noise + model.log_noise.exp().item() + 1e-8))
    mean = kernel(at, x) @ inverse @ y
    return mean, np.sqrt(np.diag(kernel(at, at) - kernel(at, x) @ inverse @ kernel(x, at)))


def test_a_prediction_is_that_of_the_slow_twin():
    draws = np.random.default_rng(0)
    x, at = draws.random((15, 2)), draws.random((9, 2))
    y, error = np.sin(4 * x).sum(1), draws.random(15) / 10
    model = GaussianProcess.fitted((0, 0), *map(torch.from_numpy, (x, y, error)))
    mean, deviation = model.predict(torch.from_numpy(at))
    expected = twin(model, x, (y - model.shift) / model.scale, (error / model.scale) ** 2, at)
    np.testing.assert_allclose((mean.numpy() - model.shift) / model.scale, expected[0], atol=1e-7)
    np.testing.assert_allclose(deviation.numpy() / model.scale, expected[1], atol=1e-5)


def test_hyperparameters_have_the_highest_posterior_nearby():
    x = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    sharp = GaussianProcess.fitted((0,), x, (20 * x[:, 0]).sin(), torch.zeros(20).double())
    smooth = GaussianProcess.fitted((0,), x, x[:, 0].square(), torch.zeros(20).double())
    assert sharp.log_lengths[0] < smooth.log_lengths[0] - 1
    noisy = x[:, 0].square() + torch.from_numpy(np.random.default_rng(0).normal(0, 0.2, 20))
    assert GaussianProcess.fitted((0,), x, noisy, torch.zeros(20).double()).log_noise > smooth.log_noise + 2


def test_no_hyperparameters_nearby_are_likelier():
    draws = np.random.default_rng(0)
    places = torch.from_numpy(draws.random((2, 8)))
    given = (
        (places[:, :, None] - places[:, None]).square(),
        doubles(draws.normal(0, 1, 8)),
        doubles(draws.random(8) / 9),
    )
    usual = doubles([math.log(0.5) + 0.5 * math.log(2)] * 2 + [0.0, math.log(1e-4)])
    lengths, signal, noise = _learnt(*given)
    found = torch.cat([lengths, signal[None], noise[None]])
    for step in 0.1 * torch.cat([torch.eye(4), -torch.eye(4)]).double():
        assert _loss(found + step, usual, *given) > _loss(found, usual, *given)


GRID = np.linspace(0, 1, 40)[:, None]
STIFF = {
    "duplicates": (np.repeat(GRID[:5], 8, axis=0), np.repeat(np.arange(5.0), 8), np.zeros(40)),
    "duplicates that differ": (np.repeat(GRID[:5], 8, axis=0), np.arange(40.0), np.zeros(40)),
    "one value": (GRID[:1], np.ones(1), np.zeros(1)),
    "constant": (GRID, np.full(40, 0.3), np.zeros(40)),
    "constant but for rounding": (GRID, 1e9 + 1e-7 * (np.arange(40) % 2), np.zeros(40)),
    "200 places": (np.random.default_rng(0).random((200, 3)), np.random.default_rng(1).random(200), np.zeros(200)),
    "tiny": (GRID, 1e-9 * np.sin(5 * GRID[:, 0]), np.full(40, 1e-11)),
    "huge": (GRID, 1e9 * np.sin(5 * GRID[:, 0]), np.full(40, 1e7)),
    "a jump": (GRID, (GRID[:, 0] > 0.5) * 1e6, np.zeros(40)),
    "errors beyond the values": (GRID, np.sin(5 * GRID[:, 0]), np.full(40, 1e6)),
}


@pytest.mark.parametrize("case", STIFF)
def test_stiff_values_have_finite_predictions_and_a_place_to_look_at(case):
    x, y, error = STIFF[case]
    search = OPTIMISERS["gp"](Cube(levels=(0,) * x.shape[1]), 0)
    for unit, value, one in zip(x, y, error, strict=True):
        search.tell(unit, value, one)
    mean, deviation = search.model().predict(torch.from_numpy(x))
    assert torch.isfinite(mean).all()
    assert torch.isfinite(deviation).all()
    spread = np.ptp(y) + 1e-6 * abs(y).max()
    assert (mean.min() >= y.min() - spread) & (mean.max() <= y.max() + spread)
    asked = search.ask()
    assert ((asked >= 0) & (asked <= 1)).all()


def test_the_unit_of_the_values_does_not_matter():
    asked = []
    for factor, offset in ((1.0, 0.0), (1e-9, 0.0), (1e9, 0.0)):
        search = OPTIMISERS["gp"](Cube(levels=(0, 0)), 5)
        run(search, 9, lambda unit, a=factor, b=offset: a * hill(unit) + b, error=1e-3 * factor)
        asked.append(search.ask())
    np.testing.assert_allclose(asked, [asked[0]] * 3, atol=2e-2)


def test_the_logarithm_of_expected_improvement_has_its_digits_far_below_too():
    z = doubles([8.0, 1.0, 0.0, -0.9, -1.1, -5.0, -20.0, -499.0, -501.0])
    # log(phi(z) + z Phi(z)) with 60 digits.
    exact = [2.0794415416798359, 0.0800262188493069, -0.9189385332046727, -2.2982829894596517, -2.6791783824760538,
             -16.7443011626609901, -206.9178385094250978]  # fmt: skip
    found = log_expected_improvement(z, torch.ones_like(z), 0.0, 1.0)
    np.testing.assert_allclose(found[:7], exact, rtol=1e-12)
    assert found[7] - found[8] == pytest.approx(1000.0 + 2 * math.log(501 / 499), abs=1e-4)
    # Twice as far with twice the deviation is twice the improvement.
    np.testing.assert_allclose(
        log_expected_improvement(2 * z, 2 * torch.ones_like(z), 0.0, 1.0), found + math.log(2), rtol=1e-12
    )
