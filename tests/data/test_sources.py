"""What every source of frames promises, and how a recording finds its format."""

import pickle

import numpy as np
import pytest
import torch

from torchcover import Scenario
from torchcover.data import FORMATS, RecordedFrames, SimulatedFrames, open_recording
from torchcover.simulation import PaperReference


def folder_of(path, places):
    """Two frames in each of some places of a recording."""
    for place in places:
        (path / place).mkdir(parents=True)
        for frame in range(2):
            np.save(path / place / f"f{frame}.npy", np.full((3, 3), frame + 1.0, dtype=np.float32))
    return path


def simulated(_):
    return SimulatedFrames("courtyard", "front_roof_32", steps=2, reference_sensor=PaperReference(16, 16))


def recorded(path):
    return open_recording(folder_of(path, ["sensor", "reference"]))


def recorded_rigs(path):
    return open_recording(folder_of(path, ["rigs/b", "rigs/a", "reference"]))


@pytest.mark.parametrize("make", [simulated, recorded, recorded_rigs])
def test_a_source_is_a_map_style_dataset_that_knows_whose_frames_they_are(tmp_path, make):
    source = make(tmp_path)
    assert len(source) == 2
    for index in range(2):
        frame = source[index]
        assert frame.index == index
        assert list(frame.clouds) == list(source.rigs)
        assert all(cloud.dtype == torch.float32 for cloud in (*frame.clouds.values(), frame.reference))
    with pytest.raises(IndexError):
        source[2]
    assert set(source.sensors) <= set(source.rigs)
    assert set(source.description) == {"scenario", "frames", "seed"}
    assert (source.reference_record is None) == (source.description["scenario"] is None)
    if source.reference_record is not None:
        assert set(source.reference_record) == {"sensor", "every_s"}
    if source.ego_outline_m is not None:
        assert source.ego_outline_m.shape[1] == 2
    torch.testing.assert_close(pickle.loads(pickle.dumps(source))[1].reference, source[1].reference)


@pytest.mark.parametrize("scenario", ["courtyard", "parking"])
def test_the_outline_of_a_simulation_is_that_of_its_ego_and_needs_no_world(monkeypatch, scenario):
    expected = Scenario.load(scenario).world().ego.mesh.vertices_m[:, :2]
    monkeypatch.setattr(Scenario, "world", lambda *_: pytest.fail("a world was built"))
    outline_m = SimulatedFrames(scenario, "front_roof_32", steps=1).ego_outline_m
    np.testing.assert_allclose(outline_m.max(axis=0), expected.max(axis=0))
    np.testing.assert_allclose(outline_m.min(axis=0), expected.min(axis=0))


def test_the_format_of_a_recording_is_recognised_or_named(tmp_path):
    folder = folder_of(tmp_path / "recording", ["sensor", "reference"])
    assert isinstance(open_recording(str(folder)), RecordedFrames)
    assert isinstance(open_recording(folder, "folder"), RecordedFrames)
    with pytest.raises(ValueError, match="format 'rosbag': no such format of recordings; there are folder"):
        open_recording(folder, "rosbag")
    with pytest.raises(FileNotFoundError, match="gone: no such recording"):
        open_recording(tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty: a recording of no known format; known are folder: sensor/FRAME\.\*"):
        open_recording(tmp_path / "empty")


def test_another_format_is_a_class_and_a_line(tmp_path, monkeypatch):
    class Single(RecordedFrames):
        layout = "a file that ends in .one"

        def __init__(self, path):
            super().__init__(path.with_suffix(""))

        @classmethod
        def recognises(cls, path):
            return path.suffix == ".one"

    monkeypatch.setitem(FORMATS, "one", Single)
    folder_of(tmp_path / "drive", ["sensor", "reference"])
    (tmp_path / "drive.one").write_text("")
    assert isinstance(open_recording(tmp_path / "drive.one"), Single)
