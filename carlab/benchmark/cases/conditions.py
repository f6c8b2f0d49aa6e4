"""Conditions of driving, recording and car file that make a case harder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from carlab.benchmark.effects.data_faults import Table

BaseModel = Literal["same", "linear_tyre", "kinematic"]
SHORT_FIT_S = 30.0
"""A recording to fit of at most this length counts as short [s]."""
MAX_DELAY_PERIODS = 0.9
"""Largest delay of a stamp, so that stamps keep their order [control periods]."""


@dataclass(frozen=True)
class Conditions:
    """Conditions of a case; the default is that of the full set.

    base_model            kind of model that the car file states; "same" as the true car
    feedback_only         commands are a function of state, path and target speed
    stamp_delay_periods   mean of the exponential delay of the logged stamps [control periods]
    """

    base_model: BaseModel = "same"
    feedback_only: bool = False
    stamp_delay_periods: float = 0.0

    def names(self, fit_s: float) -> list[str]:
        """The conditions that differ from those of the full set, with a recording to fit of ``fit_s``."""
        present = {
            "short recording": fit_s <= SHORT_FIT_S,
            f"base model {self.base_model}": self.base_model != "same",
            "feedback only": self.feedback_only,
            "stamp jitter": self.stamp_delay_periods > 0.0,
        }
        return [name for name, is_present in present.items() if is_present]

    def implied_effects(self) -> tuple[str, ...]:
        """Effects that a wrong car file lacks whatever is concealed: linear tyres and wheels without slip saturate."""
        return () if self.base_model == "same" else ("tyre_saturation",)


def with_stamp_delays(table: Table, mean_s: float, period_s: float, rng: np.random.Generator) -> Table:
    """The recording with stamps of a logger that receives each row late by an exponential delay, in order."""
    delays = np.minimum(rng.exponential(mean_s, len(table["t"])), MAX_DELAY_PERIODS * period_s)
    return {**table, "t": table["t"] + delays}
