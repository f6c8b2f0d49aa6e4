"""Bounds of fitted effects: a simulator accepts the values that a fit may reach."""

from types import SimpleNamespace

import numpy as np
import pytest

from carlab.diagnosis.evidence import ScoredSearch, estimate
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.fit_parameters import base_parameters, effect_parameters, with_effect
from carlab.diagnosis.settings import DEFAULT
from sim_backends import SimulatorConfig
from sim_backends.effects import EFFECTS

PROBLEM = SimpleNamespace(settings=DEFAULT, windows=SimpleNamespace(block=np.arange(20)))
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
    scored = ScoredSearch(PROBLEM, None, None, fit, {})
    found = estimate(scored, "effects.steering_rate_limit.rate")
    assert found.at_limit is at_limit
    assert found.value == pytest.approx(np.clip(free[0].origin * np.exp(free[0].size * z), free[0].low, free[0].high))


@pytest.mark.parametrize(
    ("effect", "stated", "z"),
    [
        ("steering_lag", {}, 2.0),
        ("steering_lag", {"time_constant": 0.06}, 0.5),
        ("steering_rate_limit", {}, 0.7),  # infinite identity
    ],
)
def test_interval_of_an_effect_contains_the_error_of_the_model(effect, stated, z):
    """A tenth of the distance from the identity, or from the car file; of the whole value if the identity is inf."""
    car = SimulatorConfig(effects={effect: stated} if stated else {})
    free = effect_parameters(effect, car)
    fit = Fit(car, free, np.array([z]), 0.0, np.zeros(1), np.array([[1e-12]]))
    typical = EFFECTS[effect].parameters[0].typical
    if effect == "steering_rate_limit":
        value = distance = typical * np.exp(0.3 * z)
    else:
        distance = typical * z
        value = stated.get("time_constant", 0.0) + distance
    for excess in (0.0, 0.6, 1.0):
        found = estimate(ScoredSearch(PROBLEM, None, None, fit, {}, False, excess), free[0].name)
        assert found.value == pytest.approx(value)
        assert found.std == pytest.approx(np.hypot(0.01 * value, 0.1 * distance * excess), rel=1e-3)


def test_interval_of_a_base_parameter_has_no_error_of_the_model():
    free = base_parameters(SimulatorConfig())
    fit = Fit(SimulatorConfig(), free, np.full(len(free), 0.5), 0.0, np.zeros(1), 1e-12 * np.eye(len(free)))
    without, with_excess = (
        estimate(ScoredSearch(PROBLEM, None, None, fit, {}, False, excess), free[0].name) for excess in (0.0, 1.0)
    )
    assert with_excess.std == pytest.approx(without.std, rel=1e-3)
