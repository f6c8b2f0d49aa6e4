"""Test rows in the body frame, and recordings as a case of the regression study."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.studies.regression.cases import CASES, BodyFrameCar, in_body_frame
from carlab.studies.regression.recordings import recorded_case
from carlab.studies.regression.study import run_study
from learning.priors.domain_models import KinematicCar, draw_parameters
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.seeded import generator


def test_rotated_rows_match_complex_arithmetic() -> None:
    rng = np.random.default_rng(1)
    yaw, rotated = rng.uniform(-3.0, 3.0, 50), rng.uniform(-0.3, 0.3, 50)
    position, velocity, displacement, acceleration = (rng.normal(size=50) + 1j * rng.normal(size=50) for _ in range(4))
    others = rng.normal(size=(50, 3))

    def row(p: np.ndarray, angle: np.ndarray, v: np.ndarray, rate: np.ndarray) -> np.ndarray:
        return np.stack([p.real, p.imag, np.sin(angle), np.cos(angle), v.real, v.imag, rate], axis=1)

    before = np.hstack([row(position, yaw, velocity, others[:, 0]), others[:, 1:]])
    after = row(position + displacement, yaw + rotated, velocity + acceleration, others[:, 0] + 1.0)
    inputs, outputs = (t.numpy() for t in in_body_frame(torch.tensor(before), torch.tensor(after)))
    back = np.exp(-1j * yaw)
    assert np.allclose(inputs[:, 4] + 1j * inputs[:, 5], back * velocity)
    assert np.allclose(outputs[:, 0] + 1j * outputs[:, 1], back * displacement)
    assert np.allclose(outputs[:, 4] + 1j * outputs[:, 5], back * acceleration)
    assert np.allclose(outputs[:, 2:4], np.stack([np.sin(rotated), np.cos(rotated) - 1.0], axis=1))
    assert np.allclose(outputs[:, 6], 1.0)
    assert np.allclose(inputs[:, :4], [0.0, 0.0, 0.0, 1.0])


def test_kinematic_car_in_the_body_frame_equals_the_one_at_the_origin() -> None:
    """State changes in the body frame do not depend on the pose, so the study may rotate its rows."""
    model = KinematicCar()
    rows = model.inputs(200, generator()).double()
    parameters = draw_parameters(model, 5, generator(1)).double()
    changes = model(rows, parameters)
    for k in range(5):
        inputs, outputs = in_body_frame(rows, rows[:, :7] + changes[k])
        assert torch.allclose(BodyFrameCar()(inputs, parameters)[k], outputs, atol=1e-6)


def test_output_norms_are_equal_in_the_world_and_body_frames(shared: Path) -> None:
    data = shared / "data" / "regression"
    assert CASES["racecar"].body_frame is not None
    world, body = CASES["racecar"].recorded(data, 20, 0), CASES["racecar"].body_frame.recorded(data, 20, 0)
    assert torch.allclose(world.outputs.square().sum(dim=1), body.outputs.square().sum(dim=1), rtol=1e-4)


def driven_episode(seed: int, ticks: int = 400) -> EpisodeData:
    rng = np.random.default_rng(seed)
    config = SimulatorConfig()
    commands = np.repeat(rng.uniform(-1.0, 1.0, (ticks // 8, 2)), 8, axis=0)
    states = rollout(config, torch.tensor([[0.0] * 3 + [1.0, 0.0, 0.0]]), torch.tensor(commands[None]).float()).states[
        0
    ]
    noisy = states.numpy() + rng.normal(size=(ticks + 1, 6)) * (0.001, 0.001, 0.002, 0.01, 0.01, 0.05)
    times_s = np.arange(ticks + 1) * config.control_period_s
    return EpisodeData(times_s, noisy, commands, commands, np.zeros(ticks))


@pytest.mark.usefixtures("short_identification")
def test_last_recording_is_held_out_and_the_simulator_is_the_prior() -> None:
    first, last = driven_episode(0), driven_episode(1)
    case = recorded_case([[first], [last]], Path("rc_car"), 3)
    data = case.recorded(Path(), 40, 0)
    assert len(data.inputs) == 40
    assert len(data.test_inputs) <= last.ticks - 3
    of_last = np.hstack([last.sent[k : k + len(last.sent) - 3] for k in range(4)])
    for row in data.test_inputs[:20, 3:].double().numpy():
        assert np.abs(of_last - row).max(axis=1).min() < 1e-6
    simulator, ridge = run_study(case, rows=(40,), seeds=1, methods=("SysID", "ridge"), data=Path())
    # The data come from the prior's simulator: 40 rows identify it better than a linear model.
    assert simulator.nll < ridge.nll - 0.5


def test_too_few_recordings_or_rows_are_reported() -> None:
    with pytest.raises(DataError, match="two recordings"):
        recorded_case([[driven_episode(0)]], Path("rc_car"), 3)
    with pytest.raises(DataError, match="give --history"):
        recorded_case([[driven_episode(0, 40)], [driven_episode(1)]], Path("rc_car"), None)
    case = recorded_case([[driven_episode(0)], [driven_episode(1)]], Path("rc_car"), 3)
    with pytest.raises(DataError, match="give fewer"):
        case.recorded(Path(), 4000, 0)
