"""Numbers and choices: every share from 0 to 1 is a value in the space, and every value has its share."""

import numpy as np
import pytest

from torchcover.placement.variables import FreeChoice, FreeNumber


@pytest.mark.parametrize(("low", "high"), [(-10.0, 15.0), (0.0, 1.0), (1.68, 1.85), (-1e6, 1e6), (0.1234567891, 0.2)])
def test_a_number_comes_back_from_its_share_to_the_last_bit(low, high):
    number = FreeNumber("roof.x_m", low, high)
    for u in [0.0, 1.0, *np.random.default_rng(0).random(200).tolist()]:
        value = number.at(u)
        assert low <= value <= high
        assert number.at(number.unit(value)) == value
        assert float(f"{value:.6f}") == value or value in (low, high)
        assert number.unit(value) == pytest.approx(u, abs=1e-6 / (high - low))
    assert (number.at(0.0), number.at(1.0)) == pytest.approx((low, high), abs=1e-6)


@pytest.mark.parametrize("options", [("a", "b"), ("a", "b", "c"), (True, False)])
def test_options_have_equal_parts_of_the_way_and_come_back_from_their_middle(options):
    choice = FreeChoice("roof.model", options)
    drawn = [choice.at(u) for u in (np.arange(3000) + 0.5) / 3000]
    assert [drawn.count(option) for option in options] == [3000 / len(options)] * len(options)
    assert choice.at(1.0) == options[-1]
    assert [choice.unit(option) for option in options] == [(k + 0.5) / len(options) for k in range(len(options))]
    for u in (0.0, 0.3, 0.7, 1.0):
        assert choice.at(choice.unit(choice.at(u))) == choice.at(u)


@pytest.mark.parametrize("variable", [FreeNumber("roof.x_m", 0.0, 1.0), FreeChoice("roof.model", ("a", "b"))])
@pytest.mark.parametrize("u", [-0.001, 1.001, np.nan, np.inf])
def test_a_share_that_is_none_is_refused(variable, u):
    with pytest.raises(ValueError, match=rf"{variable.name}: a share from 0 to 1 is needed; got {u}"):
        variable.at(u)


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan, "a", True])
def test_a_value_outside_has_no_share(value):
    assert not FreeNumber("roof.x_m", 0.0, 1.0).holds(value)
    with pytest.raises(ValueError, match=r"roof\.x_m: a number from 0 to 1 is needed"):
        FreeNumber("roof.x_m", 0.0, 1.0).unit(value)


@pytest.mark.parametrize("value", ["c", 1.0, 1])
def test_only_an_option_has_a_part_of_the_way(value):
    assert not FreeChoice("roof.present", (True, False)).holds(value)
    with pytest.raises(ValueError, match=r"roof\.present: one of True, False is needed"):
        FreeChoice("roof.present", (True, False)).unit(value)
