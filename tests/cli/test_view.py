"""``carlab view`` opens recordings, run folders and folders of a diagnosis."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.command_line import Carlab
from tests.helpers.rerun_files import cells, tabs


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
    assert set(tabs(file)) == {"Drive by episode", "Latency and health"}
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


def test_rerun_file_is_plotted_from_its_recording_without_a_vulkan_driver(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carlab.recording.rerun.screenshot.has_vulkan_driver", lambda: False)
    assert carlab("drive", "--ticks", "5", "--out", tmp_path, "--no-picture")[0] == 0
    (episode,) = tmp_path.glob("*/episodes/0001.rrd")
    code, text = carlab("view", episode, "--screenshot", tmp_path / "a.png")
    assert code == 0, text
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    episode.with_suffix(".mcap").unlink()
    code, text = carlab("view", episode, "--screenshot", tmp_path / "b.png")
    assert code == 3
    assert "apt-get install mesa-vulkan-drivers libvulkan1', or name the .mcap recording" in text


def test_report_of_a_diagnosis_has_its_summary_or_page_as_picture(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carlab.recording.rerun.screenshot.has_vulkan_driver", lambda: False)
    (tmp_path / "report.rrd").write_bytes(b"RRF2 the report")
    (tmp_path / "report.html").write_text("the figures", encoding="utf-8")
    for opened in (tmp_path, tmp_path / "report.rrd"):
        code, text = carlab("view", opened, "--screenshot", tmp_path / "a.png")
        assert code == 3
        assert f"or open {tmp_path / 'report.html'} in a browser, which has the same figures." in text
    (tmp_path / "summary.png").write_bytes(b"the summary")
    assert carlab("view", tmp_path / "report.rrd", "--screenshot", tmp_path / "a.png")[0] == 0
    assert (tmp_path / "a.png").read_bytes() == b"the summary"
