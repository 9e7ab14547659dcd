"""A killed process leaves a complete result; `python -m benchmarks kills` tests all commands."""

import json
import os

import pytest
import torch

import torchcover
from tests.killing import run_in_fork
from torchcover import Coverage
from torchcover.data import Frame, FrameDataset, FrameMetadata
from torchcover.files import BadFileError


class Drive(FrameDataset):
    """Two reference points, one of which a sensor detects."""

    metadata = FrameMetadata(("low",), {"scenario": None, "frames": "made up", "seed": None})

    def __len__(self):
        return 3

    def __getitem__(self, index):
        points = torch.tensor([[2.0, 0.5, 0.0], [6.0, 0.5, 1.0]])
        return Frame({"low": points[:1]}, points, index, f"f{index}")


@pytest.mark.usefixtures("blank_maps")
def test_kills_leave_the_earlier_or_the_new_result(tmp_path):
    earlier, new = (torchcover.evaluate(frames=Drive(), cell_m=8.0, num_frames=num_frames) for num_frames in (2, 3))
    earlier.save(tmp_path / "out")
    copies = tmp_path / "copies"
    count, code = run_in_fork(lambda: new.save(tmp_path / "out"), copied=(tmp_path / "out", copies))
    assert (count > 40, code) == (True, 0)
    saved_frames = []
    for index in range(count):
        out = copies / str(index)
        summary = json.loads((out / "summary.json").read_text())
        if summary.get("writing"):
            with pytest.raises(BadFileError, match="an incomplete result"):
                Coverage.load(out / "coverage.npz")
            continue
        saved_frames.append(Coverage.load(out / "coverage.npz").counts["num_frames"])
        assert summary["counts"]["num_frames"] == saved_frames[-1]
        assert [name for name in summary["files"] if not os.path.isfile(out / name)] == []
    assert saved_frames == sorted(saved_frames)
    assert set(saved_frames) == {2, 3}
