"""``carlab view`` opens recordings, run folders and folders of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.helpers.rerun_files import cells, tabs

Carlab = Callable[..., tuple[int, str]]


def test_run_folder_is_one_recording_of_its_episodes(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _ = carlab("drive", "--ticks", "5", "--episodes", "2", "--out", tmp_path, "--no-rerun", "--no-picture")
    assert code == 0
    (run,) = tmp_path.iterdir()
    monkeypatch.setattr("carlab.recording.rerun.screenshot.has_vulkan_driver", lambda: False)
    file, picture = tmp_path / "new" / "run.rrd", tmp_path / "run.png"
    code, text = carlab("view", run, "--save", file, "--screenshot", picture)
    assert code == 0
    assert "Drawing a plot instead." in text
    assert picture.read_bytes().startswith(b"\x89PNG")
    steps = cells(file, "Scalars:scalars", "episode")["episode/tick/policy_ms"]
    assert [number for number, cell in steps if cell[0] == cell[0]] == [1] * 5 + [2] * 5
    assert set(tabs(file)) == {"Drive by episode", "Link"}
    code, text = carlab("view", run, "--save", file)
    assert code == 1
    assert "exists already" in text


def test_folder_of_a_diagnosis_opens_its_report_and_other_folders_are_refused(carlab: Carlab, tmp_path: Path) -> None:
    code, text = carlab("view", tmp_path, "--save", tmp_path / "x.rrd")
    assert code == 2
    assert "is not the folder of a run or of a diagnosis" in text
    (tmp_path / "report.rrd").write_bytes(b"RRF2 the report")
    assert carlab("view", tmp_path, "--save", tmp_path / "x.rrd")[0] == 0
    assert (tmp_path / "x.rrd").read_bytes() == b"RRF2 the report"


@pytest.mark.parametrize("content", [b"", b"RR", b"\x89MCAP0\r\n"])
def test_file_that_is_no_rerun_recording_is_refused_and_not_copied(
    carlab: Carlab, tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "some.rrd").write_bytes(content)
    code, text = carlab("view", tmp_path / "some.rrd", "--save", tmp_path / "copy.rrd")
    assert code == 1
    assert "some.rrd is not a rerun recording" in text
    assert not (tmp_path / "copy.rrd").exists()
