"""What the tests of the simulation share."""

import numpy as np
import pytest


@pytest.fixture
def at(monkeypatch):
    """Let every place be this one."""

    def put(place_m):
        monkeypatch.setattr(
            "torchcover.simulation.surface_reference.sample_position_in_shell",
            lambda *_: np.array(place_m, dtype=np.float64),
        )

    return put
