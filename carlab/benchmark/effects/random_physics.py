"""Random smooth physics outside the catalogue: force fields, command maps and pose errors, drawn by a seed.

A field is a draw of a Gaussian process with a squared-exponential kernel by random Fourier features (Rahimi and Recht
2007, "Random features for large-scale kernel machines"). A case uses it only if it is unlike every effect of the
catalogue (``cases.resemblance``).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from carlab.benchmark.effects.catalogue import Draw, Form, FormName, Parameters
from carlab.benchmark.world.physics import Instant, World
from carlab.benchmark.world.simulation import FloatArray

RANDOM: FormName = "random"
FEATURES = 48
REST_MPS = 0.2
"""Below this speed a random force fades, so that the car can stand [m/s]."""
# Length scales of the fields: about three of them fit into the range of a drive.
SPEED_SCALE_MPS, SLIP_SCALE_RAD, STEERING_SCALE_RAD, THROTTLE_SCALE, PLACE_SCALE_M = 1.0, 0.15, 0.25, 0.35, 0.8
MAP_SCALE = 0.4
"""Length scale of the logarithmic slope of a command map, in shares of full command."""
OUTPUTS = ("push_x", "push_y", "moment")
_SEEDS = 1_000_000


class RandomField:
    """f(z) = sqrt(2 / M) sum_m a_m cos(w_m z + b_m): M features with a_m and w_m standard normal, b_m uniform.

    Zero mean and unit variance over seeds; length scale 1.

    Args:
        seed: Seed of the draw.
        dimensions: Number of inputs.
    """

    def __init__(self, seed: int, dimensions: int) -> None:
        rng = np.random.default_rng((seed, dimensions))
        self.frequencies = rng.normal(size=(FEATURES, dimensions))
        self.phases = rng.uniform(0.0, 2.0 * math.pi, FEATURES)
        self.amplitudes = math.sqrt(2.0 / FEATURES) * rng.normal(size=FEATURES)

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Evaluate at (..., dimensions); returns (...)."""
        waves = np.cos(inputs @ self.frequencies.T + self.phases)
        return np.asarray(waves @ self.amplitudes, dtype=np.float64)


class MonotoneMap:
    """Strictly increasing map of [-1, 1] with slope proportional to exp(size f(u)) on each side of 0.

    0, -1 and 1 are unchanged; size 0 is the identity.
    """

    def __init__(self, seed: int, size: float) -> None:
        self._grid = np.linspace(-1.0, 1.0, 401)
        log_slope = size * RandomField(seed, 1)(self._grid[:, None] / MAP_SCALE)
        slope = np.exp(log_slope - log_slope.max())
        steps = 0.5 * (slope[1:] + slope[:-1])
        values = np.concatenate([[0.0], np.cumsum(steps)])
        values -= values[200]
        self._values = np.where(self._grid < 0.0, values / -values[0], values / values[-1])

    def __call__(self, share: float) -> float:
        """Map a share of full command; values outside [-1, 1] give the ends."""
        return float(np.interp(share, self._grid, self._values))


def _force(inputs_of: Callable[[Instant], tuple[float, ...]], dimensions: int) -> Callable[[World, Parameters], None]:
    """A random force [N] or yaw moment [N m], by half the wheelbase, over scaled inputs."""

    def attach(world: World, p: Parameters) -> None:
        field, size = RandomField(int(p["seed"]), dimensions), p["size"]
        output = OUTPUTS[int(p["output"])]
        gain = size * (0.5 * world.car.wheelbase if output == "moment" else 1.0)

        def push(now: Instant) -> None:
            value = gain * float(field(np.array(inputs_of(now)))) * math.tanh(abs(now.vx) / REST_MPS)
            setattr(now, output, getattr(now, output) + value)

        world.hooks["body"].append(push)

    return attach


def _slips(now: Instant) -> tuple[float, ...]:
    return now.alpha_f / SLIP_SCALE_RAD, now.alpha_r / SLIP_SCALE_RAD


def _acting_commands(now: Instant) -> tuple[float, ...]:
    return now.d / STEERING_SCALE_RAD, now.u / THROTTLE_SCALE


def _place(now: Instant) -> tuple[float, ...]:
    return now.x / PLACE_SCALE_M, now.y / PLACE_SCALE_M


over_speed = _force(lambda now: (now.vx / SPEED_SCALE_MPS,), 1)
over_slip = _force(_slips, 2)
over_command = _force(_acting_commands, 2)
over_place = _force(_place, 2)


def steering_map(world: World, p: Parameters) -> None:
    """A random increasing map of the steering command."""
    top, distort = world.car.max_angle, MonotoneMap(int(p["seed"]), p["size"])
    world.steering_maps.append(lambda d: top * distort(d / top))


def throttle_map(world: World, p: Parameters) -> None:
    """A random increasing map of the throttle."""
    world.throttle_maps.append(MonotoneMap(int(p["seed"]), p["size"]))


def pose_error(world: World, p: Parameters) -> None:
    """Motion capture with a random smooth error of x and y over the place; velocities follow the wrong pose."""
    seed, size = int(p["seed"]), p["size"]
    fields = [RandomField(seed + k * _SEEDS, 2) for k in range(2)]

    def move(t: FloatArray, pose: FloatArray) -> FloatArray:
        place = pose[:, :2] / PLACE_SCALE_M
        error = np.stack([field(place) for field in fields], axis=1)
        return np.concatenate([pose[:, :2] + size * error, pose[:, 2:]], axis=1)

    world.pose_changes.append(move)


def yaw_error(world: World, p: Parameters) -> None:
    """Motion capture with a random smooth error of the heading over the heading."""
    field, size = RandomField(int(p["seed"]), 2), p["size"]

    def turn(t: FloatArray, pose: FloatArray) -> FloatArray:
        error = size * field(np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1))
        return np.concatenate([pose[:, :2], (pose[:, 2] + error)[:, None]], axis=1)

    world.pose_changes.append(turn)


def _field(size: float, draw: Draw) -> dict[str, float]:
    return {**_map(size, draw), "output": math.floor(len(OUTPUTS) * draw.shares[1])}


def _map(size: float, draw: Draw) -> dict[str, float]:
    return {"size": size, "seed": math.floor(_SEEDS * draw.shares[0])}


FORMS = (
    Form("random_force_over_speed", RANDOM, _field, over_speed, 0.1, 6.0,
         class_words=(("speed", "even", "drive", "constant"),)),
    Form("random_force_over_slip", RANDOM, _field, over_slip, 0.06, 6.0,
         class_words=(("slip", "lateral", "steering", "yaw rate", "yaw_rate"),)),
    Form("random_force_over_command", RANDOM, _field, over_command, 0.06, 6.0,
         class_words=(("steering", "throttle"),)),
    Form("random_force_over_place", RANDOM, _field, over_place, 0.08, 6.0,
         class_words=(("place", "position", "location"),)),
    Form("random_steering_map", RANDOM, _map, steering_map, 0.06, 3.0, class_words=(("steering",),)),
    Form("random_throttle_map", RANDOM, _map, throttle_map, 0.12, 3.0, class_words=(("throttle", "speed"),)),
    Form("random_pose_error", RANDOM, _map, pose_error, 0.004, 0.3,
         class_words=(("place", "position", "location"),)),
    Form("random_yaw_error", RANDOM, _map, yaw_error, 0.007, 0.4,
         class_words=(("heading", "direction", "world"),)),
)  # fmt: skip
