"""Frames that several tests use."""

import pytest

from tests.placement.worlds import held
from torchcover.placement import validation


@pytest.fixture(autouse=True, scope="session")
def no_targets():
    """Targets around the winner of every small search would take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validation, "TARGETS", ())
        yield


@pytest.fixture(scope="session")
def frames():
    return held()
