"""Figures of the parking study on cars that differ from the prior, against values computed by hand."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import pytest

from carlab.cli import run
from carlab.core.errors import ConfigError
from carlab.experiment.campaign.figures import EpisodeFigures
from carlab.studies.parking import Curve
from carlab.studies.parking_realities import REALITIES, arm_of, compared, write_reality
from sim_backends.car_parameters import SimulatorConfig


def curve(arm: str, reality: str, parked: set[int], returns: tuple[float, ...] = (10.0,) * 5) -> Curve:
    episodes = tuple(
        EpisodeFigures(
            k, value, 20.0, k in parked, 0.1, 0.0, 0.0, 97, math.nan, math.nan, 5.0, 55.0, 1000, "COMPLETED",
            predicted_low=5.0, predicted_high=30.0,
        )
        for k, value in enumerate(returns, start=1)
    )  # fmt: skip
    return Curve(arm, 0, 1000, episodes, reality)


def test_arms_are_compared_by_first_parked_episode_and_coverage() -> None:
    curves = [
        curve("nominal", "low_grip", {3, 4, 5}),
        curve("nominal", "patch", set()),
        curve("auto", "low_grip", {2, 5}, (10.0, 31.0, 5.0, 30.0, 4.0)),
        curve("auto", "patch", {5}),
    ]
    nominal, auto = compared(curves)
    assert (nominal.mean_first_parked, nominal.parked_early, nominal.parked_after) == (4.5, 0.5, 1.0)
    assert nominal.coverage == 1.0
    assert (auto.mean_first_parked, auto.parked_early) == (3.5, 0.5)
    assert auto.parked_after == pytest.approx(1 / 3), "episodes 3, 4 and 5 of the first run"
    assert auto.coverage == pytest.approx(8 / 10)
    assert auto.latest_against_nominal == -1.0, "2 against 3, and 5 against 6"
    assert math.isnan(compared(curves[2:])[0].latest_against_nominal)


def test_an_unfinished_run_that_never_parked_is_not_earlier_than_a_finished_one() -> None:
    curves = [curve("nominal", "patch", {5}), curve("auto", "patch", set(), (10.0, 10.0))]
    nominal, auto = compared(curves)
    assert (nominal.mean_first_parked, auto.mean_first_parked) == (5.0, 6.0)
    assert auto.latest_against_nominal == 1.0


def test_each_reality_is_a_car_that_differs_from_the_default(tmp_path: Path) -> None:
    nominal = SimulatorConfig.from_preset()
    for name, changes in REALITIES.items():
        car = SimulatorConfig.from_tables(tomllib.loads(write_reality(name, tmp_path).read_text()))
        assert {key: car.values()[key] for key in changes} == changes
        assert {key for key, value in nominal.values().items() if car.values()[key] != value} <= set(changes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--realities 9", "--realities 9: give a number from 1 to 8."),
        ("--realities 2 --methods fsvgd", "There is no arm 'fsvgd'; choose among nominal, auto, no-simulator."),
    ],
)
def test_invalid_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: str, message: str
) -> None:
    assert run(["bench", "parking", *options.split(), "--runs", str(tmp_path / "runs")]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "runs").exists()
    with pytest.raises(ConfigError):
        arm_of("fsvgd")
