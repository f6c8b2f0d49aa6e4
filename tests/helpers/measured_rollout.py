"""Measured states of simulated cars, by a simulation with short control periods."""

from typing import NamedTuple

import torch

from carlab.core.planar import arc
from sim_backends.batch.inputs import with_effects_of_values
from sim_backends.batch.rollout import rollout
from sim_backends.dynamics.torch_ops import torch_ops
from sim_backends.measurement import MeasurementModel, filter_velocities


class MeasuredRollout(NamedTuple):
    """True and measured states (N, T + 1, 6)."""

    states: torch.Tensor
    measured: torch.Tensor


def measured_rollout(config, start, commands, *, history=None, values=None, parts=10, **options):
    """Simulate N cars as ``rollout``, and measure them at each tick, without noise.

    Each period has ``parts`` equal parts; states between their ends are interpolated. Before the start the car moves at
    its first body velocity.
    """
    config = with_effects_of_values(config, values or {})
    part_s = config.control_period_s / parts
    short = config.with_values({"timing.control_period": part_s})
    each_part = [None if c is None else c.repeat_interleave(parts, dim=1) for c in (commands, history)]
    states = rollout(short, start, each_part[0], history=each_part[1], values=values, **options).states
    rows = states.permute(2, 1, 0)  # (6, instants, cars)
    numbers = {name: torch.as_tensor(v, dtype=start.dtype) for name, v in (config.values() | (values or {})).items()}
    ops = torch_ops(rows[0])
    model = MeasurementModel(ops, numbers, config.effects)
    seen = torch.stack(torch.broadcast_tensors(*model.observe(tuple(rows))))
    if model.velocity_time_constant_s is not None:
        inputs = [tuple(instant) for instant in seen[3:].unbind(dim=1)]
        filtered = filter_velocities(torch_ops(rows[0, 0]), inputs, part_s, model.velocity_time_constant_s)
        seen = torch.cat([seen[:3], torch.stack([torch.stack(instant) for instant in filtered], dim=1)])
    instants = parts * torch.arange(commands.shape[1] + 1)[:, None] - model.latency_s / part_s + 0.0 * rows[0, ::parts]
    before = torch.floor(instants.detach() + 1e-9).clamp(0, max(len(rows[0]) - 2, 0)).to(torch.int64)
    share = (instants - before).clamp_min(0.0)
    one, other = (
        torch.gather(seen, 1, i.expand(6, -1, -1)) for i in (before, (before + 1).clamp_max(len(rows[0]) - 1))
    )
    forward, left, turn = arc(*start.T[3:], instants * part_s)
    x, y, yaw = start.T[:3]
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    early = (x + cos * forward - sin * left, y + sin * forward + cos * left, yaw + turn, *start.T[3:])
    early = MeasurementModel(torch_ops(turn), numbers, config.effects).observe(early)
    measured = torch.where(instants < -1e-9, torch.stack(torch.broadcast_tensors(*early)), one + share * (other - one))
    return MeasuredRollout(states[:, ::parts], measured.permute(2, 1, 0))
