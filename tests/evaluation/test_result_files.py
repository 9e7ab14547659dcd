"""A folder of results is of one run only."""

import os
import signal
import subprocess
import sys
from pathlib import Path

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


def test_a_signal_waits_until_the_files_are_in_their_places(tmp_path, monkeypatch):
    write(tmp_path)
    replace = os.replace
    monkeypatch.setattr(os, "replace", lambda *paths: (signal.raise_signal(signal.SIGINT), replace(*paths)))
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "summary.json"]


def test_what_is_listed_stays_so_while_more_is_added(tmp_path, monkeypatch):
    replace, seen = os.replace, []
    monkeypatch.setattr(
        os, "replace", lambda *paths: (seen.append((tmp_path / "summary.json").exists()), replace(*paths))
    )
    with ResultFiles(tmp_path) as files:
        for name in "ab", "b":
            for letter in name:
                files.add(f"{letter}.txt", lambda path: path.write_text("new"))
            files.publish({"complete": True})
        files.add("c.txt", lambda path: path.write_text("more"))
        files.publish({"complete": True})
    # Not there while a file that it lists is replaced.
    assert seen == [False, False, False, False, False, True, True]


def test_kills_leave_a_result_or_none():
    """In full: `python -m benchmarks kills`."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.kills", "--kills", "4"],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    rows = [line.split(" | ") for line in done.stdout.splitlines() if "| SIG" in line]
    assert len(rows) == 4
    assert [row for row in rows if "BROKEN" in row[2] or (row[2] == "incomplete" and row[1] != "SIGKILL")] == []
