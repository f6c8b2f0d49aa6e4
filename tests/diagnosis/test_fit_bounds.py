"""Bounds of fitted effects: a simulator accepts the values that a fit may reach."""

from types import SimpleNamespace

import numpy as np
import pytest

from carlab.diagnosis.evidence import ScoredSearch, estimate
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.fit_parameters import effect_parameters, with_effect
from carlab.diagnosis.settings import DEFAULT
from sim_backends import SimulatorConfig
from sim_backends.effects import EFFECTS

EVERY_CASE = [(kind, effect) for kind in ("dynamic", "linear_tyre", "kinematic") for effect in sorted(EFFECTS)]


@pytest.mark.parametrize(("kind", "effect"), [case for case in EVERY_CASE if case[0] in EFFECTS[case[1]].base_models])
@pytest.mark.parametrize("z", [-1e3, 1e3])
def test_simulator_accepts_the_bounds_of_every_effect(kind, effect, z):
    car = SimulatorConfig(kind=kind)
    free = effect_parameters(effect, car)
    values = {f.name: float(f.value(np.array(z))) for f in free}
    reached = with_effect(car, effect).with_values(values).values()
    assert {name: reached[name] for name in values} == values


@pytest.mark.parametrize(("z", "at_limit"), [(0.5, False), (-1e3, True), (1e3, True)])
def test_estimate_states_that_a_fit_ended_at_a_bound(z, at_limit):
    free = effect_parameters("steering_rate_limit", SimulatorConfig())
    fit = Fit(SimulatorConfig(), free, np.array([z]), 0.0, np.zeros(1), np.array([[0.01]]))
    scored = ScoredSearch(SimpleNamespace(settings=DEFAULT), None, None, fit, {})
    found = estimate(scored, "effects.steering_rate_limit.rate")
    assert found.at_limit is at_limit
    assert found.value == pytest.approx(np.clip(free[0].origin * np.exp(free[0].size * z), free[0].low, free[0].high))
