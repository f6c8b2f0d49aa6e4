"""Test the written report: JSON schema, HTML by a parser, TOML as a car file, rerun by its tool."""

import importlib.util
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

from carlab.cars.car_file import load_car_file
from carlab.core.errors import DataError
from carlab.diagnosis.findings import (
    DataFault,
    Diagnosis,
    FigureData,
    RecordingUse,
    Unexplained,
)
from carlab.diagnosis.report.figures import restarts
from carlab.diagnosis.report.numbers import number
from carlab.diagnosis.report.svg import nice_ticks
from carlab.diagnosis.report.write import write_report

_spec = importlib.util.spec_from_file_location("report_material", Path(__file__).with_name("report_material.py"))
material = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(material)
VOID = {"meta", "link", "img", "br", "hr", "input", "path", "circle", "rect"}
HOSTILE = '<script>alert("x")</script>&"\'\n\x07.csv'


@pytest.fixture(params=sorted(material.CASES))
def case(request: pytest.FixtureRequest) -> Diagnosis:
    return material.CASES[request.param]


@pytest.fixture(scope="module", params=sorted(material.CASES))
def written_case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a diagnosis with each verdict, with all figures."""
    folder = tmp_path_factory.mktemp("case")
    write_report(material.CASES[request.param], material.figure_data(), folder, material.model())
    return folder


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reports") / "new" / "folder"
    write_report(material.mismatch(), material.figure_data(), folder, material.model())
    return folder


class Page(HTMLParser):
    """Check nesting, and collect all attributes and the text outside of drawings and style sheets."""

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
    write_report(case, FigureData(), tmp_path, material.model())
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["schema"] == "carlab.diagnosis/1"
    assert report["verdict"] == case.verdict
    expected = {"schema", "verdict", "effects", "parameters", "fit", "unexplained", "data_faults", "recordings"}
    expected |= {"curves", "curve_trial", "ceiling", "skill", "drift", "events", "search", "limits", "withdrawn"}
    assert set(report) == expected | {"seed", "seconds", "sentence", "advice"}
    assert set(report["fit"]) == {"horizon_s", "fitted_score", "held_out", "held_out_share"}
    for errors in report["fit"]["held_out"].values():
        assert set(errors) == {"position_m", "yaw_rad", "vx", "vy", "yaw_rate", "score"}
    for effect in report["effects"]:
        assert set(effect) == {
            *("id", "confidence", "parameters", "indistinguishable_from", "separating_drive", "where", "evidence"),
            *("sentence", "car_file_values"),
        }
        assert set(effect["where"]) == {"channels", "regime", "lag_s", "time", "place"}
        assert set(effect["evidence"]) == {
            *("held_out_error_reduction", "standard_errors", "visibility", "deletion_fingerprint"),
        }
        for value in effect["parameters"].values():
            assert set(value) == {"value", "std", "low90", "high90", "unit", "at_limit"}
    assert (report["unexplained"] is None) == (case.verdict != "unexplained")
    if report["unexplained"] is not None:
        assert set(report["unexplained"]) == {"share", "channels", "regime", "class", "formula"}
    assert all(set(f) == {"id", "channel", "rows", "action"} for f in report["data_faults"])
    assert all(set(r) == {"path", "sha256", "role"} for r in report["recordings"])


def test_json_contains_the_numbers_and_default_sentences(written: Path) -> None:
    report = json.loads((written / "report.json").read_text(encoding="utf-8"))
    assert report["effects"][0]["parameters"]["time_constant"]["value"] == 0.11
    assert report["effects"][1]["where"]["place"] == {"x": 1.31, "y": -0.42, "radius": 0.62}
    assert report["fit"]["held_out"]["refit"]["score"] == 3.86
    assert report["sentence"].startswith("The simulator leaves out two effects")
    assert report["effects"][0]["sentence"] == "Left out: the steering servo lags by 0.11 s (0.095 to 0.125 at 90 %)."
    assert "carlab drive --policy steering_steps" in report["advice"]


def test_numbers_that_are_not_finite_become_null(tmp_path: Path) -> None:
    case = replace(material.mismatch(), seconds=math.nan)
    write_report(case, FigureData(), tmp_path, material.model())
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["seconds"] is None


def test_page_is_one_file_without_scripts_and_external_references(written_case: Path) -> None:
    text, page = read_page(written_case)
    assert not {"script", "link", "img", "iframe", "object", "embed"} & set(page.tags)
    assert not {"src", "href", "xlink:href", "srcset"} & {name for name, _ in page.attributes}
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    assert not re.search(r"https?:|@import|url\(", text)
    assert {"svg", "h1", "table"} <= set(page.tags)
    assert "nan" not in re.findall(r"[a-z]+", text)


def _numbers_of(value: object) -> set[str]:
    """Return all numbers in plain data in the formats of the page: value, magnitude, percent, per minute."""
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


def test_each_number_in_the_text_comes_from_the_data(written_case: Path) -> None:
    pictures = material.figure_data()
    _, page = read_page(written_case)
    known = _numbers_of(json.loads((written_case / "report.json").read_text(encoding="utf-8")))
    for t in pictures.traces:
        known |= _numbers_of(t.marked) | {t.name.split()[-1]}
    known |= _numbers_of(pictures.candidates)
    lags, curve, bound = pictures.correlation["steering_lag"]
    known |= _numbers_of([float(lags[curve.argmax()]), float(curve.max()), int((curve > bound).sum()), len(lags)])
    attained = (material.REFIT.score - material.WITH.score) / (material.REFIT.score - 1.0)
    known |= {"90", "1", "99", "3", f"{100 * attained:.0f}", "256", str(len(pictures.candidates))}
    known |= {"2", "0.15"}  # units such as m/s2, and the throttle of a second drive
    shown = {n for word in page.words for n in re.findall(r"\d+(?:\.\d+)?", word)}
    assert shown - known == set()
    assert len(shown) > 8


def test_page_contains_effect_interval_set_and_next_drive(written: Path) -> None:
    text, page = read_page(written)
    words = re.sub(r"\s+", " ", " ".join(page.words))
    assert "the steering servo lags by 0.11 s (0.095 to 0.125 at 90 %)" in words
    assert "These recordings do not distinguish it from a delay of the steering." in words
    assert "carlab drive --policy steering_steps" in words
    assert "within 0.62 m of x = 1.31 m, y = −0.42 m" in words
    assert "This would be wrong if" in words
    assert "repaired from the pose" in words
    assert "9f" * 32 in words
    assert text.count("<svg") >= 12


def test_report_without_a_verdict_states_why_and_what_to_record(tmp_path: Path) -> None:
    write_report(material.inconclusive(), FigureData(), tmp_path, material.model())
    words = " ".join(read_page(tmp_path)[1].words)
    assert "No verdict. The car hardly moves in the recordings to fit" in words
    assert "carlab drive --policy figure_eight" in words


def test_names_from_outside_are_escaped(tmp_path: Path) -> None:
    case = replace(
        material.mismatch(),
        recordings=(RecordingUse(HOSTILE, HOSTILE, "fit"),),
        data_faults=(DataFault(HOSTILE, HOSTILE, 1, HOSTILE),),
        unexplained=Unexplained(0.5, (HOSTILE,), HOSTILE, HOSTILE, HOSTILE),
        parameters={HOSTILE: material.estimate(1.0, 0.1, HOSTILE)},
        effects=(replace(material.lag_finding(), where=replace(material.lag_finding().where, regime=HOSTILE)),),
    )
    regimes = {HOSTILE: (np.arange(3.0), np.ones(3), np.ones(3))}
    hostile = replace(
        material.figure_data(), traces=(material.trace(HOSTILE),), scores_by_step=((HOSTILE, 1.0),), regimes=regimes
    )
    write_report(case, hostile, tmp_path, material.model())
    text, page = read_page(tmp_path)
    assert "script" not in page.tags
    assert "<script" not in text
    assert any('<script>alert("x")</script>' in word for word in page.words)
    assert replace(load_car_file(tmp_path / "model.toml").simulator, parameter_std={}) == material.model()
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["recordings"][0]["path"] == HOSTILE


def test_model_is_a_car_file_that_states_its_origin(written: Path) -> None:
    loaded = load_car_file(written / "model.toml")
    assert replace(loaded.simulator, parameter_std={}) == material.model()
    known = {"effects.steering_lag.time_constant": material.lag_finding().parameters["time_constant"]}
    assert loaded.simulator.parameter_std == {name: e.std for name, e in (material.PARAMETERS | known).items()}
    assert loaded.simulator.effects["steering_lag"]["time_constant"] == 0.11
    comments = [line for line in loaded.text.splitlines() if line.startswith("#")]
    assert any("drives/2024-06-07 morning.csv" in line for line in comments)
    assert any("do not distinguish steering_lag from steering_delay" in line for line in comments)
    assert not any("noon" in line for line in comments)


def test_rerun_reads_the_recording_and_prints_its_entities(written: Path) -> None:
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


def test_recordings_of_equal_names_have_different_entities(tmp_path: Path) -> None:
    write_report(
        material.mismatch(),
        FigureData(traces=(material.trace("a b"), material.trace("a b"), material.trace("verdict"))),
        tmp_path,
        material.model(),
    )
    rerun = Path(sys.executable).with_name("rerun")
    command = [str(rerun), "rrd", "print", str(tmp_path / "report.rrd")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert all(f"/{name}/map/recorded/trail" in printed for name in ("a_b", "a_b_2", "verdict_2"))


def test_report_replaces_an_older_one_without_leftover_files(tmp_path: Path) -> None:
    write_report(material.mismatch(), material.figure_data(), tmp_path, material.model())
    write_report(material.no_mismatch(), FigureData(), tmp_path, material.model())
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["verdict"] == "none"
    assert {p.name for p in tmp_path.iterdir()} == {"report.json", "report.html", "report.rrd", "model.toml"}


def test_file_in_place_of_the_folder_raises_data_error(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine", encoding="utf-8")
    with pytest.raises(DataError, match="a file has the path of its folder; choose another folder"):
        write_report(material.no_mismatch(), FigureData(), tmp_path / "taken", material.model())
    assert (tmp_path / "taken").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("name", ["report.html", "report.rrd", "model.toml"])
def test_file_that_cannot_be_written_leaves_no_report_json(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(DataError, match=re.escape(name)):
        write_report(material.no_mismatch(), FigureData(), tmp_path, material.model())
    assert not (tmp_path / "report.json").exists()
    assert [p for p in tmp_path.iterdir() if "partial" in p.name] == []


def test_restarts_are_the_first_rows_of_predictions() -> None:
    trace = material.trace()
    assert restarts(trace.recorded, trace.predicted["refit"]) == list(range(30, len(trace.times_s) - 60, 30))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]), (-3.0, 7.0, [-2.0, 0.0, 2.0, 4.0, 6.0]), (5.0, 5.0, [5.0])],
)
def test_ticks_are_round_numbers_inside_the_range(low: float, high: float, expected: list[float]) -> None:
    assert nice_ticks(low, high) == pytest.approx(expected)
