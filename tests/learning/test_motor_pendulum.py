"""The pendulum that loses energy behind a lagging motor, against scipy and the laws of energy."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from learning.networks.normaliser import Normaliser
from learning.posterior.inference import infer
from learning.priors.domain_models import Pendulum, draw_parameters
from learning.priors.motor_pendulum import SLIDING_RADPS, MotorPendulum

LOSSES = {"frictions": (0.4, 0.6), "drags": (0.4, 0.6), "dry": (0.1, 0.4), "lags": (0.02, 0.06)}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def changed(row, drawn):
    """Change over 50 ms by scipy, the torque being a third state."""
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
def test_it_follows_its_equations_with_the_torque_as_a_state(discrepancy):
    model = MotorPendulum(**LOSSES, **discrepancy)
    x, parameters = model.inputs(12, generator()).double(), draw_parameters(model, 4, generator(1)).double()
    ours = model(x, parameters).numpy()
    theirs = [[changed(row, drawn) for row in x.tolist()] for drawn in parameters.tolist()]
    assert np.allclose(ours, theirs, atol=2e-5)


def test_without_lag_the_past_command_changes_nothing_and_with_it_something():
    x = MotorPendulum().inputs(6, generator())
    other = x.clone()
    other[:, 3] = -other[:, 3]
    for model, same in ((MotorPendulum(), True), (MotorPendulum(lags=(0.02, 0.06)), False)):
        parameters = draw_parameters(model, 3, generator(1))
        assert torch.isfinite(model(x, parameters)).all()
        assert torch.equal(model(x, parameters), model(other, parameters)) == same


def energies(model, commands, steps=60):
    """Energy by m l^2 of free pendulums after each step: (steps + 1, P * N)."""
    parameters = draw_parameters(model, 6, generator(2)).double()
    states = MotorPendulum().inputs(16, generator(3)).double()[:, :3]
    found = []
    for drawn in parameters:
        state, pull = states, drawn[2] / drawn[1]
        own = []
        for _ in range(steps + 1):
            own.append(0.5 * state[:, 2] ** 2 + pull * state[:, 1])
            after = state + model(torch.cat([state, torch.zeros((len(state), commands))], dim=1), drawn[None])[0]
            state = torch.cat([after[:, :2] / after[:, :2].norm(dim=1, keepdim=True), after[:, 2:]], dim=1)
        found.append(torch.stack(own))
    return torch.cat(found, dim=1)


def test_energy_without_torque_stays_without_losses_and_never_grows_with_them():
    kept = energies(MotorPendulum(), 2)
    assert torch.allclose(kept, kept[:1].expand_as(kept), atol=1e-5)
    lost = energies(MotorPendulum(**LOSSES), 2)
    assert float(lost.diff(dim=0).max()) < 1e-7
    assert bool((lost[-1] < lost[0] - 0.1).all())


def test_drag_by_the_square_of_the_rate_alone_can_feed_energy():
    """The drag of the authors' code, alone: a pendulum that turns backwards gains from it, soon without bounds."""
    fine = {"substeps": 200, "drags": (0.4, 0.6)}
    assert float(energies(Pendulum(**fine), 1, steps=2).diff(dim=0).max()) > 0.1
    assert float(energies(Pendulum(**fine, dissipative=True), 1, steps=2).diff(dim=0).max()) < 0.02


@pytest.mark.parametrize("lag", [0.02, 0.06])
def test_a_gap_in_the_dynamics_finds_what_the_motor_does(lag):
    """Over a step the past command has the share ``lag / T (1 - exp(-T / lag))`` of the mean torque."""
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
