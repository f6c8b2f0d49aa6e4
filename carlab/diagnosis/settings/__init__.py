"""Settings of the diagnosis: thresholds and search parameters of all stages, with meaning, unit and reason.

The thresholds that accept or reject effects are chosen on the concealed cases of ``carlab prove --set development``,
never on the test set. ``carlab prove --set development --calibrate`` states the false and missed names over the range
of each of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from carlab.diagnosis.settings.comparison import ComparisonSettings
from carlab.diagnosis.settings.drift import DriftSettings
from carlab.diagnosis.settings.events import EventSettings
from carlab.diagnosis.settings.evidence import EvidenceSettings, UnexplainedSettings
from carlab.diagnosis.settings.prediction import CurveSettings, IdentificationSettings, WindowSettings
from carlab.diagnosis.settings.quick import QuickSettings
from carlab.diagnosis.settings.report import ReportSettings
from carlab.diagnosis.settings.selection import RestartSettings, RivalSettings, ScreeningSettings, SelectionSettings


@dataclass(frozen=True, slots=True)
class DiagnosisSettings:
    """Settings that a single diagnosis may change, by stage."""

    windows: WindowSettings = field(default_factory=WindowSettings)
    curves: CurveSettings = field(default_factory=CurveSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    rivals: RivalSettings = field(default_factory=RivalSettings)


DEFAULT = DiagnosisSettings()
"""The settings of ``carlab diagnose`` and of the proof."""

COMPARISON = ComparisonSettings()
DRIFT = DriftSettings()
EVENTS = EventSettings()
EVIDENCE = EvidenceSettings()
IDENTIFICATION = IdentificationSettings()
QUICK = QuickSettings()
REPORT = ReportSettings()
RESTARTS = RestartSettings()
SCREENING = ScreeningSettings()
UNEXPLAINED = UnexplainedSettings()
"""Settings that are the same in every diagnosis, check and comparison."""

__all__ = [
    "COMPARISON",
    "DEFAULT",
    "DRIFT",
    "EVENTS",
    "EVIDENCE",
    "IDENTIFICATION",
    "QUICK",
    "REPORT",
    "RESTARTS",
    "SCREENING",
    "UNEXPLAINED",
    "CurveSettings",
    "DiagnosisSettings",
    "ScreeningSettings",
    "SelectionSettings",
    "WindowSettings",
]
