"""Fixtures of the tests of studies."""

import pytest

import learning.world.disturbance_fit as disturbance_fit


@pytest.fixture
def few_correlation_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try three correlation times of the disturbance; its own tests try them all, which takes seconds for each fit."""
    monkeypatch.setattr(disturbance_fit, "CORRELATION_TIMES_S", (0.1, 0.4, 1.6))
