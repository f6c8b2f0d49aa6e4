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
from carlab.diagnosis.settings.selection import RivalSettings, ScreeningSettings, SelectionSettings


@dataclass(frozen=True, slots=True)
class DiagnosisSettings:
    """All settings of a diagnosis, by stage."""

    windows: WindowSettings = field(default_factory=WindowSettings)
    events: EventSettings = field(default_factory=EventSettings)
    identification: IdentificationSettings = field(default_factory=IdentificationSettings)
    curves: CurveSettings = field(default_factory=CurveSettings)
    screening: ScreeningSettings = field(default_factory=ScreeningSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    rivals: RivalSettings = field(default_factory=RivalSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    unexplained: UnexplainedSettings = field(default_factory=UnexplainedSettings)
    quick: QuickSettings = field(default_factory=QuickSettings)
    comparison: ComparisonSettings = field(default_factory=ComparisonSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    report: ReportSettings = field(default_factory=ReportSettings)


DEFAULT = DiagnosisSettings()
"""The settings of ``carlab diagnose`` and of the proof."""

__all__ = [
    "DEFAULT",
    "ComparisonSettings",
    "CurveSettings",
    "DiagnosisSettings",
    "DriftSettings",
    "EventSettings",
    "EvidenceSettings",
    "IdentificationSettings",
    "QuickSettings",
    "ReportSettings",
    "RivalSettings",
    "ScreeningSettings",
    "SelectionSettings",
    "UnexplainedSettings",
    "WindowSettings",
]
