"""Test the study of priors: equal rows for each prior, and no influence of held-out rows."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
import torch
from linear_simulator import mean_and_scale
from scipy.special import logsumexp
from scipy.stats import norm

from carlab.cars import load_car_file
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.core.quantities import FloatArray
from carlab.experiment.campaign.campaign import check_period
from carlab.studies.concealed_recordings import record_pair
from carlab.studies.priors import (
    DIAGNOSED,
    KINEMATIC,
    NOMINAL,
    NONE,
    InDomain,
    prior_models,
    run_prior_study,
)
from carlab.studies.regression import methods as regression_methods
from carlab.studies.regression import recordings as regression_recordings
from carlab.studies.regression.recordings import DELAY_S, RecordedCase, check_periods, recorded_case
from carlab.studies.regression.study import run_study
from learning.baselines.ridge import Ridge
from learning.outliers import tail_scales
from learning.posterior.inference import infer
from learning.posterior.residuals import fit_residuals
from learning.priors.domain_models import draw_parameters
from learning.priors.simulator_model import DELAY, CarModel, known_ranges
from learning.world.history import HistoryChoice
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.measured_rollout import measured_rollout

HISTORY = 5
TRUTH = SimulatorConfig.from_preset().with_values(
    {"effects.motor_lag.time_constant": 0.09, "effects.mocap_yaw_misalignment.angle": 0.08}
)
KNOWN = replace(
    TRUTH, parameter_std={"effects.motor_lag.time_constant": 0.004, "effects.mocap_yaw_misalignment.angle": 0.004}
)


def drive(seed: int, ticks: int = 240) -> EpisodeData:
    """Simulate a noisy recording of the true car."""
    rng = np.random.default_rng(seed)
    sent = np.repeat(rng.uniform(-1, 1, size=(ticks // 6, 2)), 6, axis=0)
    sent[:, 1] = 0.1 + 0.5 * np.abs(sent[:, 1])
    start = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]], dtype=torch.float64)
    measured = measured_rollout(TRUTH, start, torch.from_numpy(sent[None])).measured
    states = measured[0].numpy() + rng.normal(size=(ticks + 1, 6)) * [3e-4, 3e-4, 1e-3, 5e-3, 5e-3, 0.02]
    return EpisodeData(np.arange(ticks + 1) * TRUTH.control_period_s, states, sent, sent, np.zeros(ticks))


def case_of(held_out: EpisodeData, history: int | None = HISTORY) -> RecordedCase:
    return recorded_case([[drive(1)], [held_out]], Path("rc_car"), history)


def test_world_nll_equals_monte_carlo_at_the_measured_states() -> None:
    """The reference draws ridge predictions and rotates them by the recorded headings."""
    held_out = drive(2)
    case = case_of(held_out)
    (score,) = run_study(case, rows=(100,), seeds=1, methods=("ridge",), data=Path())
    data = case.recorded(Path(), 100, 0)
    model = Ridge.fit(data.inputs.double().numpy(), data.outputs.double().numpy())
    mean = model(data.test_inputs.double().numpy())
    rows = np.arange(HISTORY, held_out.ticks)
    assert len(mean) == len(rows)  # each tick has a row
    before, after = held_out.states[rows], held_out.states[rows + 1]
    residuals = fit_residuals(torch.from_numpy(model.errors))
    rng, yaw = np.random.default_rng(0), before[:, 2:3]

    def seven_drawn(factor: FloatArray) -> FloatArray:
        drawn = mean[:, None] + rng.normal(size=(len(mean), 500, 6)) @ factor.T
        ahead, left = drawn[..., 0], drawn[..., 1]
        displacement = np.cos(yaw) * ahead - np.sin(yaw) * left, np.sin(yaw) * ahead + np.cos(yaw) * left
        heading, vx, vy = yaw + drawn[..., 2], before[:, 3:4] + drawn[..., 3], before[:, 4:5] + drawn[..., 4]
        velocity = np.cos(heading) * vx - np.sin(heading) * vy, np.sin(heading) * vx + np.cos(heading) * vy
        return np.stack([*displacement, np.sin(heading), np.cos(heading), *velocity, drawn[..., 5]], axis=-1)

    sin, cos = np.sin(after[:, 2]), np.cos(after[:, 2])
    truth = np.column_stack([
        *(after[:, :2] - before[:, :2]).T, sin, cos,
        cos * after[:, 3] - sin * after[:, 4], sin * after[:, 3] + cos * after[:, 4], after[:, 5] - before[:, 5],
    ])  # fmt: skip
    # Approximate the Student-t distribution by twenty Gaussians.
    log_densities = []
    for scale in tail_scales(residuals.dof, 20).numpy():
        seven = seven_drawn(scale * residuals.factor.numpy())
        log_densities.append(norm.logpdf(truth, seven.mean(axis=1), seven.std(axis=1)).sum(axis=1))
    expected = math.log(20.0) - logsumexp(log_densities, axis=0).mean()
    assert score.nll_in_world == pytest.approx(expected, abs=0.05)


def test_training_rows_exclude_held_out_rows() -> None:
    case = case_of(drive(2))
    for count, seed in ((20, 0), (200, 1)):
        data = case.recorded(Path(), count, seed)
        training_rows = {row.tobytes() for row in data.inputs.numpy()}
        assert len(training_rows) == count == len(data.outputs)
        assert not training_rows & {row.tobytes() for row in data.test_inputs.numpy()}
        assert {row.tobytes() for row in data.test_inputs.numpy()} == {
            row.astype(np.float32).tobytes()
            for row in case_of(drive(2)).held_out.inputs  # type: ignore[union-attr]
        }


def test_expected_discrepancy_is_smaller_with_few_rows_and_for_pose_outputs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case: RecordedCase = recorded_case([[drive(1, 480)], [drive(2)]], Path("rc_car"), HISTORY)
    received: list[torch.Tensor] = []

    def recorded_call(*args: object, discrepancy_std: torch.Tensor, **options: object) -> None:
        received.append(discrepancy_std / torch.tensor(case.output_std))
        raise DataError("Enough.")

    monkeypatch.setattr(regression_methods, "infer", recorded_call)
    for name, value in (("STEPS", 4), ("REFINEMENT_STEPS", 2), ("N_SCREENED", 32)):  # GreyBox is not used
        monkeypatch.setattr(f"learning.baselines.system_identification.{name}", value)
    few, many = 100, 450
    list(run_study(case, rows=(few, many), seeds=1, methods=("gp-sim-posterior", "GreyBox"), data=Path()))
    assert [a.tolist() for a in received] == [pytest.approx([0.03] * 3 + [0.1] * 3)] * 2 + [
        pytest.approx([0.3] * 6)
    ] * 2


def test_only_scores_depend_on_the_held_out_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """History, units, ranges and delays depend on the training recordings only."""
    received: list[int] = []

    def recorded_call(episodes: list[EpisodeData]) -> HistoryChoice:
        received.extend(id(e) for e in episodes)
        return HistoryChoice(3, {3: -1.0})

    monkeypatch.setattr(regression_recordings, "find_history", recorded_call)
    first, different = drive(1), drive(3)
    different = replace(different, states=different.states * 3.0, sent=-different.sent)
    one, other = (recorded_case([[first], [held]], Path("rc_car"), None) for held in (drive(2), different))
    assert set(received) == {id(first)}
    assert (one.output_std, one.input_std, one.rows.history) == (other.output_std, other.input_std, other.rows.history)  # type: ignore[union-attr]
    models = [prior_models(case, SimulatorConfig.from_preset(), KNOWN) for case in (one, other)]
    assert list(models[0]) == [NONE, KINEMATIC, NOMINAL, DIAGNOSED]
    assert repr(models[0]) == repr(models[1])


def test_priors_have_the_parameters_of_their_car_files() -> None:
    case = case_of(drive(2))
    models = prior_models(case, SimulatorConfig.from_preset(), KNOWN)
    assert models[NONE] is None
    nominal, kinematic, diagnosed = models[NOMINAL], models[KINEMATIC], models[DIAGNOSED]
    assert isinstance(nominal, CarModel)
    assert isinstance(kinematic, InDomain)
    assert isinstance(diagnosed, InDomain)
    assert isinstance(kinematic.model, CarModel)
    assert isinstance(diagnosed.model, CarModel)
    preset = SimulatorConfig.from_preset()
    assert kinematic.model.config.kind == "kinematic"
    assert kinematic.model.ranges["motor.drive_gain"] == preset.priors.get(
        "motor.drive_gain", pytest.approx((0.7 * 8.2, 1.3 * 8.2))
    )
    assert not nominal.config.effects
    assert set(diagnosed.model.config.effects) == {"motor_lag", "mocap_yaw_misalignment"}
    assert "effects.motor_lag.time_constant" in diagnosed.model.ranges
    assert kinematic.domain is nominal is diagnosed.domain
    assert nominal.at_s == pytest.approx(case.rows.tick.mean() * TRUTH.control_period_s)  # type: ignore[union-attr]


def test_recorded_case_uses_the_standard_deviations_of_a_diagnosed_car(tmp_path: Path) -> None:
    """The prior equals that of the study of priors; uncertain diagnosed parameters are not fixed."""
    path = tmp_path / "model.toml"
    path.write_text(tomli_w.dumps(KNOWN.to_tables()))
    case = recorded_case([[drive(1)], [drive(2)]], path, HISTORY)
    simulator = load_car_file(path).simulator
    assert isinstance(case.prior, CarModel)
    assert set(KNOWN.parameter_std) == set(simulator.parameter_std) <= set(case.prior.ranges)
    assert repr(case.prior) == repr(prior_models(case, simulator, simulator)[NOMINAL])
    drawn = draw_parameters(case.prior, 400, torch.Generator().manual_seed(0))
    lags = drawn[:, case.prior.names.index("effects.motor_lag.time_constant")]
    assert 0.002 < float((lags - 0.09).abs().median()) < 0.02


def test_nominal_car_prior_varies_only_parameters_with_ranges() -> None:
    """The file has neither standard deviations nor effects, as in the published results."""
    car = load_car_file(Path("eth_rc_car")).simulator
    case = recorded_case([[drive(1)], [drive(2)]], Path("eth_rc_car"), HISTORY)
    assert isinstance(case.prior, CarModel)
    assert not car.parameter_std
    assert not car.effects
    assert case.prior.config == car
    assert list(case.prior.ranges.items()) == [(DELAY, DELAY_S), *car.priors.items()]
    assert DELAY not in car.priors
    draws = draw_parameters(case.prior, 3, torch.Generator().manual_seed(0))
    inputs = case.recorded(Path(), 20, 0).inputs
    before = replace(case.prior, at_s=0.0)
    assert torch.equal(case.prior(inputs, draws), before(inputs, draws))


def test_car_file_without_ranges_gets_default_ranges(tmp_path: Path) -> None:
    bare = replace(SimulatorConfig.from_preset(), priors={})
    path = tmp_path / "bare.toml"
    path.write_text(tomli_w.dumps(bare.to_tables()))
    case = recorded_case([[drive(1)], [drive(2)]], path, HISTORY)
    assert isinstance(case.prior, CarModel)
    assert case.prior.ranges["motor.drive_gain"] == pytest.approx((0.7 * 8.2, 1.3 * 8.2))
    assert dict(case.prior.ranges) == {DELAY: DELAY_S, **known_ranges(case.prior.config)}


def test_recording_with_another_period_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "slow.toml"
    path.write_text(tomli_w.dumps(replace(SimulatorConfig.from_preset(), control_period_s=0.05).to_tables()))
    with pytest.raises(ConfigError, match=r"control_period of the prior is 0\.05 s, that of a recording is 0\.03333 s"):
        recorded_case([[drive(1)], [drive(2)]], path, HISTORY)


@pytest.mark.usefixtures("short_inference")
def test_study_has_a_score_for_each_prior() -> None:
    case = case_of(drive(2))
    models = prior_models(case, SimulatorConfig.from_preset(), KNOWN)
    scores = list(run_prior_study(case, models, rows=(20,), seeds=1, steps=20))
    assert [(s.method, s.rows, s.seed) for s in scores] == [
        (name, 20, 0) for name in (NONE, KINEMATIC, NOMINAL, DIAGNOSED)
    ]
    assert len({s.nll for s in scores}) == 4


@pytest.mark.usefixtures("short_inference")
def test_failed_fit_of_one_prior_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(task: object) -> object:
        raise DataError("The fit diverged; fit again with a smaller learning rate.")

    case = case_of(drive(2))
    models = prior_models(case, SimulatorConfig.from_preset(), KNOWN)
    monkeypatch.setitem(regression_methods.METHODS, "gp-posterior", broken)
    scores = list(run_prior_study(case, {n: models[n] for n in (NONE, NOMINAL)}, rows=(20,), seeds=1, steps=20))
    assert [(s.method, s.failed is None) for s in scores] == [(NONE, False), (NOMINAL, True)]
    assert "The fit diverged" in str(scores[0].failed)


def test_diagnosed_prior_has_lower_nll_than_nominal_with_20_rows() -> None:
    """The test uses the function posterior, before distillation into particles."""
    case = case_of(drive(2))
    models = prior_models(case, SimulatorConfig.from_preset(), KNOWN)
    data, units = case.recorded(Path(), 20, 0), case.normaliser
    nll = {}
    for name in (NOMINAL, DIAGNOSED):
        found = infer(
            models[name], data.inputs, data.outputs, units, torch.tensor(case.prior_noise_std),
            discrepancy_std=0.3 * units.output_std,
        )  # fmt: skip
        mean, std = mean_and_scale(found.predict(data.test_inputs))
        nll[name] = -norm.logpdf(data.test_outputs, mean, std).sum(axis=1).mean()
    assert nll[DIAGNOSED] < nll[NOMINAL] - 0.4


def test_invalid_rows_periods_and_pairs_are_refused() -> None:
    case = case_of(drive(2))
    models = prior_models(case, SimulatorConfig.from_preset(), KNOWN)
    with pytest.raises(DataError, match="not 5000; give fewer with --rows"):
        next(run_prior_study(case, models, rows=(5000,)))
    slow = replace(KNOWN, control_period_s=0.05)
    with pytest.raises(ConfigError, match=r"is 0\.05 s, that of the car's file is 0\.03333 s"):
        prior_models(case, SimulatorConfig.from_preset(), slow)
    with pytest.raises(ConfigError, match=r"that of a recording is 0\.03333 s"):
        check_periods([[drive(1)]], slow)
    check_period(slow, 0.0501, "a recording")
    with pytest.raises(ConfigError, match="no pair 4; choose 1 to 3"):
        record_pair(4, Path("nowhere"), 100.0, 40.0)
