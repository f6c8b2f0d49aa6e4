"""Recordings without faults of the kinematic car."""

import pytest

from carlab.core.episode_data import EpisodeData
from tests.helpers.kinematic_drives import Car


@pytest.fixture(scope="session")
def clean() -> EpisodeData:
    """A recording to fit."""
    return Car().drive()


@pytest.fixture(scope="session")
def held() -> EpisodeData:
    """A held-out recording."""
    return Car(seed=1, seconds=40.0).drive()
