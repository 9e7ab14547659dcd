"""Numbers in words: how they are rounded, and that words and marks see the same."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcover.coverage.quantities import RADIUS, make_detection_quantity
from torchcover.estimation import Difference, Number
from torchcover.report.number_format import (
    format_difference,
    format_error,
    format_number,
    format_percent,
    format_value,
    round_number,
)

SHARE = make_detection_quantity(0.4)
NUMBERS = st.tuples(
    st.floats(0.0, 1.0) | st.sampled_from([0.0, 1.0, 0.9996, 0.0004, 0.5]),
    st.floats(0.0, 0.1) | st.sampled_from([0.0, math.nan, 1e-13, 1e-9]),
)


@given(st.floats(0.0, 1.0))
def test_only_exact_shares_are_0_or_100(share):
    assert (format_percent(share) in ("0", "0.0")) == (share == 0.0)
    assert (format_percent(share) in ("100", "100.0")) == (share == 1.0)
    assert abs(float(format_percent(share).strip("<>")) - 100 * share) <= 0.1


@given(st.floats(0.0, 1e3), st.floats(1e-11, 1e2))
def test_numbers_have_the_decimals_of_their_error(value, error):
    words = format_number(Number(RADIUS, value, error, value - 3 * error, value + 3 * error))
    shown = [float(end) for end in re.fullmatch(r"[<>]?(\S+)  \[(\S+), (\S+)\]", words).groups()]
    (decimals,) = {len(number.partition(".")[2]) for number in re.findall(r"[\d.]+", words)}
    assert decimals <= 4
    expected = [value, value - 3 * error, value + 3 * error]
    assert shown == pytest.approx(expected, abs=(1.0 if words[0] in "<>" else 0.5001) * 10.0**-decimals)
    if 0 < decimals < 4:
        assert 10 <= round(error * 10**decimals, 3) < 100


@given(st.floats(0.0, 1.0))
def test_tiny_errors_keep_shares_off_0_and_100(share):
    words = format_number(Number(SHARE, share, 1e-9))
    assert (words == "0.000") == (share == 0.0)
    assert (words == "100.000") == (share == 1.0)


@given(st.floats(-2.0, 2.0), st.floats(1e-9, 1.0))
def test_differences_have_a_sign_but_no_minus_zero(difference, error):
    words = format_difference(Difference(RADIUS, difference, error))
    assert words[0] == ("-" if float(words) < 0 else "+" if float(words) else "0")
    if float(words):
        assert math.copysign(1, difference) == math.copysign(1, float(words))


@given(NUMBERS, NUMBERS, st.sampled_from([RADIUS, SHARE]))
def test_equal_numbers_look_the_same(a, b, quantity):
    look_the_same = format_number(Number(quantity, *a)) == format_number(Number(quantity, *b))
    assert (round_number(*a, quantity.unit) == round_number(*b, quantity.unit)) is look_the_same


def test_number_without_error_stands_alone():
    shares = [format_number(Number(SHARE, *number)) for number in ((1.0, math.nan), (0.0, 0.0), (0.5, 1e-17))]
    assert shares == ["100", "0", "50.0"]
    assert format_number(Number(RADIUS, 0.2, 0.013)) == "0.200"
    assert format_number(Number(RADIUS, 0.2, 0.5, 0.001, 1e200)) == "0.20  [0.00, inf]"
    assert format_difference(Difference(SHARE, 0.0, 0.0, 0.0, 0.0)) == "0"
    assert format_difference(Difference(RADIUS, 0.0)) == "0"
    assert format_difference(Difference(SHARE, -1e-6)) == "0.0"
    assert format_error(math.nan, "m") == "unknown"


def test_infinite_and_missing_numbers_have_no_interval():
    assert format_number(Number(RADIUS, math.inf)) == format_value(math.inf, "m") == "infinite"
    assert format_difference(Difference(SHARE, math.inf, 1.0)) == "+infinite"
    assert format_difference(Difference(RADIUS, -math.inf)) == "-infinite"
    assert format_number(Number(RADIUS, math.nan, 0.1)) == format_value(math.nan, "m") == "unknown"
    assert format_difference(Difference(SHARE, math.nan, 0.1)) == "unknown"
