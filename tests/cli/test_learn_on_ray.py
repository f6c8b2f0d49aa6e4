"""``carlab learn --ray`` from the command line: refusals and output, without a cluster."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import tyro

from carlab.cli.console import progress
from carlab.cli.learn import Learn
from tests.helpers.command_line import Carlab


def test_missing_ray_is_refused_before_the_run(carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    code, text = carlab("learn", "--ray", "local", "--out", tmp_path / "runs", "--no-rerun")
    assert code == 2
    assert "--ray needs Ray, which is not installed; in the repository of carlab, run:" in text
    assert "-e '.[ray]'." in text
    assert list((tmp_path / "runs").iterdir()) == []


def test_sentence_about_the_link_is_printed_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    with progress() as bar:
        Learn()._hooks(bar).on_link("The cluster ray://[::1]:10001 answers again.")
    assert "The cluster ray://[::1]:10001 answers again." in capsys.readouterr().out


def test_resume_command_names_the_cluster() -> None:
    command = Learn(ray="ray://box:10001", ray_wait=30.0)
    parsed = tyro.cli(Learn, args=shlex.split(command.ray_text()))
    assert (parsed.ray, parsed.ray_wait) == ("ray://box:10001", 30.0)
    assert Learn().ray_text() == ""
