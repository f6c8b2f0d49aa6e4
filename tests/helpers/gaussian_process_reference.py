"""Reference Gaussian processes in NumPy for the posterior over functions of a linear simulator."""

from __future__ import annotations

import numpy as np
from linear_simulator import UNITS, features

from learning.posterior.discrepancy import CHOLESKY_JITTER


def simulated_mean(parameters, x):
    """Return normalised simulator outputs (O, N) for the mean of parameter draws."""
    raw = features(x) @ parameters.double().numpy().mean(axis=0)
    return (raw - UNITS.output_mean.numpy()[:, None]) / UNITS.output_std.numpy()[:, None]


def kernel(discrepancy, first, second, parameters=None):
    """Return the discrepancy covariance of raw outputs (O, N, M) at raw inputs; draws add the multiplicative part."""
    a, b = ((np.asarray(v, dtype=float) - UNITS.input_mean.numpy()) / UNITS.input_std.numpy() for v in (first, second))
    found = []
    for k, unit in enumerate(UNITS.output_std.double().numpy()):
        s, length, w, c = (
            v[k].double().numpy()
            for v in (discrepancy.scales, discrepancy.lengthscales, discrepancy.slopes, discrepancy.offsets)
        )
        distance = (((a[:, None] - b[None]) / length) ** 2).sum(axis=2)
        covariance = s**2 * np.exp(-0.5 * distance) + (w * a) @ (w * b).T + c**2
        if parameters is not None:
            d, multiplier_length = (
                v[k].double().numpy() for v in (discrepancy.multiplier_stds, discrepancy.multiplier_lengthscales)
            )
            correlation = np.exp(-0.5 * (((a[:, None] - b[None]) / multiplier_length) ** 2).sum(axis=2))
            first_mean, second_mean = (simulated_mean(parameters, v)[k] for v in (first, second))
            covariance = covariance + d**2 * first_mean[:, None] * second_mean * correlation
        found.append(unit**2 * covariance)
    return np.stack(found)


def discrepancy_alone(x, y, query, discrepancy, noise):
    """Return mean (M, 2), std (M, 2) and covariances (2, M, M) of the discrepancy without a simulator."""
    means, covariances = [], []
    train_query, train_train, query_query = (
        kernel(discrepancy, x, query),
        kernel(discrepancy, x, x),
        kernel(discrepancy, query, query),
    )
    for k, (output_mean, unit) in enumerate(
        zip(UNITS.output_mean.numpy(), UNITS.output_std.double().numpy(), strict=True)
    ):
        train_covariance = train_train[k] + (noise[k] ** 2 + CHOLESKY_JITTER * unit**2) * np.eye(len(x))
        gain = np.linalg.solve(train_covariance, train_query[k]).T
        means.append(output_mean + gain @ (np.asarray(y, dtype=float)[:, k] - output_mean))
        covariances.append(query_query[k] - gain @ train_query[k])
    covariance = np.stack(covariances)
    return np.stack(means, axis=1), np.sqrt(covariance.diagonal(axis1=1, axis2=2).T + noise**2), covariance


def raw_noise(posterior):
    return (posterior.noise_std * UNITS.output_std).double().numpy()


def simulator_and_discrepancy(x, y, query, discrepancy, noise, parameters=None):
    """Return mean (M, 2), std (M, 2) and covariances (2, M, M) of simulator plus discrepancy.

    The outputs share the simulator's parameters, so all outputs are conditioned jointly.
    """
    n, m, units = len(x), len(query), UNITS.output_std.double().numpy()

    def joint(first, second):
        """Return the joint covariance (2 N, 2 M) of both outputs."""
        a, b = (np.concatenate(features(v)) for v in (first, second))
        of_discrepancy = np.zeros((len(a), len(b)))
        if discrepancy is not None:
            for k, block in enumerate(kernel(discrepancy, first, second, parameters)):
                of_discrepancy[k * len(first) : (k + 1) * len(first), k * len(second) : (k + 1) * len(second)] = block
        return a @ b.T + of_discrepancy

    train_covariance = joint(x, x) + np.diag(np.repeat(noise**2 + CHOLESKY_JITTER * units**2, n))
    gain = np.linalg.solve(train_covariance, joint(x, query)).T
    mean = (gain @ np.asarray(y, dtype=float).T.ravel()).reshape(2, m)
    covariance = joint(query, query) - gain @ joint(x, query)
    blocks = np.stack([covariance[k * m : (k + 1) * m, k * m : (k + 1) * m] for k in range(2)])
    return mean.T, np.sqrt(blocks.diagonal(axis1=1, axis2=2).T + noise**2), blocks
