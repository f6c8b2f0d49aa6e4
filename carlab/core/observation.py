"""The encoder of the inputs of policies and models; environments, policies, data sets and learned worlds use it.

Features, shape (..., 7 + 2 H): ``[x, y, sin yaw, cos yaw, vx, vy, yaw_rate, a(t-H) ... a(t-1)]`` with poses in ``map``,
velocities in the body frame, SI units, and the last H actions sent, oldest first (H = 3 in Rothfuss et al.,
arXiv 2403.16644). The row after tick t ends in the action sent at t.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace

from carlab.core.quantities import Action, FloatArray

STATE_FEATURES = 7
ACTION_SIZE = 2


def feature_size(history_length: int) -> int:
    """Number of features for a history of H actions."""
    return STATE_FEATURES + ACTION_SIZE * history_length


def encode(state: Any, history: Any) -> Any:
    """Encode states (..., 6) and action histories (..., H, 2) into features (..., 7 + 2 H); NumPy or torch."""
    xp = array_namespace(state)
    yaw = state[..., 2:3]
    flat = xp.reshape(history, (*history.shape[:-2], history.shape[-2] * ACTION_SIZE))
    return xp.concat([state[..., :2], xp.sin(yaw), xp.cos(yaw), state[..., 3:], flat], axis=-1)


def decode_state(features: Any) -> Any:
    """States (..., 6) of features (..., 7 + 2 H); yaw in [-pi, pi]. NumPy or torch."""
    xp = array_namespace(features)
    yaw = xp.atan2(features[..., 2:3], features[..., 3:4])
    return xp.concat([features[..., :2], yaw, features[..., 4:STATE_FEATURES]], axis=-1)


def decode_history(features: Any) -> Any:
    """Action history (..., H, 2), oldest first, of features (..., 7 + 2 H)."""
    xp = array_namespace(features)
    flat = features[..., STATE_FEATURES:]
    return xp.reshape(flat, (*flat.shape[:-1], flat.shape[-1] // ACTION_SIZE, ACTION_SIZE))


def episode_features(states: FloatArray, sent: FloatArray, history_length: int) -> FloatArray:
    """Features (T + 1, 7 + 2 H) of an episode's states (T + 1, 6) and sent actions (T, 2), neutral before the first."""
    padded = np.concatenate([np.zeros((history_length, ACTION_SIZE)), sent])
    rows = np.arange(len(states))[:, None] + np.arange(history_length)
    features: FloatArray = encode(states, padded[rows])
    return features


def push_action(history: Any, action: Any) -> Any:
    """Append ``action`` (..., 2) to a history (..., H, 2) and drop the oldest action. NumPy or torch."""
    if history.shape[-2] == 0:
        return history
    xp = array_namespace(history)
    return xp.concat([history[..., 1:, :], action[..., None, :]], axis=-2)


class ActionHistory:
    """The last H actions sent, oldest first; neutral before the first."""

    def __init__(self, length: int) -> None:
        self._rows: FloatArray = np.zeros((length, ACTION_SIZE))

    def reset(self) -> None:
        """Reset to neutral."""
        self._rows = np.zeros_like(self._rows)

    def push(self, action: Action) -> None:
        """Append the action that was sent."""
        self._rows = push_action(self._rows, action.to_array())

    @property
    def rows(self) -> FloatArray:
        """The history (H, 2), a copy."""
        return self._rows.copy()
