"""What every source of frames promises, and how a recording finds its format."""

import pickle

import numpy as np
import pytest
import torch

from torchcover import Scenario
from torchcover.data import (
    FORMATS,
    Frame,
    FrameDataset,
    RecordedFrames,
    RecordingSettings,
    RigSubset,
    SimulatedFrames,
    collate_frames,
    open_recording,
)
from torchcover.evaluation.measurement import find_block_ends
from torchcover.recordings.formats.folder import FolderRecording
from torchcover.simulation import PaperReference, SurfaceReference


def folder_of(path, places):
    """Two frames in each of some places of a recording."""
    for place in places:
        (path / place).mkdir(parents=True)
        for frame in range(2):
            np.save(path / place / f"f{frame}.npy", np.full((3, 3), frame + 1.0, dtype=np.float32))
    return path


def simulated(_):
    return SimulatedFrames("courtyard", "front_roof_32", num_frames=2, reference_sensor=PaperReference(16, 16))


def recorded(path):
    return RecordedFrames(folder_of(path, ["sensor", "reference"]))


def recorded_rigs(path):
    return RecordedFrames(folder_of(path, ["rigs/b", "rigs/a", "reference"]))


def chosen(path):
    return RigSubset(recorded_rigs(path), {"first": "b"})


def by_area(_):
    reference_sensor = SurfaceReference((((0.0, 20.0), (-5.0, 5.0)),), num_rays=256)
    return SimulatedFrames("courtyard", "front_roof_32", num_frames=2, reference_sensor=reference_sensor)


@pytest.mark.parametrize("make", [simulated, by_area, recorded, recorded_rigs, chosen])
def test_sources_are_map_style_datasets_of_rigs(tmp_path, make):
    source = make(tmp_path)
    metadata = source.metadata
    assert isinstance(source, FrameDataset)
    assert len(source) == 2
    for index in range(2):
        frame = source[index]
        assert (frame.index, frame.block_index) == (index, source.get_block_index(index))
        assert list(frame.clouds) == list(metadata.rigs)
        assert (frame.reference_weights is not None) == metadata.has_area_weights
        assert (frame.boxes is not None) == metadata.has_boxes
        heights_m = frame.reference_heights_m
        assert (heights_m is not None and bool(heights_m.isfinite().any())) == source.has_heights()
        assert all(cloud.dtype == torch.float32 for cloud in (*frame.clouds.values(), frame.reference))
    assert [frame.index for frame in source] == [frame.index for frame in source] == [0, 1]
    for outside in (2, -3):
        with pytest.raises(IndexError, match=f"frame {outside} of 2"):
            source[outside]
    assert [source[number].index for number in (-1, torch.tensor(1), np.int64(1))] == [1, 1, 1]
    assert [frame.index for frame in source[:1]] == [0]
    assert len(source[1:5]) == 1
    assert set(metadata.sensors) <= set(metadata.rigs)
    assert set(metadata.sensor_names) == set(metadata.rigs)
    assert set(metadata.description) >= {"scenario", "vehicle", "frames", "seed"}
    simulated = metadata.description["scenario"] is not None
    assert {"sensor", "notes"} | ({"frame_interval_s"} if simulated else set()) == set(source.describe_reference())
    if metadata.ego_outline_m is not None:
        assert metadata.ego_outline_m.shape[1] == 2
    torch.testing.assert_close(pickle.loads(pickle.dumps(source))[1].reference, source[1].reference)


@pytest.mark.parametrize("scenario", ["courtyard", "parking"])
def test_ego_outline_needs_no_scene(monkeypatch, scenario):
    expected = Scenario.load(scenario).build_scene().ego.mesh.vertices_m[:, :2]
    monkeypatch.setattr(Scenario, "build_scene", lambda *_: pytest.fail("a world was built"))
    outline_m = SimulatedFrames(scenario, "front_roof_32", num_frames=1).metadata.ego_outline_m
    np.testing.assert_allclose(outline_m.max(axis=0), expected.max(axis=0))
    np.testing.assert_allclose(outline_m.min(axis=0), expected.min(axis=0))


def test_formats_of_recordings_are_detected_or_given(tmp_path):
    folder = folder_of(tmp_path / "recording", ["sensor", "reference"])
    assert isinstance(open_recording(str(folder)), FolderRecording)
    assert isinstance(open_recording(folder, RecordingSettings(format="folder")), FolderRecording)
    with pytest.raises(ValueError, match=r"format 'rosbag': no such format of recordings; there are .*folder"):
        open_recording(folder, RecordingSettings(format="rosbag"))
    with pytest.raises(FileNotFoundError, match="gone: no such recording"):
        open_recording(tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty: a recording of no known format; known are nuscenes: v1"):
        open_recording(tmp_path / "empty")


def test_another_format_is_a_class_and_a_line(tmp_path, monkeypatch):
    class Single(FolderRecording):
        layout = "a file that ends in .one"

        def __init__(self, path):
            super().__init__(path.with_suffix(""))

        @classmethod
        def can_read(cls, path):
            return path.suffix == ".one"

    monkeypatch.setitem(FORMATS, "one", Single)
    folder_of(tmp_path / "drive", ["sensor", "reference"])
    (tmp_path / "drive.one").write_text("")
    assert isinstance(open_recording(tmp_path / "drive.one"), Single)


def test_rigs_are_selected_in_any_order_and_name():
    rigs = {"a": "front_roof_32", "b": "front_grille_128"}
    reference_sensor = PaperReference(16, 16)
    both = SimulatedFrames("parking", rigs=rigs, num_frames=1, boxes=True, reference_sensor=reference_sensor)
    turned = RigSubset(both, {"second": "b", "a": "a"})
    assert list(turned.metadata.rigs) == list(turned.metadata.sensors) == list(turned[0].clouds) == ["second", "a"]
    assert turned.metadata.sensors["second"] == both.metadata.sensors["b"]
    assert torch.equal(turned[0].get_cloud("second"), both[0].get_cloud("b"))
    assert torch.equal(turned[0].reference, both[0].reference)
    assert torch.equal(turned[0].boxes.points_in_box["second"], both[0].boxes.points_in_box["b"])
    assert list(RigSubset(both, {"b": "b"})[0].boxes.points_in_box) == ["b"]
    with pytest.raises(ValueError, match="no clouds of the rig c; the frames have a, b"):
        RigSubset(both, {"b": "c"})


def test_batches_without_the_requested_rig_list_theirs(tmp_path):
    batch = collate_frames([recorded_rigs(tmp_path)[0]])
    with pytest.raises(ValueError, match="frame 'f0' has no rig 'c'; it has a, b"):
        batch.get_clouds("c")


def test_batches_have_weights_of_all_or_none():
    points, weights = torch.zeros(3, 3), torch.ones(3)
    area = Frame({"rig": points}, points, 0, "a", reference_weights=weights)
    none = Frame({"rig": points}, points, 0, "b")
    assert torch.equal(collate_frames([area, area]).weights[1], weights)
    assert collate_frames([none, none]).weights is None
    for mixed in ([area, none], [none, area]):
        with pytest.raises(
            ValueError, match=r"weights: frame 'a' has the areas .*, frame 'b' has none; use separate batches"
        ):
            _ = collate_frames(mixed).weights


def test_blocks_end_where_the_scene_changes(tmp_path):
    traffic = SimulatedFrames(
        "urban", "front_roof_32", num_frames=3, frame_interval_s=10.0, reference_sensor=PaperReference(4, 4)
    )
    ends = find_block_ends(traffic, max_blocks=4)
    places = [traffic.get_block_index(index) for index in range(ends[-1] + 1)]
    assert ends == [places.index(number) for number in range(1, 5)]
    assert find_block_ends(simulated(None), max_blocks=3) == [1, 2, 3]  # nothing moves: each frame has its reference
    assert find_block_ends(recorded(tmp_path)) == [1, 2]
