"""The Python interface: load, load_car, predict, diagnose, compare, check, drive, replay, learn, save_run.

``carlab`` re-exports these names. The command line calls this interface: each option of a verb is an argument of the
same name. The interface does not print. Each call imports the heavy libraries that it needs (torch, scipy, matplotlib,
rerun).
"""

from carlab.api.cars import load_car
from carlab.api.checking import CarCheck, check
from carlab.api.comparison import compare
from carlab.api.diagnosis import DiagnosisReport, diagnose
from carlab.api.drive_run import DriveRun
from carlab.api.driving import drive, replay
from carlab.api.learning import LearnRun, learn
from carlab.api.prediction import PredictionErrors, predict
from carlab.api.recordings import Recording, load, save_run
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.episodes.hooks import RunHooks

__all__ = [
    "CarCheck",
    "DiagnosisReport",
    "DriveRun",
    "LearnHooks",
    "LearnRun",
    "PredictionErrors",
    "Recording",
    "RunHooks",
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
