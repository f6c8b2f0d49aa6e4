"""Test the seven world-frame outputs: moments against draws, measurements against world states."""

import numpy as np
import torch
from scipy.stats import norm

from carlab.core.angles import wrap
from learning.evaluation import Mixture
from learning.world.world_outputs import measured_seven_outputs, seven_outputs

MEANS = torch.tensor([[[0.1, -0.02, 0.3, 0.5, -0.4, 1.0]], [[0.0, 0.05, -0.2, -0.3, 0.2, -2.0]]])
STDS = torch.tensor([[[0.02, 0.01, 0.1, 0.2, 0.3, 0.5]], [[0.01, 0.04, 0.3, 0.1, 0.2, 0.4]]])
VELOCITY, YAW = torch.tensor([[2.0, -0.5]]), torch.tensor([0.9])


def world(changes, velocity, yaw):
    """Compute the seven outputs in numpy."""
    ahead, left, yaw_change, vx, vy, rate = np.moveaxis(np.asarray(changes, dtype=float), -1, 0)
    after, vx, vy = yaw + yaw_change, velocity[0] + vx, velocity[1] + vy
    x, y = np.cos(yaw) * ahead - np.sin(yaw) * left, np.sin(yaw) * ahead + np.cos(yaw) * left
    world_velocity = np.cos(after) * vx - np.sin(after) * vy, np.sin(after) * vx + np.cos(after) * vy
    return np.stack([x, y, np.sin(after), np.cos(after), *world_velocity, rate], axis=-1)


def test_components_have_the_moments_of_their_draws():
    found = seven_outputs(Mixture(MEANS, STDS), VELOCITY, YAW)
    rng = np.random.default_rng(0)
    for component in range(2):
        drawn = rng.normal(MEANS[component, 0], STDS[component, 0], (400_000, 6))
        outputs = world(drawn, VELOCITY[0].numpy(), 0.9)
        assert np.allclose(found.means[component, 0], outputs.mean(axis=0), atol=4e-3)
        assert np.allclose(found.stds[component, 0], outputs.std(axis=0), rtol=0.01)


def test_student_components_become_scale_mixtures_of_gaussians():
    """Quantiles of Student-t draws with four degrees of freedom equal those of the Gaussian mixture."""
    found = seven_outputs(Mixture(MEANS, 0.1 * STDS, 4.0), VELOCITY, YAW)
    rng = np.random.default_rng(0)
    scales = np.sqrt(4.0 / rng.chisquare(4.0, (2, 200_000, 1)))
    drawn = MEANS.numpy() + 0.1 * STDS.numpy() * scales * rng.normal(size=(2, 200_000, 6))
    outputs = np.concatenate(world(drawn, VELOCITY[0].numpy(), 0.9))
    shares = np.array([0.1, 0.5, 0.9])
    quantiles = np.quantile(outputs, shares, axis=0)[:, None]
    below = norm.cdf((quantiles - found.means[:, 0].numpy()) / found.stds[:, 0].numpy()).mean(axis=1)
    assert np.allclose(below, shares[:, None], atol=0.02)


def test_measured_outputs_equal_differences_of_world_states():
    """Random world states at both ends of a step give body-frame changes and the expected outputs."""
    rng = np.random.default_rng(1)
    before, after = rng.normal(size=(2, 50, 6))
    sin, cos = np.sin(before[:, 2]), np.cos(before[:, 2])
    displacement = after[:, :2] - before[:, :2]
    ahead, left = (
        cos * displacement[:, 0] + sin * displacement[:, 1],
        cos * displacement[:, 1] - sin * displacement[:, 0],
    )
    changes = np.column_stack([ahead, left, wrap(after[:, 2] - before[:, 2]), after[:, 3:] - before[:, 3:]])
    found = measured_seven_outputs(*(torch.from_numpy(v) for v in (changes, before[:, 3:5], before[:, 2])))
    sin, cos = np.sin(after[:, 2]), np.cos(after[:, 2])
    vx, vy = cos * after[:, 3] - sin * after[:, 4], sin * after[:, 3] + cos * after[:, 4]
    expected = np.column_stack([displacement, sin, cos, vx, vy, after[:, 5] - before[:, 5]])
    assert np.allclose(found, expected, atol=1e-12)


def test_density_factorises_for_a_known_yaw_of_zero():
    """For a car facing x, sine and cosine of yaw are independent of the other five outputs."""
    means, stds = MEANS[:1].clone(), STDS[:1].clone()
    means[..., 2], stds[..., 2] = 0.0, 1e-4
    found = seven_outputs(Mixture(means, stds), VELOCITY, torch.zeros(1))
    changes = means[0] + 0.7 * stds[0] * torch.tensor([1.0, -1.0, 0.0, 1.0, 1.0, -1.0])
    truth = measured_seven_outputs(changes, VELOCITY, torch.zeros(1))
    five = norm.logpdf(0.7, 0.0, 1.0) * 5 - np.log(stds[0, 0, [0, 1, 3, 4, 5]].numpy()).sum()
    angle = norm(found.means[0, 0, 2:4], found.stds[0, 0, 2:4]).logpdf(truth[0, 2:4]).sum()
    assert np.isclose(float(found.log_density(truth)[0]), five + angle, atol=1e-3)
