"""The whole diagnosis on drives by an independent generator: a concealed effect is named and sized."""

import json
import re
from pathlib import Path

import pytest

from carlab.cli import run
from carlab.concealment import make_case
from carlab.concealment.measurement import write_csv


@pytest.fixture(scope="module")
def concealed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """A servo lag concealed in 60 s of driving, base parameters off by up to 10 %, and 30 s to judge by."""
    folder = tmp_path_factory.mktemp("concealed")
    case = make_case("single", 11, effects=("steering_lag",), excess=4.0, fit_s=60, hold_s=30)
    write_csv(folder / "fit.csv", case.fit)
    write_csv(folder / "hold.csv", case.hold)
    case.nominal.write(folder / "car.toml")
    return folder, case.answer()["effects"][0]["parameters"]["time_constant"]


def test_a_concealed_servo_lag_is_named_first_and_sized(concealed: tuple[Path, float]) -> None:
    folder, truth_s = concealed
    out = folder / "out"
    arguments = [str(folder / "fit.csv"), "--car", str(folder / "car.toml"), "--holdout", str(folder / "hold.csv")]
    assert run(["diagnose", *arguments, "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "mismatch"
    first = report["effects"][0]
    assert first["id"] == "steering_lag"
    assert first["parameters"]["time_constant"]["value"] == pytest.approx(truth_s, rel=0.05)
    held_out = report["fit"]["held_out"]
    assert held_out["with_effects"]["score"] < 0.5 * held_out["refit"]["score"]
    for name in ("report.html", "report.rrd", "model.toml"):
        assert (out / name).stat().st_size > 0


def test_a_parked_car_is_inconclusive_and_says_what_to_record(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rows = (concealed[0] / "fit.csv").read_text().splitlines()
    first = rows[1].split(",")
    parked = [rows[0], *(",".join([r.split(",")[0], *first[1:4], "0", "0", "0", *r.split(",")[7:]]) for r in rows[1:])]
    path = tmp_path / "parked.csv"
    path.write_text("\n".join(parked) + "\n")
    assert run(["diagnose", str(path), "--out", str(tmp_path / "out")]) == 5
    assert "record it driving" in " ".join(capfd.readouterr().err.split())
    assert json.loads((tmp_path / "out" / "report.json").read_text())["verdict"] == "inconclusive"


@pytest.mark.parametrize("held_out", [False, True])
def test_a_recording_that_is_too_short_is_inconclusive(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str], held_out: bool
) -> None:
    path = tmp_path / "short.csv"
    path.write_text("\n".join((concealed[0] / "fit.csv").read_text().splitlines()[:120]) + "\n")
    more = ["--holdout", str(concealed[0] / "hold.csv")] if held_out else []
    assert run(["diagnose", str(path), *more, "--out", str(tmp_path / "out")]) == 5
    assert "100 s" in " ".join(capfd.readouterr().err.split())
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "inconclusive"
    assert report["effects"] == []


def test_a_recording_whose_tracking_is_lost_all_the_time_is_itself_at_fault(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Motion capture takes another body for the car for a third of a second in each second."""
    rows = [r.split(",") for r in (concealed[0] / "fit.csv").read_text().splitlines()]
    column = rows[0].index("x")
    for k, row in enumerate(rows[1:]):
        if k % 12 < 4:
            row[column] = str(float(row[column]) + 2.0)
    path = tmp_path / "swapped.csv"
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    assert run(["diagnose", str(path), "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "data"
    assert report["effects"] == []
    assert "outliers" in {fault["id"] for fault in report["data_faults"]}
    assert "The recording is at fault" in " ".join(capfd.readouterr().err.split())


def test_a_constant_command_is_inconclusive_and_names_the_drive_that_varies_it(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rows = [r.split(",") for r in (concealed[0] / "fit.csv").read_text().splitlines()]
    column = rows[0].index("throttle")
    path = tmp_path / "constant.csv"
    path.write_text("\n".join(",".join([*r[:column], "throttle" if k == 0 else "0.3", *r[column + 1 :]])
                              for k, r in enumerate(rows)) + "\n")  # fmt: skip
    assert run(["diagnose", str(path), "--out", str(tmp_path / "out")]) == 5
    assert "--policy throttle_steps" in " ".join(capfd.readouterr().err.split())


def test_what_is_fitted_cannot_judge(concealed: tuple[Path, float], tmp_path: Path) -> None:
    same = str(concealed[0] / "fit.csv")
    assert run(["diagnose", same, "--holdout", same, "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_the_share_that_judges_is_not_fitted(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str], share: float
) -> None:
    """Nor are the second and a half before it, which shots that judge begin with."""
    rows = [
        r for r in (concealed[0] / "fit.csv").read_text().splitlines() if r[0] == "t" or float(r.split(",")[0]) < 12
    ]
    path = tmp_path / "short.csv"
    path.write_text("\n".join(rows) + "\n")
    assert run(["diagnose", str(path), "--holdout-share", str(share), "--out", str(tmp_path / "out")]) == 5
    found = re.search(r"to fit hold ([\d.]+) s", " ".join(capfd.readouterr().err.split()))
    assert found is not None
    assert float(found[1]) == pytest.approx((1.0 - share) * 12.0 - 1.5, abs=0.11)


@pytest.mark.parametrize("share", ["0", "0.6", "nan"])
def test_a_share_that_leaves_too_little_is_refused(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str], share: str
) -> None:
    path = str(concealed[0] / "fit.csv")
    assert run(["diagnose", path, "--holdout-share", share, "--out", str(tmp_path / "out")]) == 2
    assert "give one above 0 and at most 0.5" in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_share_beside_a_recording_that_is_held_out_is_refused(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    paths = [str(concealed[0] / "fit.csv"), "--holdout", str(concealed[0] / "hold.csv")]
    assert run(["diagnose", *paths, "--holdout-share", "0.1", "--out", str(tmp_path / "out")]) == 2
    assert "counts only where no recording is held out whole" in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "out").exists()
