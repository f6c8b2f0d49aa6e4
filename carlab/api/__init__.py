"""The Python interface: load, load_car, predict, diagnose, check, drive, replay, learn.

``carlab`` re-exports these names. The command line is a layer over it: each option of a verb is an argument of the same
name. Nothing here prints. Heavy libraries (torch, scipy, matplotlib, rerun) are imported by the call that needs them.
"""

from carlab.api.cars import load_car
from carlab.api.checking import CarCheck, check
from carlab.api.diagnosis import DiagnosisReport, diagnose
from carlab.api.driving import DriveRun, drive, replay
from carlab.api.learning import LearnHooks, LearnRun, learn
from carlab.api.prediction import PredictionErrors, predict
from carlab.api.recordings import Recording, load
from carlab.api.runs import RunHooks

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
    "diagnose",
    "drive",
    "learn",
    "load",
    "load_car",
    "predict",
    "replay",
]
