"""Recursive estimate of a car's disturbances from prediction windows of the past: an extended Kalman filter.

The first n of m disturbances drift: each is an Ornstein-Uhlenbeck process. A window that ends at t measures them by the
prediction error after the window, ``0 = e + J (x - d) + v``, with the error e of a prediction with disturbances d and
its Jacobian J. The covariance of v is ``diag(error_std**2) + J diag(white_std**2) J'``: noise, and white noise on all m
disturbances. v has a Student t distribution, so that a collision moves the estimate little (Roth, Ozkan and Gustafsson
2013, A Student's t filter for heavy tailed process and measurement noise).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.prediction.windows import IndexArray


@dataclass(frozen=True, slots=True)
class Processes:
    """Ornstein-Uhlenbeck processes and noise of C candidates.

    Disturbances are in [1, rad, 1, m/s2, m/s2, rad/s2], the first n drift. Errors are in [m, m, rad, m/s, m/s, rad/s].

    Attributes:
        std: (C, n) stationary standard deviations, also at the start of a recording; 0 for a disturbance that is 0.
        time_constant_s: (C,).
        error_std: (C, 6) of the error after a window in calm driving.
        white_std: (C, m) of the white noise on the disturbances.
        dof: degrees of freedom of the Student t distribution.
    """

    std: FloatArray
    time_constant_s: FloatArray
    error_std: FloatArray
    white_std: FloatArray
    dof: float


@dataclass(frozen=True, slots=True)
class MeasuredWindows:
    """S windows in the order of recording and time, with predictions by C candidates (or one for all).

    Units are those of ``Processes``.

    Attributes:
        recording: (S,) index of the recording.
        end_s: (S,) end of the window since the first row of its recording.
        error: (C, S, 6) predicted minus measured after the window.
        jacobian: (C, S, 6, m) of the error by the disturbances.
        at: (C, S, m) disturbances of the prediction.
    """

    recording: IndexArray
    end_s: FloatArray
    error: FloatArray
    jacobian: FloatArray
    at: FloatArray


@dataclass(frozen=True, slots=True)
class Filtered:
    """Estimates of the n drifting disturbances by C candidates, in the units of ``Processes``.

    Attributes:
        mean: (C, S, n) after each window.
        covariance: (C, S, n, n) after each window.
        predicted: (C, S, n) mean before each window, from earlier windows alone.
        nll: (C, S) negative log-likelihood of each window's error, given earlier windows.
    """

    mean: FloatArray
    covariance: FloatArray
    predicted: FloatArray
    nll: FloatArray


def run_filter(windows: MeasuredWindows, processes: Processes) -> Filtered:
    """Filter the windows of each recording, from the stationary distribution on."""
    candidates, size = processes.std.shape
    count = len(windows.end_s)
    shape = (candidates, count, size)
    found = Filtered(np.zeros(shape), np.zeros((*shape, size)), np.zeros(shape), np.zeros(shape[:2]))
    stationary = processes.std[:, :, None] ** 2 * np.eye(size)
    mean, covariance = np.zeros((candidates, size)), stationary
    for k in range(count):
        if k == 0 or windows.recording[k] != windows.recording[k - 1]:
            mean, covariance = np.zeros((candidates, size)), stationary
        else:
            decay = np.exp(-(windows.end_s[k] - windows.end_s[k - 1]) / processes.time_constant_s)[:, None]
            mean = decay * mean
            covariance = decay[:, :, None] ** 2 * (covariance - stationary) + stationary
        found.predicted[:, k] = mean
        jacobian = windows.jacobian[:, k]
        offset = mean - windows.at[:, k, :size]
        innovation = -(windows.error[:, k] + np.einsum("cij,cj->ci", jacobian[..., :size], offset))
        noise = _error_covariance(jacobian, processes)
        mean, covariance, found.nll[:, k] = _update(
            mean, covariance, jacobian[..., :size], innovation, noise, processes.dof
        )
        found.mean[:, k], found.covariance[:, k] = mean, covariance
    return found


def _error_covariance(jacobian: FloatArray, processes: Processes) -> FloatArray:
    """Covariance (C, 6, 6) of the error v after a window with ``jacobian`` (C or 1, 6, m)."""
    spread = jacobian * processes.white_std[:, None, :]
    return np.asarray(spread @ spread.swapaxes(1, 2) + processes.error_std[:, :, None] ** 2 * np.eye(6))


def _update(
    mean: FloatArray,
    covariance: FloatArray,
    jacobian: FloatArray,
    innovation: FloatArray,
    noise: FloatArray,
    dof: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (C, n), covariance (C, n, n) and negative log-likelihood (C,) after a window.

    Args:
        mean: (C, n) before the window.
        covariance: (C, n, n) before the window.
        jacobian: (C, 6, n) of the error.
        innovation: (C, 6) minus the error at ``mean``.
        noise: (C, 6, 6) covariance of v.
        dof: degrees of freedom.
    """
    channels = innovation.shape[-1]
    cross = jacobian @ covariance
    spread = cross @ jacobian.swapaxes(1, 2)
    total = spread + noise
    distance_sq = np.einsum("ci,ci->c", innovation, np.linalg.solve(total, innovation[..., None])[..., 0])
    nll = 0.5 * np.linalg.slogdet(total)[1] + 0.5 * (dof + channels) * np.log1p(distance_sq / dof)
    nll += 0.5 * channels * math.log(dof * math.pi) + math.lgamma(0.5 * dof) - math.lgamma(0.5 * (dof + channels))
    weight = (dof + channels) / (dof + distance_sq)
    gain = np.linalg.solve(spread + noise / weight[:, None, None], cross).swapaxes(1, 2)
    updated = mean + np.einsum("cni,ci->cn", gain, innovation)
    reduced = covariance - gain @ cross
    return updated, 0.5 * (reduced + reduced.swapaxes(1, 2)), np.asarray(nll)
