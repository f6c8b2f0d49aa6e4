"""What a simulator with given numbers predicts for shots, for many sets of numbers at once.

Time is that of the recording: motion capture is ``latency`` old, so seen from it every command acts that much later.
Effects on what is measured are undone at the start of a shot and done again along it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from carlab.core.quantities import FloatArray
from carlab.diagnosis.shots import Shots
from sim_backends.batch_rollout import rollout
from sim_backends.car_parameters import SimulatorConfig

LATENCY = "effects.mocap_latency.latency"
FILTER = "effects.velocity_filter_lag.time_constant"
AHEAD, LEFT = "effects.marker_offset.ahead", "effects.marker_offset.left"
TURNED = "effects.mocap_yaw_misalignment.angle"
SCALE = "effects.position_scale.scale"
OBSERVED = (LATENCY, FILTER, AHEAD, LEFT, TURNED, SCALE)
DELAY = "timing.command_delay"
STEP_S = 0.017
"""Longest step of the integration: at 30 Hz its error stays within a hundredth of a noise floor."""
_OBSERVATION_EFFECTS = (
    "mocap_latency",
    "velocity_filter_lag",
    "marker_offset",
    "mocap_yaw_misalignment",
    "position_scale",
)
_LENGTHS = (0, 1, 3, 4)


@dataclass(frozen=True, slots=True)
class Predictor:
    """Predicts shots with the simulator ``config``; its observation effects are taken care of here."""

    shots: Shots
    config: SimulatorConfig
    max_step_s: float = STEP_S

    def __call__(self, values: Mapping[str, FloatArray] | None = None) -> FloatArray:
        """Predict with P sets of numbers.

        Args:
            values: by dotted name, each (P,); numbers that are not given are those of the simulator.

        Returns:
            Predicted measurements (P, S, K + 1, 6): x, y, yaw in the recording's frame, vx, vy, yaw rate.
        """
        given = {name: np.atleast_1d(np.asarray(value, dtype=np.float64)) for name, value in (values or {}).items()}
        sets = max((len(v) for v in given.values()), default=1)
        numbers: dict[str, float | FloatArray] = {**self.config.values(), **given}
        seen = {name: _broadcast(numbers.get(name, 0.0), sets) for name in OBSERVED}
        latency = seen[LATENCY] if LATENCY in numbers else _broadcast(numbers["mocap.latency"], sets)
        inner = {n: _broadcast(v, sets) for n, v in given.items() if n not in OBSERVED and not n.startswith("mocap.")}
        inner[DELAY] = np.maximum(_broadcast(numbers[DELAY], sets) + latency, 0.0)
        effects = {name: v for name, v in self.config.effects.items() if name not in _OBSERVATION_EFFECTS}
        config = replace(self.config, effects=effects, control_period_s=self.shots.period_s, priors={}, doubts={})
        count = len(self.shots)

        def tensor(array: FloatArray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))

        start = _undone(self.shots.start, seen)
        states = rollout(
            config,
            tensor(start.reshape(-1, 6)),
            tensor(np.tile(self.shots.commands, (sets, 1, 1))),
            history=tensor(np.tile(self.shots.history, (sets, 1, 1))),
            values={name: tensor(np.repeat(v, count)) for name, v in inner.items()},
            t0_s=tensor(np.tile(self.shots.t0_s, sets)),
            max_step_s=self.max_step_s,
        ).states
        out = states.numpy().astype(np.float64).reshape(sets, count, self.shots.steps + 1, 6)
        return self._done(out, seen)

    def _done(self, states: FloatArray, seen: Mapping[str, FloatArray]) -> FloatArray:
        """What motion capture makes of true states (P, S, K + 1, 6)."""
        ahead, left, turned = (seen[name][:, None, None] for name in (AHEAD, LEFT, TURNED))
        if np.any(ahead) or np.any(left):
            sin, cos = np.sin(states[..., 2]), np.cos(states[..., 2])
            rate = states[..., 5]
            states[..., 0] += cos * ahead - sin * left
            states[..., 1] += sin * ahead + cos * left
            states[..., 3] -= left * rate
            states[..., 4] += ahead * rate
        scale = seen[SCALE]
        if np.any(scale):
            states[..., _LENGTHS] *= (1.0 + scale)[:, None, None, None]
        if np.any(turned):
            sin, cos = np.sin(turned), np.cos(turned)
            vx, vy = states[..., 3].copy(), states[..., 4].copy()
            states[..., 2] += turned
            states[..., 3] = cos * vx + sin * vy
            states[..., 4] = cos * vy - sin * vx
        if self.shots.smear_s2 > 0.0:
            states[..., 3:] += 0.5 * self.shots.smear_s2 * bend_of(states, self.shots.period_s)
        lag = seen[FILTER]
        if np.any(lag > 0):
            self._filter(states, lag)
        return states

    def _filter(self, states: FloatArray, lag_s: FloatArray) -> None:
        """First-order lag on velocities, exact for straight lines between ticks, started in the past of the shot."""
        dt = self.shots.period_s
        span = dt / np.maximum(lag_s, 1e-9)
        decay = np.exp(-span)[:, None, None]
        ramp = (1.0 - (1.0 - np.exp(-span)) / span)[:, None, None]
        past = self.shots.before[None, :, :, 3:]
        out = np.repeat(past[:, :, 0], len(lag_s), axis=0)
        inputs = [past[:, :, k] for k in range(past.shape[2])]
        previous = inputs[0]
        for value in inputs[1:]:
            out = out * decay + (1.0 - decay) * previous + ramp * (value - previous)
            previous = value
        for k in range(states.shape[2]):
            value = states[:, :, k, 3:].copy()
            out = out * decay + (1.0 - decay) * previous + ramp * (value - previous)
            previous = value
            states[:, :, k, 3:] = out


def bend_of(states: FloatArray, period_s: float) -> FloatArray:
    """Second derivative (..., K + 1, 3) of the velocities of (..., K + 1, 6) in the world, turned into the body frame.

    From central differences; 0 at both ends.
    """
    turn = np.diff(states[..., 2], axis=-1)
    cos, sin = np.cos(turn), np.sin(turn)
    vx, vy, rate = states[..., 3], states[..., 4], states[..., 5]
    bend = np.zeros((*states.shape[:-1], 3))
    # The velocities of the next and of the last tick as the body sees them now.
    bend[..., 1:-1, 0] = cos[..., 1:] * vx[..., 2:] - sin[..., 1:] * vy[..., 2:] - 2.0 * vx[..., 1:-1]
    bend[..., 1:-1, 1] = sin[..., 1:] * vx[..., 2:] + cos[..., 1:] * vy[..., 2:] - 2.0 * vy[..., 1:-1]
    bend[..., 1:-1, 0] += cos[..., :-1] * vx[..., :-2] + sin[..., :-1] * vy[..., :-2]
    bend[..., 1:-1, 1] += cos[..., :-1] * vy[..., :-2] - sin[..., :-1] * vx[..., :-2]
    bend[..., 1:-1, 2] = rate[..., 2:] - 2.0 * rate[..., 1:-1] + rate[..., :-2]
    return bend / period_s**2


def _broadcast(value: float | FloatArray, sets: int) -> FloatArray:
    return np.broadcast_to(np.asarray(value, dtype=np.float64).reshape(-1), (sets,)).copy()


def _undone(start: FloatArray, seen: Mapping[str, FloatArray]) -> FloatArray:
    """True states (P, S, 6) that are measured as ``start`` (S, 6)."""
    ahead, left, turned = (seen[name][:, None] for name in (AHEAD, LEFT, TURNED))
    true = np.repeat(start[None], len(seen[AHEAD]), axis=0)
    if np.any(turned):
        sin, cos = np.sin(turned), np.cos(turned)
        vx, vy = true[..., 3].copy(), true[..., 4].copy()
        true[..., 2] -= turned
        true[..., 3] = cos * vx - sin * vy
        true[..., 4] = sin * vx + cos * vy
    if np.any(seen[SCALE]):
        true[..., _LENGTHS] /= (1.0 + seen[SCALE])[:, None, None]
    if np.any(ahead) or np.any(left):
        sin, cos = np.sin(true[..., 2]), np.cos(true[..., 2])
        true[..., 0] -= cos * ahead - sin * left
        true[..., 1] -= sin * ahead + cos * left
        true[..., 3] += left * true[..., 5]
        true[..., 4] -= ahead * true[..., 5]
    return true


def errors(predicted: FloatArray, shots: Shots) -> FloatArray:
    """Predicted minus measured (P, S, K + 1, 6): x, y in the body frame of each shot's start, the rest as it is."""
    error = predicted - shots.measured[None]
    sin, cos = np.sin(shots.start[:, 2])[None, :, None], np.cos(shots.start[:, 2])[None, :, None]
    dx, dy = error[..., 0].copy(), error[..., 1].copy()
    error[..., 0] = cos * dx + sin * dy
    error[..., 1] = cos * dy - sin * dx
    return error
