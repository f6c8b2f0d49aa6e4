"""Parking that ends as soon as the car is parked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from carlab.core.task import ParkingTask


@dataclass(frozen=True, slots=True)
class TerminatingParking(ParkingTask):
    """The episode ends with the first success."""

    def terminated(self, next_features: Any) -> Any:
        return self.success(next_features)
