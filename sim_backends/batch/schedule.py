"""Schedule of the acting commands within a control period: exact, for batches of cars.

A command given at tick ``k`` acts from ``k T + delay``. With ``delay = m T + phase`` the command of tick ``k - m``
takes over at ``phase`` into period ``k``; so each channel switches once in each period, at the same phase. The period
is cut there, and each piece is integrated with held commands. The result is exact for any delay, and its derivative by
the delay is that of the pieces' lengths. For a capture of motion capture within a piece, the piece is integrated
a second time up to the capture, so that measuring does not change the trajectory.

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
    new_command: tuple[bool | torch.Tensor, bool | torch.Tensor]
    """Whether the later of the period's two commands acts, for steering and throttle; each for all cars or (N,)."""
    has_capture: bool | torch.Tensor
    """Whether a capture lies in this piece, for all cars or (N,)."""
    capture_after_s: Number | None
    """Time of the capture after the start of the piece [s]; None at its end."""
    capture_steps: int


@dataclass(frozen=True, slots=True)
class PeriodPlan:
    """The pieces of each period, and the delays of commands and poses in whole periods, for all cars or (N,)."""

    pieces: tuple[Piece, ...]
    command_periods: tuple[int | torch.Tensor, int | torch.Tensor]
    capture_periods: int | torch.Tensor


def plan_period(period_s: float, delays_s: tuple[Number, Number], latency_s: Number, max_step_s: float) -> PeriodPlan:
    """Cut a control period for the delays of steering and throttle and the latency of measurements [s].

    Delays and latency are numbers or one per car (N,), and not negative. A latency of zero needs no extra steps.
    """
    if any(isinstance(v, torch.Tensor) for v in (*delays_s, latency_s)):
        return _plan_per_car(period_s, delays_s, latency_s, max_step_s)
    steering, throttle, latency = float(delays_s[0]), float(delays_s[1]), float(latency_s)
    periods, phases = zip(*(_split(d, period_s) for d in (steering, throttle)), strict=True)
    late_periods, late_s = _split(latency, period_s)
    capture_s = period_s - late_s
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
        has_capture = start_s + _TOLERANCE_S < capture_s <= end_s + _TOLERANCE_S
        after_s = capture_s - start_s if has_capture and capture_s < end_s - _TOLERANCE_S else None
        pieces.append(
            Piece(
                start_s,
                length_s,
                substeps_for(length_s, max_step_s),
                (new_steering, new_throttle),
                has_capture,
                after_s,
                0 if after_s is None else substeps_for(after_s, max_step_s),
            )
        )
        start_s = end_s
    return PeriodPlan(tuple(pieces), (periods[0], periods[1]), late_periods)


def _split(delay_s: float, period_s: float) -> tuple[int, float]:
    periods = math.floor(delay_s / period_s + _TOLERANCE_S / period_s)
    phase_s = delay_s - periods * period_s
    return periods, phase_s if phase_s > _TOLERANCE_S else 0.0


def _plan_per_car(period_s: float, delays_s: tuple[Number, Number], latency_s: Number, max_step_s: float) -> PeriodPlan:
    shared = delays_s[0] is delays_s[1]
    like = next(v for v in (*delays_s, latency_s) if isinstance(v, torch.Tensor))
    steering, throttle, latency = (
        torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in (*delays_s, latency_s)
    )
    shape = (steering + throttle + latency).shape
    steering, throttle, latency = (v.expand(shape) for v in (steering, throttle, latency))
    whole = [torch.floor(v.detach() / period_s) for v in (steering, throttle, latency)]
    phases = [steering - whole[0] * period_s, throttle - whole[1] * period_s]
    capture = period_s - (latency - whole[2] * period_s)
    distinct = [phases[0]]
    # Two equal delays may depend on different parameters.
    differentiable = phases[0].requires_grad or phases[1].requires_grad
    if not shared and (differentiable or not torch.equal(phases[0], phases[1])):
        distinct.append(phases[1])
    sorted_phases, order = torch.stack(distinct).sort(dim=0, stable=True)
    # Order of the switches; between two simultaneous switches there is a piece of length zero.
    places = [order.argsort(dim=0)[channel % len(distinct)] for channel in range(2)]
    ends = torch.cat([sorted_phases, torch.full_like(capture, period_s)[None]])
    starts = torch.cat([torch.zeros_like(capture)[None], ends[:-1]])
    pieces = []
    for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
        length = end - start
        longest_s = float(length.detach().max())
        if longest_s <= 0.0 and not length.requires_grad:
            continue
        has_capture = (capture.detach() > start.detach()) & (capture.detach() <= end.detach())
        after = torch.where(has_capture, capture - start, 0.0) if bool(has_capture.any()) else None
        pieces.append(
            Piece(
                start,
                length,
                substeps_for(longest_s, max_step_s),
                (places[0] < index, places[1] < index),
                has_capture if after is not None else False,
                after,
                0 if after is None else substeps_for(float(after.detach().max()), max_step_s),
            )
        )
    late = [w.to(torch.int64) for w in whole]
    return PeriodPlan(tuple(pieces), (late[0], late[1]), late[2])
