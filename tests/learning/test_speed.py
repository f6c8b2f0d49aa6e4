"""Test what ``carlab bench speed`` measures of learning: whole fits and predictions, and their parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from carlab.experiment.campaign.training import velocity_delay_s
from learning import speed
from learning.evaluation import Mixture
from learning.priors.simulator_model import CarModel
from learning.transitions import Transitions
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import CarFitSettings, fit_car


def test_prediction_speed_reports_networks_predictions_and_learned_car_separately(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    times: Iterator[float] = iter((0.002, 0.001, 0.004, 0.0005))
    done: list[Any] = []

    def once(work: Callable[[], Any], device: str, times_: int = 50) -> float:
        done.append(work())
        return next(times)

    monkeypatch.setattr(speed, "_seconds", once)
    found = speed.prediction_speed()
    assert found == pytest.approx({
        "batch_ms": 2.0, "matrix_product_ms": 1.0, "share_of_its_speed": 0.5,
        "posterior_ms": 4.0, "posterior_share_of_its_speed": 0.25, "learned_car_ms": 0.5,
    })  # fmt: skip
    network_outputs, _, prediction, drawn = done
    assert network_outputs.shape == (20, 256, 6)
    assert isinstance(prediction, Mixture)
    assert prediction.means.shape == network_outputs.shape
    assert drawn.shape == (256, 6)
    assert not torch.allclose(prediction.means, network_outputs, atol=0.01), (
        "trend and decorrelation are part of a prediction"
    )
    assert prediction.decorrelation is not None
    assert prediction.correlation is not None
    assert np.isfinite(prediction.dof)


@pytest.mark.usefixtures("short_inference")
def test_whole_fit_uses_the_settings_of_carlab_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Transitions, CarModel, CarFitSettings, str]] = []

    def fit_with_few_steps(rows: Transitions, model: CarModel, settings: CarFitSettings, *, device: str) -> CarDynamics:
        calls.append((rows, model, settings, device))
        return fit_car(rows, model, CarFitSettings(steps=20), device=device)

    monkeypatch.setattr(speed, "fit_car", fit_with_few_steps)
    monkeypatch.setattr(speed, "SIZES", {})
    (figures,) = speed.training_speed().values()
    ((rows, model, settings, device),) = calls
    assert figures["whole_fit_s"] > 0.01
    assert (len(rows), rows.history, model.history, device) == (100, 3, 3, "cpu")
    assert settings == CarFitSettings()
    assert model.config.kind == "kinematic"
    assert model.velocity_delay_s == velocity_delay_s([]) > 0.0
    assert set(model.ranges) == {"motor.drive_gain", "motor.damping", "steering.max_angle"}
    # The synthetic drive is physical: displacement per step agrees with velocity times period.
    forward = rows.inputs[:, 0] * model.config.control_period_s
    assert np.corrcoef(forward, rows.targets[:, 0])[0, 1] > 0.9
    assert rows.targets.std(axis=0).min() > 1e-4
