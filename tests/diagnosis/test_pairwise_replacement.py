"""Replacement of effects by confusable effects."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.identification.fit_parameters import with_effect
from carlab.diagnosis.selection import pairwise_tests
from carlab.diagnosis.selection.elimination import EliminationResult, delete_each
from carlab.diagnosis.selection.pairwise_tests import PairwiseResult, choose_confusable, compare_pairs
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import fit_base, refit, refit_candidate
from carlab.diagnosis.selection.screening import screen_of
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

DELAY, LATENCY = "command_delay", "mocap_latency"


def test_two_effects_that_fit_equally_well_do_not_replace_one_another_again_and_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Here each comparison prefers the alternative, as it does if further iterations lower the cost each time."""
    car = SimulatorConfig(control_period_s=PERIOD_S)
    windows = cut_windows(segments_of([drive(car, 20.0, 1)]), 0.8, 0.6)
    problem = SearchProblem(car, windows, np.full(6, 1e-3), np.full(6, 1e-3), {})
    base = fit_base(problem)
    compared: list[tuple[str, ...]] = []

    def compare(problem: SearchProblem, eliminated: EliminationResult, control: RunControl) -> PairwiseResult:
        name = eliminated.model.effects[0]
        compared.append(eliminated.model.effects)
        other = LATENCY if name == DELAY else DELAY
        return PairwiseResult(replacements={name: Candidate(other, base.fit, 1.0)})

    monkeypatch.setattr(pairwise_tests, "compare_pairs", compare)
    monkeypatch.setattr(pairwise_tests, "delete_each", lambda _, model, control: EliminationResult(model, {}))
    monkeypatch.setattr(pairwise_tests, "refit", lambda _, effects, fit, scale: Model(effects, fit, scale))
    effects = (DELAY, "motor_lag", "steering_lag", "load_transfer")
    model, _ = choose_confusable(problem, EliminationResult(Model(effects, base.fit, base.scale), {}), RunControl())
    assert model.effects == (LATENCY, *effects[1:])
    assert compared == [effects, model.effects]


def test_indistinguishable_effect_within_its_range_replaces_one_at_a_bound() -> None:
    """The commands act 8.5 ms earlier than the car file states: 0.5 ms more than its latency of motion capture."""
    car = SimulatorConfig(control_period_s=PERIOD_S)
    recorded = drive(replace(car, command_delay_s=car.command_delay_s - 0.0005), 30.0, 1, noise=3e-3)
    windows = cut_windows(segments_of([recorded]), 0.8, 0.6)
    confusable = {LATENCY: (DELAY,), DELAY: (LATENCY,)}
    problem = SearchProblem(car, windows, np.full(6, 1e-2), np.full(6, 1e-2), confusable)
    base = fit_base(problem)
    model = refit(problem, (LATENCY,), base.fit, base.scale)
    assert model.fit.values()[f"effects.{LATENCY}.latency"] == 0.0
    chosen, pairs = choose_confusable(problem, delete_each(problem, model, RunControl()), RunControl())
    assert chosen.effects == (DELAY,)
    assert pairs.indistinguishable[DELAY] == (LATENCY,)
    assert chosen.fit.values()[f"effects.{DELAY}.extra_delay"] == pytest.approx(-0.0085, abs=0.003)


def test_sharp_limit_is_not_replaced_because_its_roundness_is_at_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sharp limit of the motor has the roundness 0, the lower bound. Here a controller predicts the same."""
    limit, controller = "motor_saturation", "speed_controller"
    car = SimulatorConfig(control_period_s=PERIOD_S)
    sharp = with_effect(car, limit).with_values({f"effects.{limit}.force": 3.0, f"effects.{limit}.roundness": 0.0})
    windows = cut_windows(segments_of([drive(sharp, 20.0, 1)]), 0.8, 0.6)
    problem = SearchProblem(car, windows, np.full(6, 1e-2), np.full(6, 1e-2), {})
    base = fit_base(problem)
    fitted = refit_candidate(problem, base, screen_of(problem, base).score(limit)).fit
    z = [0.0 if free.name.endswith(".roundness") else at for free, at in zip(fitted.free, fitted.z, strict=True)]
    model = Model((limit,), replace(fitted, z=np.array(z)), base.scale)
    assert model.fit.values()[f"effects.{limit}.roundness"] == 0.0
    equal = Candidate(controller, base.fit, 1.0), problem.left_out_loss_of_free_states(model.fit, model.scale)
    monkeypatch.setattr(pairwise_tests, "_fitted_alternatives", lambda *_: {limit: [equal]})
    pairs = compare_pairs(problem, delete_each(problem, model, RunControl()), RunControl())
    assert pairs.indistinguishable[limit] == (controller,)
    assert not pairs.replacements
