"""What the tests of several rooms share."""

import os
import signal

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is loaded: threads that wait are to leave the cores
os.environ["TORCHCOVER_CACHE_GB"] = "0"  # what tests draw does not go to the user's disk

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def blank_maps(monkeypatch):
    """Maps with nothing on them, under their names: drawing one takes a third of a second."""
    monkeypatch.setattr("torchcover.report.maps.plot_side_by_side", lambda *_, **__: Figure((0.2, 0.2)))


@pytest.fixture
def drawn_maps():
    """Maps as a user gets them, where a folder leaves them blank."""


@pytest.fixture(autouse=True)
def _signals():
    """As in the foreground of a terminal: whoever starts the tests in the background has Ctrl-C ignored in them."""
    usual = {
        signal.SIGINT: signal.default_int_handler,
        **{getattr(signal, name): signal.SIG_DFL for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)},
    }
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    left = {number: signal.signal(number, handler) for number, handler in before.items()}
    assert left == usual, "a test has to leave signals as it found them"
