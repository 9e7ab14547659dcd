"""Instants that several tests look at."""

import pytest

from tests.placement.worlds import held


@pytest.fixture(scope="session")
def instants():
    return held()
