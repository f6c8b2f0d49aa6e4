"""Test hard cases: conditions of driving, recording and car file, several effects, and their strengths."""

from __future__ import annotations

import json
from collections import Counter
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.cases.case import Case, make_case
from carlab.benchmark.cases.conditions import Conditions, with_stamp_delays
from carlab.benchmark.cases.hard_set import CONDITIONS, drawn_evenly, hard_set, under
from carlab.benchmark.cases.proof_set import (
    MAX_DEVELOPMENT_SEED,
    MAX_TEST_SEED,
    STRENGTHS,
    CaseSpec,
    Purpose,
    full_set,
)
from carlab.benchmark.effects.catalogue import EFFECT_IDS, are_confusable
from carlab.benchmark.proof.runner import Proof
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import COLUMNS, read_csv
from carlab.core.errors import ConfigError

SHORT = {"fit_s": 8.0, "hold_s": 5.0}
PERIOD_S = 1.0 / 30.0


def test_no_permitted_seed_shares_cases_between_development_and_test() -> None:
    def seeds(purpose: Purpose, last: int) -> set[int]:
        sets = [full_set(purpose, seed) for seed in range(last + 1)]
        sets += [hard_set(purpose, seed) for seed in range(MAX_DEVELOPMENT_SEED + 1)]
        return {spec.seed for specs in sets for spec in specs}

    assert not seeds("development", MAX_DEVELOPMENT_SEED) & seeds("test", MAX_TEST_SEED)
    assert seeds("development", MAX_DEVELOPMENT_SEED) & seeds("test", MAX_TEST_SEED + 1)
    assert seeds("development", MAX_DEVELOPMENT_SEED + 1) & seeds("test", MAX_TEST_SEED)


def test_set_has_each_effect_under_each_condition_and_with_each_strength_once() -> None:
    singles = [spec for spec in hard_set("test") if spec.kind == "single"]
    for name in EFFECT_IDS:
        specs = [spec for spec in singles if spec.effects == (name,)]
        assert sorted(spec.excess for spec in specs) == sorted(STRENGTHS)
        names = [tuple(spec.conditions.names(spec.fit_s)) for spec in specs]
        assert len(set(names)) == len(names) == len(CONDITIONS)
        assert all(len(conditions) == 1 for conditions in names)


def test_effects_of_one_case_are_not_confusable_and_sets_are_separate() -> None:
    specs = hard_set("test")
    multiples = [spec for spec in specs if spec.kind == "multiple"]
    assert Counter(len(spec.effects) for spec in multiples) == {3: 24, 4: 12, 5: 12}
    for spec in multiples:
        assert not any(are_confusable(one, two) for one, two in combinations(spec.effects, 2))
    assert specs == hard_set("test")
    seeds = [
        {spec.seed for spec in some(purpose)}  # type: ignore[operator]
        for some in (hard_set, full_set)
        for purpose in ("test", "development")
    ]
    assert not any(one & two for one, two in combinations(seeds, 2))
    assert len(seeds[0]) == len(specs)


def test_limited_set_has_equally_many_cases_of_each_kind() -> None:
    kinds = Counter(spec.kind for spec in drawn_evenly(hard_set("test"), 20))
    assert kinds["single"] == kinds["multiple"] == kinds["outside"] == kinds["null"] + kinds["parameters"] == 5


def test_plan_of_a_case_is_read_back_and_plain_cases_keep_their_plan() -> None:
    for spec in hard_set("test")[:8] + full_set("test")[:2]:
        assert CaseSpec.from_dict(json.loads(json.dumps(spec.as_dict()))) == spec
    assert "conditions" not in full_set("test")[0].as_dict()


def test_stamps_are_late_by_the_stated_mean_and_keep_their_order() -> None:
    table = {"t": np.arange(20_000) * PERIOD_S, "x": np.arange(20_000.0)}
    late = with_stamp_delays(table, 0.1 * PERIOD_S, PERIOD_S, np.random.default_rng(1))
    delays = late["t"] - table["t"]
    assert delays.mean() == pytest.approx(0.1 * PERIOD_S, rel=0.03)
    assert delays.std() == pytest.approx(0.1 * PERIOD_S, rel=0.05)  # exponential: standard deviation equals mean
    assert (np.diff(late["t"]) > 0.0).all()
    np.testing.assert_array_equal(late["x"], table["x"])


def stamps_case(stamp_delay_periods: float) -> Case:
    conditions = Conditions(stamp_delay_periods=stamp_delay_periods)
    return make_case("parameters", 31, fit_s=8.0, hold_s=5.0, conditions=conditions)


def test_jitter_changes_the_stamps_of_a_case_and_nothing_else() -> None:
    jittered, even = stamps_case(0.1), stamps_case(0.0)
    delays = jittered.fit["t"] - even.fit["t"]
    assert 0.0 < delays.std() < PERIOD_S
    assert not np.array_equal(delays[:100], (jittered.hold["t"] - even.hold["t"])[:100])
    for name in COLUMNS[1:]:
        np.testing.assert_array_equal(jittered.fit[name], even.fit[name])
    np.testing.assert_array_equal(jittered.fit["t"], stamps_case(0.1).fit["t"])


def test_feedback_commands_are_a_function_of_state_and_target_speed() -> None:
    """At one target speed the steering command repeats with the state: a least-squares fit of pure pursuit is exact."""
    from carlab.benchmark.world.driver import HumanDriver, Track

    track = Track(np.random.default_rng(3))
    state = np.array([*track.points[40], track.heading[40] + 0.1, 1.2, 0.0, 0.0])
    spread = {}
    for feedback_only in (True, False):
        commands = []
        for seed in range(6):
            driver = HumanDriver(BaseCar(), track, np.random.default_rng(seed), feedback_only=feedback_only)
            driver._until, driver._mode, driver._direction = 1e9, "follow", 1
            commands.append([driver(0.1 * k, state)[0] for k in range(5)])
        spread[feedback_only] = float(np.std(commands))
    assert spread[True] < 1e-12 < 1e-3 < spread[False]


def test_feedback_driver_never_leaves_the_mode_that_follows_the_track() -> None:
    from carlab.benchmark.world.driver import HumanDriver, Track

    driver = HumanDriver(BaseCar(), Track(np.random.default_rng(3)), np.random.default_rng(4), feedback_only=True)
    modes = set()
    for k in range(200):
        driver._choose_mode(float(k), 0.0)
        modes.add(driver._mode)
    assert modes == {"follow"}


def test_car_file_of_a_wrong_base_model_differs_in_its_kind_only() -> None:
    same, wrong = (
        make_case("parameters", 33, fit_s=8.0, hold_s=5.0, conditions=Conditions(base_model=kind))
        for kind in ("same", "kinematic")
    )
    assert wrong.nominal.kind == "kinematic"
    assert {**wrong.nominal.table(), "model": {}} == {**same.nominal.table(), "model": {}}
    np.testing.assert_array_equal(wrong.fit["vx"], same.fit["vx"])  # the true car is the same
    assert wrong.excess == same.excess
    assert wrong.answer()["conditions"] == ["short recording", "base model kinematic"]
    assert wrong.answer()["implied_effects"] == ["tyre_saturation"]
    assert Conditions(base_model="linear_tyre").implied_effects() == ("tyre_saturation",)
    assert not Conditions().implied_effects()


def test_a_concealed_effect_is_not_implied_by_the_base_model() -> None:
    kinematic = Conditions(base_model="kinematic")
    case = make_case(
        "single", 35, effects=("tyre_saturation",), excess=2.0, conditions=kinematic, fit_s=8.0, hold_s=5.0
    )
    assert case.answer()["implied_effects"] == []


def test_each_of_three_effects_has_the_asked_strength() -> None:
    effects = ("steering_lag", "rolling_resistance", "lateral_bias")
    case = make_case("multiple", 41, effects=effects, excess=2.0, **SHORT)  # type: ignore[arg-type]
    assert case.single_excesses == pytest.approx((2.0, 2.0, 2.0), rel=0.15)
    alone = make_case("single", 41, effects=effects[:1], excess=2.0, **SHORT)  # type: ignore[arg-type]
    assert alone.concealed[0].parameters == case.concealed[0].parameters
    assert alone.excess == pytest.approx(case.single_excesses[0])
    with pytest.raises(ConfigError, match="3 or 4 or 5 effects"):
        make_case("multiple", 41, effects=effects[:2])


def test_hard_case_is_handed_over_as_specified_and_its_answer_is_sealed(tmp_path: Path) -> None:
    spec = CaseSpec("null", 51, fit_s=8.0, hold_s=5.0)
    for condition in ("base_model", "feedback", "stamps"):
        spec = under(spec, condition)
    spec = CaseSpec(**{**vars(spec), "fit_s": 8.0, "hold_s": 5.0})
    proof = Proof(tmp_path / "proof", [spec])
    assert proof.make() is not None
    (name,) = proof.names()
    answer = proof.open_seal()[name]
    assert answer["conditions"] == ["short recording", "base model linear_tyre", "feedback only", "stamp jitter"]
    handed = proof.root / "handed" / name
    assert BaseCar.read(handed / "car.toml").kind == "linear_tyre"
    assert np.diff(read_csv(handed / "fit.csv")["t"]).std() > 0.05 * PERIOD_S
    path = proof.answers_folder / f"{name}.json"
    path.write_text(json.dumps({**answer, "conditions": []}))
    with pytest.raises(Exception, match="seal is broken"):
        proof.open_seal()
