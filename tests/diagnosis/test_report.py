"""The written report, read back: JSON by its schema, HTML by a parser, TOML as a car file, rerun by its own tool."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from carlab.cars.car_file import load_car_file
from carlab.core.errors import DataError
from carlab.diagnosis.findings import (
    DataFault,
    Diagnosis,
    EffectFinding,
    Estimate,
    Evidence,
    Exhibits,
    FitErrors,
    RecordingUse,
    Trace,
    Unexplained,
    Where,
)
from carlab.diagnosis.report import write_report
from carlab.diagnosis.report_figures import restarts
from carlab.diagnosis.report_svg import nice_ticks
from carlab.diagnosis.report_text import number
from sim_backends.car_parameters import SimulatorConfig

VOID = {"meta", "link", "img", "br", "hr", "input", "path", "circle", "rect"}
HOSTILE = '<script>alert("x")</script>&"\'\n\x07.csv'


def estimate(value: float, std: float, unit: str) -> Estimate:
    return Estimate(value, std, value - 1.6449 * std, value + 1.6449 * std, unit)


def drive(lag_s: float, seconds: float = 24.0, rate_hz: float = 30.0) -> tuple[NDArray, NDArray]:
    """A kinematic car that weaves at changing speed with a lag in its steering: times (T,), states (T, 6)."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return t, _weave(t, np.zeros(6), 0.0, lag_s)


def _weave(t: NDArray, start: NDArray, angle: float, lag_s: float) -> NDArray:
    states = [start]
    for k in range(len(t) - 1):
        dt = t[k + 1] - t[k]
        wanted = 0.35 * np.sign(np.sin(2 * np.pi * t[k] / 3.1)) + 0.1 * np.sin(t[k])
        angle += (wanted - angle) * (1.0 if lag_s <= 0 else -math.expm1(-dt / lag_s))
        x, y, yaw = states[-1][:3]
        v = 1.6 + 0.5 * np.sin(0.5 * t[k])
        r = v * np.tan(angle) / 0.3
        move = (x + dt * v * np.cos(yaw), y + dt * v * np.sin(yaw), yaw + dt * r)
        states.append(np.array([*move, v, 0.12 * r, r]))
    return np.array(states)


def trace(name: str = "recording 1") -> Trace:
    t, recorded = drive(0.11)
    predicted: dict[str, NDArray] = {}
    for model, lag_s in (("nominal", 0.0), ("refit", 0.03), ("with_effects", 0.10)):
        rows = np.full_like(recorded, np.nan)
        for first in range(30, len(t) - 60, 30):
            part = slice(first, first + 30)
            rows[part] = _weave(t[part], recorded[first], float(np.arctan(recorded[first, 5] * 0.15)), lag_s)
        predicted[model] = rows
    return Trace(name, t, recorded, predicted, ((4.0, 5.0), (9.0, 10.0), (17.0, 18.0)))


def lag_finding() -> EffectFinding:
    return EffectFinding(
        id="steering_lag",
        confidence=0.49,
        parameters={"time_constant": estimate(0.11, 0.0091, "s")},
        where=Where(("yaw_rate", "vy"), "|steering rate| > 2.1 /s", 0.11, None, None),
        evidence=Evidence(
            0.413, 14.2, 0.63, {"yaw_rate": 0.92, "vy": 0.41, "yaw": 0.33, "x": 0.02, "y": 0.1, "vx": -0.01}
        ),
        sentence="",
        indistinguishable_from=("steering_delay",),
        separating_drive="steering_steps",
    )


def patch_finding() -> EffectFinding:
    parameters = {
        "x": estimate(1.31, 0.021, "m"),
        "y": estimate(-0.42, 0.034, "m"),
        "radius": estimate(0.62, 0.045, "m"),
        "loss": estimate(0.47, 0.052, "1"),
    }
    where = Where(("vy",), "speed > 1.9 m/s", None, (3.5, 21.25), (1.31, -0.42, 0.62))
    evidence = Evidence(0.17, 6.4, 0.88, {"vy": 0.44, "yaw_rate": 0.21, "yaw": 0.12, "x": 0.01, "y": 0.05, "vx": 0.03})
    return EffectFinding("low_friction_patch", 0.97, parameters, where, evidence, "")


FLOOR = FitErrors(0.0051, 0.0082, 0.021, 0.019, 0.053, 1.0)
NOMINAL = FitErrors(0.193, 0.184, 0.118, 0.153, 0.72, 7.42)
REFIT = FitErrors(0.084, 0.091, 0.043, 0.081, 0.41, 3.86)
WITH = FitErrors(0.0091, 0.0122, 0.027, 0.024, 0.071, 1.37)
USES = (
    RecordingUse("drives/2024-06-07 morning.csv", "9f" * 32, "fit"),
    RecordingUse("drives/2024-06-07 noon.csv", "3c" * 32, "held out"),
)
PARAMETERS = {
    "motor.drive_gain": estimate(7.83, 0.092, "N"),
    "motor.damping": estimate(1.61, 0.033, "N s/m"),
    "tyre.front.mu": estimate(0.432, 0.0072, "1"),
    "vehicle.yaw_inertia": estimate(0.0612, 0.0021, "kg m2"),
    "steering.max_angle": estimate(0.583, 0.0063, "rad"),
}


def mismatch() -> Diagnosis:
    held = {"nominal": NOMINAL, "refit": REFIT, "with_effects": WITH, "noise_floor": FLOOR}
    faults = (DataFault("yaw_wrap_spikes", "yaw_rate", 21, "repaired from the pose"),)
    effects = (lag_finding(), patch_finding())
    return Diagnosis("mismatch", "", effects, PARAMETERS, 1.0, held, None, faults, USES, 7, 41.3)


def exhibits() -> Exhibits:
    lags = np.arange(12) / 30.0
    curve = 0.46 * np.exp(-((lags - 0.1) ** 2) / 0.006)
    speed, ay = np.linspace(0.4, 2.4, 6), np.linspace(0.1, 6.2, 6)
    return Exhibits(
        traces=(trace(), replace(trace("recording 2"), marked=((7.0, 8.0),))),
        ladder=(
            ("nominal", 7.42),
            ("refit", 3.86),
            ("+ steering_lag", 1.81),
            ("+ low_friction_patch", 1.37),
            ("noise floor", 1.0),
        ),
        regimes={
            "speed [m/s]": (speed, 1.1 + 1.5 * speed, 1.2 + 0.1 * speed),
            "|steering rate| [/s]": (ay, 1.3 + 0.9 * ay, 1.3 + 0.02 * ay),
            "lateral acceleration [m/s2]": (ay, 1.5 + 0.4 * ay, 1.25 + 0.03 * ay),
        },
        correlation={"steering_lag": (lags, curve, 0.14)},
        candidates=(("steering_lag", 14.2, 1.8), ("steering_delay", 13.6, 1.83), ("steering_rate_limit", 7.7, 2.9)),
    )


def parameters_only() -> Diagnosis:
    held = {"nominal": NOMINAL, "refit": replace(WITH, score=1.08), "noise_floor": FLOOR}
    return replace(mismatch(), verdict="parameters", effects=(), held_out=held, data_faults=())


def nothing() -> Diagnosis:
    held = {"nominal": replace(WITH, score=1.03), "refit": replace(WITH, score=1.02), "noise_floor": FLOOR}
    return replace(parameters_only(), verdict="none", held_out=held)


def bad_data() -> Diagnosis:
    fault = DataFault("stale_samples", "yaw_rate", 1834, "unusable: the column repeats itself for 61 s")
    return replace(nothing(), verdict="data", held_out={}, parameters={}, data_faults=(fault,))


def nameless() -> Diagnosis:
    rest = Unexplained(
        0.83, ("vx", "x"), "speed > 1.8 m/s", "even in steering, grows with speed; acts on vx", "a_x = -0.31 |d| v"
    )
    return replace(nothing(), verdict="unexplained", held_out=mismatch().held_out, unexplained=rest)


def no_verdict() -> Diagnosis:
    why = "The car hardly moves in the recordings to fit; record it driving (carlab drive --policy figure_eight)."
    return Diagnosis("inconclusive", why, (), {}, 1.0, {}, None, (), USES[:1], 0, 0.0, why)


CASES = {d.verdict: d for d in (mismatch(), parameters_only(), nothing(), bad_data(), nameless(), no_verdict())}


@pytest.fixture(params=sorted(CASES))
def case(request: pytest.FixtureRequest) -> Diagnosis:
    return CASES[request.param]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reports") / "new" / "folder"
    write_report(mismatch(), exhibits(), folder, model())
    return folder


def model() -> SimulatorConfig:
    changes = {"motor.drive_gain": 7.83, "effects.steering_lag.time_constant": 0.11}
    return SimulatorConfig.from_preset().with_values(changes)


class Page(HTMLParser):
    """Checks nesting, and gathers the words outside of drawings and style sheets, and all attributes."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.pictures = 0
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "svg"} & set(self.open):
            self.words.append(data)


def read_page(folder: Path) -> tuple[str, Page]:
    text = (folder / "report.html").read_text(encoding="utf-8")
    return text, Page(text)


def test_json_has_the_keys_of_the_schema_for_each_verdict(case: Diagnosis, tmp_path: Path) -> None:
    write_report(case, Exhibits(), tmp_path, model())
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["schema"] == "carlab.diagnosis/1"
    assert report["verdict"] == case.verdict
    wanted = {"schema", "verdict", "effects", "parameters", "fit", "unexplained", "data_faults", "recordings"}
    assert set(report) == wanted | {"seed", "seconds", "sentence", "advice"}
    assert set(report["fit"]) == {"horizon_s", "held_out"}
    for errors in report["fit"]["held_out"].values():
        assert set(errors) == {"position_m", "yaw_rad", "vx", "vy", "yaw_rate", "score"}
    for effect in report["effects"]:
        assert set(effect) == {
            *("id", "confidence", "parameters", "indistinguishable_from", "separating_drive", "where", "evidence"),
            "sentence",
        }
        assert set(effect["where"]) == {"channels", "regime", "lag_s", "time", "place"}
        assert set(effect["evidence"]) == {
            *("held_out_error_reduction", "standard_errors", "visibility", "deletion_fingerprint"),
        }
        for value in effect["parameters"].values():
            assert set(value) == {"value", "std", "low90", "high90", "unit"}
    assert (report["unexplained"] is None) == (case.verdict != "unexplained")
    if report["unexplained"] is not None:
        assert set(report["unexplained"]) == {"share", "channels", "regime", "class", "formula"}
    assert all(set(f) == {"id", "channel", "rows", "action"} for f in report["data_faults"])
    assert all(set(r) == {"path", "sha256", "role"} for r in report["recordings"])


def test_json_holds_the_numbers_and_fills_in_the_sentences(written: Path) -> None:
    report = json.loads((written / "report.json").read_text(encoding="utf-8"))
    assert report["effects"][0]["parameters"]["time_constant"]["value"] == 0.11
    assert report["effects"][1]["where"]["place"] == {"x": 1.31, "y": -0.42, "radius": 0.62}
    assert report["fit"]["held_out"]["refit"]["score"] == 3.86
    assert report["sentence"].startswith("The simulator leaves out two things")
    assert report["effects"][0]["sentence"] == "Left out: the steering servo lags by 0.11 s (0.095 to 0.125 at 90 %)."
    assert "carlab drive --policy steering_steps" in report["advice"]


def test_numbers_that_are_not_finite_become_null(tmp_path: Path) -> None:
    case = replace(mismatch(), seconds=math.nan)
    write_report(case, Exhibits(), tmp_path, model())
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["seconds"] is None


def test_page_is_one_file_without_scripts_or_references_to_elsewhere(case: Diagnosis, tmp_path: Path) -> None:
    write_report(case, exhibits(), tmp_path, model())
    text, page = read_page(tmp_path)
    assert not {"script", "link", "img", "iframe", "object", "embed"} & set(page.tags)
    assert not {"src", "href", "xlink:href", "srcset"} & {name for name, _ in page.attributes}
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    assert not re.search(r"https?:|@import|url\(", text)
    assert {"svg", "h1", "table"} <= set(page.tags)
    assert "nan" not in re.findall(r"[a-z]+", text)


def _numbers_of(value: object) -> set[str]:
    """Every number in plain data, as the page may write it: itself, its size, in per cent, each minute."""
    if isinstance(value, Mapping):
        return {n for v in value.values() for n in _numbers_of(v)}
    if isinstance(value, list | tuple):
        return {n for v in value for n in _numbers_of(v)}
    if isinstance(value, str):
        return set(re.findall(r"\d+(?:\.\d+)?", value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        return set()
    size = abs(float(value))
    shapes = {number(size), number(100 * size), number(6000 * size), f"{100 * size:.0f}", f"{100 * size:.1f}"}
    return shapes | {str(value)}


def test_every_number_in_the_text_comes_from_the_data(case: Diagnosis, tmp_path: Path) -> None:
    pictures = exhibits()
    write_report(case, pictures, tmp_path, model())
    _, page = read_page(tmp_path)
    known = _numbers_of(json.loads((tmp_path / "report.json").read_text(encoding="utf-8")))
    for t in pictures.traces:
        known |= _numbers_of(t.marked) | {t.name.split()[-1]}
    known |= _numbers_of(pictures.candidates)
    lags, curve, bound = pictures.correlation["steering_lag"]
    known |= _numbers_of([float(lags[curve.argmax()]), float(curve.max()), int((curve > bound).sum()), len(lags)])
    reached = (REFIT.score - WITH.score) / (REFIT.score - 1.0)
    known |= {"90", "1", "99", "3", f"{100 * reached:.0f}", "256", str(len(pictures.candidates))}
    known |= {"2", "0.15"}  # units such as m/s2, and the throttle of a second drive
    said = {n for word in page.words for n in re.findall(r"\d+(?:\.\d+)?", word)}
    assert said - known == set()
    assert len(said) > 8


def test_page_tells_effect_interval_set_and_next_drive(written: Path) -> None:
    text, page = read_page(written)
    words = re.sub(r"\s+", " ", " ".join(page.words))
    assert "the steering servo lags by 0.11 s (0.095 to 0.125 at 90 %)" in words
    assert "These recordings cannot tell it from a delay of the steering." in words
    assert "carlab drive --policy steering_steps" in words
    assert "within 0.62 m of x = 1.31 m, y = −0.42 m" in words
    assert "This would be wrong if" in words
    assert "repaired from the pose" in words
    assert "9f" * 32 in words
    assert text.count("<svg") >= 12


def test_a_report_without_a_verdict_says_why_and_what_to_record(tmp_path: Path) -> None:
    write_report(no_verdict(), Exhibits(), tmp_path, model())
    words = " ".join(read_page(tmp_path)[1].words)
    assert "No verdict. The car hardly moves in the recordings to fit" in words
    assert "carlab drive --policy figure_eight" in words


def test_names_from_outside_cannot_become_markup(tmp_path: Path) -> None:
    case = replace(
        mismatch(),
        recordings=(RecordingUse(HOSTILE, HOSTILE, "fit"),),
        data_faults=(DataFault(HOSTILE, HOSTILE, 1, HOSTILE),),
        unexplained=Unexplained(0.5, (HOSTILE,), HOSTILE, HOSTILE, HOSTILE),
        parameters={HOSTILE: estimate(1.0, 0.1, HOSTILE)},
        effects=(replace(lag_finding(), where=replace(lag_finding().where, regime=HOSTILE)),),
    )
    regimes = {HOSTILE: (np.arange(3.0), np.ones(3), np.ones(3))}
    hostile = replace(exhibits(), traces=(trace(HOSTILE),), ladder=((HOSTILE, 1.0),), regimes=regimes)
    write_report(case, hostile, tmp_path, model())
    text, page = read_page(tmp_path)
    assert "script" not in page.tags
    assert "<script" not in text
    assert any('<script>alert("x")</script>' in word for word in page.words)
    assert load_car_file(tmp_path / "model.toml").simulator == model()
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["recordings"][0]["path"] == HOSTILE


def test_model_is_a_car_file_that_says_where_it_comes_from(written: Path) -> None:
    loaded = load_car_file(written / "model.toml")
    assert loaded.simulator == model()
    assert loaded.simulator.effects["steering_lag"]["time_constant"] == 0.11
    comments = [line for line in loaded.text.splitlines() if line.startswith("#")]
    assert any("drives/2024-06-07 morning.csv" in line for line in comments)
    assert any("cannot tell steering_lag from steering_delay" in line for line in comments)
    assert not any("noon" in line for line in comments)


def test_rerun_reads_the_recording_and_finds_its_entities(written: Path) -> None:
    rerun = Path(sys.executable).with_name("rerun")
    path = str(written / "report.rrd")
    checked = subprocess.run([str(rerun), "rrd", "verify", path], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    printed = subprocess.run([str(rerun), "rrd", "print", path], capture_output=True, text=True, check=True).stdout
    for part in ("recording_1", "recording_2"):
        for name in ("recorded", "nominal", "refit", "with_effects"):
            assert f"/{part}/map/{name}/base_link" in printed
            assert f"/{part}/map/{name}/trail" in printed
            assert f"/{part}/state/yaw_rate/{name}" in printed
        for name in ("nominal", "refit", "with_effects"):
            assert f"/{part}/residual/position/{name}" in printed
        assert f"/{part}/marks" in printed
        assert f"/{part}/map/worst" in printed
        assert f"/{part}/map/place" in printed
    assert "/verdict" in printed


def test_recordings_of_the_same_name_stay_apart(tmp_path: Path) -> None:
    write_report(mismatch(), Exhibits(traces=(trace("a b"), trace("a b"), trace("verdict"))), tmp_path, model())
    rerun = Path(sys.executable).with_name("rerun")
    command = [str(rerun), "rrd", "print", str(tmp_path / "report.rrd")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert all(f"/{name}/map/recorded/trail" in printed for name in ("a_b", "a_b_2", "verdict_2"))


def test_a_report_replaces_an_older_one_and_leaves_nothing_unfinished(tmp_path: Path) -> None:
    write_report(mismatch(), exhibits(), tmp_path, model())
    write_report(nothing(), Exhibits(), tmp_path, model())
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["verdict"] == "none"
    assert {p.name for p in tmp_path.iterdir()} == {"report.json", "report.html", "report.rrd", "model.toml"}


def test_a_file_in_place_of_the_folder_is_told_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine", encoding="utf-8")
    with pytest.raises(DataError, match="a file stands where its folder belongs; choose another folder"):
        write_report(nothing(), Exhibits(), tmp_path / "taken", model())
    assert (tmp_path / "taken").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("name", ["report.html", "report.rrd", "model.toml"])
def test_a_file_that_cannot_be_written_leaves_no_report_json(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(DataError, match=re.escape(name)):
        write_report(nothing(), Exhibits(), tmp_path, model())
    assert not (tmp_path / "report.json").exists()
    assert [p for p in tmp_path.iterdir() if "partial" in p.name] == []


def test_restarts_are_where_the_predictions_were_started() -> None:
    made = trace()
    assert restarts(made.recorded, made.predicted["refit"]) == list(range(30, len(made.times_s) - 60, 30))


@pytest.mark.parametrize(
    ("low", "high", "wanted"),
    [(0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]), (-3.0, 7.0, [-2.0, 0.0, 2.0, 4.0, 6.0]), (5.0, 5.0, [5.0])],
)
def test_ticks_are_round_numbers_inside_the_range(low: float, high: float, wanted: list[float]) -> None:
    assert nice_ticks(low, high) == pytest.approx(wanted)
