"""Recording for the Rerun viewer: content of the file, read back."""

import numpy as np
import pytest
import torch

import torchcover
from torchcover.data import Frame
from torchcover.detection import Boxes
from torchcover.evaluation.rerun_log import RerunLog, RerunParams

rr = pytest.importorskip("rerun", reason="releases of Rerun need NumPy 2")
MAX_POINTS = RerunParams().max_points


def read(path) -> dict[str, list]:
    """Read the chunks of each entity path."""
    chunks: dict[str, list] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        chunks.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    return chunks


def get_column(batches, name: str) -> list:
    return [row for batch in batches if name in batch.schema.names for row in batch.column(name).to_pylist()]


def test_frames_have_points_colored_by_radius_and_boxes(tmp_path):
    log = RerunLog(tmp_path / "run.rrd")
    car = Boxes(torch.tensor([[10.0, 2.0, 0.75]]), torch.tensor([[4.0, 2.0, 1.5]]), torch.tensor([np.pi]), ids=("a",))
    near_and_far = torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    for index in (3, 5):
        log.update(Frame({"a b": torch.zeros(1, 3)}, near_and_far, index, "f", boxes=car))
    log.update(Frame({"a b": torch.rand(3 * MAX_POINTS, 3)}, near_and_far, 6, "f"))
    result = torchcover.evaluate("front_roof_32", num_frames=1, num_rays=1024, cell_m=1.0)
    log.finish(result)
    contents = read(tmp_path / "run.rrd")
    points, reference = contents["/a\\ b/points"], contents["/a\\ b/reference\\ by\\ radius"]
    assert sorted(get_column(points, "frame")) == [3, 5, 6]
    assert sorted(len(row) for row in get_column(points, "Points3D:positions")) == [1, 1, MAX_POINTS]
    detected, undetected = get_column(reference, "Points3D:colors")[0]
    assert detected >> 8 == 0xFDE724  # the ends of viridis: 0 m, and 3 m or more
    assert undetected >> 8 == 0x440154
    assert get_column(contents["/boxes"], "Boxes3D:half_sizes")[0] == [[2.0, 1.0, 0.75]]
    assert np.allclose(get_column(contents["/boxes"], "Boxes3D:quaternions")[0], [[0, 0, 1, 0]], atol=1e-6)
    assert len(get_column(contents["/front_roof_32/sensors/roof"], "LineStrips3D:strips")[0]) == 6
    (corners,) = get_column(contents["/front_roof_32/radius/ground"], "Mesh3D:vertex_positions")
    assert len(corners) == 4 * int(result.coverage.radius[0].isfinite().sum())
    assert "/ego" in contents


def test_other_suffixes_and_several_processes_are_rejected(tmp_path):
    with pytest.raises(ValueError, match=r"ends in \.rrd"):
        RerunLog(tmp_path / "run.txt")
    log = RerunLog(tmp_path / "run.rrd")
    with pytest.raises(ValueError, match="without torchrun"):
        log.merge_state(log)


def test_links_are_not_followed(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / ".unfinished_run.rrd").symlink_to(tmp_path / "mine")
    RerunLog(tmp_path / "run.rrd").update(Frame({"a": torch.zeros(1, 3)}, torch.zeros(1, 3), 0, "f"))
    (tmp_path / "run.rrd").symlink_to(tmp_path / "mine")
    with pytest.raises(ValueError, match=r"run\.rrd: a symbolic link; nothing is written through links"):
        RerunLog(tmp_path / "run.rrd")
    assert (tmp_path / "mine").read_text() == "mine"
