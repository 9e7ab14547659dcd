"""YAML: unique keys, numbers of YAML 1.2, and limits of size."""

import math
import time

import pytest

from torchcover.files import parse_yaml, to_yaml

LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1", 1), ("-3", -3), ("+1", 1), ("0", 0), ("99999999999999999999", 99_999_999_999_999_999_999),
        ("1.", 1.0), ("2.e+00", 2.0), (".5", 0.5), ("1e-3", 1e-3), ("-.5E+3", -500.0), (".Inf", math.inf),
        ("-.inf", -math.inf), ("true", True), ("False", False), ("~", None), ("", None), ("null", None),
        # Values that YAML 1.1 reads as numbers, booleans and dates.
        ("0100", "0100"), ("1:40", "1:40"), ("1_000", "1_000"), ("0x10", "0x10"), ("yes", "yes"), ("on", "on"),
        ("2020-01-01", "2020-01-01"), ("'60'", "60"), ("9" * 5000, "9" * 5000), ("1.5.2", "1.5.2"),
    ],
)  # fmt: skip
def test_scalars_are_what_they_look_like(text, expected):
    value = parse_yaml(f"key: {text}")["key"]
    assert (value, type(value)) == (expected, type(expected))


def test_anchors_and_opencvs_matrices_are_read():
    assert parse_yaml("x: &x {p: 1, q: 2}\ny: {<<: *x, p: 3}\nz: [*x, *x]") == {
        "x": {"p": 1, "q": 2},
        "y": {"p": 3, "q": 2},
        "z": [{"p": 1, "q": 2}] * 2,
    }
    matrix = "%YAML:1.0\n---\nM: !!opencv-matrix\n   rows: 1\n   dt: d\n   data: [ 1., 2.e+00, -.5 ]\n"
    assert parse_yaml(matrix) == {"M": {"rows": 1, "dt": "d", "data": [1.0, 2.0, -0.5]}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", "the key 'a' is there twice, in line 1 and in line 3"),
        ("m:\n  - x_m: 1\n    y_m: 2\n    x_m: 1", "the key 'x_m' is there twice, in line 2 and in line 4"),
        ("{a: 1, 'a': 2}", "the key 'a' is there twice"),
        ("a: !!int '0100'", "'0100' is no int, line 1"),
        ("a: !!python/object:os.system x", "tag .*python.* is not read, line 1"),
        ("a: &a [*a]", "an anchor that holds itself, line 1"),
        ("a: &a {b: {c: *a}}", "an anchor that holds itself, line 1"),
        ("[" * 500 + "]" * 500, "more than 64 lists and mappings within each other, line 1"),
        ("- " * 500 + "x", "more than 64 lists"),
        (LAUGHS, "more than 200,000 values, those of aliases included, line 6"),
        ("a: " + "x" * 1_000_000, "of 1,000,000 characters at most; it has 1,000,003"),
        ("a: [1", r"line 1, column 4"),
        ("a: 1\n---\na: 2", "another document"),
        ("? [a]\n: 1", "unhashable key"),
    ],
)
def test_malicious_yaml_is_refused_with_its_line(text, message):
    start = time.perf_counter()
    with pytest.raises(ValueError, match=f"not a YAML file.*{message}"):
        parse_yaml(text)
    assert time.perf_counter() - start < 10


@pytest.mark.parametrize(
    "text", ["1e5", "1:40", "on", "0100", "~", "null", "0o17", "-.inf", "1.", "+1", "", "a: b", "é"]
)
def test_written_yaml_is_read_back_equally(text):
    content = {"name": text, "values": [1, 1.0, 1e-7, 1e22, True, None], text or "empty": {"a": [text]}}
    assert parse_yaml(to_yaml(content)) == content
