"""Faults of poses: repeated rows, rows off the path, a pose that stands still while the car moves."""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.faults.robust import robust_std, runs
from carlab.recording.faults.settings import LIMITS
from carlab.recording.pose_velocity import BoolArray


def stale_rows(t_s: FloatArray, pose: FloatArray) -> BoolArray:
    """Rows (N,) that repeat the pose before to the last digit although the car moves, by the distance to the next pose.

    ``pose`` (N, 3) is x, y [m], yaw [rad].
    """
    same = np.concatenate([[False], (np.diff(pose, axis=0) == 0.0).all(axis=1)])
    stale = np.zeros(len(same), dtype=bool)
    for first, last in runs(same):
        if last >= len(same):
            break
        elapsed = t_s[last] - t_s[first - 1]
        stale[first:last] = np.hypot(*(pose[last, :2] - pose[first - 1, :2])) > LIMITS.stale_mps * elapsed
    return stale


def rows_off_path(t_s: FloatArray, pose: FloatArray) -> BoolArray:
    """Rows (N,) whose pose (N, 3) is far from a local cubic through the neighbours. The worst row is removed first.

    No row is returned if more than a share ``outlier_share`` would be, or if a run of them leaves too few neighbours:
    its ends are jumps of the pose.
    """
    reach, rows = LIMITS.outlier_neighbours, len(pose)
    pose = pose.copy()
    pose[:, 2] = np.unwrap(pose[:, 2])
    offsets = np.concatenate([np.arange(-reach, 0), np.arange(1, reach + 1)])
    weights = np.linalg.pinv(np.vander(offsets.astype(np.float64), 4, increasing=True))[0]
    off_path = np.zeros(rows, dtype=bool)
    inner = _evenly_spaced_rows(t_s, reach)
    if len(inner) < 50:
        return off_path

    def miss(at: np.ndarray) -> FloatArray:
        """Errors (n, 3) of x, y [m] and yaw [rad] at the rows ``at`` (n,)."""
        return np.asarray(pose[at] - np.einsum("j,nji->ni", weights, pose[at[:, None] + offsets]))

    error = miss(inner)
    sigma = np.array([max(robust_std(error[:, 0]), robust_std(error[:, 1])), robust_std(error[:, 2])])
    limit = np.maximum(LIMITS.outlier_sigmas * sigma, [LIMITS.outlier_m, LIMITS.outlier_rad])
    ratio = _largest_ratio(error, limit)
    for _ in range(max(int(rows * LIMITS.outlier_share), 5)):
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 1.0:
            return off_path
        row = int(inner[worst])
        off_path[row] = True
        good = [k for k in range(row - 2 * reach, row + 2 * reach + 1) if 0 <= k < rows and not off_path[k]]
        if len(good) < 4:
            return np.zeros(rows, dtype=bool)
        design = np.vander((np.array(good) - row) / reach, min(3, len(good) - 2) + 1, increasing=True)
        pose[row] = np.linalg.lstsq(design, pose[good], rcond=None)[0][0]
        near = np.flatnonzero(np.abs(inner - row) <= reach)
        ratio[near] = _largest_ratio(miss(inner[near]), limit)
        ratio[worst] = 0.0
    return np.zeros(rows, dtype=bool)


def _evenly_spaced_rows(t_s: FloatArray, reach: int) -> np.ndarray:
    """Indices of the rows whose ``reach`` neighbours on either side are evenly spaced."""
    step = np.diff(t_s)
    period = float(np.median(step))
    even = np.concatenate([[False], np.abs(step - period) < 0.5 * period])
    inner = np.all([np.roll(even, -k) for k in range(-reach + 1, reach + 1)], axis=0)
    inner[:reach] = inner[-reach:] = False
    return np.flatnonzero(inner)


def _largest_ratio(error: FloatArray, limit: FloatArray) -> FloatArray:
    """Larger of position error and yaw error over their limits (2,); ``error`` (n, 3) of x, y, yaw. Shape (n,)."""
    position, yaw = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    return np.asarray(np.maximum(position / limit[0], yaw / limit[1]))


def frozen_rows(t_s: FloatArray, state: FloatArray, sensor: FloatArray, threshold: float) -> BoolArray:
    """Rows (N,) in which the pose stands still for half a second while a sensor of that motion exceeds a threshold.

    Half a second is longer than the lag of such a sensor (0.1 to 0.2 s) when the car stops. ``state`` (N,) is the
    velocity of the pose that the sensor (N,) measures, in m/s or rad/s.
    """
    frozen = np.zeros(len(t_s), dtype=bool)
    for first, last in runs((np.abs(state) < 0.02) & (np.abs(sensor) > threshold)):
        frozen[first:last] = t_s[last - 1] - t_s[first] >= 0.5
    return frozen
