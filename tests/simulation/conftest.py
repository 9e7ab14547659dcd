"""Shared fixtures of the simulation tests."""

import numpy as np
import pytest


@pytest.fixture
def fix_position(monkeypatch):
    """Fix the reference position."""

    def put(position_m):
        monkeypatch.setattr(
            "torchcover.simulation.surface_reference.sample_position_in_shell",
            lambda *_: np.array(position_m, dtype=np.float64),
        )

    return put
