"""Hostile documents and options end quickly with one line; `benchmarks hostile_documents` runs all."""

import time
from itertools import chain

import pytest

from . import hostile

# Every second document and option, and one number of one document.
CASES = [
    *list(chain(hostile.list_documents(), hostile.list_options()))[::2],
    *(case for case in hostile.list_values() if case.name.startswith("rig: columns: ")),
]


def test_there_are_enough_hostile_cases():
    assert len(list(hostile.list_cases())) >= 400


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name[:40])
def test_hostile_case_ends_quickly_with_one_line(case, torchcover, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, content in case.files.items():
        (tmp_path / name).write_text(content)
    case.prepare(tmp_path)
    start = time.perf_counter()
    code, _, stderr = torchcover(*case.arguments)
    assert time.perf_counter() - start < 30
    assert code == 2, stderr
    assert stderr.startswith("torchcover: ")
    assert stderr.count("\n") == 1
    assert len(stderr) < 2100
