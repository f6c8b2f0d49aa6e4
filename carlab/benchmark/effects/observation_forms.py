"""Effects of motion capture and logger, in the catalogue's form and an alternative form."""

from __future__ import annotations

import math

import numpy as np

from carlab.benchmark.effects.catalogue import Form, Parameters, plain, signed
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import FloatArray
from carlab.core.planar import to_world


def mocap_latency(world: World, p: Parameters) -> None:
    """Every measured channel is ``latency`` old (instead of the car file's)."""
    world.extra_latency_s += p["latency"] - world.car.latency


def marker_offset(world: World, p: Parameters) -> None:
    """The tracked point is not the centre of mass."""
    ahead, left = p["ahead"], p["left"]

    def move(t: FloatArray, pose: FloatArray) -> FloatArray:
        moved = pose.copy()
        moved[:, :2] += np.stack(to_world(ahead, left, pose[:, 2]), axis=1)
        return moved

    world.pose_changes.append(move)


def mocap_yaw_misalignment(world: World, p: Parameters) -> None:
    """The heading of the rigid body has an offset from that of the car."""
    turn = np.array([0.0, 0.0, p["angle"]])
    world.pose_changes.append(lambda t, pose: pose + turn)


def ramp_filter(t_s: FloatArray, values: FloatArray, time_constant_s: float) -> FloatArray:
    """First-order low-pass filter of (N, k) values that are linear between even stamps; exact."""
    if time_constant_s <= 0.0:
        return values
    out = values.copy()
    gap = float(t_s[1] - t_s[0])
    keep = math.exp(-gap / time_constant_s)
    ramp = time_constant_s / gap * (1.0 - keep)
    for k in range(1, len(values)):
        out[k] = keep * out[k - 1] + (ramp - keep) * values[k - 1] + (1.0 - ramp) * values[k]
    return out


def velocity_filter_lag(world: World, p: Parameters) -> None:
    """First-order filter of the velocity columns with an input that is linear between captures."""
    world.velocity_changes.append(lambda t, v: ramp_filter(t, v, p["time_constant"]))


def moving_average(world: World, p: Parameters) -> None:
    """A causal moving average over twice the time constant."""
    span = 2.0 * p["time_constant"]

    def smooth(t: FloatArray, v: FloatArray) -> FloatArray:
        if span <= 0.0:
            return v
        gap = float(t[1] - t[0])
        whole = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * gap * (v[1:] + v[:-1]), axis=0)])
        begin = np.maximum(t - span, t[0])
        early = np.stack([np.interp(begin, t, whole[:, k]) for k in range(3)], axis=1)
        return np.where((t > t[0])[:, None], (whole - early) / np.maximum(t - begin, gap)[:, None], v)

    world.velocity_changes.append(smooth)


FORMS = (
    Form(
        "mocap_latency", "catalogue", lambda size, draw: {"latency": draw.car.latency + size}, mocap_latency, 0.01, 0.3
    ),
    Form(
        "marker_offset",
        "catalogue",
        lambda size, draw: {
            "ahead": size * math.cos(2 * math.pi * draw.shares[0]),
            "left": size * math.sin(2 * math.pi * draw.shares[0]),
        },
        marker_offset,
        0.01,
        0.3,
    ),
    Form("mocap_yaw_misalignment", "catalogue", signed("angle"), mocap_yaw_misalignment, 0.01, 0.3),
    Form("velocity_filter_lag", "catalogue", plain("time_constant"), velocity_filter_lag, 0.02, 0.5),
    Form("velocity_filter_lag", "other", plain("time_constant"), moving_average, 0.02, 0.5),
)
