"""Ensembles of small networks, trained on prediction windows with a multi-step loss: a black box, or a discrepancy.

A black box has no physics, so its error shows how much of a recording can be predicted from past commands and
velocities at all. Each network maps past commands and the body velocities of the last rows to accelerations; the loss
is the error of a whole window (simulation error training; Forgione and Piga 2021, "Continuous-time system
identification with neural networks: Model structures and fitting criteria").

A learned discrepancy is the same ensemble with a simulator: its networks also see the simulated velocities, and their
output is added to the simulated accelerations (an additive model discrepancy; Kennedy and O'Hagan 2001, "Bayesian
calibration of computer models").
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from carlab.core.errors import DataError
from carlab.core.planar import to_world
from carlab.core.quantities import FloatArray
from carlab.core.robust import STD_OVER_MAD
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import ConstantVelocity, PredictiveModel
from carlab.prediction.windows import PredictionWindows, RecordingSegment, cut_windows

Progress = Callable[[str, float], None]
Weights = tuple[torch.Tensor, ...]


@dataclass(frozen=True, slots=True)
class EnsembleSettings:
    """Size and training of the networks. Chosen on the first two thirds of one real recording (ETH train_1)."""

    n_networks: int = 3
    """Networks of the ensemble; their mean path is the prediction."""
    hidden_units: int = 64
    """Units of each of the two hidden layers."""
    past_s: float = 0.35
    """Length [s] of the past commands: the delays and lags of small cars are below 0.2 s."""
    velocity_rows: int = 3
    """Rows of body velocities, the present one included: their differences show the state of servo and motor."""
    updates: int = 3000
    """Gradient steps: about two minutes on one core."""
    batch_windows: int = 128
    """Windows of a gradient step."""
    learning_rate: float = 3e-3
    """Initial learning rate of AdamW, with cosine decay."""
    weight_decay: float = 1e-4
    """Weight decay of AdamW."""
    horizon_s: float = 1.0
    """Length [s] of the training windows."""
    stride_s: float = 0.1
    """Time [s] between the starts of training windows."""
    validation_share: float = 0.15
    """Share of the blocks for early stopping."""
    check_every: int = 150
    """Updates between two checks on the validation blocks."""
    min_duration_s: float = 60.0
    """Minimum driving time [s] to train on: a network cannot learn a car from less."""
    huber_delta: float = 1.0
    """Error, over that of the constant-velocity baseline, from which the loss is linear."""


@dataclass(frozen=True, slots=True)
class NetworkEnsemble:
    """A trained ensemble; a ``PredictiveModel``.

    Attributes:
        weights: per layer, weights (E, inputs, outputs) and biases (E, 1, outputs) of E networks.
        period_s: step of the windows.
        past_rows: past commands that the networks use.
        velocity_rows: rows of body velocities that the networks use.
        input_mean, input_std: (inputs,) standardisation.
        output_std: (3,) unit of the accelerations [m/s2, m/s2, rad/s2].
        simulator: the model whose accelerations the networks correct; None for a black box.
    """

    weights: Weights
    period_s: float
    past_rows: int
    velocity_rows: int
    input_mean: torch.Tensor
    input_std: torch.Tensor
    output_std: torch.Tensor
    simulator: PredictiveModel | None = None

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """Mean path (S, K + 1, 6) of the networks. Raises DataError for windows with another period."""
        if not math.isclose(windows.period_s, self.period_s, rel_tol=0.02):
            raise DataError(
                f"The network was trained at {1 / self.period_s:.1f} Hz and the windows have "
                f"{1 / windows.period_s:.1f} Hz; train it on recordings with the same rate."
            )
        with torch.no_grad():
            paths = _paths(self, _inputs(windows, self, _simulated(self.simulator, windows)))
        mean = paths.mean(dim=0).double().numpy()
        return _in_world(mean, windows)


@dataclass(frozen=True, slots=True)
class _Inputs:
    """Commands (S, P + K, 2) with P past rows, velocities (S, V, 3) up to the start, simulated ones (S, K + 1, 3)."""

    commands: torch.Tensor
    velocities: torch.Tensor
    simulated: torch.Tensor | None


def check_duration(segments: Sequence[RecordingSegment], settings: EnsembleSettings) -> None:
    """Raise DataError if the recordings are too short to train on."""
    seconds = sum(segment.duration_s for segment in segments)
    if seconds < settings.min_duration_s:
        raise DataError(
            f"The recordings to fit contain {seconds:.0f} s of driving; a network needs at least "
            f"{settings.min_duration_s:.0f} s. Record more, or omit --ceiling and --discrepancy."
        )


def train_ensemble(
    segments: Sequence[RecordingSegment],
    settings: EnsembleSettings | None = None,
    *,
    simulator: PredictiveModel | None = None,
    seed: int = 0,
    velocity_window_s2: float = 0.0,
    progress: Progress = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> NetworkEnsemble:
    """Train an ensemble on the windows of recorded segments.

    Args:
        segments: recordings to fit, at least ``settings.min_duration_s`` in all.
        settings: sizes and training.
        simulator: model whose discrepancy the networks learn; without it they are a black box.
        seed: seed of initial weights, batches and validation blocks.
        velocity_window_s2: variance [s2] of the velocity window, for the initial states.
        progress: callback with the activity and the completed share in [0, 1].
        stop: callback; if it returns true, the best networks so far are returned.

    Raises:
        DataError: too little driving, or the car moves in no window.
    """
    settings = settings or EnsembleSettings()
    check_duration(segments, settings)
    windows = cut_windows(segments, settings.horizon_s, settings.stride_s)
    windows = replace(windows, velocity_window_s2=velocity_window_s2)
    return _Training(windows, settings, simulator, seed).run(progress, stop)


@dataclass(slots=True)
class _Training:
    """Training of one ensemble."""

    windows: PredictionWindows
    settings: EnsembleSettings
    simulator: PredictiveModel | None
    seed: int
    _best: tuple[float, Weights] = field(init=False, default=(math.inf, ()))

    def run(self, progress: Progress, stop: Callable[[], bool]) -> NetworkEnsemble:
        settings, windows = self.settings, self.windows
        generator = torch.Generator().manual_seed(self.seed)
        simulated = _simulated(self.simulator, windows)
        model = self._initial(generator, simulated)
        validates = _validation(windows, settings.validation_share, self.seed)
        target = _target(windows)
        scale = _scale(windows.take(~validates))
        inputs = _inputs(windows, model, simulated)
        rows = torch.from_numpy(np.flatnonzero(~validates))
        held_rows = torch.from_numpy(np.flatnonzero(validates))
        optimiser = torch.optim.AdamW(model.weights, settings.learning_rate, weight_decay=settings.weight_decay)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.updates)
        for update in range(settings.updates):
            if stop():
                break
            if update % settings.check_every == 0:
                self._check(model, inputs, target, scale, held_rows)
                progress(f"training {self._name}", update / settings.updates)
            batch = rows[torch.randint(len(rows), (settings.batch_windows,), generator=generator)]
            steps = _curriculum(update / settings.updates, windows.steps)
            loss = self._loss(model, inputs, target, scale, batch, steps).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(model.weights, 1.0)
            optimiser.step()
            schedule.step()
        self._check(model, inputs, target, scale, held_rows)
        return replace(model, weights=self._best[1])

    @property
    def _name(self) -> str:
        return "the black box" if self.simulator is None else "the discrepancy"

    def _initial(self, generator: torch.Generator, simulated: FloatArray | None) -> NetworkEnsemble:
        settings, windows = self.settings, self.windows
        past = min(max(round(settings.past_s / windows.period_s), 1), windows.past_commands.shape[1])
        n_inputs = 3 * settings.velocity_rows + 2 * (past + 1) + (0 if simulated is None else 6)
        sizes = (n_inputs, settings.hidden_units, settings.hidden_units, 3)
        weights: list[torch.Tensor] = []
        for layer, (before, after) in enumerate(itertools.pairwise(sizes)):
            gain = 0.1 if layer == 2 else 1.0
            drawn = torch.randn(settings.n_networks, before, after, generator=generator) * gain / math.sqrt(before)
            zeros = torch.zeros(settings.n_networks, 1, after)
            weights += [drawn.requires_grad_(), zeros.requires_grad_()]
        velocities = windows.measured[..., 3:].reshape(-1, 3)
        commands = windows.commands.reshape(-1, 2)
        repeats = ((velocities, settings.velocity_rows), (commands, past + 1))
        input_mean = np.concatenate([np.tile(a.mean(axis=0), n) for a, n in repeats])
        input_std = np.concatenate([np.tile(np.maximum(a.std(axis=0), 1e-3), n) for a, n in repeats])
        rate = np.diff(windows.measured[..., 3:], axis=1) / windows.period_s
        if simulated is not None:
            error_std, rate_std = _simulated_std(windows, simulated)
            input_mean = np.concatenate([input_mean, np.zeros(6)])
            input_std = np.concatenate([input_std, error_std, rate_std])
        unit = np.maximum(STD_OVER_MAD * np.median(np.abs(rate), axis=(0, 1)), 1e-2)
        mean, std, output = (torch.from_numpy(v).float() for v in (input_mean, input_std, unit))
        rows = settings.velocity_rows
        return NetworkEnsemble(tuple(weights), windows.period_s, past, rows, mean, std, output, self.simulator)

    def _loss(
        self,
        model: NetworkEnsemble,
        inputs: _Inputs,
        target: torch.Tensor,
        scale: torch.Tensor,
        rows: torch.Tensor,
        steps: int,
    ) -> torch.Tensor:
        """Huber loss (E,) over the first ``steps`` steps of windows."""
        count = inputs.commands.shape[1] - target.shape[1] + 1 + steps
        simulated = None if inputs.simulated is None else inputs.simulated[rows, : steps + 1]
        chosen = _Inputs(inputs.commands[rows, :count], inputs.velocities[rows], simulated)
        white = (_paths(model, chosen)[:, :, 1:] - target[rows, 1 : steps + 1]) / scale[1 : steps + 1]
        delta = self.settings.huber_delta
        size = white.abs()
        loss = torch.where(size <= delta, 0.5 * white**2, delta * size - 0.5 * delta**2)
        return loss.mean(dim=(1, 2, 3))

    def _check(
        self, model: NetworkEnsemble, inputs: _Inputs, target: torch.Tensor, scale: torch.Tensor, rows: torch.Tensor
    ) -> None:
        """Keep the weights with the smallest loss on the validation blocks."""
        with torch.no_grad():
            loss = float(self._loss(model, inputs, target, scale, rows, target.shape[1] - 1).mean())
        if loss < self._best[0]:
            self._best = (loss, tuple(w.detach().clone() for w in model.weights))


def _curriculum(share: float, steps: int) -> int:
    """Steps of the training windows: a third at first, all of them from half of the training on."""
    return min(steps, max(2, round(steps * (1.0 / 3.0 + 4.0 / 3.0 * share))))


def _paths(model: NetworkEnsemble, inputs: _Inputs) -> torch.Tensor:
    """Paths (E, S, K + 1, 6) of each network from the origin; K is the number of commands after the past ones."""
    networks = model.weights[0].shape[0]
    velocities = inputs.velocities.expand(networks, -1, -1, -1)
    now = velocities[:, :, -1]
    recent = [velocities[:, :, k] for k in range(velocities.shape[2])]
    commands = inputs.commands.expand(networks, -1, -1, -1)
    pose = torch.zeros_like(now)
    path = [torch.cat([pose, now], dim=-1)]
    step_s = model.period_s
    for k in range(commands.shape[2] - model.past_rows):
        past = commands[:, :, k : k + model.past_rows + 1].flatten(2)
        change = torch.zeros_like(now)
        known = [*recent, past]
        if inputs.simulated is not None:
            change = (inputs.simulated[:, k + 1] - inputs.simulated[:, k]).expand_as(now)
            known += [now - inputs.simulated[:, k], change / step_s]
        features = (torch.cat(known, dim=-1) - model.input_mean) / model.input_std
        after = now + change + step_s * model.output_std * _network(model.weights, features)
        mean = 0.5 * (now + after)
        yaw = pose[..., 2] + 0.5 * step_s * mean[..., 2]
        rate = torch.stack(to_world(mean[..., 0], mean[..., 1], yaw), dim=-1)
        pose = pose + step_s * torch.cat([rate, mean[..., 2:]], dim=-1)
        now = after
        recent = [*recent[1:], now]
        path.append(torch.cat([pose, now], dim=-1))
    return torch.stack(path, dim=2)


def _network(weights: Weights, features: torch.Tensor) -> torch.Tensor:
    for k in range(0, len(weights) - 2, 2):
        features = torch.tanh(torch.baddbmm(weights[k + 1], features, weights[k]))
    return torch.baddbmm(weights[-1], features, weights[-2])


def _simulated(simulator: PredictiveModel | None, windows: PredictionWindows) -> FloatArray | None:
    """Simulated velocities (S, K + 1, 3); None without a simulator."""
    return None if simulator is None else simulator.predict(windows)[..., 3:]


def _simulated_std(windows: PredictionWindows, simulated: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale (3,) of the simulator's velocity errors, and of its accelerations."""
    error, rate = windows.measured[..., 3:] - simulated, np.diff(simulated, axis=1) / windows.period_s
    return np.maximum(error.std(axis=(0, 1)), 1e-3), np.maximum(rate.std(axis=(0, 1)), 1e-2)


def _inputs(windows: PredictionWindows, model: NetworkEnsemble, simulated: FloatArray | None) -> _Inputs:
    past = windows.past_commands[:, windows.past_commands.shape[1] - model.past_rows :]
    commands = np.concatenate([past, windows.commands], axis=1)
    before = windows.past_states[:, windows.past_states.shape[1] - model.velocity_rows + 1 :, 3:]
    velocities = np.concatenate([before, windows.initial_states[:, None, 3:]], axis=1)

    def tensor(array: FloatArray) -> torch.Tensor:
        return torch.from_numpy(array).float()

    return _Inputs(tensor(commands), tensor(velocities), None if simulated is None else tensor(simulated))


def _target(windows: PredictionWindows) -> torch.Tensor:
    """Measured path (S, K + 1, 6) with the pose in the frame of the initial pose."""
    zero = np.zeros_like(windows.measured)
    zero[..., :3] = windows.initial_states[:, None, :3]
    path = -prediction_errors(zero, windows)
    return torch.from_numpy(path).float()


def _scale(windows: PredictionWindows) -> torch.Tensor:
    """Median error (K + 1, 6) of the constant-velocity baseline, at least a tenth of that of its last step."""
    error = np.abs(prediction_errors(ConstantVelocity().predict(windows), windows))
    spread = STD_OVER_MAD * np.median(error, axis=0)
    return torch.from_numpy(np.maximum(spread, np.maximum(0.1 * spread[-1], 1e-4))).float()


def _validation(windows: PredictionWindows, share: float, seed: int) -> np.ndarray:
    """Windows (S,) in randomly chosen blocks; at least one block."""
    blocks = np.unique(windows.block)
    count = max(round(share * len(blocks)), 1)
    chosen = np.random.default_rng(seed).permutation(blocks)[:count]
    return np.isin(windows.block, chosen)


def _in_world(path: FloatArray, windows: PredictionWindows) -> FloatArray:
    """Paths (S, K + 1, 6) from the origin, moved to the initial poses of the windows."""
    x, y, yaw = (windows.initial_states[:, k, None] for k in range(3))
    cos, sin = np.cos(yaw), np.sin(yaw)
    out = path.copy()
    out[..., 0] = x + cos * path[..., 0] - sin * path[..., 1]
    out[..., 1] = y + sin * path[..., 0] + cos * path[..., 1]
    out[..., 2] = yaw + path[..., 2]
    return out
