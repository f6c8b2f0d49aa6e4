"""The black box and the learned discrepancy against closed forms, the constant-velocity baseline and a known car."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from carlab.core.errors import DataError
from carlab.diagnosis.final_models import ceiling_of
from carlab.prediction.errors import final_errors
from carlab.prediction.network_ensemble import EnsembleSettings, train_ensemble
from carlab.prediction.predict import ConstantVelocity, SimulatorModel
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

SMALL = EnsembleSettings(updates=150, check_every=50, n_networks=2, hidden_units=32, batch_windows=48)


@pytest.fixture(scope="module")
def segments():
    return segments_of([drive(SimulatorConfig(control_period_s=PERIOD_S), 70.0, 11)])


@pytest.fixture(scope="module")
def model(segments):
    return train_ensemble(segments, SMALL)


@pytest.fixture(scope="module")
def held_out():
    return cut_windows(segments_of([drive(SimulatorConfig(control_period_s=PERIOD_S), 30.0, 12)]), 1.0, 0.25)


def rms(model, windows):
    return np.sqrt(np.mean(final_errors(model, windows) ** 2, axis=0))


def test_black_box_predicts_held_out_windows_better_than_constant_velocity(model, held_out):
    assert (rms(model, held_out)[[0, 1, 2, 3, 5]] < 0.5 * rms(ConstantVelocity(), held_out)[[0, 1, 2, 3, 5]]).all()


def test_networks_without_output_keep_the_velocities_constant(model, held_out):
    silent = replace(model, weights=tuple(torch.zeros_like(w) for w in model.weights))
    expected = ConstantVelocity().predict(held_out)
    assert silent.predict(held_out) == pytest.approx(expected, abs=3e-3)
    assert silent.predict(held_out)[..., 3:] == pytest.approx(expected[..., 3:], abs=1e-5)


def test_prediction_moves_with_the_frame_of_the_recording(model, held_out):
    turn, shift = 1.3, np.array([4.0, -2.0])
    c, s = np.cos(turn), np.sin(turn)

    def moved(states):
        out = states.copy()
        out[..., 0] = shift[0] + c * states[..., 0] - s * states[..., 1]
        out[..., 1] = shift[1] + s * states[..., 0] + c * states[..., 1]
        out[..., 2] += turn
        return out

    elsewhere = replace(
        held_out, initial_states=moved(held_out.initial_states), past_states=moved(held_out.past_states),
        measured=moved(held_out.measured),
    )  # fmt: skip
    assert model.predict(elsewhere) == pytest.approx(moved(model.predict(held_out)), abs=1e-4)


def test_training_repeats_with_the_same_seed(segments, held_out):
    short = replace(SMALL, updates=20)
    first, again, other = (train_ensemble(segments, short, seed=k).predict(held_out) for k in (3, 3, 4))
    assert (first == again).all()
    assert not (first == other).all()


def test_stop_ends_the_training_with_a_usable_model(segments, held_out):
    model = train_ensemble(segments, SMALL, stop=lambda: True)
    assert np.isfinite(model.predict(held_out)).all()


def test_short_recordings_are_refused_in_one_sentence():
    segments = segments_of([drive(SimulatorConfig(control_period_s=PERIOD_S), 10.0, 1)])
    with pytest.raises(DataError, match="contain 10 s of driving; a network needs at least 60 s"):
        train_ensemble(segments)


def test_windows_with_another_rate_are_refused(model, held_out):
    with pytest.raises(DataError, match=r"was trained at 30\.0 Hz and the windows have 60\.0 Hz"):
        model.predict(replace(held_out, period_s=PERIOD_S / 2))


@pytest.fixture(scope="module")
def weak_motor():
    """A simulator with two thirds of the drive force of the recorded car."""
    car = SimulatorConfig(control_period_s=PERIOD_S)
    return SimulatorModel(car.with_values({"motor.drive_gain": car.values()["motor.drive_gain"] * 2 / 3}))


@pytest.fixture(scope="module")
def corrected(segments, weak_motor):
    return train_ensemble(segments, SMALL, simulator=weak_motor)


def test_discrepancy_without_output_is_the_simulator(corrected, weak_motor, held_out):
    silent = replace(corrected, weights=tuple(torch.zeros_like(w) for w in corrected.weights))
    expected = weak_motor.predict(held_out)
    assert silent.predict(held_out)[..., 3:] == pytest.approx(expected[..., 3:], abs=1e-4)
    assert silent.predict(held_out)[..., :3] == pytest.approx(expected[..., :3], abs=0.01)  # trapezoidal rule


def test_discrepancy_corrects_a_wrong_drive_force(corrected, weak_motor, held_out):
    before, after = rms(weak_motor, held_out), rms(corrected, held_out)
    assert after[0] < 0.3 * before[0]
    assert after[3] < 0.3 * before[3]


def test_discrepancy_of_the_true_simulator_adds_little_error(segments, held_out):
    truth = SimulatorModel(SimulatorConfig(control_period_s=PERIOD_S))
    corrected = train_ensemble(segments, SMALL, simulator=truth)
    assert (rms(corrected, held_out)[:2] < rms(truth, held_out)[:2] + 0.01).all()


@pytest.mark.parametrize(
    ("scores", "shares"),
    [
        ((np.sqrt(101.0), np.sqrt(26.0), np.sqrt(11.0)), (0.75, 0.15, 0.10)),
        ((np.sqrt(101.0), np.sqrt(11.0), np.sqrt(26.0)), (0.90, 0.0, 0.10)),  # the model beats the black box
        ((np.sqrt(101.0), np.sqrt(201.0), np.sqrt(51.0)), (0.0, 0.5, 0.5)),  # the model is worse than the refit
    ],
)
def test_shares_of_the_ceiling_split_the_squared_excess(scores, shares):
    ceiling = ceiling_of(*scores)
    assert (ceiling.by_model, ceiling.predictable, ceiling.unpredictable) == pytest.approx(shares)
    assert ceiling.explained_of_predictable == pytest.approx(shares[0] / (shares[0] + shares[1]))


def test_refit_at_the_noise_floor_has_no_ceiling():
    assert ceiling_of(0.98, 0.97, 1.4) is None
