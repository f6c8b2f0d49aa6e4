"""Gaussian processes in NumPy for a linear simulator: the reference of the posterior over functions."""

from __future__ import annotations

import numpy as np
from linear_simulator import UNITS, features

from learning.posterior.discrepancy import CHOLESKY_JITTER


def simulated_mean(parameters, x):
    """Normalised outputs of the simulator with the mean of some parameters (O, N)."""
    raw = features(x) @ parameters.double().numpy().mean(axis=0)
    return (raw - UNITS.output_mean.numpy()[:, None]) / UNITS.output_std.numpy()[:, None]


def kernel(discrepancy, first, second, parameters=None):
    """The discrepancy's covariance at raw inputs, of raw outputs (O, N, M); with draws of a simulator's parameters."""
    a, b = ((np.asarray(v, dtype=float) - UNITS.input_mean.numpy()) / UNITS.input_std.numpy() for v in (first, second))
    found = []
    for k, unit in enumerate(UNITS.output_std.double().numpy()):
        s, length, w, c = (
            v[k].double().numpy()
            for v in (discrepancy.scales, discrepancy.lengthscales, discrepancy.slopes, discrepancy.offsets)
        )
        distance = (((a[:, None] - b[None]) / length) ** 2).sum(axis=2)
        own = s**2 * np.exp(-0.5 * distance) + (w * a) @ (w * b).T + c**2
        if parameters is not None:
            d, long = (
                v[k].double().numpy() for v in (discrepancy.multiplier_stds, discrepancy.multiplier_lengthscales)
            )
            near = np.exp(-0.5 * (((a[:, None] - b[None]) / long) ** 2).sum(axis=2))
            own = (
                own
                + d**2 * simulated_mean(parameters, first)[k][:, None] * simulated_mean(parameters, second)[k] * near
            )
        found.append(unit**2 * own)
    return np.stack(found)


def discrepancy_alone(x, y, at, discrepancy, noise):
    """Mean (M, 2), standard deviations (M, 2) and covariances (2, M, M) of the discrepancy alone, output by output."""
    means, covariances = [], []
    between, within, own = kernel(discrepancy, x, at), kernel(discrepancy, x, x), kernel(discrepancy, at, at)
    for k, (middle, unit) in enumerate(zip(UNITS.output_mean.numpy(), UNITS.output_std.double().numpy(), strict=True)):
        seen = within[k] + (noise[k] ** 2 + CHOLESKY_JITTER * unit**2) * np.eye(len(x))
        gain = np.linalg.solve(seen, between[k]).T
        means.append(middle + gain @ (np.asarray(y, dtype=float)[:, k] - middle))
        covariances.append(own[k] - gain @ between[k])
    covariance = np.stack(covariances)
    return np.stack(means, axis=1), np.sqrt(covariance.diagonal(axis1=1, axis2=2).T + noise**2), covariance


def raw_noise(posterior):
    return (posterior.noise_std * UNITS.output_std).double().numpy()


def simulator_and_discrepancy(x, y, at, discrepancy, noise, parameters=None):
    """Mean (M, 2), standard deviations (M, 2) and covariances (2, M, M) of simulator and discrepancy, in numpy.

    Outputs share the simulator's parameters, so that all rows of all outputs are conditioned on at once.
    """
    n, m, units = len(x), len(at), UNITS.output_std.double().numpy()

    def joint(first, second):
        """Covariances (2 N, 2 M), output by output."""
        a, b = (np.concatenate(features(v)) for v in (first, second))
        of_discrepancy = np.zeros((len(a), len(b)))
        if discrepancy is not None:
            for k, block in enumerate(kernel(discrepancy, first, second, parameters)):
                of_discrepancy[k * len(first) : (k + 1) * len(first), k * len(second) : (k + 1) * len(second)] = block
        return a @ b.T + of_discrepancy

    seen = joint(x, x) + np.diag(np.repeat(noise**2 + CHOLESKY_JITTER * units**2, n))
    gain = np.linalg.solve(seen, joint(x, at)).T
    mean = (gain @ np.asarray(y, dtype=float).T.ravel()).reshape(2, m)
    covariance = joint(at, at) - gain @ joint(x, at)
    blocks = np.stack([covariance[k * m : (k + 1) * m, k * m : (k + 1) * m] for k in range(2)])
    return mean.T, np.sqrt(blocks.diagonal(axis1=1, axis2=2).T + noise**2), blocks
