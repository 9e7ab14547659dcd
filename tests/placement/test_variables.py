"""Numbers and choices: every share from 0 to 1 is a value in the space."""

import numpy as np
import pytest

from torchcover.placement.free_sensor import FreeChoice, FreeNumber


@pytest.mark.parametrize(("low", "high"), [(-10.0, 15.0), (0.0, 1.0), (1.68, 1.85), (-1e6, 1e6), (0.1234567891, 0.2)])
def test_free_numbers_are_rounded_within_bounds(low, high):
    number = FreeNumber("roof.x_m", low, high)
    for share in [0.0, 1.0, *np.random.default_rng(0).random(200).tolist()]:
        value = number.get_value(share)
        assert low <= value <= high
        assert number.round_value(value) == value
        assert float(f"{value:.6f}") == value or value in (low, high)
        assert (value - low) / (high - low) == pytest.approx(share, abs=1e-6 / (high - low))
    assert number.round_value(high + 1e-9) == high


@pytest.mark.parametrize("options", [("a", "b"), ("a", "b", "c"), (True, False)])
def test_options_have_equal_shares(options):
    choice = FreeChoice("roof.model", options)
    sampled = [choice.get_value(share) for share in (np.arange(3000) + 0.5) / 3000]
    assert [sampled.count(option) for option in options] == [3000 / len(options)] * len(options)
    assert choice.get_value(1.0) == options[-1]


@pytest.mark.parametrize(
    ("variable", "values", "message"),
    [
        (
            FreeNumber("roof.x_m", 0.0, 1.0),
            (-0.1, 1.1, np.nan, "a", True),
            r"roof\.x_m: got .*; give a number from 0 to 1",
        ),
        (FreeChoice("roof.present", (True, False)), ("c", 1.0, 1), r"roof\.present: got .*; give one of True, False"),
    ],
)
def test_values_outside_are_refused(variable, values, message):
    for value in values:
        assert not variable.is_allowed(value)
        with pytest.raises(ValueError, match=message):
            variable.check(value)
