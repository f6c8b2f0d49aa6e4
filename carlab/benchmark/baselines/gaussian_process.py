"""Gaussian process of the discrepancy (scikit-learn); it predicts but names no effect.

Inputs are vx, vy, yaw rate and the acting steering and throttle, outputs the three residual accelerations, as in
learning-based control of race cars (Kabzan et al., 2019, IEEE RA-L 4(4), 3363).
"""

from __future__ import annotations

import warnings

import numpy as np

from carlab.benchmark.baselines.data import Prepared, Steps, held_out_score
from carlab.benchmark.world.simulation import FloatArray

POINTS = 400
TUNED_ON = 150


def gp_score(data: Prepared) -> float:
    """Held-out score of the refitted model with the process's mean added."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    inputs = _inputs(data.steps)
    centre, spread = inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-6)
    rows = np.linspace(0, len(inputs) - 1, min(POINTS, len(inputs))).round().astype(np.int64)
    x = (inputs[rows] - centre) / spread
    some = slice(None, None, max(1, len(rows) // TUNED_ON))
    means = []
    for k in range(3):
        y = data.errors[rows, k] * data.weights[k]
        kernel = ConstantKernel(0.1, (1e-4, 1e2)) * RBF(np.full(5, 2.0), (0.3, 30.0)) + WhiteKernel(1.0, (0.05, 20.0))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a hyperparameter at its bound: an input that does not matter
            tuned = GaussianProcessRegressor(kernel).fit(x[some], y[some]).kernel_
        means.append(GaussianProcessRegressor(tuned, optimizer=None).fit(x, y))

    def correction(steps: Steps) -> FloatArray:
        at = np.clip((_inputs(steps) - centre) / spread, -4.0, 4.0)
        return np.stack([m.predict(at) / w for m, w in zip(means, data.weights, strict=True)], axis=1)

    return held_out_score(data, correction)


def _inputs(steps: Steps) -> FloatArray:
    return np.concatenate([steps.starts[:, 3:], steps.commands().mean(axis=1)], axis=1)
