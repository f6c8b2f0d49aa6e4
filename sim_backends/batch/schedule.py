"""Schedule of the acting commands within a control period: exact, for batches of cars.

A command given at tick ``k`` acts from ``k T + delay``. With ``delay = m T + phase`` the command of tick ``k - m``
takes over at ``phase`` into period ``k``; so each channel switches once in each period, at the same phase. The period
is cut there, and each piece is integrated with held commands. The result is exact for any delay, and its derivative by
the delay is that of the pieces' lengths.

Delays that are equal for all cars give a plan of floats: one shared delay costs no more steps than no delay. Delays
per car give pieces with one length per car, each with the number of steps of the longest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import torch

from sim_backends.dynamics.integrate import substeps_for

Number: TypeAlias = "float | torch.Tensor"
"""A number for all cars, or a tensor of shape () or (N,)."""
_TOLERANCE_S = 1e-9
"""Difference below which two instants are equal [s]."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of a control period, from ``start_s`` [s] in it. Flags are for all cars or one per car (N,)."""

    start_s: Number
    length_s: Number
    steps: int
    step_s: Number
    """Length of a Runge-Kutta step [s]."""
    new_command: tuple[bool | torch.Tensor, bool | torch.Tensor]
    """Whether the later of the period's two commands acts, for steering and throttle; each for all cars or (N,)."""


@dataclass(frozen=True, slots=True)
class PeriodPlan:
    """The pieces of each period, and the delays of steering and throttle in whole periods, for all cars or (N,)."""

    pieces: tuple[Piece, ...]
    command_periods: tuple[int | torch.Tensor, int | torch.Tensor]


def plan_period(period_s: float, delays_s: tuple[Number, Number], max_step_s: float) -> PeriodPlan:
    """Cut a control period for the delays of steering and throttle [s], numbers or one per car (N,), not negative."""
    if any(isinstance(v, torch.Tensor) for v in delays_s):
        return _plan_per_car(period_s, delays_s, max_step_s)
    periods, phases = zip(*(_split(float(d), period_s) for d in delays_s), strict=True)
    ends: list[float] = []
    for instant_s in sorted((*phases, period_s)):
        if instant_s > _TOLERANCE_S and (not ends or instant_s - ends[-1] > _TOLERANCE_S):
            ends.append(instant_s)
    ends[-1] = period_s
    pieces = []
    start_s = 0.0
    for end_s in ends:
        new_steering, new_throttle = (phase <= start_s + _TOLERANCE_S for phase in phases)
        length_s = end_s - start_s
        steps = substeps_for(length_s, max_step_s)
        pieces.append(Piece(start_s, length_s, steps, length_s / steps, (new_steering, new_throttle)))
        start_s = end_s
    return PeriodPlan(tuple(pieces), (periods[0], periods[1]))


def _split(delay_s: float, period_s: float) -> tuple[int, float]:
    periods = math.floor(delay_s / period_s + _TOLERANCE_S / period_s)
    phase_s = delay_s - periods * period_s
    return periods, phase_s if phase_s > _TOLERANCE_S else 0.0


def _plan_per_car(period_s: float, delays_s: tuple[Number, Number], max_step_s: float) -> PeriodPlan:
    shared = delays_s[0] is delays_s[1]
    like = next(v for v in delays_s if isinstance(v, torch.Tensor))
    steering, throttle = (torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in delays_s)
    shape = (steering + throttle).shape
    steering, throttle = steering.expand(shape), throttle.expand(shape)
    whole = [torch.floor(v.detach() / period_s) for v in (steering, throttle)]
    phases = [steering - whole[0] * period_s, throttle - whole[1] * period_s]
    distinct = [phases[0]]
    # Two equal delays may depend on different parameters.
    differentiable = phases[0].requires_grad or phases[1].requires_grad
    if not shared and (differentiable or not torch.equal(phases[0], phases[1])):
        distinct.append(phases[1])
    sorted_phases, order = torch.stack(distinct).sort(dim=0, stable=True)
    # Order of the switches; between two simultaneous switches there is a piece of length zero.
    places = [order.argsort(dim=0)[channel % len(distinct)] for channel in range(2)]
    ends = torch.cat([sorted_phases, torch.full_like(steering, period_s)[None]])
    starts = torch.cat([torch.zeros_like(steering)[None], ends[:-1]])
    pieces = []
    for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
        length = end - start
        longest_s = float(length.detach().max())
        if longest_s <= 0.0 and not length.requires_grad:
            continue
        steps = substeps_for(longest_s, max_step_s)
        pieces.append(Piece(start, length, steps, length / steps, (places[0] < index, places[1] < index)))
    return PeriodPlan(tuple(pieces), (whole[0].to(torch.int64), whole[1].to(torch.int64)))
