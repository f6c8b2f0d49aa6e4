"""carlab: drive, learn and diagnose small race cars.

    import carlab
    car = carlab.load_car("eth_rc_car")
    recording = carlab.load("train_1.csv.gz")
    report = carlab.diagnose(recording, car)
    report.model.save("model.toml")

The Python interface and the contract of a car are re-exported here, imported when they are first used; everything else
is reached by its module.
"""

import importlib
from typing import TYPE_CHECKING

from carlab.core.version import VERSION as __version__

if TYPE_CHECKING:
    from carlab.api.cars import load_car
    from carlab.api.checking import CarCheck, check
    from carlab.api.comparison import compare
    from carlab.api.diagnosis import DiagnosisReport, diagnose
    from carlab.api.drive_run import DriveRun
    from carlab.api.driving import drive, replay
    from carlab.api.learning import LearnRun, learn
    from carlab.api.prediction import PredictionErrors, predict
    from carlab.api.recordings import Recording, load, save_run
    from carlab.core.car import Car
    from carlab.core.errors import CarlabError
    from carlab.core.quantities import NEUTRAL, Action, CarState, Health, Observation, PoseSample, Reality
    from carlab.experiment.campaign.hooks import LearnHooks
    from carlab.experiment.episodes.hooks import RunHooks

_MODULES = {
    "api.cars": ("load_car",),
    "api.checking": ("CarCheck", "check"),
    "api.comparison": ("compare",),
    "api.diagnosis": ("DiagnosisReport", "diagnose"),
    "api.drive_run": ("DriveRun",),
    "api.driving": ("drive", "replay"),
    "api.learning": ("LearnRun", "learn"),
    "api.prediction": ("PredictionErrors", "predict"),
    "api.recordings": ("Recording", "load", "save_run"),
    "experiment.campaign.hooks": ("LearnHooks",),
    "experiment.episodes.hooks": ("RunHooks",),
    "core.car": ("Car",),
    "core.errors": ("CarlabError",),
    "core.quantities": ("NEUTRAL", "Action", "CarState", "Health", "Observation", "PoseSample", "Reality"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "NEUTRAL",
    "Action",
    "Car",
    "CarCheck",
    "CarState",
    "CarlabError",
    "DiagnosisReport",
    "DriveRun",
    "Health",
    "LearnHooks",
    "LearnRun",
    "Observation",
    "PoseSample",
    "PredictionErrors",
    "Reality",
    "Recording",
    "RunHooks",
    "__version__",
    "check",
    "compare",
    "diagnose",
    "drive",
    "learn",
    "load",
    "load_car",
    "predict",
    "replay",
    "save_run",
]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"carlab.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        """Public names, imported or not."""
        return sorted({*globals(), *__all__})
