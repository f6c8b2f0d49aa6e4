"""Results of a diagnosis as data: the schema ``carlab.diagnosis/1``, and the data of its figures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from carlab.core.json_files import plain
from carlab.core.quantities import FloatArray
from carlab.core.recording_noise import RecordingNoise
from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.events import Event, EventUse
from carlab.diagnosis.measured import CurveAxis as CurveAxis
from carlab.diagnosis.measured import CurveFinding as CurveFinding
from carlab.diagnosis.measured import CurveTrial as CurveTrial
from carlab.diagnosis.measured import Estimate as Estimate
from carlab.diagnosis.measured import FormFinding as FormFinding
from carlab.diagnosis.measured import RejectedCurves as RejectedCurves
from carlab.diagnosis.settings import EVIDENCE

SCHEMA = "carlab.diagnosis/1"
SLOW_POSES = "slow_poses"
"""Id of the fault of velocities that are estimated from poses that are too far apart."""
Verdict = Literal["mismatch", "parameters", "none", "data", "unexplained", "inconclusive"]


@dataclass(frozen=True, slots=True)
class ErrorLocation:
    """Location of an effect's error; ``time`` is (start, end) [s], ``place`` is (x, y, radius) [m]."""

    channels: tuple[str, ...]
    regime: str
    lag_s: float | None = None
    time: tuple[float, float] | None = None
    place: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence for an effect on held-out recordings.

    held_out_error_reduction   relative fall of the held-out score when it is added last
    standard_errors            held-out log-likelihood gain over its clustered standard error
    visibility                 share of its influence that base parameters cannot reproduce
    deletion_fingerprint       relative rise of each channel's error when it is removed
    """

    held_out_error_reduction: float
    standard_errors: float
    visibility: float
    deletion_fingerprint: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class EffectFinding:
    """An accepted effect.

    Attributes:
        id: id of the effect.
        confidence: probability that the name is right.
        parameters: fitted value of each parameter.
        where: channels, regime, time and place of its influence.
        evidence: its strength on held-out windows.
        sentence: the finding with its numbers.
        indistinguishable_from: effects that explain the recordings as well.
        separating_drive: the manoeuvre that separates this set.
        car_file_values: value of each parameter in the car file; empty if the car file does not state the effect.
    """

    id: str
    confidence: float
    parameters: Mapping[str, Estimate]
    where: ErrorLocation
    evidence: Evidence
    sentence: str
    indistinguishable_from: tuple[str, ...] = ()
    separating_drive: str = ""
    car_file_values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FitErrors:
    """Root mean square held-out errors after the horizon: position, yaw, vx, vy [m/s], yaw rate [rad/s].

    ``score`` is their root mean square in noise floors.
    """

    position_m: float
    yaw_rad: float
    vx: float
    vy: float
    yaw_rate: float
    score: float


@dataclass(frozen=True, slots=True)
class Unexplained:
    """Residual with all accepted effects: share of the squared excess, channels, regime, class and formula."""

    share: float
    channels: tuple[str, ...]
    regime: str
    kind: str
    formula: str


@dataclass(frozen=True, slots=True)
class Ceiling:
    """How much of the refit's squared excess can be explained from past commands and velocities.

    Shares add up to 1: ``by_model`` is what the diagnosed model explains, ``predictable`` what the better of black
    box and learned discrepancy predicts in addition, ``unpredictable`` what neither predicts.
    """

    by_model: float
    predictable: float
    unpredictable: float

    @property
    def explained_of_predictable(self) -> float:
        """Share of the explainable excess that the diagnosed model explains."""
        explainable = self.by_model + self.predictable
        return self.by_model / explainable if explainable > 0.0 else 1.0


@dataclass(frozen=True, slots=True)
class Skill:
    """Position errors of the diagnosed model and of constant velocity on one held-out recording in one regime.

    Attributes:
        recording: number of the recording, from 1.
        regime: "all", "steady commands", "changing commands", "low speed" or "high speed" (halves of its windows).
        windows: number of windows.
        model_m: root mean square position error of the model after the horizon [m].
        constant_velocity_m: that of constant body velocities and yaw rate, from the same windows [m].
        travelled_m: mean distance that the car travels in a window [m].
        standard_errors: mean fall of the position error by the model over its clustered standard error.
    """

    recording: int
    regime: str
    windows: int
    model_m: float
    constant_velocity_m: float
    travelled_m: float
    standard_errors: float


@dataclass(frozen=True, slots=True)
class QuantityChange:
    """A quantity of the car that changed since the fitted recordings.

    Attributes:
        quantity: "drive force", "steering trim", "grip" or "force forward".
        unit: of the values; 1 for a share of the simulator's own force.
        value: mean over the recording after its first quarter, less the mean of the fitted recordings.
        std: standard deviation of that: of the filter, and of the same estimate along the fitted recordings, where the
            car has not changed.
        first, last: the same over the first and the last quarter of the recording.
    """

    quantity: str
    unit: str
    value: float
    std: float
    first: float
    last: float


@dataclass(frozen=True, slots=True)
class Drift:
    """Adaptation to one held-out recording, and the drift of the car that it shows.

    Attributes:
        recording: number of the recording, from 1.
        is_drift: whether a slow adaptation predicts held-out windows better, by the minimum number of standard errors,
            than the simulator, than the simulator with the mean disturbance of the fitted recordings, and than the
            simulator corrected by the mean error of fitted windows in similar states.
        changes: quantities that changed, largest gain first; empty without a drift, or if no single one is significant.
        time_constant_s: time constant of the slow adaptation with the highest weight [s].
        model_m, adapted_m, slow_m, similar_states_m: root mean square position errors after the horizon [m] of the
            simulator, of the adapted prediction, of the slow adaptation, and of the simulator corrected by errors in
            similar states.
        standard_errors: smallest gain of the slow adaptation over these three, over its clustered standard error.
        similar_share: share of the windows with fitted windows in a similar state. If it is small, an error of the
            simulator that depends on the state explains a drift as well as a change of the car.
        t_s: (N,) times of the series since the first row [s].
        mean, std: (N, 4) estimated share of the drive force [1], steering trim [rad], share of the grip [1] and force
            forward per mass [m/s2], and their standard deviations.
    """

    recording: int
    is_drift: bool
    changes: tuple[QuantityChange, ...]
    time_constant_s: float
    model_m: float
    adapted_m: float
    slow_m: float
    similar_states_m: float
    standard_errors: float
    similar_share: float
    t_s: FloatArray
    mean: FloatArray
    std: FloatArray


@dataclass(frozen=True, slots=True)
class DataFault:
    """A fault of a recording."""

    id: str
    channel: str
    rows: int
    action: str


@dataclass(frozen=True, slots=True)
class RecordingUse:
    """A recording and its role: ``fit`` or ``held out``."""

    path: str
    sha256: str
    role: str


@dataclass(frozen=True, slots=True)
class Withdrawal:
    """An effect that the search accepted and a later test withdrew; ``reason`` is a clause that follows "because"."""

    id: str
    reason: str


@dataclass(frozen=True, slots=True)
class SearchExtent:
    """How far the search for effects went.

    Attributes:
        is_complete: whether it ended by itself.
        stopped_by: "budget" or "user" if it was cut short; else empty.
        budget_s: time limit [s]; None without one.
        effects: effects that the search was restricted to; empty for the whole catalogue.
        omitted: requested stages after the search that the user ended: the report lacks their results.
    """

    is_complete: bool = True
    stopped_by: str = ""
    budget_s: float | None = None
    effects: tuple[str, ...] = ()
    omitted: tuple[str, ...] = ()

    @property
    def covers_catalogue(self) -> bool:
        """Whether all effects of the catalogue were searched."""
        return self.is_complete and not self.effects


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of a diagnosis.

    ``held_out`` has nominal, refit, with_effects, constant_velocity and noise_floor; if uncatalogued physics describes
    the residual also with_uncatalogued_physics, with measured curves also with_curves, with a ceiling also black_box,
    with a discrepancy also with_discrepancy. ``held_out_with_events`` has the same models, scored with the windows that
    events left out; empty without such windows. ``fitted_score`` is that of with_effects on the windows that were
    fitted; NaN if unknown. ``held_out_share`` is the share of the last part of each recording that is held out; None if
    whole recordings are. ``car_file_parameters`` has the value of each of the ``parameters`` in
    the car file, if it states one. ``limits`` has estimates of the effects that are not named, by effect and
    parameter, and ``withdrawn`` the effects that the search accepted and a later test withdrew. ``curve_trial`` is None
    without measured curves as a stage, and if the user ended it.
    """

    verdict: Verdict
    sentence: str
    effects: tuple[EffectFinding, ...]
    parameters: Mapping[str, Estimate]
    horizon_s: float
    held_out: Mapping[str, FitErrors]
    unexplained: Unexplained | None
    data_faults: tuple[DataFault, ...]
    recordings: tuple[RecordingUse, ...]
    seed: int
    seconds: float
    advice: str = ""
    curves: tuple[CurveFinding, ...] = ()
    curve_trial: CurveTrial | None = None
    ceiling: Ceiling | None = None
    fitted_score: float = math.nan
    skill: tuple[Skill, ...] = ()
    drift: tuple[Drift, ...] = ()
    car_file_parameters: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)
    withdrawn: tuple[Withdrawal, ...] = ()
    search: SearchExtent = field(default_factory=SearchExtent)
    events: EventUse = field(default_factory=EventUse)
    held_out_with_events: Mapping[str, FitErrors] = field(default_factory=dict)
    held_out_share: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain data in the report's schema, ready for JSON; numbers that are not finite become null."""
        made = asdict(self)
        for effect in made["effects"]:
            where = effect["where"]
            if where["time"] is not None:
                where["time"] = {"kind": "drift", "from_s": where["time"][0], "to_s": where["time"][1]}
            if where["place"] is not None:
                where["place"] = dict(zip(("x", "y", "radius"), where["place"], strict=True))
        if (residual := made["unexplained"]) is not None:
            residual["class"] = residual.pop("kind")
            if not residual["share"] >= EVIDENCE.unexplained_share_min:
                made["unexplained"] = None
        stated = made.pop("car_file_parameters")
        for name, estimate in made["parameters"].items():
            estimate["car_file"] = stated.get(name)
        of_fit = ("horizon_s", "fitted_score", "held_out_share", "held_out")
        made["fit"] = {name: made.pop(name) for name in of_fit}
        made["events"]["held_out_with_events"] = made.pop("held_out_with_events")
        return dict(plain({"schema": SCHEMA, **made}))


def final_model_name(models: Iterable[str]) -> str:
    """Name of the model that model.toml contains, of the names of all models."""
    names = set(models)
    return next((n for n in ("with_curves", "with_uncatalogued_physics") if n in names), "with_effects")


@dataclass(frozen=True, slots=True)
class Trace:
    """One held-out recording and its predictions, each restarted every horizon.

    times_s (T + 1,) since the first row; recorded (T + 1, 6) in SI units; predicted by model (nominal, refit,
    with_effects), each (T + 1, 6), NaN without a prediction; marked: stretches (start, end) [s] with the largest errors
    of the refit. A fitted recording with events is a trace without predictions.
    """

    name: str
    times_s: FloatArray
    recorded: FloatArray
    predicted: Mapping[str, FloatArray]
    marked: tuple[tuple[float, float], ...] = ()
    events: tuple[Event, ...] = ()


@dataclass(frozen=True, slots=True)
class FigureData:
    """Data of the report's figures.

    traces: held-out recordings with their predictions, and fitted recordings with events
    scores_by_step: label and held-out score of: nominal, refit, each added effect, noise floor
    regimes: by feature name, bin centres (n,) and rms error in noise floors of refit and with_effects, each (n,)
    correlation: by effect id, lags [s] (n,), cross-correlation of the refit's residual with the effect's input (n,),
                 and the 99 % bound
    candidates: candidates for the first effect: id, gain on left-out blocks in standard errors (NaN without a test),
                loss with it
    decisions: accepted and rejected effects with statistics and thresholds
    noise: noise of the recordings, for model.toml
    """

    traces: tuple[Trace, ...] = ()
    scores_by_step: tuple[tuple[str, float], ...] = ()
    regimes: Mapping[str, tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=dict)
    correlation: Mapping[str, tuple[FloatArray, FloatArray, float]] = field(default_factory=dict)
    candidates: tuple[tuple[str, float, float], ...] = ()
    decisions: tuple[Decision, ...] = ()
    noise: RecordingNoise | None = None
