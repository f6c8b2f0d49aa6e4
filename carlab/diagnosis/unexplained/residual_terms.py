"""Library of unnamed accelerations, and the change of the errors of whole windows by each of them.

A missing acceleration g(t) on a channel changes the error at the end of a window by the sum of its impulses, propagated
by the simulator. Impulse responses are computed by restarts of the simulator within the windows. Each term then costs a
matrix product (a linear response, as in the adjoint method of discrepancy modelling).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.settings import UNEXPLAINED
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows
from sim_backends.car_parameters import SimulatorConfig

Features = dict[str, FloatArray]


@dataclass(frozen=True, slots=True)
class Term:
    """A term of the library: formula, class statement, inputs, and its value as a function of features.

    The value is an array of the shape of each feature, (S, J).
    """

    formula: str
    statement: str
    inputs: tuple[str, ...]
    value: Callable[[Features], FloatArray]


def _harmonic(axis: str, length_m: float, phase: str) -> Term:
    wave = np.cos if phase == "cos" else np.sin
    return Term(
        f"{phase}(2 pi {axis} / {length_m:g} m)",
        f"depends on the place (position), repeating every {length_m:g} m",
        ("place",),
        lambda f: np.asarray(wave(2.0 * np.pi * f[axis] / length_m)),
    )


def _stepped(name: str, symbol: str, period: float) -> Term:
    steps = f"repeats with the {name} in steps of about {period:.2g} of its range, as if the {name} were quantised"
    curve = f"a curve over the {name} with a period of about {period:.2g} of its range, not steps"
    return Term(
        f"sin(2 pi {symbol} / {period:.3g})",
        steps if period <= MAX_STEP_SHARE else curve,
        (name, "steps"),
        lambda f: np.asarray(np.sin(2.0 * np.pi * f[symbol] / period)),
    )


MAX_STEP_SHARE = 0.25
"""Longest period [share of the range] that is called steps; four steps from zero to full command. A longer period
follows any nonlinear response."""
STEP_SHARES = tuple(float(p) for p in np.geomspace(0.05, 0.8, 22))
"""Periods over a command, as shares of its range."""
WAVELENGTHS_M = (0.4, 0.5, 0.64, 0.8, 1.0, 1.3, 1.7, 2.2)
"""Wavelengths [m] of terms that repeat with the place."""
TERMS: tuple[Term, ...] = (
    Term("1", "constant: a bias in all driving conditions", ("bias",), lambda f: np.ones_like(f["v"])),
    Term("sign(v)", "odd in speed and independent of its size, like dry friction", ("speed",),
         lambda f: np.tanh(f["v"] / 0.05)),
    Term("v", "odd in speed, proportional to it", ("speed",), lambda f: f["v"]),
    Term("v |v|", "odd in speed, grows with speed squared", ("speed",), lambda f: f["v"] * np.abs(f["v"])),
    Term("v^2", "even in speed, grows with speed squared", ("speed",), lambda f: f["v"] ** 2),
    Term("u", "odd in throttle: a gain of the drive", ("throttle",), lambda f: f["u"]),
    Term("|u|", "even in throttle", ("throttle",), lambda f: np.abs(f["u"])),
    Term("u |u|", "odd in throttle, grows faster than linearly", ("throttle",), lambda f: f["u"] * np.abs(f["u"])),
    Term("u |v|", "odd in throttle, grows with speed", ("throttle", "speed"), lambda f: f["u"] * np.abs(f["v"])),
    Term("d", "odd in steering", ("steering",), lambda f: f["d"]),
    Term("|d|", "even in steering", ("steering",), lambda f: np.abs(f["d"])),
    Term("d^3", "odd in steering, grows faster than linearly", ("steering",), lambda f: f["d"] ** 3),
    Term("d |v|", "odd in steering, grows with speed", ("steering", "speed"), lambda f: f["d"] * np.abs(f["v"])),
    Term("d v^2", "odd in steering, grows with speed squared", ("steering", "speed"), lambda f: f["d"] * f["v"] ** 2),
    Term("|d| v", "even in steering, grows with speed", ("steering", "speed"), lambda f: np.abs(f["d"]) * f["v"]),
    Term("|d| v^2", "even in steering, grows with speed squared", ("steering", "speed"),
         lambda f: np.abs(f["d"]) * f["v"] * np.abs(f["v"])),
    Term("d u", "odd in steering and in throttle", ("steering", "throttle"), lambda f: f["d"] * f["u"]),
    Term("r", "odd in the yaw rate", ("yaw rate",), lambda f: f["r"]),
    Term("|r| v", "even in turning, grows with lateral acceleration", ("lateral acceleration",),
         lambda f: np.abs(f["r"]) * f["v"]),
    Term("r v", "odd in turning, grows with lateral acceleration", ("lateral acceleration",),
         lambda f: f["r"] * f["v"]),
    Term("(r v)^3", "odd in turning, grows with the cube of lateral acceleration", ("lateral acceleration",),
         lambda f: (f["r"] * f["v"] / 5.0) ** 3),
    Term("r / v", "odd in the path's curvature and independent of speed", ("yaw rate", "curvature"),
         lambda f: np.tanh(f["r"] / np.maximum(np.abs(f["v"]), 0.3))),
    Term("w", "odd in side slip (lateral velocity)", ("side slip",), lambda f: f["w"]),
    Term("w |w|", "odd in side slip (lateral velocity), grows faster than linearly", ("side slip",),
         lambda f: f["w"] * np.abs(f["w"])),
    Term("cos(yaw)", "depends on the heading, a direction of the world", ("heading",), lambda f: np.cos(f["yaw"])),
    Term("sin(yaw)", "depends on the heading, a direction of the world", ("heading",), lambda f: np.sin(f["yaw"])),
    Term("v cos(yaw)", "depends on the heading, a direction of the world, and grows with speed",
         ("heading", "speed"), lambda f: np.abs(f["v"]) * np.cos(f["yaw"])),
    Term("v sin(yaw)", "depends on the heading, a direction of the world, and grows with speed",
         ("heading", "speed"), lambda f: np.abs(f["v"]) * np.sin(f["yaw"])),
    Term("x", "depends on the place (position)", ("place",), lambda f: f["x"]),
    Term("y", "depends on the place (position)", ("place",), lambda f: f["y"]),
    Term("x cos(yaw) + y sin(yaw)", "pulls towards a place (position)", ("place", "heading"),
         lambda f: f["x"] * np.cos(f["yaw"]) + f["y"] * np.sin(f["yaw"])),
    Term("y cos(yaw) - x sin(yaw)", "pulls towards a place (position)", ("place", "heading"),
         lambda f: f["y"] * np.cos(f["yaw"]) - f["x"] * np.sin(f["yaw"])),
    *(_harmonic(axis, length, phase) for length in WAVELENGTHS_M for axis in ("x", "y") for phase in ("cos", "sin")),
    Term("t", "drifts with time", ("time",), lambda f: f["t"]),
    Term("t v", "a resistance that drifts with time", ("time", "speed"), lambda f: f["t"] * f["v"]),
    Term("t u", "a throttle whose effect drifts with time", ("time", "throttle"), lambda f: f["t"] * f["u"]),
    Term("t d", "a steering whose effect drifts with time", ("time", "steering"), lambda f: f["t"] * f["d"]),
    Term("t r v", "a lateral grip that drifts with time", ("time", "lateral acceleration"),
         lambda f: f["t"] * f["r"] * f["v"]),
    Term("du/dt", "follows the rate of throttle: a lag, delay or hysteresis (a state with history)",
         ("throttle", "history"), lambda f: f["du"]),
    Term("du/dt |u|", "follows the rate of throttle and its size: a state with history", ("throttle", "history"),
         lambda f: f["du"] * np.abs(f["u"])),
    Term("u - u before", "depends on where the throttle was: a lag or hysteresis (a state with history)",
         ("throttle", "history"), lambda f: f["u"] - f["u before"]),
    Term("dd/dt", "follows the rate of steering: a lag, delay or hysteresis (a state with history)",
         ("steering", "history"), lambda f: f["dd"]),
    Term("v dd/dt", "follows the rate of steering times speed: a lag, delay or hysteresis (a state with history)",
         ("steering", "speed", "history"), lambda f: f["dd"] * f["v"]),
    Term("d - d before", "depends on where the steering was: a lag or hysteresis (a state with history)",
         ("steering", "history"), lambda f: f["d"] - f["d before"]),
    Term("|u| dd/dt", "follows the rate of steering where there is throttle: a lag (a state with history)",
         ("steering", "throttle", "history"), lambda f: f["dd"] * np.abs(f["u"])),
    *(_stepped("steering", "d", p) for p in STEP_SHARES),
    *(_stepped("throttle", "u", p) for p in STEP_SHARES),
    Term("grip work", "depends on the work that the tyres have done before: a slow state (history), like warming",
         ("history", "lateral acceleration"), lambda f: f["work"] * f["r"] * f["v"]),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Responses:
    """Changes of the whitened errors by J impulses on vx, vy and yaw rate.

    matrix    (3, J, S, U, 6) change per unit of velocity [1 / (m/s), 1 / (m/s), 1 / (rad/s)]
    features  inputs of the terms at the impulses, each (S, J)
    span_s    time between impulses
    """

    matrix: FloatArray
    features: Features
    span_s: float

    def of(self, term: Term, channel: int) -> FloatArray:
        """Change of the whitened errors (S, U, 6) by one unit of a term as acceleration on vx, vy or yaw rate.

        Args:
            term: the term.
            channel: 0 for vx [m/s2], 1 for vy [m/s2], 2 for yaw rate [rad/s2].
        """
        value = term.value(self.features) * self.span_s
        return np.asarray(np.einsum("sj,jsuc->suc", value, self.matrix[channel]))


def responses(
    windows: PredictionWindows,
    config: SimulatorConfig,
    scale: Scale,
) -> Responses:
    """Impulse responses of ``config`` along its predictions of windows, at the middle of each time span."""
    predicted = simulate_windows(windows, config)[0]
    impulses = UNEXPLAINED.impulse_sizes
    every = max(windows.steps // UNEXPLAINED.impulses, 1)
    begins = np.arange(every // 2, windows.steps, every)
    yaw = windows.initial_states[:, 2, None]
    matrix = np.zeros((3, len(begins), len(windows), len(scale.steps), 6))
    for j, begin in enumerate(begins):
        outs = []
        for which in (None, 0, 1, 2):
            start = predicted[:, begin].copy()
            if which is not None:
                start[:, 3 + which] += impulses[which]
            outs.append(simulate_windows(_remainder(windows, predicted, int(begin), start), config)[0])
        later = scale.steps > begin
        for which in range(3):
            change = (outs[1 + which] - outs[0])[:, scale.steps[later] - begin] / impulses[which]
            change[..., 0], change[..., 1] = to_body(change[..., 0], change[..., 1], yaw)
            matrix[which, j][:, later] = change / scale.sigma[later]
    matrix = np.nan_to_num(matrix.clip(-1e3, 1e3))
    return Responses(matrix, features(windows, predicted, config, begins), every * windows.period_s)


def _remainder(windows: PredictionWindows, predicted: FloatArray, begin: int, start: FloatArray) -> PredictionWindows:
    """The windows from step ``begin`` on, from the states ``start`` (S, 6)."""
    past = windows.past_commands.shape[1]
    commands = np.concatenate([windows.past_commands, windows.commands], axis=1)
    before = np.concatenate([windows.past_states, predicted[:, :begin]], axis=1)
    return replace(
        windows,
        initial_states=start,
        past_commands=commands[:, begin : begin + past],
        commands=windows.commands[:, begin:],
        measured=windows.measured[:, begin:],
        past_states=before[:, -past:],
        t0_s=windows.t0_s + begin * windows.period_s,
        command_deviations=windows.deviations_in(slice(begin, None)),
    )


def features(windows: PredictionWindows, predicted: FloatArray, config: SimulatorConfig, at: np.ndarray) -> Features:
    """Inputs of the terms, each (S, J): commands after delays, motion, place and time.

    v, w, r: vx, vy [m/s], yaw rate [rad/s]; d, u: steering, throttle; d before, u before: the same 0.3 s earlier; dd,
    du: their rates [1/s]; yaw [rad]; x, y [m]; t: time as a share of the recording; work: mean lateral acceleration
    before the window over 3 m/s2.

    Args:
        windows: S windows.
        predicted: predicted states (S, K + 1, 6).
        config: the simulator, for the delay of the commands.
        at: steps (J,).
    """
    period_s, past = windows.period_s, windows.past_commands.shape[1]
    commands = np.concatenate([windows.past_commands, windows.commands], axis=1)
    age_s = config.command_delay_s + config.mocap.latency_s
    now = past + at - round(age_s / period_s)
    back = max(round(0.1 / period_s), 1)
    earlier = np.clip(now - back, 0, None)
    long_ago = np.clip(now - 3 * back, 0, None)
    state = predicted[:, at]
    span = (np.clip(now, 0, None) - earlier) * period_s
    work = np.abs(windows.past_states[:, :, 5] * windows.past_states[:, :, 3]).mean(axis=1) / 3.0
    return {
        "v": state[:, :, 3],
        "w": state[:, :, 4],
        "r": state[:, :, 5],
        "d": commands[:, np.clip(now, 0, None), 0],
        "u": commands[:, np.clip(now, 0, None), 1],
        "d before": commands[:, long_ago, 0],
        "u before": commands[:, long_ago, 1],
        "dd": (commands[:, np.clip(now, 0, None), 0] - commands[:, earlier, 0]) / np.maximum(span, period_s),
        "du": (commands[:, np.clip(now, 0, None), 1] - commands[:, earlier, 1]) / np.maximum(span, period_s),
        "yaw": state[:, :, 2],
        "x": state[:, :, 0],
        "y": state[:, :, 1],
        "t": (windows.t0_s[:, None] + at * period_s) / max(float(windows.t0_s.max()), 1.0),
        "work": np.tile(work[:, None], (1, len(at))),
    }
