import pytest
from matplotlib.figure import Figure

from torchcover.training import figures


@pytest.fixture
def blank_maps(monkeypatch):
    """Replace maps by empty figures where only their logging matters; plotting one takes half a second."""
    monkeypatch.setattr(
        figures, "plot_band_maps", lambda coverage: [("radius", Figure((1, 1))), ("blank", Figure((1, 1)))]
    )
