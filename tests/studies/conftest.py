"""Fixtures of the tests of studies."""

import pytest

import learning.world.disturbance_fit as disturbance_fit


@pytest.fixture
def few_correlation_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit few windows with few candidates of the disturbance; its own tests have more, which takes seconds."""
    monkeypatch.setattr(disturbance_fit, "DOF_CANDIDATES", disturbance_fit.DOF_CANDIDATES[::3])
    monkeypatch.setattr("carlab.studies.rollouts.MAX_WINDOWS", 70)
    monkeypatch.setattr(disturbance_fit, "CORRELATION_TIMES_S", (0.1, 0.4, 1.6))
