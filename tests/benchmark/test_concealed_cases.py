"""Test concealed cases: score of the true car, strengths, reproducibility by seed, data faults."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.cases.case import Case, make_case
from carlab.benchmark.cases.proof_set import full_set
from carlab.benchmark.cases.refit import channel_scores, cut_windows, score
from carlab.benchmark.cases.set_check import indistinguishable
from carlab.benchmark.effects.catalogue import CONFUSABLE, EFFECT_IDS
from carlab.benchmark.effects.data_faults import FAULTS
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import FREE, BaseCar
from carlab.benchmark.world.measurement import COLUMNS, local_fit, write_csv
from carlab.core.errors import ConfigError
from sim_backends import SimulatorConfig

SHORT = {"fit_s": 40.0, "hold_s": 20.0}


@pytest.fixture(scope="module")
def parameters_only() -> Case:
    return make_case("parameters", 11, **SHORT)


def test_true_car_has_score_one(parameters_only: Case) -> None:
    case = parameters_only
    for recording in case.recordings:
        windows = cut_windows(recording, case.true_car)
        assert score(windows, case.true_car.free()) == pytest.approx(1.0, abs=0.01)
    assert case.refit.nominal_score > 1.5
    assert case.refit.score < 1.12  # the refit explains the whole error
    assert case.excess < 0.5


def test_measurement_noise_has_the_given_size(parameters_only: Case) -> None:
    error = parameters_only.recordings[0].error
    car = parameters_only.nominal
    np.testing.assert_allclose(error[:, :3].std(axis=0), [car.position_std, car.position_std, car.yaw_std], rtol=0.1)
    assert 0.003 < error[:, 3].std() < 0.03  # differentiation amplifies it
    assert 0.015 < error[:, 5].std() < 0.08


def test_base_parameters_differ_by_up_to_a_tenth_and_measured_ones_are_equal(parameters_only: Case) -> None:
    nominal, true = parameters_only.nominal, parameters_only.true_car
    ratios = np.array([true.free()[n] / nominal.free()[n] for n in FREE])
    assert (np.abs(ratios - 1.0) <= 0.1 + 1e-12).all()
    assert np.abs(ratios - 1.0).max() > 0.02
    for fact in ("mass", "front_axle", "rear_axle", "control_period", "command_delay"):
        assert getattr(true, fact) == getattr(nominal, fact)


def test_driving_excites_the_car(parameters_only: Case) -> None:
    table = parameters_only.fit
    assert np.ptp(table["vx"]) > 1.5
    assert table["yaw_rate"].min() < -0.5
    assert table["yaw_rate"].max() > 0.5
    assert table["steering"].std() > 0.2
    assert np.abs(np.stack([table["steering"], table["throttle"]])).max() <= 1.0
    assert max(np.abs(table["x"]).max(), np.abs(table["y"]).max()) < 8.0


def test_null_car_equals_the_nominal_car() -> None:
    case = make_case("null", 12, fit_s=15.0, hold_s=10.0)
    assert case.true_car == case.nominal
    assert case.refit.nominal_score == pytest.approx(1.0, abs=0.01)
    assert case.answer()["effects"] == []


@pytest.mark.parametrize(
    ("name", "form", "excess"), [("steering_lag", "other", 2.0), ("rolling_resistance", "catalogue", 0.5)]
)
def test_strength_is_reached(name: str, form: str, excess: float) -> None:
    case = make_case("single", 21, effects=[name], form=form, excess=excess, fit_s=10.0, hold_s=6.0)  # type: ignore[arg-type]
    assert case.excess == pytest.approx(excess, rel=0.15)
    lateral = {"y", "yaw", "vy", "yaw_rate"}
    main = set(case.answer()["main_channels"])
    assert main & (lateral | {"x"}) if name == "steering_lag" else main & {"x", "vx"}


def test_case_is_reproducible_by_its_seed() -> None:
    first, second = (make_case("parameters", 31, fit_s=8.0, hold_s=5.0) for _ in range(2))
    for name in COLUMNS:
        np.testing.assert_array_equal(first.fit[name], second.fit[name])
    other = make_case("parameters", 32, fit_s=8.0, hold_s=5.0)
    assert not np.array_equal(first.fit["steering"], other.fit["steering"])


def test_simulator_reads_car_file_and_csv(tmp_path: Path, parameters_only: Case) -> None:
    import tomllib

    parameters_only.nominal.write(tmp_path / "car.toml")
    assert BaseCar.read(tmp_path / "car.toml") == parameters_only.nominal
    tables = tomllib.loads((tmp_path / "car.toml").read_text())
    config = SimulatorConfig.from_tables(tables)
    assert config.parameters.front_b == parameters_only.nominal.b_front
    assert config.command_delay_s == parameters_only.nominal.command_delay
    write_csv(tmp_path / "fit.csv", parameters_only.fit)
    with (tmp_path / "fit.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert float(rows[100]["vx"]) == pytest.approx(parameters_only.fit["vx"][100], rel=1e-5, abs=1e-6)
    assert np.abs([float(r["yaw"]) for r in rows]).max() <= np.pi + 1e-6


def test_local_polynomial_is_exact_for_polynomials_including_the_ends() -> None:
    t = np.arange(40) * 0.01
    values = np.stack([2 + 3 * t - t**2, t**2], axis=1)
    fitted, slope = local_fit(values, 9, 2, 0.01)
    np.testing.assert_allclose(fitted, values, atol=1e-10)
    np.testing.assert_allclose(slope, np.stack([3 - 2 * t, 2 * t], axis=1), atol=1e-8)


@pytest.mark.parametrize("name", FAULTS)
def test_faults_change_only_the_reported_columns(name: str, parameters_only: Case) -> None:
    table = parameters_only.fit
    changed, columns, rows = FAULTS[name](table, np.random.default_rng(1), parameters_only.nominal)
    if name == "dropouts":
        assert 0 < rows == len(table["t"]) - len(changed["t"])
        return
    differing = {c for c in COLUMNS if not np.array_equal(changed[c], table[c])}
    assert differing
    assert differing <= set(columns) | ({"vx", "vy"} if name == "outliers" else set())
    assert 0 < rows <= len(table["t"])


def test_full_set_has_the_counts_of_the_protocol() -> None:
    known = all_forms()
    for purpose in ("development", "test"):
        specs = full_set(purpose)  # type: ignore[arg-type]
        kinds = [s.kind for s in specs]
        random = [s for s in specs if s.effects and (s.effects[0], "random") in known]
        assert kinds.count("null") + kinds.count("parameters") == 100
        assert (kinds.count("pair"), kinds.count("outside") - len(random), len(random)) == (40, 40, 40)
        assert kinds.count("null") == 50
        for name in EFFECT_IDS:
            effect_specs = [s for s in specs if s.kind == "single" and s.effects == (name,)]
            assert sorted(s.excess for s in effect_specs) == [0.5, 1.0, 2.0, 4.0]
            if (name, "other") in known and (name, "catalogue") in known:
                assert sum(s.form == "other" for s in effect_specs) == 2
        assert len({s.seed for s in specs}) == len(specs)
    seeds = [{s.seed for s in full_set(p)} for p in ("development", "test")]  # type: ignore[arg-type]
    assert not seeds[0] & seeds[1]


def test_forms_cover_the_catalogue() -> None:
    known = all_forms()
    assert all((name, "catalogue") in known or (name, "other") in known for name in EFFECT_IDS)
    assert sum(form == "other" for _, form in known) >= 15
    outside = [form for (_, kind), form in known.items() if kind == "outside"]
    assert len(outside) >= 10
    assert all(form.class_words and form.id not in EFFECT_IDS for form in outside)
    assert all(other in EFFECT_IDS for others in CONFUSABLE.values() for other in others)


def test_channel_scores_combine_to_the_score(parameters_only: Case) -> None:
    windows = cut_windows(parameters_only.recordings[1], parameters_only.true_car)
    values = parameters_only.nominal.free()
    assert np.sqrt((channel_scores(windows, values) ** 2).mean()) == pytest.approx(score(windows, values))


def test_invalid_arguments_raise_errors() -> None:
    with pytest.raises(ConfigError, match="no effect"):
        make_case("single", 1, effects=["steering_lagg"])
    with pytest.raises(ConfigError, match="requires 2 effects"):
        make_case("pair", 1, effects=["steering_lag"])
    with pytest.raises(ConfigError, match="data fault"):
        make_case("fault", 1, fault="gremlins")


@pytest.mark.slow
def test_refit_distinguishes_steering_delay_from_throttle_delay() -> None:
    case = make_case("single", 51, effects=["steering_delay"], excess=4.0, **SHORT)
    data = (case.nominal, case.fit, case.hold, np.array(case.floor))
    assert indistinguishable("steering_delay", "throttle_delay", *data) is False
    assert indistinguishable("steering_delay", "steering_delay", *data) is True
    assert indistinguishable("steering_delay", "tyre_relaxation", *data) is None


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_most_forms_reach_a_strength_and_all_have_an_influence() -> None:
    """Some forms cannot be weak (wheel slip) or strong, and a spin changes the strength."""
    excesses = {}
    for form in all_forms().values():
        kind = "outside" if form.form == "outside" else "single"
        case = make_case(kind, 7, effects=[form.id], form=form.form, excess=2.0)  # type: ignore[arg-type]
        excesses[(form.id, form.form)] = case.excess
    missed = {name: e for name, e in excesses.items() if abs(e - 2.0) > 0.3}
    assert len(missed) <= 0.15 * len(excesses), missed
    assert min(excesses.values()) > 0.3, excesses


def test_case_with_recordings_at_100_hz() -> None:
    case = make_case("null", 41, period_s=0.01, fit_s=6.0, hold_s=5.0)
    assert np.diff(case.fit["t"]) == pytest.approx(0.01)
    assert dataclasses.replace(case.nominal, kind="blend").kind == "blend"
    assert isinstance(case.nominal, BaseCar)
