"""A folder of results is of one run only."""

import subprocess
import sys

import pytest

from torchcover.evaluation import claimed
from torchcover.evaluation.result_files import ResultFiles

CLAIM = """
import sys
from pathlib import Path
from torchcover.evaluation import claimed
with claimed(Path(sys.argv[1])):
    print("claimed", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path):
    """Another process that has claimed the folder."""
    with subprocess.Popen(
        [sys.executable, "-c", CLAIM, tmp_path / "out"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "claimed\n"
        yield process
        process.kill()


def write(folder):
    with ResultFiles(folder) as files:
        files.add("a.txt", lambda path: path.write_text("a"))
        files.publish({"complete": True})


def test_the_second_is_refused_while_the_first_lives_and_not_when_it_was_killed(other, tmp_path):
    with pytest.raises(ValueError, match="another run is writing there"), claimed(tmp_path / "out"):
        pass
    with pytest.raises(ValueError, match="another run is writing there"):
        write(tmp_path / "out")
    assert not (tmp_path / "out" / "a.txt").exists()
    other.kill()
    other.wait()
    write(tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.txt", "summary.json"]


def test_a_process_may_write_where_it_has_claimed(tmp_path):
    with claimed(tmp_path / "out"):
        write(tmp_path / "out")
        assert (tmp_path / "out" / ".lock").exists()
    assert not (tmp_path / "out" / ".lock").exists()


def test_what_was_made_for_nothing_is_taken_away(tmp_path):
    with pytest.raises(ZeroDivisionError), claimed(tmp_path / "new" / "out"):
        raise ZeroDivisionError
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    with claimed(tmp_path / "old"):
        pass
    assert (tmp_path / "old").exists()
