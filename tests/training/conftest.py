import pytest
from matplotlib.figure import Figure

from torchcover.training import figures


@pytest.fixture
def blank_maps(monkeypatch):
    """Maps with nothing on them, where it matters who gets them and when: drawing one takes half a second."""
    monkeypatch.setattr(
        figures, "plot_band_maps", lambda coverage: [("radius", Figure((1, 1))), ("blank", Figure((1, 1)))]
    )
