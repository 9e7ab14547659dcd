"""Documented loops: examples that update a metric with the reference of frames pass its area weights."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = [
    ROOT / "README.md",
    *ROOT.glob("docs/*.md"),
    *ROOT.glob("examples/**/*.py"),
    *ROOT.glob("torchcover/**/*.py"),
]
# Call of `update` with its arguments, which may contain one level of parentheses.
UPDATE = re.compile(r"\bupdate\(((?:[^()]|\([^()]*\))*)\)")


def find_unweighted_updates(text):
    """Find calls of `update` with the reference of a frame but without weights."""
    calls = UPDATE.findall(text)
    return [call for call in calls if re.search(r"\.reference\b", call) and "weights=" not in call]


def test_loops_over_frames_pass_reference_weights():
    unweighted = {path.relative_to(ROOT): find_unweighted_updates(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert len(unweighted) > 100
    assert {path: calls for path, calls in unweighted.items() if calls} == {}


def test_loops_without_weights_are_found():
    weighted = "metric.update(sensor_of(frame), frame.reference, weights=frame.reference_weights)"
    assert find_unweighted_updates(weighted) == []
    unweighted = "\nmetric.update(\n    frame.cloud_of('a'), batch.reference, block_index=[0]\n)"
    assert len(find_unweighted_updates(weighted + unweighted)) == 1
