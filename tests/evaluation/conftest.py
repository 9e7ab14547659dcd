"""Frames made by hand."""

import pytest
import torch

from torchcover.data import Frame


@pytest.fixture
def frame_of():
    """Frame number k: a sensor point of `a` and one of `b` above 20 random reference points; odd counts."""

    def make(index):
        generator = torch.Generator().manual_seed(index)
        reference = torch.rand(20, 3, generator=generator) * torch.tensor([4.0, 2.0, 0.4])
        clouds = {rig: torch.rand(5, 3, generator=generator) * 4 for rig in ("a", "b")}
        weights = torch.rand(20, generator=generator) + 0.5
        return Frame(clouds, reference, index, f"f{index}", counts={"seen": index}, reference_weights=weights)

    return make


@pytest.fixture(autouse=True)
def _maps(request):
    """Blank, unless a test asks for `drawn_maps`: what is on them is the business of tests/report."""
    if "drawn_maps" not in request.fixturenames:
        request.getfixturevalue("blank_maps")
