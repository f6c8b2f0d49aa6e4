"""Test effects concealed in recordings against simulated cars that have them, the sealed run, and its scores."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from carlab.benchmark.real.cases import RealCaseSpec, case_specs, make_real_case, parts, reference, with_full_lock
from carlab.benchmark.real.kinds import FULL_LOCK, KINDS, Kind, Truth
from carlab.benchmark.real.runner import RealProof
from carlab.benchmark.real.scores import add_visibility, kind_rows, rate_rows, real_results_page, score_comparison
from carlab.benchmark.world.measurement import COLUMNS, read_csv
from carlab.core.errors import DataError
from sim_backends import SimulatorConfig
from sim_backends.effects import CATALOGUE
from tests.helpers.measured_rollout import measured_rollout

PERIOD_S = 1.0 / 30.0
FAKE = (sys.executable, str(Path(__file__).with_name("fake_comparison.py")))
LAGS = ("steering_lag", "motor_lag")
BY_ID = {kind.id: kind for kind in KINDS}
CAR = SimulatorConfig(control_period_s=PERIOD_S, command_delay_s=2.0 * PERIOD_S)
MAX_ANGLE_RAD = CAR.parameters.max_angle_rad
OBSERVED = COLUMNS[1:7]
# Largest distance from the car with the effect [m, m, rad, m/s, m/s, rad/s]: interpolation of poses; steps that a lag
# rounds off over a row; commands of less than 0.002 within a dead band. All other transformations are exact.
TOLERANCE = {
    "mocap_latency": np.array([2e-4, 2e-4, 5e-4, 0.01, 3e-3, 0.02]),
    "velocity_filter_lag": np.array([1e-9, 1e-9, 1e-9, 3e-3, 1e-3, 1e-3]),
    "steering_deadband": np.full(6, 1e-4),
}
EXACT = np.full(6, 1e-6)


def commands(seconds: float, seed: int = 0) -> np.ndarray:
    """One second at rest, then smooth steering within full lock and held throttle that is often zero, (T, 2)."""
    t = PERIOD_S * np.arange(int(seconds / PERIOD_S))
    rng = np.random.default_rng(seed)
    steering = FULL_LOCK * np.clip(0.6 * np.sin(1.9 * t) + 0.5 * np.sin(0.73 * t + rng.random()), -1.0, 1.0)
    throttle = np.repeat(rng.choice([0.0, 0.1, 0.25, 0.4], len(t) // 20 + 1), 20)[: len(t)]
    return np.where(t[:, None] < 1.0, 0.0, np.stack([steering, throttle], axis=1))


def simulated(sent: np.ndarray, config: SimulatorConfig = CAR) -> dict[str, np.ndarray]:
    """The noise-free recording of a car."""
    start = torch.tensor([[0.0, 0.0, 0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    states = measured_rollout(config, start, torch.from_numpy(sent)[None]).measured
    rows = states[0].numpy()
    columns = [PERIOD_S * np.arange(len(rows)), *rows.T, *np.vstack([sent, sent[-1:]]).T]
    return dict(zip(COLUMNS, columns, strict=True))


def with_effect(kind: Kind, truth: Sequence[Truth]) -> SimulatorConfig:
    """The car with the kind's effect, of the size that the generator states."""
    numbers = {t.parameter: t.size * (MAX_ANGLE_RAD if t.per_lock else 1.0) for t in truth}
    if kind.id == "mocap_latency":
        numbers["latency"] += CAR.mocap.latency_s
    if kind.id == "steering_gain":
        return CAR.with_values({"steering.max_angle": MAX_ANGLE_RAD * numbers["value"]})
    return dataclasses.replace(CAR, effects={kind.names[0]: numbers})


@pytest.mark.parametrize("kind", [k for k in KINDS if k.id not in LAGS], ids=lambda k: k.id)
def test_recording_is_that_of_a_car_with_the_effect(kind: Kind) -> None:
    """The effect-free car's recording with transformed columns is reproduced by a simulated car with the effect."""
    change = kind.change(simulated(commands(12.0)), kind.sizes[1], 0.3)
    sent = np.stack([change.table["steering"], change.table["throttle"]], axis=1)[:-1]
    assert np.abs(sent).max() <= 1.0
    expected = simulated(sent, with_effect(kind, change.truth))
    rows = slice(10, -10)  # without the start of a delayed recording, and rows whose commands a shift has lost
    for name, tolerance in zip(OBSERVED, TOLERANCE.get(kind.id, EXACT), strict=True):
        error = change.table[name][rows] - expected[name][rows]
        error = np.remainder(error + np.pi, 2.0 * np.pi) - np.pi if name == "yaw" else error
        assert np.abs(error).max() <= tolerance, name


@pytest.mark.parametrize("name", LAGS)
def test_lag_leaves_a_fifteenth_of_its_effect(name: str) -> None:
    """Compare with the error of the untransformed recording against the car with the lag."""
    plain = simulated(commands(12.0))
    change = BY_ID[name].change(plain, BY_ID[name].sizes[1], 0.3)
    car = with_effect(BY_ID[name], change.truth)
    sent = np.stack([change.table["steering"], change.table["throttle"]], axis=1)[:-1]
    column = "yaw_rate" if name == "steering_lag" else "vx"
    effect = simulated(commands(12.0), car)[column] - plain[column]
    error = simulated(sent, car)[column] - plain[column]
    assert np.std(error) < 0.07 * np.std(effect)


def test_lag_reports_commands_that_it_clips() -> None:
    table = simulated(commands(12.0))
    table["steering"] = FULL_LOCK * np.sign(table["steering"])
    change = BY_ID["steering_lag"].change(table, 0.1, 0.3)
    assert np.abs(change.table["steering"]).max() <= 1.0
    assert change.inexact > 0.1


@pytest.fixture(scope="module")
def recordings() -> dict[str, dict[str, np.ndarray]]:
    tables = {
        name: simulated(commands(length_s, seed))
        for seed, (name, length_s) in enumerate({"a": 130.0, "b": 70.0}.items())
    }
    for table in tables.values():
        table["steering"] = table["steering"] / FULL_LOCK
    return tables


def test_reference_leaves_out_the_pieces_of_the_case(recordings: dict[str, dict[str, np.ndarray]]) -> None:
    tables = {name: with_full_lock(table) for name, table in recordings.items()}
    left_out = parts(tables)
    lengths = [[(p.recording, round(p.duration_s)) for p in part] for part in left_out]
    assert lengths == [[("a", 22)] * 3 + [("b", 18), ("b", 18)], [("a", 22)] * 3 + [("b", 18), ("b", 18)]]
    for seed in range(3):
        number, others, answer = make_real_case(RealCaseSpec("null", seed), tables, left_out)
        assert answer["effects"] == []
        used = {pose for table in others for pose in poses(table)} - {(0.0, 0.0)}
        assert 53.0 / PERIOD_S < len(used) < 100.0 / PERIOD_S
        kept = {pose for table in reference(tables, left_out[number]) for pose in poses(table)}
        assert not used & kept
        assert len(kept) > 80.0 / PERIOD_S


@pytest.mark.parametrize(("ratio", "message"), [(1.0 + 1e-5, None), (1.3, "different periods")])
def test_size_is_that_of_all_pieces(
    recordings: dict[str, dict[str, np.ndarray]], ratio: float, message: str | None
) -> None:
    """A delay of whole rows has the same size in all pieces if their periods are equal up to the jitter of stamps."""
    tables = {name: with_full_lock(table) for name, table in recordings.items()}
    tables["b"] = {**tables["b"], "t": ratio * tables["b"]["t"]}
    spec = RealCaseSpec("single", 3, ("steering_delay",), (2,))
    if message is None:
        assert len(make_real_case(spec, tables, parts(tables))[1]) > 1
    else:
        with pytest.raises(DataError, match=message):
            make_real_case(spec, tables, parts(tables))


def poses(table: dict[str, np.ndarray]) -> set[tuple[float, float]]:
    return set(zip(table["x"].tolist(), table["y"].tolist(), strict=True))


def test_set_has_each_kind_at_each_size() -> None:
    specs = case_specs(0)
    singles = [(spec.kinds[0], spec.sizes[0]) for spec in specs if spec.kind == "single"]
    assert {(kind.id, size): 2 for kind in KINDS for size in range(3)} == {
        case: singles.count(case) for case in singles
    }
    assert sum(spec.kind == "null" for spec in specs) >= 30
    assert len(KINDS) >= 12
    assert case_specs(0) == specs != case_specs(1)


def test_too_little_driving_is_refused(recordings: dict[str, dict[str, np.ndarray]]) -> None:
    with pytest.raises(DataError, match="a proof needs 160 s"):
        parts({"b": recordings["b"]})
    still = {name: {**table, "steering": 0.0 * table["steering"]} for name, table in recordings.items()}
    with pytest.raises(DataError, match="varying commands"):
        parts(still)


def test_tool_sees_files_without_the_answer(recordings: dict[str, dict[str, np.ndarray]], tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    car.write_text("[steering]\nmax_angle = { value = 0.42, low = 0.35, high = 0.7 }\n")
    specs = [RealCaseSpec("single", 1, ("steering_offset",), (2,)), RealCaseSpec("null", 2)]
    log: list[str] = []
    proof = RealProof(
        tmp_path / "proof", specs, recordings, car, tool="compare", command=FAKE,
        progress=lambda stage, done, total, note: log.append(stage),
    )  # fmt: skip
    with pytest.raises(DataError, match="Seal the answers"):
        proof.answer()
    proof.make()
    assert proof.diagnose_references()
    assert proof.answer()
    assert log.index("seal") < log.index("references") < log.index("answer")
    answers, models = proof.open_seal(), proof.models()
    rows = {
        name: score_comparison(answers[name], run["report"], models[name], run["seconds"])
        for name, run in proof.reports().items()
    }
    for name, run in proof.reports().items():
        seen = run["report"]["seen"]
        assert all(f.startswith(("untouched_", "other_")) or f in ("model.toml", "out") for f in seen["files"])
        assert str(tmp_path) not in seen["folder"]
        assert models[name]["steering"]["max_angle"]["value"] == pytest.approx(0.42 / FULL_LOCK)
        assert np.diff(read_csv(proof.root / "handed" / name / "other_1.csv")["t"]).max() < 1.5 * PERIOD_S
    add_visibility(rows)
    by_kind = {row["kind"]: row for row in rows.values()}
    assert by_kind["null"]["false_alarm"]
    assert by_kind["single"]["first"]
    size = by_kind["single"]["sizes"][0]
    # 12 % of full lock, which is 0.42 rad, whatever the unit of the command.
    assert abs(size["true"]) == pytest.approx(0.12 * 0.42)
    assert size["covered"] == (0.0 <= size["true"] <= 0.04)
    assert by_kind["single"]["stds"] == pytest.approx(5.04)
    assert {row[0]: row[2] for row in rate_rows(rows)}["false alarms, untouched recordings"] == "1/1"
    assert kind_rows(rows.values()) == [("steering_offset", "-", "-", "1/1", f"{int(size['covered'])}/1")]
    assert "nothing: answered steering_offset" in real_results_page({"seed": "0"}, rows, proof.reports())
    name, table = next(iter(recordings.items()))
    drifted = {**recordings, name: {**table, "vx": 1.01 * table["vx"]}}
    other_car = tmp_path / "other.toml"
    other_car.write_text(car.read_text().replace("0.42", "0.5"))
    for others in ((recordings, other_car), (drifted, car)):
        with pytest.raises(DataError, match="proof of other cases or files"):
            RealProof(proof.root, specs, *others, tool="compare", command=FAKE).make()
    handed = proof.root / "handed" / next(iter(rows)) / "other_1.csv"
    handed.write_text(handed.read_text().replace("0", "1", 1))
    with pytest.raises(DataError, match="seal is broken"):
        proof.open_seal()


def answer(name: str, names: list[str], **truth: Any) -> dict[str, Any]:
    change = {"parameter": "delay", "size": 0.07, "composes": "adds", "per_lock": False, **truth}
    return {"kind": "single", "part": [], "effects": [{"id": name, "names": names, "size_index": 1, "truth": [change]}]}


def report(*named: tuple[str, str, float], others: tuple[str, ...] = ()) -> dict[str, Any]:
    changes = [
        {"id": name, "parameters": {parameter: {"value": v, "std": 0.01, "low90": v - 0.02, "high90": v + 0.02}},
         "indistinguishable_from": list(others)}
        for name, parameter, v in named
    ]  # fmt: skip
    return {"schema": "carlab.compare/1", "verdict": "changed", "changes": changes}


def test_failures_state_the_reason_of_a_missing_report() -> None:
    rows = {"a": score_comparison(answer("steering_delay", ["steering_delay"]), None, {})}
    add_visibility(rows)
    page = real_results_page({}, rows, {"a": {"exit_status": -9, "output": "reading\nKilled"}})
    assert "* a: single, steering_delay (middle): no report (exit status -9): Killed" in page


def test_size_is_added_to_the_model_of_the_reference() -> None:
    truth = answer("steering_delay", ["steering_delay"])
    model = {"effects": {"steering_delay": {"delay": 0.03}}}
    row = score_comparison(truth, report(("steering_delay", "delay", 0.09)), model)
    assert row["sizes"][0]["true"] == pytest.approx(0.1)
    assert row["sizes"][0]["covered"]
    assert not score_comparison(truth, report(("steering_delay", "delay", 0.07)), model)["sizes"][0]["covered"]
    gain = answer("steering_gain", ["steering.max_angle"], parameter="value", size=1.1, composes="multiplies")
    row = score_comparison(gain, report(("steering.max_angle", "max_angle", 0.45)), {"steering": {"max_angle": 0.4}})
    assert row["sizes"][0]["true"] == pytest.approx(0.44)
    assert row["sizes"][0]["stds"] == pytest.approx(4.0)


def test_size_of_the_other_correct_name_is_added_to_its_own_parameter() -> None:
    # A delay of both commands and a latency give the same recording; the car file has values of both.
    model = {"mocap": {"latency": 0.008}, "effects": {"command_delay": {"extra_delay": 0.07}}}
    names = {"command_delay": "extra_delay", "mocap_latency": "latency"}
    for concealed, parameter in names.items():
        truth = answer(concealed, list(names), parameter=parameter, size=0.045)
        for named, true in (("command_delay", 0.115), ("mocap_latency", 0.053)):
            row = score_comparison(truth, report((named, names[named], true + 0.001)), model)
            assert row["sizes"][0]["true"] == pytest.approx(true)
            assert row["sizes"][0]["covered"]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.id)
def test_identity_of_a_kind_is_that_of_the_catalogue(kind: Kind) -> None:
    parameters = [p for name in kind.names if name in CATALOGUE for p in CATALOGUE[name].parameters]
    changed = {truth.parameter for truth in kind.change(simulated(commands(12.0)), kind.sizes[0], 0.3).truth}
    for parameter in parameters:
        if parameter.name in changed and parameter.identity is not None:
            assert kind.identity == parameter.identity


def test_size_against_an_infinite_identity_has_no_standard_deviations() -> None:
    truth = answer(
        "steering_nonlinearity", ["steering_nonlinearity"], parameter="saturation", size=0.9, composes="replaces",
        per_lock=True,
    )  # fmt: skip
    model = {"steering": {"max_angle": 0.5}}
    named = report(("steering_nonlinearity", "saturation", 0.44))
    row = score_comparison(truth, named, model)
    assert row["sizes"][0]["true"] == pytest.approx(0.45)
    assert row["sizes"][0]["covered"]
    assert row["sizes"][0]["stds"] is None
    tested = [{"id": "steering_nonlinearity", "parameters": {"saturation": 0.44}, "standard_errors": 9.0}]
    unnamed = score_comparison(truth, {**report(), "tested": tested}, model)
    rows = {"named": row, "unnamed": unnamed}
    add_visibility(rows)
    assert [each["stds"] for each in rows.values()] == [None, None]
    stated = {**model, "effects": {"steering_nonlinearity": {"saturation": 0.6}}}
    assert score_comparison(truth, named, stated)["sizes"][0]["stds"] == pytest.approx(15.0)


def test_standard_deviation_of_an_effect_without_a_name_is_that_of_its_limit() -> None:
    truth = answer("command_delay", ["command_delay", "mocap_latency"], parameter="extra_delay", size=0.045)
    limits = {"mocap_latency": {"latency": {"value": 0.02, "std": 0.015, "low90": 0.0, "high90": 0.045}}}
    row = score_comparison(truth, {**report(), "limits": limits}, {"mocap": {"latency": 0.008}})
    rows = {"unnamed": row}
    add_visibility(rows)
    assert rows["unnamed"]["stds"] == pytest.approx(3.0)
    assert score_comparison(truth, {**report(), "limits": {}}, {})["unnamed_stds"] is None


def test_change_to_a_value_counts_from_the_value_in_the_first_group() -> None:
    truth = answer(
        "steering_nonlinearity", ["steering_nonlinearity"], parameter="saturation", size=0.9, composes="replaces",
        per_lock=True,
    )  # fmt: skip
    named = report(("steering_nonlinearity", "saturation", 0.45 - 20.0))
    named["changes"][0]["reference"] = {"saturation": 20.0}
    size = score_comparison(truth, named, {"steering": {"max_angle": 0.5}})["sizes"][0]
    assert size["true"] == pytest.approx(0.45 - 20.0)
    assert size["covered"]


def test_sets_and_spurious_names() -> None:
    truth = answer("steering_delay", ["steering_delay"])
    row = score_comparison(truth, report(("steering_lag", "time_constant", 0.1), others=("steering_delay",)), {})
    assert (row["first"], row["first_with_sets"], row["spurious"]) == (False, True, [])
    two = score_comparison(truth, report(("motor_lag", "time_constant", 0.1), ("steering_delay", "delay", 0.07)), {})
    assert (two["first_with_sets"], two["found"], two["spurious"]) == (False, 1, ["motor_lag"])
    pair = {**truth, "kind": "pair", "effects": [*truth["effects"], *answer("motor_lag", ["motor_lag"])["effects"]]}
    both = score_comparison(
        pair, report(("steering_lag", "time_constant", 0.1), others=("steering_delay", "motor_lag")), {}
    )
    assert (both["found"], both["spurious"]) == (1, [])
    none = score_comparison(truth, None, {})
    assert (none["first"], none["verdict"]) == (False, "no report")
    untouched = {"kind": "null", "part": [], "effects": []}
    rows = {"a": none, "b": score_comparison(untouched, None, {}), "c": score_comparison(untouched, report(), {})}
    add_visibility(rows)
    counts = {row[0]: row[2] for row in rate_rows(rows)}
    assert counts["named first, sets allowed, all sizes"] == "0/1"
    assert counts["cases with a spurious name"] == "0/0"
    assert counts["false alarms, untouched recordings"] == "0/1"
    with pytest.raises(DataError, match="schema"):
        score_comparison(truth, {"schema": "other/1"}, {})
