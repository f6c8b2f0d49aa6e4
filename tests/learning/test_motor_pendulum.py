"""Test the pendulum with losses and motor lag against scipy and energy conservation."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from learning.networks.normaliser import Normaliser
from learning.posterior.inference import infer
from learning.priors.domain_models import Pendulum, draw_parameters
from learning.priors.motor_pendulum import SLIDING_RADPS, MotorPendulum
from tests.helpers.seeded import generator

LOSSES = {"frictions": (0.4, 0.6), "drags": (0.4, 0.6), "dry": (0.1, 0.4), "lags": (0.02, 0.06)}


def state_change(row, drawn):
    """Integrate the state change over 50 ms by scipy, with the torque as third state."""
    sin, cos, rate, past, command = row
    m, length, g, nu, drag, dry, lag, linear, odd, even, sliding, of_command, of_past = drawn

    def rates(t, state):
        theta, omega, torque = state
        sign = math.tanh(omega / SLIDING_RADPS)
        lost = nu * omega / (m * length) + drag / m * omega * abs(omega) + dry * sign / (m * length**2)
        missing = linear * omega + odd * omega * abs(omega) + even * omega**2 + sliding * sign
        missing += (of_command * command + of_past * past) / (m * length**2)
        driven = g / length * math.sin(theta) + torque / (m * length**2)
        return [omega, driven - lost + missing, (command - torque) / lag]

    end = solve_ivp(rates, (0, 0.05), [math.atan2(sin, cos), rate, past], rtol=1e-11, atol=1e-12).y[:, -1]
    return np.array([math.sin(end[0]) - sin, math.cos(end[0]) - cos, end[1] - rate])


@pytest.mark.parametrize("discrepancy", [{}, {"rate_discrepancy": (0.8, 0.3, 0.3, 0.7), "command_discrepancy": 0.5}])
def test_motor_pendulum_equals_scipy_with_torque_state(discrepancy):
    model = MotorPendulum(**LOSSES, **discrepancy)
    x, parameters = model.inputs(12, generator()).double(), draw_parameters(model, 4, generator(1)).double()
    changes = model(x, parameters).numpy()
    expected = [[state_change(row, drawn) for row in x.tolist()] for drawn in parameters.tolist()]
    assert np.allclose(changes, expected, atol=2e-5)


def test_past_command_matters_with_motor_lag_only():
    x = MotorPendulum().inputs(6, generator())
    other = x.clone()
    other[:, 3] = -other[:, 3]
    for model, same in ((MotorPendulum(), True), (MotorPendulum(lags=(0.02, 0.06)), False)):
        parameters = draw_parameters(model, 3, generator(1))
        assert torch.isfinite(model(x, parameters)).all()
        assert torch.equal(model(x, parameters), model(other, parameters)) == same


def energies(model, commands, steps=60):
    """Return the energy over m l^2 of free pendulums after each step (steps + 1, P * N)."""
    parameters = draw_parameters(model, 6, generator(2)).double()
    states = MotorPendulum().inputs(16, generator(3)).double()[:, :3]
    found = []
    for drawn in parameters:
        state, pull = states, drawn[2] / drawn[1]
        trajectory_energies = []
        for _ in range(steps + 1):
            trajectory_energies.append(0.5 * state[:, 2] ** 2 + pull * state[:, 1])
            after = state + model(torch.cat([state, torch.zeros((len(state), commands))], dim=1), drawn[None])[0]
            state = torch.cat([after[:, :2] / after[:, :2].norm(dim=1, keepdim=True), after[:, 2:]], dim=1)
        found.append(torch.stack(trajectory_energies))
    return torch.cat(found, dim=1)


def test_energy_is_constant_without_losses_and_decreases_with_losses():
    conserved = energies(MotorPendulum(), 2)
    assert torch.allclose(conserved, conserved[:1].expand_as(conserved), atol=1e-5)
    dissipated = energies(MotorPendulum(**LOSSES), 2)
    assert float(dissipated.diff(dim=0).max()) < 1e-7
    assert bool((dissipated[-1] < dissipated[0] - 0.1).all())


def test_quadratic_drag_without_sign_can_add_energy():
    """The drag of the authors' code adds energy to a pendulum that rotates backwards."""
    fine = {"substeps": 200, "drags": (0.4, 0.6)}
    assert float(energies(Pendulum(**fine), 1, steps=2).diff(dim=0).max()) > 0.1
    assert float(energies(Pendulum(substeps=200), 1, steps=2).diff(dim=0).max()) < 0.02


@pytest.mark.parametrize("lag", [0.02, 0.06])
def test_command_discrepancy_identifies_the_motor_lag(lag):
    """The past command contributes the share ``lag / T (1 - exp(-T / lag))`` of the mean torque of a step."""
    truth = MotorPendulum(lags=(lag, lag), dry=(0.2, 0.2), drags=(0.5, 0.5))
    inputs = truth.inputs(60, generator(4))
    outputs = truth(inputs, draw_parameters(truth, 1, generator(5)))[0]
    outputs = outputs + 0.005 * torch.randn(outputs.shape, generator=generator(6))
    units = Normaliser(torch.zeros(5), torch.tensor([1.0, 1.0, 3.5, 2.0, 2.0]), torch.zeros(3), torch.full((3,), 0.5))
    process = MotorPendulum(rate_discrepancy=(1.0, 0.5, 0.5, 1.0), command_discrepancy=0.5)
    found = infer(process, inputs, outputs, units, torch.full((3,), 0.005), with_discrepancy=False, noise_known=True)
    of_command, of_past = found.parameters[:, 11], found.parameters[:, 12]
    ratio = of_past / (1.0 + of_command)
    share = lag / 0.05 * (1.0 - math.exp(-0.05 / lag))
    assert float(ratio.std()) < 0.15 * share / (1.0 - share)
    assert abs(float(ratio.mean()) - share / (1.0 - share)) < 3.0 * float(ratio.std())
