"""Numbers in words: how they are rounded, and that words and marks see the same."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcover.coverage.quantity import RADIUS, detection
from torchcover.estimation import Difference
from torchcover.report.wording import difference_words, error_words, percent, rounded, value_words

SHARE = detection(0.4)
NUMBERS = st.tuples(
    st.floats(0.0, 1.0) | st.sampled_from([0.0, 1.0, 0.9996, 0.0004, 0.5]),
    st.floats(0.0, 0.1) | st.sampled_from([0.0, math.nan, 1e-13, 1e-9]),
)


@given(st.floats(0.0, 1.0))
def test_only_nothing_is_0_percent_and_only_all_is_100(share):
    assert (percent(share) in ("0", "0.0")) == (share == 0.0)
    assert (percent(share) in ("100", "100.0")) == (share == 1.0)
    assert abs(float(percent(share).strip("<>")) - 100 * share) <= 0.1


@given(st.floats(0.0, 1e3), st.floats(1e-11, 1e2))
def test_a_number_has_the_decimals_of_its_error(value, error):
    words, error_words = value_words(value, error, "m").split(" ± ")
    decimals = [len(number.partition(".")[2]) for number in (words, error_words)]
    assert decimals[0] == decimals[1] <= 4
    if not error_words.startswith("<"):
        assert 0 < float(error_words) == pytest.approx(error, rel=0.051, abs=0.00005 if decimals[0] == 4 else 0.0)
        assert float(words) == pytest.approx(value, abs=0.5001 * 10.0 ** -decimals[0])
        assert len(error_words.replace(".", "").lstrip("0")) <= max(2, len(str(math.ceil(error))))


@given(st.floats(0.0, 1.0))
def test_with_a_tiny_error_only_nothing_is_0_percent_and_only_all_is_100(share):
    words, error_words = value_words(share, 1e-9, "share").split(" ± ")
    assert error_words == "<0.001"
    assert (words == "0.000") == (share == 0.0)
    assert (words == "100.000") == (share == 1.0)


@given(st.floats(-2.0, 2.0), st.floats(1e-9, 1.0))
def test_a_difference_has_a_sign_and_none_is_minus_nothing(difference, error):
    words = difference_words(Difference(RADIUS, difference, error)).split(" ± ")[0]
    assert words[0] == ("-" if float(words) < 0 else "+" if float(words) else "0")
    if float(words):
        assert math.copysign(1, difference) == math.copysign(1, float(words))


@given(NUMBERS, NUMBERS, st.sampled_from(["m", "share"]))
def test_two_numbers_are_equal_if_and_only_if_they_look_the_same(a, b, unit):
    look_the_same = value_words(*a, unit).split(" ± ")[0] == value_words(*b, unit).split(" ± ")[0]
    assert (rounded(*a, unit) == rounded(*b, unit)) is look_the_same


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0) | st.just(math.nan), st.sampled_from(["m", "share"]))
def test_an_error_alone_reads_as_behind_its_number(value, error, unit):
    *_, behind = value_words(value, error, unit).split(" ± ")
    assert error_words(error, unit) == ("unknown" if math.isnan(error) else behind)


def test_what_has_no_error_at_all_is_shown_as_such():
    shares = [value_words(*number, "share") for number in ((1.0, 0.0), (0.0, 0.0), (0.5, 1e-17))]
    assert shares == ["100 ± 0", "0 ± 0", "50.0 ± 0"]
    assert value_words(0.2, 0.0, "m") == "0.20 ± 0"
    assert difference_words(Difference(SHARE, 0.0, 0.0)) == "0 ± 0"
    assert difference_words(Difference(RADIUS, 0.0)) == "0"
    assert difference_words(Difference(SHARE, -1e-6)) == "0.0"


def test_infinity_and_the_unknown_have_neither_digits_nor_errors():
    assert value_words(math.inf, math.nan, "m") == "infinite"
    assert difference_words(Difference(SHARE, math.inf, 1.0)) == "+infinite"
    assert difference_words(Difference(RADIUS, -math.inf)) == "-infinite"
    assert value_words(math.nan, 0.1, "m") == "unknown"
    assert difference_words(Difference(SHARE, math.nan, 0.1)) == "unknown"
