"""Instants that several tests look at."""

import pytest

from tests.placement.worlds import held
from torchcover.placement import fresh


@pytest.fixture(autouse=True, scope="session")
def no_targets():
    """Targets around the winner of every small search would take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fresh, "TARGETS", ())
        yield


@pytest.fixture(scope="session")
def instants():
    return held()
