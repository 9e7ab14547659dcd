"""What the tests of several rooms share."""

import pytest
from matplotlib.figure import Figure

from torchcover.report.maps import figures


@pytest.fixture
def blank_maps(monkeypatch):
    """Maps with nothing on them, under their names: drawing one takes a third of a second."""
    for draw in ("draw_map", "draw_side_by_side"):
        monkeypatch.setattr(figures, draw, lambda *_, **__: Figure((0.2, 0.2)))


@pytest.fixture
def drawn_maps():
    """Maps as a user gets them, where a folder leaves them blank."""
