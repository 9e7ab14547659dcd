"""Folders and files are whole whenever they are looked at."""

import errno
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.killing import operations_of
from torchcover.files import RECORDING, Publication, claimed, noted, reads, settled, write_durably

# Of two publications by the name of each file: what is in it. `mine.txt` and `maps/mine.png` are a user's.
EARLIER = {"a.txt": "earlier", "gone.txt": "earlier", "maps/m.png": "earlier", "maps/gone.png": "earlier"}
NUMBERS = {"a.txt": "new", "b.txt": "new"}
MAPS = {"maps/m.png": "new", "maps/n.png": "new"}
CLAIM = """
import sys
from pathlib import Path
from torchcover.files import claimed
with claimed(Path(sys.argv[1])):
    print("claimed", flush=True)
    sys.stdin.read()
"""


def publish(folder, *contents):
    """Publish files, one after the other what is added to them."""
    with Publication(folder) as files:
        for content in contents:
            for name, text in content.items():
                files.add(name, lambda path, text=text: path.write_text(text))
            files.publish({"complete": True})
    return files


@reads("a text")
def read(path):
    return path.read_text()


def found(folder):
    """What a reader finds under each name that there ever was, and what the summary lists."""
    texts = {}
    for name in {**EARLIER, **NUMBERS, **MAPS, "mine.txt": "", "maps/mine.png": ""}:
        try:
            texts[name] = read(folder / name)
        except FileNotFoundError:
            texts[name] = None
    return {name: text for name, text in texts.items() if text}, set(json.loads(read(folder / "summary.json"))["files"])


def in_place(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def with_earlier(folder):
    (folder / "maps").mkdir(parents=True)
    mine = {"mine.txt": "mine", "maps/mine.png": "mine"}
    for name, text in mine.items():
        (folder / name).write_text(text)
    publish(folder, EARLIER)
    wholes = EARLIER, NUMBERS, NUMBERS | MAPS
    return [({**mine, **whole}, set(whole)) for whole in wholes]


@pytest.fixture
def other(tmp_path):
    """Another process that has claimed the folder."""
    with subprocess.Popen(
        [sys.executable, "-c", CLAIM, tmp_path / "out"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "claimed\n"
        yield process
        process.kill()


def test_the_second_is_refused_while_the_first_lives_and_not_when_it_was_killed(other, tmp_path):
    with pytest.raises(ValueError, match="another run is writing there"), claimed(tmp_path / "out"):
        pass
    with pytest.raises(ValueError, match="another run is writing there"):
        publish(tmp_path / "out", NUMBERS)
    assert not (tmp_path / "out" / "a.txt").exists()
    other.kill()
    other.wait()
    publish(tmp_path / "out", NUMBERS)
    assert in_place(tmp_path / "out") == {"a.txt", "b.txt", "summary.json"}


def test_a_folder_without_locks_is_named_and_read_all_the_same(tmp_path, monkeypatch):
    whole = killed_in_the_middle(tmp_path)

    def flock(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", flock)  # as on a network disk
    with pytest.raises(OSError, match=rf"No locks available: '{tmp_path}/.lock'"):
        publish(tmp_path, MAPS)
    assert found(tmp_path) == whole


def test_a_process_may_write_where_it_has_claimed(tmp_path):
    with claimed(tmp_path / "out"):
        publish(tmp_path / "out", NUMBERS)
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


def test_what_is_published_is_the_content_of_the_folder(tmp_path):
    earlier, numbers, whole = with_earlier(tmp_path)
    assert found(tmp_path) == earlier
    assert publish(tmp_path, NUMBERS).paths == [tmp_path / name for name in (*NUMBERS, "summary.json")]
    assert found(tmp_path) == numbers
    publish(tmp_path, NUMBERS, MAPS)
    assert found(tmp_path) == whole
    assert in_place(tmp_path) == {*whole[0], "summary.json"}


def test_a_kill_at_any_file_operation_leaves_the_earlier_or_the_new(tmp_path, monkeypatch):
    wholes = with_earlier(tmp_path / "earlier")
    out = copied(tmp_path / "earlier", tmp_path / "out")
    count, code = operations_of(lambda: publish(out, NUMBERS, MAPS), copied=(out, tmp_path / "copies"))
    assert (count > 40, code) == (True, 0)
    seen = []
    for at in range(count):
        folder = tmp_path / "copies" / str(at)
        with monkeypatch.context() as patched:
            patched.setattr("filelock.FileLock.acquire", lambda *_, at=folder, **__: denied(at))
            seen.append(wholes.index(found(folder)))
        waiting = (folder / ".whole" / "summary.json").exists()
        assert wholes[seen[-1]] == found(folder)  # which puts all in their places
        if waiting:
            assert not (folder / ".whole").exists()
        if waiting or at % 8 == 0:
            publish(folder, NUMBERS)
            assert found(folder) == wholes[1]
            assert in_place(folder) == {*wholes[1][0], "summary.json"}
    assert seen == sorted(seen)
    assert set(seen) == {0, 1, 2}


@pytest.mark.parametrize("at", [9, 24, 33])
def test_what_a_kill_leaves_is_what_is_there_in_that_moment(tmp_path, at):
    trees = []
    for name in ("copied", "killed"):
        out = tmp_path / name / "out"
        with_earlier(out)
        ended = operations_of(
            lambda out=out: publish(out, NUMBERS, MAPS),
            at if name == "killed" else None,
            copied=(out, tmp_path / name / "copies"),
        )
        left = out if name == "killed" else tmp_path / name / "copies" / str(at)
        trees.append(sorted(re.sub("partial_.*?/", "/", path) for path in in_place(left)))
    assert ended == (at, -signal.SIGKILL)
    assert trees[0] == trees[1]


def test_whoever_puts_files_in_their_places_may_be_killed_too(tmp_path):
    out = tmp_path / "out"
    whole = killed_in_the_middle(out)
    count, code = operations_of(lambda: read(out / "a.txt"), copied=(out, tmp_path / "copies"))
    assert (count > 12, code) == (True, 0)
    for at in range(count):
        assert found(tmp_path / "copies" / str(at)) == whole


def copied(folder, place):
    shutil.copytree(folder, place)
    return place


def denied(path):
    raise OSError(errno.EROFS, "Read-only file system", str(path / ".lock"))


def killed_in_the_middle(folder):
    """The new files of the folder are complete, and one of them is in its place; returns what a reader has to find."""
    wholes = with_earlier(folder)
    moved = []

    def replace(source, target, replace=os.replace):
        replace(source, target)
        if target.suffix == ".txt":
            moved.append(target)
            os._exit(0)

    def act():
        os.replace = replace
        publish(folder, NUMBERS)

    assert operations_of(act)[1] == 0
    assert (folder / ".whole" / "summary.json").is_file()
    return wholes[1]


def test_what_another_process_is_about_to_move_is_read_where_it_lies(tmp_path):
    whole = killed_in_the_middle(tmp_path)
    moved, not_moved = sorted(NUMBERS, key=lambda name: (tmp_path / ".whole" / name).is_file())
    with subprocess.Popen([sys.executable, "-c", CLAIM.replace("claimed(", "FileLock(").replace(
        "from torchcover.files import claimed", "from filelock import FileLock"
    ), tmp_path / ".lock"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:  # fmt: skip
        process.stdout.readline()
        assert settled(tmp_path / moved) == tmp_path / moved
        assert settled(tmp_path / not_moved) == tmp_path / ".whole" / not_moved
        with pytest.raises(FileNotFoundError, match="was part of an earlier result"):
            settled(tmp_path / "gone.txt")
        assert found(tmp_path) == whole
        process.communicate()
    assert (tmp_path / ".whole").exists()
    assert found(tmp_path) == whole
    assert not (tmp_path / ".whole").exists()


def test_it_may_be_moved_just_before_it_is_opened(tmp_path, monkeypatch):
    publish(tmp_path, NUMBERS)
    monkeypatch.setattr("torchcover.files.bad_file.settled", lambda path: tmp_path / ".whole" / path.name)
    assert read(tmp_path / "a.txt") == "new"


def test_many_may_finish_at_once(tmp_path):
    whole = killed_in_the_middle(tmp_path)
    with ThreadPoolExecutor() as pool:
        results = list(pool.map(lambda _: operations_of(lambda: check(tmp_path, whole)), range(6)))
    assert [code for _, code in results] == [0] * 6
    assert in_place(tmp_path) == {*whole[0], "summary.json"}


def check(folder, whole):
    assert found(folder) == whole


def test_a_folder_in_it_may_be_of_another_file_system(tmp_path, monkeypatch):
    replace = os.replace

    def across(source, target):
        if ".whole" in str(source) and "maps" in str(source):
            raise OSError(errno.EXDEV, "Invalid cross-device link", str(source), None, str(target))
        replace(source, target)

    monkeypatch.setattr(os, "replace", across)
    *_, whole = with_earlier(tmp_path)
    publish(tmp_path, NUMBERS, MAPS)
    assert found(tmp_path) == whole
    assert in_place(tmp_path) == {*whole[0], "summary.json"}


@pytest.mark.parametrize(
    "left",
    [
        {},
        {"b.txt": "new"},
        {"summary.json": "{"},
        {"summary.json": '{"files": ["a.txt", "never.txt"]}', "a.txt": "new"},
    ],
)
def test_a_publication_that_is_not_whole_is_none(tmp_path, left):
    earlier, *_ = with_earlier(tmp_path)
    for look in range(2):
        (tmp_path / ".whole").mkdir(exist_ok=True)
        for name, text in left.items():
            (tmp_path / ".whole" / name).write_text(text)
        if look:
            with claimed(tmp_path):
                assert not (tmp_path / ".whole").exists()
        assert found(tmp_path) == earlier


@pytest.mark.parametrize("names", [["../mine.txt"], ["ABSOLUTE"], ["maps"], [3, None], "mine.txt", None])
@pytest.mark.parametrize("summary", ["summary.json", ".whole/summary.json"])
def test_a_summary_that_lists_others_touches_nothing(tmp_path, names, summary):
    out, mine = tmp_path / "out", tmp_path / "mine.txt"
    (out / ".whole").mkdir(parents=True)
    (out / "maps").mkdir()
    for path in (mine, out / "maps" / "mine.png"):
        path.write_text("mine")
    (out / summary).write_text(json.dumps({"files": [str(mine)] if names == ["ABSOLUTE"] else names}))
    publish(out, NUMBERS)
    assert in_place(tmp_path) == {"mine.txt", "out/maps/mine.png", "out/a.txt", "out/b.txt", "out/summary.json"}


def test_a_result_of_a_version_that_listed_nothing_is_replaced(tmp_path):
    (tmp_path / "summary.json").write_text('{"complete": true}')
    (tmp_path / "a.txt").write_text("old")
    seen = []
    with Publication(tmp_path) as files:
        files.add("a.txt", lambda path: path.write_text("new"))
        files.publish({})
        seen.append(json.loads((tmp_path / "summary.json").read_text()))
    assert seen == [{"files": ["a.txt"]}]
    assert (tmp_path / "a.txt").read_text() == "new"


def test_what_killed_processes_left_aside_is_cleared(tmp_path):
    (tmp_path / ".partial_left").mkdir()
    (tmp_path / ".partial_left" / "a.txt").write_text("half")
    (tmp_path / ".partial_checkpoint.npz").write_text("half")
    publish(tmp_path, NUMBERS)
    assert in_place(tmp_path) == {"a.txt", "b.txt", "summary.json"}


def test_what_is_listed_stays_so_while_more_is_added(tmp_path, monkeypatch):
    replace, seen = os.replace, []
    monkeypatch.setattr(
        os, "replace", lambda *paths: (seen.append((tmp_path / "summary.json").exists()), replace(*paths))
    )
    publish(tmp_path, {"a.txt": "new", "b.txt": "new"}, {"b.txt": "newer"}, {"c.txt": "more"})
    # Not there while a file that it lists is replaced.
    assert seen == [False, False, False, False, True, False, False, True, True]


def test_a_signal_waits_until_the_files_are_in_their_places(tmp_path, monkeypatch):
    publish(tmp_path, EARLIER)
    replace = os.replace
    signals = iter([signal.SIGINT])
    monkeypatch.setattr(os, "replace", lambda *paths: (signal.raise_signal(next(signals, 0)), replace(*paths)))
    with pytest.raises(KeyboardInterrupt):
        publish(tmp_path, NUMBERS)
    assert in_place(tmp_path) == {*NUMBERS, "summary.json"}


def limited(act):
    """Do it where a file has room for 1,000 bytes; returns what the error says."""
    there, here = os.pipe()

    def write():
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
        try:
            act()
        except OSError as error:
            os.write(here, str(error).encode())

    assert operations_of(write)[1] == 0
    os.close(here)
    with open(there, "rb") as told:
        return told.read().decode()


def test_where_there_is_no_room_the_file_is_named_and_all_stays_as_it_was(tmp_path):
    earlier, *_ = with_earlier(tmp_path)
    said = limited(lambda: publish(tmp_path, {"a.txt": "new", "maps/m.png": "x" * 2000}))
    assert said == f"[Errno 27] File too large: '{tmp_path}/maps/m.png'"
    said = limited(lambda: write_durably(tmp_path / "a.txt", lambda path: path.write_text("x" * 2000)))
    assert said == f"[Errno 27] File too large: '{tmp_path}/a.txt'"
    assert found(tmp_path) == earlier
    assert in_place(tmp_path) == {*earlier[0], "summary.json"}


def test_what_a_library_says_of_no_room_gets_a_name(tmp_path):
    def full(_):
        raise OSError("encoder error -2")

    with pytest.raises(OSError, match=r"a\.png: encoder error -2$"), Publication(tmp_path) as files:
        files.add("a.png", full)
    assert in_place(tmp_path) == set()


def test_all_is_on_the_disk_before_it_is_the_new_content(tmp_path, monkeypatch):
    synced, seen, fsync, rename = set(), [], os.fsync, os.rename
    monkeypatch.setattr(os, "fsync", lambda number: (synced.add(os.fstat(number).st_ino), fsync(number)))

    def renamed(source, target):
        seen.append({path.name for path in (source, *source.rglob("*")) if path.stat().st_ino not in synced})
        rename(source, target)

    monkeypatch.setattr(os, "rename", renamed)
    publish(tmp_path, NUMBERS, MAPS)
    assert seen == [set(), set()]
    assert {path.stat().st_ino for path in (tmp_path, tmp_path / "maps")} <= synced


def parts(folder, count, then=None):
    """Write so many parts, those that are there left out; publish them, or do something else."""
    with Publication(folder, RECORDING, goes_on=True) as files:
        for part in range(len(files.notes), count):
            for name in (f"a/{part}.txt", f"a/b/{part}.txt"):
                files.add(name, lambda path, part=part: path.write_text(str(part)))
            files.note({"part": part})
        assert [note["part"] for note in files.notes] == list(range(len(files.notes)))
        then() if then else files.publish({"parts": count})


def all_parts(folder, count):
    assert json.loads((folder / "recording.json").read_text())["parts"] == count
    names = {f"{place}/{part}.txt" for place in ("a", "a/b") for part in range(count)}
    assert in_place(folder) == {*names, "recording.json"}
    assert {(folder / name).read_text() for name in names} == set(map(str, range(count)))


def test_what_was_noted_is_gone_on_with(tmp_path):
    with pytest.raises(ZeroDivisionError):
        parts(tmp_path, 2, then=lambda: 1 / 0)
    assert [(note["part"], note["files"]) for note in noted(tmp_path)] == [
        (part, [f"a/{part}.txt", f"a/b/{part}.txt"]) for part in range(2)
    ]
    assert not (tmp_path / "recording.json").exists()
    publish(tmp_path, {})  # another one leaves it alone
    (tmp_path / "summary.json").unlink()
    parts(tmp_path, 3)
    all_parts(tmp_path, 3)
    assert noted(tmp_path) == []


def test_a_kill_at_any_file_operation_costs_a_part_at_most(tmp_path):
    out = tmp_path / "out"
    count, _ = operations_of(lambda: parts(out, 2), copied=(out, tmp_path / "copies"))
    all_parts(out, 2)
    kept = []
    for folder in (tmp_path / "copies" / str(at) for at in range(count)):
        kept.append(len(noted(folder)))
        with claimed(folder):
            is_whole = (folder / "recording.json").exists()
        if kept[-1] and not is_whole:
            with (folder / ".partial_to_go_on_with" / ".notes.jsonl").open("a") as lines:
                lines.write('{"part": 9')  # what a kill within the line leaves
        if not is_whole:
            parts(folder, 2)
        all_parts(folder, 2)
    assert set(kept) == {0, 1, 2}
