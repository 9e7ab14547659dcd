"""Exit codes of commands, also with closed streams."""

import os
import signal
import subprocess
import sys

import pytest

from torchcover.cli import app, listing

PROGRAM = [sys.executable, "-m", "torchcover"]


@pytest.mark.parametrize(
    ("error", "code", "lines"),
    [
        (ValueError("such a value"), 2, 1),
        (FileNotFoundError("no such file"), 2, 1),
        (MemoryError(), 2, 1),
        (RuntimeError("a defect"), 70, 3),
        (KeyError("name"), 70, 3),
        (AssertionError(), 70, 3),
        (BrokenPipeError(32, "Broken pipe"), 141, 0),
        (KeyboardInterrupt(), 130, 1),
        (app.typer.Exit(1), 1, 0),
        (app.typer.Exit(), 0, 0),
    ],
)
def test_each_error_has_its_exit_code(torchcover, monkeypatch, error, code, lines):
    def run(word):
        raise error

    monkeypatch.setattr(listing, "print_builtin", run)
    ended, _, stderr = torchcover("list")
    assert (ended, ("Traceback" in stderr)) == (code, code == 70)
    assert len(stderr.splitlines()) >= lines if code == 70 else len(stderr.splitlines()) == lines
    assert code != 70 or stderr.splitlines()[-1].startswith("torchcover: internal error (")


@pytest.mark.parametrize(
    ("arguments", "code", "closed"),
    [
        ("list", 0, "<&-"),
        ("list", 0, ">&-"),
        ("list nothing-such", 2, "2>&-"),
        ("--help", 0, "<&- >&- 2>&-"),
        ("", 2, ">&- 2>&-"),
    ],
)
def test_commands_run_with_closed_streams(arguments, code, closed):
    command = f"exec {' '.join(PROGRAM)} {arguments} {closed}"
    done = subprocess.run(["sh", "-c", command], check=False, capture_output=True, text=True)
    assert (done.returncode, "Traceback" in done.stderr) == (code, False)


def test_results_are_written_with_closed_streams(scenes):
    settings = f"--scenario {scenes}/yard.yaml --set cell_m=4 --num-rays 1024 --num-frames 2 --num-workers 1"
    command = f"exec {' '.join(PROGRAM)} evaluate {scenes}/low.yaml {settings} --files numbers <&- >&- 2>&-"
    assert subprocess.run(["sh", "-c", command], check=False, cwd=scenes).returncode == 0
    assert {path.name for path in (scenes / "out").iterdir()} >= {"summary.json", "coverage.npz", "summary.csv"}
    assert b"\x1b" not in (scenes / "out" / "summary.csv").read_bytes()


@pytest.mark.parametrize("arguments", ["list", "targets front_roof_32 --raster 3,5,-1,1,1 --files numbers"])
def test_broken_pipe_ends_with_141_and_no_message(arguments, tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    command = [*PROGRAM, *arguments.split()]
    done = subprocess.run(command, check=False, stdout=writer, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


def test_full_disk_at_stdout_is_one_line():
    with open("/dev/full", "w", encoding="utf-8") as full:
        done = subprocess.run([*PROGRAM, "list"], check=False, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, "torchcover: [Errno 28] No space left on device\n")


def test_help_lists_the_exit_codes(torchcover):
    for arguments in (["--help"], ["check", "--help"]):
        printed = " ".join(torchcover(*arguments)[1].split())
        assert all(f"{code} " in printed for code in (0, 1, 2, 70, 141)), printed
