"""``carlab bench realcars``: bad input in one sentence, and the table and file of its figures."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from carlab.cli import run
from carlab.diagnosis.events import EventUse
from carlab.diagnosis.report.write import JSON_NAME
from carlab.prediction.predict import ConstantVelocity, NoChange
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with three files that are named like recordings."""
    data = tmp_path / "data"
    data.mkdir()
    for name in ("a.csv", "b.csv", "c.csv"):
        (data / name).write_text("t,x\n")
    return data


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "bench realcars needs --data FOLDER"),
        (["--data", "nowhere"], "--data nowhere is not a folder"),
        (["--data", "data", "--held-out", "z"], "No recording has 'z' in its name; there are a.csv, b.csv, c.csv."),
        (["--data", "data", "--held-out", ".csv"], "At least one recording to fit and one held-out recording"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    monkeypatch.chdir(folder.parent)
    assert run(["bench", "realcars", *options]) != 0
    error = " ".join(capsys.readouterr().err.split())
    assert message in error
    assert "Traceback" not in error


def test_figures_are_printed_and_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The diagnosis is replaced: three models on the windows of two held-out drives."""
    windows = cut_windows(segments_of([drive(SimulatorConfig(), 12.0, k) for k in (1, 2)], PERIOD_S), 1.0, 0.25)
    models = {"nominal": NoChange(), "adapted": NoChange(), "constant_velocity": ConstantVelocity()}
    asked: dict[str, object] = {}

    def diagnose(fit, car, **options):
        asked.update(options, fit=[p.name for p in fit])
        names = tuple(str(p) for p in options["held_out"])
        return SimpleNamespace(
            outcome=SimpleNamespace(models=models, held_out_windows=windows), held_out_names=names,
            diagnosis=SimpleNamespace(events=EventUse(), held_out={}, held_out_with_events={}),
        )  # fmt: skip

    monkeypatch.setattr("carlab.cli.bench_realcars.diagnose", diagnose)
    out = folder.parent / "figures.json"
    command = ["bench", "realcars", "--data", str(folder), "--held-out", "b.csv", "c.csv", "--out", str(out)]
    command += ["--effects", "command_delay"]
    assert run(command) == 0
    assert asked["fit"] == ["a.csv"]
    assert asked["curves"]
    assert asked["ceiling"]
    assert asked["adapt"]
    assert asked["discrepancy"]
    assert asked["effects"] == ("command_delay",)
    figures = json.loads(out.read_text())
    assert (figures["fit"], figures["held_out"]) == (["a.csv"], ["b.csv", "c.csv"])
    rows = {(e["recording"], e["model"], e["horizon_s"]): e for e in figures["errors"]}
    assert len(rows) == 3 * 3 * 3
    still, adapted, constant = (
        rows["all", name, 1.0]["position_rms_m"] for name in ("car file", "adapted", "constant velocity")
    )
    assert still > 2.0 * constant
    assert adapted == still
    assert f"{constant:.3f}" in capsys.readouterr().out
    assert JSON_NAME not in {p.name for p in folder.iterdir()}
