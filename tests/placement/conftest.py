"""Fixtures of the tests of placement."""

import pytest

from tests.placement.worlds import create_frames
from torchcover.placement import validation


@pytest.fixture(autouse=True, scope="session")
def no_targets():
    """Validate without test targets, which would take most of the time of a small search."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validation, "TARGETS", ())
        yield


@pytest.fixture(scope="session")
def frames():
    return create_frames()
