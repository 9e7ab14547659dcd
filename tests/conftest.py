"""Fixtures of all tests."""

import os
import signal

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is loaded: waiting threads must not occupy cores
os.environ["TORCHCOVER_CACHE_GB"] = "0"  # scenes of tests must not fill the cache of the user

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def blank_maps(monkeypatch):
    """Replace maps by blank figures with the same names, since plotting a map takes a third of a second."""
    monkeypatch.setattr("torchcover.report.maps.plot_side_by_side", lambda *_, **__: Figure((0.2, 0.2)))


@pytest.fixture
def drawn_maps():
    """Request real maps in a folder whose tests have blank maps."""


@pytest.fixture(autouse=True)
def _default_signals():
    """Set the signal handlers of a foreground process, since a shell ignores Ctrl-C in background processes."""
    handlers = {signal.SIGINT: signal.default_int_handler}
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            handlers[getattr(signal, name)] = signal.SIG_DFL
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    yield
    final = {number: signal.signal(number, handler) for number, handler in previous.items()}
    assert final == handlers, "the test changed a signal handler and did not restore it"
