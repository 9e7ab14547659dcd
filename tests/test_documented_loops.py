"""What the documentation shows: whoever copies it must not lose what the numbers depend on."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHOWN = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("examples/**/*.py"), *ROOT.glob("torchcover/**/*.py")]
# `update(...)` with what stands in its brackets, and in brackets within these.
UPDATE = re.compile(r"\bupdate\(((?:[^()]|\([^()]*\))*)\)")


def forgetful(text):
    """Updates with the reference of frames, and without its weights."""
    return [call for call in UPDATE.findall(text) if re.search(r"\.reference\b", call) and "weights=" not in call]


def test_loops_over_frames_pass_the_weights_of_their_reference_points():
    found = {path.relative_to(ROOT): forgetful(path.read_text(encoding="utf-8")) for path in SHOWN}
    assert len(found) > 100
    assert {path: calls for path, calls in found.items() if calls} == {}


def test_a_loop_that_forgets_them_is_found():
    told = "metric.update(sensor_of(frame), frame.reference, weights=frame.reference_weights)"
    assert forgetful(told) == []
    assert len(forgetful(told + "\nmetric.update(\n    frame.cloud_of('a'), batch.reference, block_index=[0]\n)")) == 1
