"""Files and folders are old, new, or reported as incomplete; nothing is written through links."""

import errno
import hashlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys

import pytest

from tests.killing import run_in_fork
from torchcover.files import RECORDING, WRITING, AtomicOutput, BadFileError, guard_reader, lock_folder, write_atomically
from torchcover.files.atomic import MAX_MANIFEST_BYTES

# Content of each file in two publications. `mine.txt` and `maps/mine.png` belong to the user.
EARLIER = {"a.txt": "earlier", "gone.txt": "earlier", "maps/m.png": "earlier", "maps/gone.png": "earlier"}
NUMBERS = {"a.txt": "new", "b.txt": "new"}
MAPS = {"maps/m.png": "new", "maps/n.png": "new"}
MINE = {"mine.txt": "mine", "maps/mine.png": "mine"}
LOCK = """
import sys
from pathlib import Path
from torchcover.files import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


def publish(folder, *contents):
    """Publish the files of each content, one content after another."""
    with AtomicOutput(folder) as files:
        for content in contents:
            for name, text in content.items():
                files.add_text(name, text)
            files.publish({"complete": True})
    return files


@guard_reader("a text")
def read(path):
    return path.read_text()


def read_folder(folder):
    """Read each file and the names in the manifest; BadFileError for incomplete results."""
    texts = {}
    for name in {**EARLIER, **NUMBERS, **MAPS, **MINE}:
        if (folder / name).exists():
            texts[name] = read(folder / name)
    return texts, set(json.loads(read(folder / "summary.json"))["files"])


def list_files(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def write_earlier(folder):
    """Write the earlier files; return what readers find then, and after the first and the second publication."""
    (folder / "maps").mkdir(parents=True)
    for name, text in MINE.items():
        (folder / name).write_text(text)
    publish(folder, EARLIER)
    return [({**MINE, **files}, set(files)) for files in (EARLIER, NUMBERS, NUMBERS | MAPS)]


@pytest.fixture
def other(tmp_path):
    """Start another process that locks the folder."""
    with subprocess.Popen(
        [sys.executable, "-c", LOCK, tmp_path / "out"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "locked\n"
        yield process
        process.kill()


def test_locks_hold_until_the_process_is_killed(other, tmp_path):
    with pytest.raises(ValueError, match="another run is writing there"), lock_folder(tmp_path / "out"):
        pass
    with pytest.raises(ValueError, match="another run is writing there"):
        publish(tmp_path / "out", NUMBERS)
    assert list_files(tmp_path / "out") == set()
    other.kill()
    other.wait()
    publish(tmp_path / "out", NUMBERS)
    assert list_files(tmp_path / "out") == {*NUMBERS, "summary.json"}


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_a_warning(tmp_path, monkeypatch, number):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.warns(UserWarning, match=rf"{tmp_path}: start no other run there, for it cannot be locked \("):
        publish(tmp_path, NUMBERS)
    assert read_folder(tmp_path) == (NUMBERS, set(NUMBERS))


def test_folders_that_stay_empty_are_removed(tmp_path):
    with pytest.raises(ZeroDivisionError), lock_folder(tmp_path / "new" / "out"):
        raise ZeroDivisionError
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    with lock_folder(tmp_path / "old"), lock_folder(tmp_path / "old"):
        pass
    assert (tmp_path / "old").exists()


def test_published_files_replace_those_of_the_manifest(tmp_path):
    earlier, numbers, all_files = write_earlier(tmp_path)
    assert read_folder(tmp_path) == earlier
    assert publish(tmp_path, NUMBERS).paths == [tmp_path / name for name in (*NUMBERS, "summary.json")]
    assert read_folder(tmp_path) == numbers
    publish(tmp_path, NUMBERS, MAPS)
    assert read_folder(tmp_path) == all_files
    assert list_files(tmp_path) == {*all_files[0], "summary.json"}


def test_kills_leave_old_new_or_incomplete_results(tmp_path):
    states = write_earlier(tmp_path / "earlier")
    out = shutil.copytree(tmp_path / "earlier", tmp_path / "out")
    count, code = run_in_fork(lambda: publish(out, NUMBERS, MAPS), copied=(out, tmp_path / "copies"))
    assert (count > 40, code) == (True, 0)
    seen = []
    for at in range(count):
        folder = tmp_path / "copies" / str(at)
        before = {path: path.lstat().st_mtime_ns for path in folder.rglob("*")}
        try:
            texts, names = read_folder(folder)
            # Maps that are missing in the manifest belong to the same run.
            seen.append(states.index(({name: texts[name] for name in (*names, *MINE)}, names)))
        except BadFileError as error:
            seen.append("incomplete" in str(error) and 0.5)
        assert {path: path.lstat().st_mtime_ns for path in folder.rglob("*")} == before  # readers do not write
        if at % 8 == 0 or seen[-1] == 0.5:
            publish(folder, NUMBERS)
            assert read_folder(folder)[1] == set(NUMBERS)
            assert not list(folder.glob(".*"))
    assert seen == sorted(seen)
    assert set(seen) == {0, 0.5, 1, 2}


@pytest.mark.parametrize("at", [9, 24, 33])
def test_copies_before_operations_equal_states_after_kills(tmp_path, at):
    trees = []
    for name in ("copied", "killed"):
        out = tmp_path / name / "out"
        write_earlier(out)
        ended = run_in_fork(
            lambda out=out: publish(out, NUMBERS, MAPS),
            at if name == "killed" else None,
            copied=(out, tmp_path / name / "copies"),
        )
        left = out if name == "killed" else tmp_path / name / "copies" / str(at)
        trees.append(sorted(re.sub(r"\.torchcover_.*?/", "/", path) for path in list_files(left)))
    assert ended == (at, -signal.SIGKILL)
    assert trees[0] == trees[1]


def test_files_of_unfinished_results_are_refused(tmp_path, monkeypatch):
    write_earlier(tmp_path)
    replace = os.replace

    def fail(source, target):
        if target.name == "b.txt":
            raise OSError(errno.EIO, "Input/output error", str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="Input/output error"):
        publish(tmp_path, NUMBERS)
    for name in (*EARLIER, "summary.json"):
        with pytest.raises(BadFileError, match=rf"{tmp_path / name}: an incomplete result: .* run it again"):
            read(tmp_path / name)
    assert read(tmp_path / "mine.txt") == "mine"


@pytest.mark.parametrize("name", ["b.txt", "summary.json", "maps/n.png"])
def test_folders_named_like_files_are_refused_first(tmp_path, name):
    publish(tmp_path / "out", {"a.txt": "earlier"}) if name != "summary.json" else None
    (tmp_path / "out" / name).mkdir(parents=True)
    before = list_files(tmp_path)
    with pytest.raises(IsADirectoryError, match=rf"a folder in the place of a file: '.*{name}'"):
        publish(tmp_path / "out", NUMBERS | MAPS)
    assert list_files(tmp_path) == before
    assert name == "summary.json" or read(tmp_path / "out" / "a.txt") == "earlier"


@pytest.mark.parametrize("text", ["NEW", "newer"])
def test_files_that_differ_from_the_manifest_are_refused(tmp_path, text):
    publish(tmp_path, {**NUMBERS, "c.yaml": "new"})
    (tmp_path / "a.txt").write_text(text)
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(
        BadFileError, match=r"a\.txt: an incomplete result: .*summary\.json lists this file with another"
    ):
        read(tmp_path / "a.txt")
    assert read(tmp_path / "b.txt") == "new"
    with pytest.warns(UserWarning, match=r"c\.yaml: edited since summary\.json"):
        assert read(tmp_path / "c.yaml") == text


HUGE = "huge"
FOREIGN = {
    "not JSON": "{",
    "another kind": "[1]",
    "no files": '{"complete": true}',
    "a list": '{"files": ["a.txt", "../mine.txt"]}',
    "nested": "[" * 100_000,
    "no sizes": '{"files": {"a.txt": {}, "b.txt": 3, "maps": null}}',
    "surrogates": '{"files": {"a\\ud800": {"bytes": 1}}}',
    "a long name": json.dumps({"files": {"n" * 5000: {"bytes": 1}}}),
    "many": json.dumps({"files": {f"{name}/x": {"bytes": 1} for name in range(100_000)}}),
    "huge": HUGE,
}


@pytest.mark.parametrize("text", FOREIGN.values(), ids=FOREIGN)
def test_foreign_manifests_list_nothing_and_are_replaced(tmp_path, text):
    (tmp_path / "a.txt").write_text("mine")
    (tmp_path / "summary.json").write_text("" if text is HUGE else text)
    if text is HUGE:
        os.truncate(tmp_path / "summary.json", 100 * MAX_MANIFEST_BYTES)
    assert read(tmp_path / "a.txt") == "mine"
    publish(tmp_path, {"b.txt": "new"})
    assert list_files(tmp_path) == {"a.txt", "b.txt", "summary.json"}
    assert set(json.loads((tmp_path / "summary.json").read_text())["files"]) == {"b.txt"}


@pytest.mark.parametrize("name", ["../mine.txt", "ABSOLUTE", "a/../../mine.txt", "./mine.txt", "folder", "m\0ine.txt"])
def test_a_manifest_that_lists_others_deletes_nothing(tmp_path, name):
    out, mine = tmp_path / "out", tmp_path / "mine.txt"
    (out / "folder").mkdir(parents=True)
    (out / "a").mkdir()
    mine.write_text("mine")
    (out / "edited.txt").write_text("edited on purpose")
    (out / ".hidden").write_text("mine")
    (out / "of_this_size.txt").write_text("mine")
    entry = {"bytes": 4, "sha256": hashlib.sha256(b"mine").hexdigest()}
    listed = {str(mine) if name == "ABSOLUTE" else name: entry, "edited.txt": {"bytes": 17, "sha256": "0"}}
    listed |= {".hidden": entry, "of_this_size.txt": {"bytes": 4}}
    (out / "summary.json").write_text(json.dumps({"files": listed}))
    publish(out, NUMBERS)
    others = {f"out/{other}" for other in ("edited.txt", ".hidden", "of_this_size.txt")}
    assert list_files(tmp_path) == {"mine.txt", *others, "out/a.txt", "out/b.txt", "out/summary.json"}


def special(path, kind, target):
    """Create a link to a target, or another special file."""
    path.unlink(missing_ok=True)
    if kind == "link":
        path.symlink_to(target)
    elif kind == "zero":
        path.symlink_to("/dev/zero")
    elif kind == "hard link":
        path.hardlink_to(target)
    elif kind == "FIFO":
        os.mkfifo(path)


@pytest.mark.parametrize("name", ["summary.json", "a.txt", "maps", "maps/m.png", ".lock", ".torchcover_left"])
@pytest.mark.parametrize("kind", ["link", "zero", "hard link", "FIFO"])
def test_links_in_the_folder_are_never_followed(tmp_path, kind, name):
    out, target = tmp_path / "out", tmp_path / "target"
    out.mkdir()
    if name == "maps" and kind == "link":
        (target / "sub").mkdir(parents=True)
        (target / "m.png").write_text("mine")
    else:
        target.write_text("mine")
    if name.startswith("maps/"):
        (out / "maps").mkdir()
    special(out / name, kind, target)
    try:
        publish(out, NUMBERS, MAPS)
    except (ValueError, OSError) as error:
        assert str(out / name) in str(error)  # noqa: PT017
        assert kind != "hard link" or name == "maps"
    assert (target / "m.png" if target.is_dir() else target).read_text() == "mine"
    assert sum(1 for _ in target.rglob("*")) == 2 * target.is_dir()


def test_linked_files_are_refused_before_the_run(tmp_path):
    publish(tmp_path / "out", NUMBERS, MAPS)
    (tmp_path / "out" / "maps").rename(tmp_path / "moved")
    (tmp_path / "out" / "maps").symlink_to(tmp_path / "moved")
    with pytest.raises(ValueError, match="out/maps: a symbolic link"), lock_folder(tmp_path / "out"):
        pytest.fail("locked")
    assert len(list((tmp_path / "moved").iterdir())) == 2


@pytest.mark.parametrize("path", ["link", "link/new", "link/new/deep", "link/../out"])
def test_paths_through_links_are_never_written(tmp_path, monkeypatch, path):
    (tmp_path / "target").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "target")
    monkeypatch.chdir(tmp_path)
    for place in (tmp_path / path, type(tmp_path)(path)):
        with pytest.raises(ValueError, match="link: a symbolic link; nothing is written through links"):
            publish(place, NUMBERS)
        with pytest.raises(ValueError, match="link: a symbolic link; nothing is written through links"):
            write_atomically(place / "a.txt", lambda path: path.write_text("new"))
    assert list_files(tmp_path) == set()
    (tmp_path / "file").symlink_to(tmp_path / "mine")
    with pytest.raises(ValueError, match="file: a symbolic link"):
        write_atomically(tmp_path / "file", lambda path: path.write_text("new"))


def test_temporary_files_cannot_be_guessed_and_are_removed(tmp_path):
    left = tmp_path / ".torchcover_left"
    left.mkdir()
    (left / "a.txt").write_text("half")
    (tmp_path / ".other").mkdir()
    (tmp_path / ".other" / "a.txt").write_text("mine")
    publish(tmp_path, NUMBERS)
    names = []
    for _ in range(2):
        write_atomically(tmp_path / "c.txt", lambda path: (names.append(path.parent.name), path.write_text("new")))
    assert len(set(names)) == 2
    assert list_files(tmp_path) == {".other/a.txt", "a.txt", "b.txt", "c.txt", "summary.json"}


@pytest.mark.parametrize("kind", ["link", "zero", "FIFO"])
def test_special_files_as_manifests_do_not_block_readers(tmp_path, kind):
    (tmp_path / "a.txt").write_text("mine")
    (tmp_path / "other.json").write_text(json.dumps({WRITING: True, "files": {"a.txt": {"bytes": 1}}}))
    special(tmp_path / "summary.json", kind, tmp_path / "other.json")
    assert read(tmp_path / "a.txt") == "mine"


def limited(act):
    """Run an action with a file size limit of 2,000 bytes; return the error message."""
    there, here = os.pipe()

    def write():
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
        try:
            act()
        except OSError as error:
            os.write(here, str(error).encode())

    assert run_in_fork(write)[1] == 0
    os.close(here)
    with open(there, "rb") as pipe:
        return pipe.read().decode()


def test_full_disks_keep_the_earlier_result(tmp_path):
    earlier, *_ = write_earlier(tmp_path)
    error = limited(lambda: publish(tmp_path, {"a.txt": "new", "maps/m.png": "x" * 3000}))
    assert error == f"[Errno 27] File too large: '{tmp_path}/maps/m.png'"
    error = limited(lambda: publish(tmp_path, {f"{number}.txt": "new" for number in range(30)}))
    assert error == f"[Errno 27] File too large: '{tmp_path}/summary.json'"
    error = limited(lambda: write_atomically(tmp_path / "a.txt", lambda path: path.write_text("x" * 3000)))
    assert error == f"[Errno 27] File too large: '{tmp_path}/a.txt'"
    assert read_folder(tmp_path) == earlier
    assert list_files(tmp_path) == {*earlier[0], "summary.json"}


def test_an_error_of_a_library_names_the_file(tmp_path):
    def fail(_):
        raise OSError("encoder error -2")

    with pytest.raises(OSError, match=r"a\.png: encoder error -2$"), AtomicOutput(tmp_path) as files:
        files.add("a.png", fail)
    assert list_files(tmp_path) == set()


def test_files_are_synced_before_any_is_replaced(tmp_path, monkeypatch):
    synced, seen, fsync, replace = set(), [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: (synced.add(os.fstat(number).st_ino), fsync(number)))

    def check(source, target):
        seen.append(
            [path.name for path in source.parent.rglob("*") if path.is_file() and path.stat().st_ino not in synced]
        )
        replace(source, target)

    monkeypatch.setattr(os, "replace", check)
    publish(tmp_path, NUMBERS, MAPS)
    assert seen == [[]] * 7
    assert {path.stat().st_ino for path in (tmp_path, tmp_path / "maps")} <= synced


def test_an_unfinished_recording_is_gone_on_with(tmp_path):
    for part in range(3):
        manifest = json.loads((tmp_path / RECORDING).read_text()) if part else {}
        with AtomicOutput(tmp_path, RECORDING, manifest.get("files")) as files:
            files.add_text(f"a/b/{part}.txt", str(part))
            files.publish({WRITING: part < 2})
            files.add_text("a/lost.txt", "half")
    assert list_files(tmp_path) == {"a/b/0.txt", "a/b/1.txt", "a/b/2.txt", RECORDING}
    assert set(json.loads((tmp_path / RECORDING).read_text())["files"]) == {f"a/b/{part}.txt" for part in range(3)}


def test_huge_summaries_above_a_file_are_not_parsed(tmp_path):
    (tmp_path / "a.txt").write_text("content")
    entry = {"bytes": 1, "sha256": "0"}
    (tmp_path / "summary.json").write_text(json.dumps({"files": {"a.txt": entry}, "rest": "x" * 16_000_000}))
    assert guard_reader("a text")(lambda path: path.read_text())(tmp_path / "a.txt") == "content"
