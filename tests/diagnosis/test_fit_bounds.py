"""Bounds of fitted effects: a simulator accepts the values that a fit may reach."""

import numpy as np
import pytest

from carlab.diagnosis.identification.fit_parameters import effect_parameters, with_effect
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
