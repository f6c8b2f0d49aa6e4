"""Models of a diagnosis after its search: uncatalogued physics, measured curves, networks, adaptation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.curves.curve_fit import CurveFit, fit_curves
from carlab.diagnosis.curves.support import without_extrapolation
from carlab.diagnosis.drift import Adaptation, adapt_to_held_out
from carlab.diagnosis.evidence import ScoredSearch, unexplained_share
from carlab.diagnosis.findings import Ceiling, CurveTrial, DataFault, FitErrors, RecordingUse, final_model_name
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.recordings import SplitRecordings
from carlab.diagnosis.selection.problem import RunControl
from carlab.diagnosis.settings import DiagnosisSettings
from carlab.prediction.errors import final_errors
from carlab.prediction.network_ensemble import train_ensemble
from carlab.prediction.predict import ConstantVelocity, PredictiveModel, SimulatorModel
from carlab.prediction.windows import PredictionWindows
from sim_backends.car_parameters import SimulatorConfig


@dataclass(frozen=True, slots=True)
class Request:
    """Arguments of ``diagnose``."""

    nominal: SimulatorConfig
    uses: Sequence[RecordingUse]
    data_faults: Sequence[DataFault]
    effects: Sequence[str] | None
    held_out_share: float
    seed: int
    settings: DiagnosisSettings
    curves: bool
    ceiling: bool
    discrepancy: bool
    adapt: bool
    keep_events: bool


def fitted_score(scored: ScoredSearch, recordings: SplitRecordings, request: Request) -> float:
    """Score [noise floors] of the model with effects at the end of the windows that were fitted."""
    fitted = HeldOut.of(recordings.fit_windows, scored.held_out.noise, request.nominal)
    return fitted.score(fitted.final_error(scored.found.best.config))


def errors_with_events(
    models: Mapping[str, PredictiveModel],
    errors: Mapping[str, FloatArray],
    held_out: HeldOut,
    event_windows: PredictionWindows,
) -> dict[str, FitErrors]:
    """Held-out errors of all models with the windows that events left out; empty without such windows."""
    if not len(event_windows):
        return {}
    together = {name: np.concatenate([errors[name], final_errors(m, event_windows)]) for name, m in models.items()}
    return {name: held_out.summary(each) for name, each in together.items()}


def measured_curves(
    scored: ScoredSearch, described: Fit | None, recordings: SplitRecordings, request: Request, control: RunControl
) -> tuple[CurveFit | None, CurveTrial | None]:
    """Measured curves if they are wanted, and the model leaves a residual that a curve may explain.

    The model is the fit ``described`` with uncatalogued physics, if that describes the residual, else the effects.

    Returns:
        The fit with accepted curves, and what the stage did; None without this stage, and if the user ended it.
    """
    settings = request.settings.curves
    if not request.curves:
        return None, None
    if unexplained_share(scored, described) < settings.min_unexplained_share:
        return None, CurveTrial(is_fitted=False)
    found, rejected = (None, ()) if control.stop() else fit_curves(scored.problem, scored.found, control)
    if found is not None:
        return without_extrapolation(found, recordings.fit_segments, settings), CurveTrial(True, rejected)
    if control.stop():
        control.omit("measured curves")
        return None, None
    return None, CurveTrial(True, rejected)


def trained_models(
    scored: ScoredSearch,
    described: Fit | None,
    measured: CurveFit | None,
    adaptation: Adaptation | None,
    recordings: SplitRecordings,
    request: Request,
    control: RunControl,
) -> dict[str, PredictiveModel]:
    """All models whose held-out errors are reported; networks are trained on the recordings to fit.

    A network whose training the user ended is omitted: its error says nothing about what can be predicted.
    """
    found = scored.found
    models: dict[str, PredictiveModel] = {
        "nominal": SimulatorModel(scored.problem.nominal),
        "refit": SimulatorModel(found.base.config),
        "with_effects": SimulatorModel(found.best.config),
    }
    if described is not None:
        models["with_uncatalogued_physics"] = SimulatorModel(described.config)
    if measured is not None:
        models["with_curves"] = SimulatorModel(measured.fit.config)

    networks = (
        ("with_discrepancy", "learned discrepancy", request.discrepancy, models[final_model_name(models)]),
        ("black_box", "black box", request.ceiling, None),
    )
    for key, name, is_requested, simulator in networks:
        if not is_requested:
            continue
        trained = train_ensemble(
            recordings.fit_segments,
            simulator=simulator,
            seed=request.seed,
            velocity_window_s2=recordings.fit_windows.velocity_window_s2,
            progress=control.progress,
            stop=control.stop,
        )
        if control.stop():
            control.omit(name)
        else:
            models[key] = trained
    if adaptation is not None:
        models["adapted"] = adaptation.model
    return models | {"constant_velocity": ConstantVelocity()}


def adapted(
    corrected: ScoredSearch, recordings: SplitRecordings, request: Request, control: RunControl
) -> Adaptation | None:
    """The corrected simulator, that of the fit, adapted along the held-out recordings, if it is wanted."""
    if not request.adapt:
        return None
    if control.stop():
        control.omit("adaptation")
        return None
    control.progress("adapting along the held-out recordings", 0.93)
    segments = recordings.fit_segments, recordings.held_out_segments
    return adapt_to_held_out(corrected.fit.config, *segments, corrected.held_out)


def ceiling_of(refit_score: float, model_score: float, network_score: float) -> Ceiling | None:
    """Shares of the refit's squared excess by held-out scores [noise floors]; None if the refit has no excess.

    ``network_score`` is the lower score of black box and learned discrepancy.

    The best of model and networks is the estimate of what can be explained. It is a lower bound: a larger network or
    more recordings may predict more.
    """
    excess, model, network = (max(score**2 - 1.0, 0.0) for score in (refit_score, model_score, network_score))
    if excess <= 0.0:
        return None
    model = min(model, excess)
    best = min(model, network)
    return Ceiling((excess - model) / excess, (model - best) / excess, best / excess)


def ceiling_by_networks(errors: Mapping[str, FitErrors]) -> Ceiling | None:
    """The ceiling by the better of black box and learned discrepancy; None without both."""
    networks = [errors[name].score for name in ("black_box", "with_discrepancy") if name in errors]
    if not networks:
        return None
    return ceiling_of(errors["refit"].score, errors[final_model_name(errors)].score, min(networks))
