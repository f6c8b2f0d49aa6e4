"""What ``carlab bench speed`` measures of learning: the whole of what a user waits for, beside its parts."""

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


def test_networks_alone_whole_predictions_and_steps_of_the_learned_car_have_figures_of_their_own(
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
    bare, _, whole, drawn = done
    assert bare.shape == (20, 256, 6)
    assert isinstance(whole, Mixture)
    assert whole.means.shape == bare.shape
    assert drawn.shape == (256, 6)
    assert not torch.allclose(whole.means, bare, atol=0.01), "trend and decorrelation are part of a prediction"
    assert whole.decorrelation is not None
    assert whole.correlation is not None
    assert np.isfinite(whole.dof)


def test_a_whole_fit_is_that_of_carlab_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Transitions, CarModel, CarFitSettings, str]] = []

    def fewer(rows: Transitions, model: CarModel, settings: CarFitSettings, *, device: str) -> CarDynamics:
        calls.append((rows, model, settings, device))
        return fit_car(rows, model, CarFitSettings(steps=20), device=device)

    monkeypatch.setattr(speed, "fit_car", fewer)
    monkeypatch.setattr(speed, "SIZES", {})
    (figures,) = speed.training_speed().values()
    ((rows, model, settings, device),) = calls
    assert figures["whole_fit_s"] > 0.01
    assert (len(rows), rows.history, model.history, device) == (100, 3, 3, "cpu")
    assert settings == CarFitSettings()
    assert model.config.kind == "kinematic"
    assert model.velocity_delay_s == velocity_delay_s([]) > 0.0
    assert set(model.ranges) == {"motor.drive_gain", "motor.damping", "steering.max_angle"}
    # A drive that a car can make: it moves about as far in a step as its velocity says.
    forward = rows.inputs[:, 0] * model.config.control_period_s
    assert np.corrcoef(forward, rows.targets[:, 0])[0, 1] > 0.9
    assert rows.targets.std(axis=0).min() > 1e-4
