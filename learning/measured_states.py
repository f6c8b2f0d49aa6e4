"""What motion capture and the velocity filter make of a car's states, undone and done again, for many draws at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sim_backends.batch_rollout import filter_velocities
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS, ObservationEffect
from sim_backends.torch_ops import torch_ops

LATENCY_EFFECT = "effects.mocap_latency.latency"


@dataclass(frozen=True, slots=True)
class Measured:
    """Observation effects of a simulator with P draws of its numbers.

    Attributes:
        effects: their ids; the latency of motion capture is among them and is none of this class' business.
        values: numbers of each effect, (P,).
        lag_s: time constant of the filter on the velocities (P,) [s]; None where there is none.
        seen: what is measured of unit velocities (P, 3, 3), a column each; None where it is what they are.
    """

    effects: tuple[str, ...]
    values: tuple[Mapping[str, Tensor], ...]
    lag_s: Tensor | None
    seen: Tensor | None

    @classmethod
    def of(
        cls, config: SimulatorConfig, drawn: Mapping[str, Tensor], draws: int, like: Tensor, delay_s: float = 0.0
    ) -> Measured:
        """Those of ``config`` with the numbers ``drawn``, each (P,), in the place of its own.

        A delay of the velocities [s] counts as so much more of a filter's time constant.
        """
        numbers = config.values()
        found = [(i, e) for i in config.effects if isinstance(e := EFFECTS[i], ObservationEffect)]
        found.sort(key=lambda pair: (pair[1].order, pair[0]))
        values = []
        for name, effect in found:
            dotted = {p.name: f"effects.{name}.{p.name}" for p in effect.parameters}
            values.append({
                key: drawn[d] if d in drawn else torch.full((draws,), numbers[d], dtype=like.dtype, device=like.device)
                for key, d in dotted.items()
            })  # fmt: skip
        lags = [e.velocity_time_constant_s(v) for (_, e), v in zip(found, values, strict=True)]
        some = [lag for lag in lags if lag is not None]
        lag_s = torch.full((draws,), delay_s, dtype=like.dtype, device=like.device) + sum(some)
        made = cls(tuple(name for name, _ in found), tuple(values), lag_s if some or delay_s > 0.0 else None, None)
        if not found:
            return made
        unit = torch.zeros((draws, 3, 6), dtype=like.dtype, device=like.device)
        unit[:, :, 3:] = torch.eye(3, dtype=like.dtype, device=like.device)
        return cls(made.effects, made.values, made.lag_s, made._observed(unit, 1)[..., 3:].transpose(1, 2))

    def undone(self, velocity: Tensor, each: int) -> Tensor:
        """Filtered true velocities (P * each, 3) that are measured as ``velocity``."""
        if self.seen is None:
            return velocity
        back = torch.linalg.inv(self.seen).repeat_interleave(each, dim=0)
        true: Tensor = (back @ velocity[:, :, None])[:, :, 0]
        return true

    def done(self, states: Tensor, filtered: Tensor, period_s: float, each: int) -> Tensor:
        """What is measured of true states (P * each, T + 1, 6) that begin with the filter at ``filtered`` (., 3)."""
        if self.lag_s is not None:
            states = torch.cat([states[:, :, :3], self.filtered(states, filtered, period_s, each)], dim=2)
        return states if self.seen is None else self._observed(states, each)

    def filtered(self, states: Tensor, begin: Tensor, period_s: float, each: int) -> Tensor:
        """Velocities (P * each, T + 1, 3) of states (., T + 1, 6) after a filter that begins at ``begin`` (., 3)."""
        assert self.lag_s is not None
        ops, lag_s = torch_ops(begin[:, 0]), self.lag_s.repeat_interleave(each)
        shown = [tuple(begin.unbind(dim=1))]
        for k in range(states.shape[1] - 1):
            first, last = (tuple(states[:, j, 3:].unbind(dim=1)) for j in (k, k + 1))
            shown.append(filter_velocities(ops, shown[-1], first, last, period_s, lag_s))
        return torch.stack([torch.stack(v, dim=1) for v in shown], dim=1)

    def _observed(self, states: Tensor, each: int) -> Tensor:
        """States (P * each, T, 6) through all effects in their order."""
        rows = tuple(states.unbind(dim=2))
        ops = torch_ops(rows[0])
        for name, own in zip(self.effects, self.values, strict=True):
            effect = EFFECTS[name]
            assert isinstance(effect, ObservationEffect)
            many = {key: v.repeat_interleave(each)[:, None].expand_as(rows[0]) for key, v in own.items()}
            rows = effect.observe(ops, rows, many)
        return torch.stack(rows, dim=2)


__all__ = ["LATENCY_EFFECT", "Measured"]
