"""carlab: drive, learn and diagnose small race cars. The contract is re-exported here; everything else by module."""

from carlab.core.car import Car
from carlab.core.errors import CarlabError
from carlab.core.quantities import NEUTRAL, Action, CarState, Health, Observation, PoseSample, Reality

__version__ = "0.1.0"
__all__ = [
    "NEUTRAL",
    "Action",
    "Car",
    "CarState",
    "CarlabError",
    "Health",
    "Observation",
    "PoseSample",
    "Reality",
    "__version__",
]
