"""Recursive estimate of a car's disturbances from prediction windows of the past: an extended Kalman filter.

The state x holds independent Ornstein-Uhlenbeck processes: a slow one of each drifting number, and a short one of each
force on the body. Each disturbance of the simulator is a sum of such processes. A window that ends at t measures the
disturbances through the prediction error after the window, ``0 = e + J (H x - d) + v``, with the error e and its
Jacobian J at the disturbances d. The error v has a Student t distribution, so that a collision moves the estimate
little (Roth, Ozkan and Gustafsson 2013, A Student's t filter for heavy tailed process and measurement noise).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.prediction.windows import IndexArray


@dataclass(frozen=True, slots=True)
class Processes:
    """n Ornstein-Uhlenbeck processes for each of C candidates.

    Attributes:
        std: (C, n) stationary standard deviations, also at the start of a recording.
        time_constant_s: (C, n).
        error_covariance: (C, 6, 6) of the error v after a window.
        sums: (m, n) matrix H: the m disturbances as sums of processes.
        dof: degrees of freedom of the Student t distribution of v.
    """

    std: FloatArray
    time_constant_s: FloatArray
    error_covariance: FloatArray
    sums: FloatArray
    dof: float

    def decay(self, elapsed_s: float) -> FloatArray:
        """Factors (C, n) of the means after a time."""
        return np.asarray(np.exp(-elapsed_s / self.time_constant_s))


@dataclass(frozen=True, slots=True)
class MeasuredWindows:
    """S windows in the order of recording and time.

    Attributes:
        recording: (S,) index of the recording.
        end_s: (S,) end of the window since the first row of its recording.
        error: (S, 6) predicted minus measured after the window.
        jacobian: (S, 6, m) of the error by the disturbances.
        at: (S, m) disturbances of the prediction.
    """

    recording: IndexArray
    end_s: FloatArray
    error: FloatArray
    jacobian: FloatArray
    at: FloatArray


@dataclass(frozen=True, slots=True)
class Filtered:
    """Estimates of C candidates.

    Attributes:
        mean: (S, C, n) after each window.
        covariance: (S, C, n, n) after each window.
        predicted: (S, C, n) mean before each window, from earlier windows alone.
        nll: (S, C) negative log-likelihood of each window's error, given earlier windows.
    """

    mean: FloatArray
    covariance: FloatArray
    predicted: FloatArray
    nll: FloatArray


def run_filter(windows: MeasuredWindows, processes: Processes) -> Filtered:
    """Filter the windows of each recording from the stationary distribution on."""
    candidates, size = processes.std.shape
    count = len(windows.end_s)
    found = Filtered(
        np.zeros((count, candidates, size)),
        np.zeros((count, candidates, size, size)),
        np.zeros((count, candidates, size)),
        np.zeros((count, candidates)),
    )
    stationary = processes.std[:, :, None] ** 2 * np.eye(size)
    mean, covariance = np.zeros((candidates, size)), stationary
    for k in range(count):
        if k == 0 or windows.recording[k] != windows.recording[k - 1]:
            mean, covariance = np.zeros((candidates, size)), stationary
        else:
            decay = processes.decay(float(windows.end_s[k] - windows.end_s[k - 1]))
            mean = decay * mean
            covariance = decay[:, :, None] * (covariance - stationary) * decay[:, None, :] + stationary
        found.predicted[k] = mean
        jacobian = windows.jacobian[k] @ processes.sums
        innovation = -(windows.error[k] + (mean @ processes.sums.T - windows.at[k]) @ windows.jacobian[k].T)
        mean, covariance, found.nll[k] = _update(mean, covariance, jacobian, innovation, processes)
        found.mean[k], found.covariance[k] = mean, covariance
    return found


def _update(
    mean: FloatArray, covariance: FloatArray, jacobian: FloatArray, innovation: FloatArray, processes: Processes
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (C, n), covariance (C, n, n) and negative log-likelihood (C,) after a window with ``jacobian`` (6, n)."""
    dof, channels = processes.dof, innovation.shape[-1]
    cross = covariance @ jacobian.T
    spread = jacobian @ cross
    total = spread + processes.error_covariance
    distance_sq = np.einsum("ci,ci->c", innovation, np.linalg.solve(total, innovation[..., None])[..., 0])
    nll = 0.5 * np.linalg.slogdet(total)[1] + 0.5 * (dof + channels) * np.log1p(distance_sq / dof)
    nll += 0.5 * channels * math.log(dof * math.pi) + math.lgamma(0.5 * dof) - math.lgamma(0.5 * (dof + channels))
    weight = (dof + channels) / (dof + distance_sq)
    total = spread + processes.error_covariance / weight[:, None, None]
    gain = np.linalg.solve(total, cross.swapaxes(1, 2)).swapaxes(1, 2)
    updated = mean + np.einsum("cni,ci->cn", gain, innovation)
    reduced = covariance - gain @ cross.swapaxes(1, 2)
    return updated, 0.5 * (reduced + reduced.swapaxes(1, 2)), np.asarray(nll)
