"""Recordings of a kinematic car with delays and lags, and copies of recordings with changed columns or rows."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from carlab.core.episode_data import EpisodeData
from sim_backends.car_parameters import SimulatorConfig

NOMINAL = SimulatorConfig.from_preset()
DELAY_S = NOMINAL.command_delay_s + NOMINAL.mocap.latency_s


@dataclass
class Car:
    """A kinematic car with delays and lags, integrated at 1 kHz and measured with noise at ``rate_hz``."""

    seed: int = 0
    seconds: float = 70.0
    rate_hz: float = 30.0
    steering_delay_s: float = DELAY_S
    throttle_delay_s: float = DELAY_S
    motor_lag_s: float = 0.0
    velocity_lag_s: float = 0.0
    drag: float = 1.2
    mean_steering: float = 0.0
    rear_axle_m: float = 0.02
    command_limit: float = 1.0

    def drive(self) -> EpisodeData:
        rng = np.random.default_rng(self.seed)
        step = 1e-3
        fine = np.arange(0.0, self.seconds, step)
        steps_per_row = round(1.0 / self.rate_hz / step)
        count = len(fine)

        def random_signal(period_s: float) -> np.ndarray:
            knots = np.arange(0.0, self.seconds + 5.0, period_s)
            return np.interp(fine, knots, rng.uniform(-1, 1, len(knots)))

        ticks = np.arange(count) // steps_per_row * steps_per_row
        steering = (self.mean_steering + 0.5 * random_signal(0.7) + 0.3 * random_signal(2.5))[ticks]
        throttle = np.clip(0.35 + 0.35 * random_signal(0.9) + 0.15 * random_signal(3.0), -1, 1)[ticks]
        steering, throttle = (np.clip(u, -self.command_limit, self.command_limit) for u in (steering, throttle))

        def delayed(u: np.ndarray, delay_s: float) -> np.ndarray:
            shift = round(delay_s / step)
            return np.concatenate([np.full(shift, u[0]), u[: count - shift]]) if shift else u

        drive = delayed(throttle, self.throttle_delay_s)
        if self.motor_lag_s:
            drive = lfilter([step / self.motor_lag_s], [1, step / self.motor_lag_s - 1], drive)
        speed = lfilter([step], [1.0, self.drag * step - 1.0], 5.0 * drive)
        target_rate = speed * np.tan(0.4 * delayed(steering, self.steering_delay_s)) / 0.3
        rate = lfilter([step / 0.06], [1.0, step / 0.06 - 1.0], target_rate)
        yaw = np.cumsum(rate) * step
        lateral_speed = self.rear_axle_m * rate
        x = np.cumsum(speed * np.cos(yaw) - lateral_speed * np.sin(yaw)) * step
        y = np.cumsum(speed * np.sin(yaw) + lateral_speed * np.cos(yaw)) * step
        poses = np.column_stack([x, y, yaw])[::steps_per_row]
        poses = poses + rng.normal(size=poses.shape) * [5e-4, 5e-4, 2e-3]
        measured = np.column_stack([speed, lateral_speed, rate])
        if self.velocity_lag_s:
            share = step / self.velocity_lag_s
            measured = lfilter([share], [1, share - 1], measured, axis=0)
        measured = measured[::steps_per_row] + rng.normal(size=poses.shape) * [8e-3, 8e-3, 2e-2]
        commands = np.column_stack([steering, throttle])[::steps_per_row][:-1]
        wrapped = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
        return EpisodeData(
            times_s=fine[::steps_per_row],
            states=np.column_stack([poses[:, :2], wrapped, measured]),
            requested=commands,
            sent=commands,
            rewards=np.full(len(commands), np.nan),
            metadata={"velocity_source": "vx, vy: columns in the body frame; yaw_rate: column"},
        )


def with_states(episode: EpisodeData, change) -> EpisodeData:
    states = episode.states.copy()
    change(states)
    return replace(episode, states=states)


def with_sent(episode: EpisodeData, change) -> EpisodeData:
    sent = episode.sent.copy()
    change(sent)
    return replace(episode, sent=sent)


def without_rows(episode: EpisodeData, rows: np.ndarray, states: np.ndarray | None = None) -> EpisodeData:
    sent = np.vstack([episode.sent, episode.sent[-1:]])[~rows][:-1]
    return replace(
        episode,
        times_s=episode.times_s[~rows],
        states=episode.states[~rows] if states is None else states,
        sent=sent,
        requested=sent,
        rewards=np.full(len(sent), np.nan),
    )
