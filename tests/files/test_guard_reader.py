"""Checks that all readers share."""

import re
import time

import numpy as np
import pytest

from torchcover.files import (
    BadFileError,
    TooLargeError,
    check_memory,
    guard_reader,
    read_csv,
    read_json_table,
    read_npz,
    read_short_text,
)
from torchcover.files.bad_file import MAX_SHORT_BYTES


def reading(tmp_path, error):
    """Read a file with a reader that raises."""

    @guard_reader("a thing")
    def read(path):
        raise error

    path = tmp_path / "thing.dat"
    path.write_bytes(b"1")
    return path, read


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("three\nlines\nof it"), "three lines of it"),
        (KeyError("k"), r"not readable as a thing \(KeyError: 'k'\); is it damaged, or another format\?"),
        (OSError(5, "Input/output error"), r"not readable as a thing \(OSError: .*Input/output error\)"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "no"), r"not readable as a thing \(UnicodeDecodeError"),
        (RecursionError("deep"), r"not readable as a thing \(RecursionError: deep\)"),
        (MemoryError(), "there is not enough memory to read a thing of this size"),
        (ValueError(), "ValueError"),
        (ValueError("x" * 10_000), "x{500}$"),
    ],
)
def test_all_errors_become_one_line_with_the_file(tmp_path, error, message):
    path, read = reading(tmp_path, error)
    with pytest.raises(BadFileError, match=f"^{re.escape(str(path))}: {message}") as caught:
        read(str(path))
    assert caught.value.__cause__ is error
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("error", [BadFileError("other.dat: bad"), ImportError("package"), KeyboardInterrupt()])
def test_errors_unrelated_to_the_file_pass(tmp_path, error):
    path, read = reading(tmp_path, error)
    with pytest.raises(type(error)) as caught:
        read(path)
    assert caught.value is error


def test_what_is_no_file_is_not_opened(tmp_path):
    path, read = reading(tmp_path, AssertionError("opened"))
    path.write_bytes(b"")
    with pytest.raises(BadFileError, match=r"thing\.dat: an empty file \(0 bytes\); a thing is needed"):
        read(path)
    with pytest.raises(FileNotFoundError, match=r"gone: no such file; a thing is needed"):
        read(tmp_path / "gone")
    with pytest.raises(IsADirectoryError, match="a folder; a thing is one file"):
        read(tmp_path)
    with pytest.raises(BadFileError, match="/dev/null: a pipe, a socket or a device; a thing has to be a regular file"):
        read("/dev/null")


def test_memory_limit_of_a_file_can_be_raised(monkeypatch):
    check_memory(2 * 10**9)
    for needed in (2 * 10**9 + 1, 10**400):
        with pytest.raises(
            TooLargeError, match=r"takes .* GB .* more than the 2 GB .* variable TORCHCOVER_MAX_FILE_GB"
        ):
            check_memory(needed)
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "3.5")
    check_memory(35 * 10**8)
    for wrong in ("much", "", "-1", "nan"):
        monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", wrong)
        with pytest.raises(ValueError, match=f"has to be a number of gigabytes; got '{wrong}'"):
            check_memory(0)


def test_all_arrays_of_an_archive_together_are_bounded(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(50_000), b=np.zeros(50_000))
    assert set(read_npz(tmp_path / "a.npz", lambda header: None)) == {"a", "b"}
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.0008001")
    with pytest.raises(TooLargeError, match=r"takes 0.0008 GB"):
        read_npz(tmp_path / "a.npz", lambda header: None)
    assert read_npz(tmp_path / "a.npz", lambda header: None, lambda names: ["b"]).keys() == {"b"}


def test_text_that_is_parsed_slowly_is_short(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + b"a" * 10)
    assert read_short_text(path) == "a" * 10
    path.write_bytes(b"a" * (MAX_SHORT_BYTES + 1))
    with pytest.raises(ValueError, match="1000001 bytes; at most 1000000 are read"):
        read_short_text(path)


def test_tables_with_many_columns_are_refused_quickly(tmp_path):
    (tmp_path / "a.csv").write_text("t," * 200_000 + "x\n1\n")
    start_s = time.process_time()
    with pytest.raises(BadFileError, match="there twice: t"):
        read_csv(tmp_path / "a.csv", ["t", "x"])
    assert time.process_time() - start_s < 5.0


def test_json_is_bounded_by_its_objects(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_text(f"[{'{},' * 10_000}{{}}]")  # 30 kB take 800 kB of memory
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.0005")
    with pytest.raises(BadFileError, match=r"reading it takes 0\.00\d+ GB .* more than the 0\.0005 GB"):
        read_json_table(tmp_path / "a.json")
