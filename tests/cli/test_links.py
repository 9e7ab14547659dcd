"""Links in recordings: only to regular files in allowed roots; pipes and devices do not block a reader."""

import os
import pickle

import numpy as np
import pytest

from torchcover.data import RecordedFrames
from torchcover.files import BadFileError, common_link_roots
from torchcover.frames.source import BadFrameError
from torchcover.recordings import open_recording
from torchcover.simulation import Rig, Scenario

NO_FILE = r"a pipe, a socket or a device|a link to /dev/zero"


def write(folder, target=None):
    """Write a recording of one frame; its cloud is a link if there is a target."""
    for name in ("sensors/roof", "reference"):
        (folder / name).mkdir(parents=True)
        np.save(folder / name / "f.npy", np.ones((4, 3), np.float32))
    if target is not None:
        target.parent.mkdir(exist_ok=True)
        (folder / "sensors" / "roof" / "f.npy").rename(target)
        (folder / "sensors" / "roof" / "f.npy").symlink_to(target)
    return folder


def test_links_may_only_lead_to_allowed_roots(tmp_path, monkeypatch):
    assert len(RecordedFrames(write(tmp_path / "within", tmp_path / "within" / "blobs" / "0"))[0].sensor) == 4
    folder, root = write(tmp_path / "out", tmp_path / "blobs" / "0"), tmp_path / "blobs"
    with pytest.raises(BadFrameError, match=rf"f\.npy: a link to {root}/0, outside of the recording; .*--allow-links"):
        RecordedFrames(folder)[0]
    assert len(RecordedFrames(open_recording(folder, link_roots=[root]))[0].sensor) == 4
    monkeypatch.setattr("torchcover.files.bad_file.common_link_roots", [root])
    assert len(RecordedFrames(folder)[0].sensor) == 4
    (root / "0").unlink()
    (root / "0").symlink_to("/dev/zero")
    with pytest.raises(BadFrameError, match="a link to /dev/zero, outside"):
        RecordedFrames(folder)[0]


def test_linked_folders_and_recordings_are_read(tmp_path):
    folder = write(tmp_path / "recording")
    (folder / "sensors").rename(tmp_path / "elsewhere")
    (folder / "sensors").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BadFrameError, match="outside of the recording"):
        RecordedFrames(folder)[0]
    (tmp_path / "named").symlink_to(write(tmp_path / "real"))
    assert len(RecordedFrames(tmp_path / "named")[0].sensor) == 4


def test_workers_follow_the_same_links(tmp_path, monkeypatch):
    folder, root = write(tmp_path / "out", tmp_path / "blobs" / "0"), tmp_path / "blobs"
    for roots in ([], [root]):
        content = pickle.dumps(RecordedFrames(open_recording(folder, link_roots=roots)))
        monkeypatch.setattr("torchcover.files.bad_file._link_roots", {})  # as in a spawned process
        frames = pickle.loads(content)
        if roots:
            assert len(frames[0].sensor) == 4
        else:
            with pytest.raises(BadFrameError, match="outside of the recording"):
                frames[0]


def test_allow_links_adds_roots(tmp_path, torchcover):
    write(tmp_path / "out", tmp_path / "blobs" / "0")
    command = ("evaluate", "--frames", "out", "--out", "result", "--files", "numbers")
    code, _, stderr = torchcover(*command)
    assert (code, "outside of the recording" in stderr) == (2, True)
    try:
        assert torchcover("--allow-links", "blobs", *command)[0] == 0
    finally:
        common_link_roots.clear()


@pytest.mark.parametrize("kind", ["FIFO", "zero"])
def test_pipe_or_device_instead_of_file_is_rejected(tmp_path, kind):
    folder = write(tmp_path / "recording")
    paths = [tmp_path / "rig.yaml", tmp_path / "mesh.ply", folder / "recording.json", folder / "reference" / "f.npy"]
    paths[-1].unlink()
    for path in paths:
        os.mkfifo(path) if kind == "FIFO" else path.symlink_to("/dev/zero")
    body = {"name": "b", "shape": {"type": "mesh", "path": str(paths[1])}}
    ego = {"shape": {"type": "box", "size_m": [4, 2, 1]}}
    scenario = Scenario.model_validate({"name": "s", "ego": ego, "bodies": [body]})
    for read in (
        lambda: Rig.load(paths[0]),
        scenario.collect_content,
        lambda: scenario.build_scene(0, 0),
        lambda: open_recording(folder),
    ):
        with pytest.raises(BadFileError, match=NO_FILE):
            read()
    paths[2].unlink()
    with pytest.raises(BadFrameError, match=NO_FILE):
        RecordedFrames(folder)[0]
