"""Damaged files of every format are read, or end in one error; in full: `python -m benchmarks.faults`."""

import os

import pytest

from tests.damaged.good_files import kinds
from tests.damaged.mutated_files import attempt, mutated

PARTS, FILES = 4, 270


@pytest.fixture(scope="module")
def every(tmp_path_factory):
    return kinds(tmp_path_factory.mktemp("seeds"))


def test_the_files_are_good_before(every, tmp_path):
    assert [kind.name for kind in every if attempt(kind, kind.data, tmp_path)[0] != "read"] == []


@pytest.mark.parametrize("part", range(PARTS))
def test_damaged_files_are_read_or_named(every, tmp_path, part):
    outcomes = {"read": 0, "bad": 0}
    for number in range(part * FILES, (part + 1) * FILES):
        what, *_ = attempt(every[number % len(every)], mutated(every, number), tmp_path)
        assert what in outcomes, (number, every[number % len(every)].name, what)
        outcomes[what] += 1
    assert min(outcomes.values()) > FILES / 10  # the damage is neither too small nor too large


def test_no_reader_waits_for_a_pipe(every, tmp_path):
    for number, kind in enumerate(every):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name, data in kind.beside:
            folder.joinpath(name).write_bytes(data)
        os.mkfifo(folder / kind.name)
        with pytest.raises(ValueError, match=f"{kind.name}: a pipe, a socket or a device; .* has to be a regular file"):
            kind.read(folder / kind.name)
