"""Domain models against closed forms, scipy, and the arrays of the paper's studies."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from learning.priors.domain_models import KinematicCar, Pendulum, Sinusoids, draw_parameters


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    ("model", "inputs", "outputs"), [(Sinusoids(), 1, 1), (Pendulum(), 4, 3), (KinematicCar(), 9, 7)]
)
def test_shapes_and_draws_of_their_own(model, inputs, outputs):
    x = model.inputs(5, generator())
    parameters = draw_parameters(model, 4, generator(1))
    out = model(x, parameters)
    assert x.shape == (5, inputs)
    assert out.shape == (4, 5, outputs)
    for k in range(4):
        assert torch.allclose(model(x, parameters[k : k + 1])[0], out[k], atol=1e-6)
    assert not torch.allclose(out[0], out[1])


def test_a_pendulum_follows_its_equation_in_small_steps():
    model = Pendulum(
        frictions=(0.4, 0.6), drags=(0.4, 0.6), dissipative=True, rate_discrepancy=(0.8, 0.3, 0.3), substeps=2000
    )
    x, parameters = model.inputs(3, generator()).double(), draw_parameters(model, 2, generator(1)).double()
    ours = model(x, parameters)
    for k in range(2):
        m, length, g, nu, drag, linear, odd, even = parameters[k].tolist()
        for n in range(3):
            torque = float(x[n, 3])

            def rates(t, s, p=(torque, m, length, g, nu, drag, linear, odd, even)):
                torque, m, length, g, nu, drag, linear, odd, even = p
                resistance = nu * s[1] / (m * length) + drag / m * s[1] * abs(s[1])
                missing = linear * s[1] + odd * s[1] * abs(s[1]) + even * s[1] ** 2
                return [s[1], g / length * math.sin(s[0]) + torque / (m * length**2) - resistance + missing]

            start = [math.atan2(x[n, 0], x[n, 1]), float(x[n, 2])]
            end = solve_ivp(rates, (0, 0.05), start, rtol=1e-10, atol=1e-12).y[:, -1]
            theirs = np.array([math.sin(end[0]), math.cos(end[0]), end[1]]) - x[n, :3].numpy()
            assert np.allclose(ours[k, n], theirs, atol=2e-4)


def test_the_pendulum_of_the_studies_explains_their_arrays(shared):
    """With drag in its range some draw leaves little more than the noise of 0.02; without drag none does."""
    data = np.load(shared / "data" / "regression" / "pendulum_seed0_n50.npz")
    x, y = (torch.tensor(data[k]) for k in ("x", "y"))
    left = []
    for drags in ((0.4, 0.6), (0.0, 0.0)):
        model = Pendulum(frictions=drags, drags=drags)
        error = model(x, draw_parameters(model, 20_000, generator())) - (y - x[:, :3])
        left.append(float(error.square().mean(dim=(1, 2)).sqrt().min()))
    assert left[0] < 0.03
    assert left[1] > 3.0 * left[0]


def test_a_rolling_car_drives_the_circle_of_its_wheels():
    """At rest of all transients, r = v tan(d) / L, and the centre of mass goes round on the rear axle's arm."""
    model = KinematicCar()
    parameters = draw_parameters(model, 6, generator()).double()
    _, front, rear, _, drive, damping, lock = (parameters[:, k] for k in range(7))
    parameters[:, 3] = 0.0
    steering, throttle = 0.6, 0.4
    speed = drive * throttle / damping**2
    rate = speed * torch.tan(lock * steering) / (front + rear)
    across = rear * rate
    for k in range(6):
        row = torch.tensor([[0, 0, 0, 1, speed[k], across[k], rate[k], steering, throttle]], dtype=torch.float64)
        change = model(row, parameters[k : k + 1])[0, 0]
        rotated = float(rate[k]) / 30.0
        radius = math.hypot(float(speed[k]), float(across[k])) / float(rate[k])
        chord = 2 * radius * math.sin(rotated / 2)
        assert math.hypot(float(change[0]), float(change[1])) == pytest.approx(chord, rel=1e-4)
        assert math.atan2(float(change[2]), 1.0 + float(change[3])) == pytest.approx(rotated, rel=1e-6)
        assert float(change[6]) == pytest.approx(0.0, abs=1e-9)


def test_turning_the_world_turns_the_car_with_it():
    model, angle = KinematicCar(), 0.9
    x = model.inputs(7, generator()).double()
    parameters = draw_parameters(model, 3, generator(1)).double()
    c, s = math.cos(angle), math.sin(angle)

    def rotated(rows):
        px, py, sin, cos, vx, vy, *rest = rows.unbind(-1)
        place, velocity = (c * px - s * py, s * px + c * py), (c * vx - s * vy, s * vx + c * vy)
        return torch.stack([*place, sin * c + cos * s, cos * c - sin * s, *velocity, *rest], dim=-1)

    ours = rotated(torch.cat([model(x, parameters), torch.zeros(3, 7, 2)], dim=-1))
    theirs = model(rotated(x), parameters)
    assert torch.allclose(ours[..., :7], theirs, atol=1e-12)
