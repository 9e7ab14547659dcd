"""Frames with random points, and blank maps."""

import pytest
import torch

from torchcover.data import Frame


@pytest.fixture
def frame_of():
    """Return a function from an index to a frame with 5 points of each rig and 20 weighted reference points."""

    def make(index):
        generator = torch.Generator().manual_seed(index)
        reference = torch.rand(20, 3, generator=generator) * torch.tensor([4.0, 2.0, 0.4])
        clouds = {rig: torch.rand(5, 3, generator=generator) * 4 for rig in ("a", "b")}
        weights = torch.rand(20, generator=generator) + 0.5
        return Frame(clouds, reference, index, f"f{index}", counts={"seen": index}, reference_weights=weights)

    return make


@pytest.fixture(autouse=True)
def _maps(request):
    """Plot blank maps unless a test uses `drawn_maps`; their content is tested in tests/report."""
    if "drawn_maps" not in request.fixturenames:
        request.getfixturevalue("blank_maps")
