"""Test domain models against closed forms, scipy and the data of the paper."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from learning.priors.domain_models import KinematicCar, Pendulum, Sinusoids, draw_parameters
from tests.helpers.seeded import generator


@pytest.mark.parametrize(
    ("model", "inputs", "outputs"), [(Sinusoids(), 1, 1), (Pendulum(), 4, 3), (KinematicCar(), 9, 7)]
)
def test_batched_parameters_equal_single_parameters(model, inputs, outputs):
    x = model.inputs(5, generator())
    parameters = draw_parameters(model, 4, generator(1))
    out = model(x, parameters)
    assert x.shape == (5, inputs)
    assert out.shape == (4, 5, outputs)
    for k in range(4):
        assert torch.allclose(model(x, parameters[k : k + 1])[0], out[k], atol=1e-6)
    assert not torch.allclose(out[0], out[1])


def test_pendulum_equals_scipy_with_small_steps():
    model = Pendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6), rate_discrepancy=(0.8, 0.3, 0.3), substeps=2000)
    x, parameters = model.inputs(3, generator()).double(), draw_parameters(model, 2, generator(1)).double()
    changes = model(x, parameters)
    for k in range(2):
        m, length, g, nu, drag, linear, odd, even = parameters[k].tolist()
        for n in range(3):
            torque = float(x[n, 3])

            def rates(t, s, p=(torque, m, length, g, nu, drag, linear, odd, even)):
                torque, m, length, g, nu, drag, linear, odd, even = p
                resistance = nu * s[1] / (m * length) + drag / m * s[1] ** 2
                missing = linear * s[1] + odd * s[1] * abs(s[1]) + even * s[1] ** 2
                return [s[1], g / length * math.sin(s[0]) + torque / (m * length**2) - resistance + missing]

            start = [math.atan2(x[n, 0], x[n, 1]), float(x[n, 2])]
            end = solve_ivp(rates, (0, 0.05), start, rtol=1e-10, atol=1e-12).y[:, -1]
            expected = np.array([math.sin(end[0]), math.cos(end[0]), end[1]]) - x[n, :3].numpy()
            assert np.allclose(changes[k, n], expected, atol=2e-4)


def test_pendulum_explains_the_data_of_the_paper_with_drag_only(shared):
    """With drag the best draw has a residual close to the noise of 0.02; without drag none has."""
    data = np.load(shared / "data" / "regression" / "pendulum_seed0_n50.npz")
    x, y = (torch.tensor(data[k]) for k in ("x", "y"))
    residual_rms = []
    for drags in ((0.4, 0.6), (0.0, 0.0)):
        model = Pendulum(frictions=drags, drags=drags)
        error = model(x, draw_parameters(model, 20_000, generator())) - (y - x[:, :3])
        residual_rms.append(float(error.square().mean(dim=(1, 2)).sqrt().min()))
    assert residual_rms[0] < 0.03
    assert residual_rms[1] > 3.0 * residual_rms[0]


def test_kinematic_car_drives_its_geometric_circle():
    """In steady state r = v tan(d) / L, and the centre of mass moves on a circle about the turning centre."""
    model = KinematicCar()
    parameters = draw_parameters(model, 6, generator()).double()
    _, front, rear, _, drive, damping, lock = (parameters[:, k] for k in range(7))
    parameters[:, 3] = 0.0
    steering, throttle = 0.6, 0.4
    speed = drive * throttle / damping**2
    rate = speed * torch.tan(lock * steering) / (front + rear)
    lateral_speed = rear * rate
    for k in range(6):
        row = torch.tensor([[0, 0, 0, 1, speed[k], lateral_speed[k], rate[k], steering, throttle]], dtype=torch.float64)
        change = model(row, parameters[k : k + 1])[0, 0]
        rotated = float(rate[k]) / 30.0
        radius = math.hypot(float(speed[k]), float(lateral_speed[k])) / float(rate[k])
        chord = 2 * radius * math.sin(rotated / 2)
        assert math.hypot(float(change[0]), float(change[1])) == pytest.approx(chord, rel=1e-4)
        assert math.atan2(float(change[2]), 1.0 + float(change[3])) == pytest.approx(rotated, rel=1e-6)
        assert float(change[6]) == pytest.approx(0.0, abs=1e-9)


def test_kinematic_car_is_equivariant_under_rotation():
    model, angle = KinematicCar(), 0.9
    x = model.inputs(7, generator()).double()
    parameters = draw_parameters(model, 3, generator(1)).double()
    c, s = math.cos(angle), math.sin(angle)

    def rotated(rows):
        px, py, sin, cos, vx, vy, *rest = rows.unbind(-1)
        place, velocity = (c * px - s * py, s * px + c * py), (c * vx - s * vy, s * vx + c * vy)
        return torch.stack([*place, sin * c + cos * s, cos * c - sin * s, *velocity, *rest], dim=-1)

    rotated_changes = rotated(torch.cat([model(x, parameters), torch.zeros(3, 7, 2)], dim=-1))
    changes_of_rotated = model(rotated(x), parameters)
    assert torch.allclose(rotated_changes[..., :7], changes_of_rotated, atol=1e-12)
