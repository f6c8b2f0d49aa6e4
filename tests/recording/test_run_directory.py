"""The folder of a run: its files, episode numbers, log, results and the git state."""

import json
import logging
import os
import re
import subprocess
import unicodedata
from pathlib import Path

import pytest

from carlab.core.errors import DataError
from carlab.recording.run_folder import RunDirectory, environment, git_state


def test_new_run_has_its_folders_configuration_and_environment(tmp_path):
    run = RunDirectory.create(tmp_path / "runs", "Parking in the lab!", config_toml="seed = 3\n")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d{6}_Parking-in-the-lab", run.path.name)
    assert {p.name for p in run.path.iterdir()} == {"config.toml", "environment.json", "episodes"}
    assert run.config_toml == "seed = 3\n"
    environment_file = json.loads((run.path / "environment.json").read_text())
    assert environment_file["packages"].keys() >= {"numpy", "mcap"}
    assert environment_file["python"].startswith("3.")
    assert RunDirectory.open_existing(run.path).path == run.path


def test_interrupted_creation_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the first file and environment.json; without it, the folder would be no run's folder."""

    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(RunDirectory, "write_json", interrupted)
    with pytest.raises(KeyboardInterrupt):
        RunDirectory.create(tmp_path / "runs", "stopped")
    assert list((tmp_path / "runs").iterdir()) == []


def test_runs_of_the_same_second_have_different_folders(tmp_path):
    runs = [RunDirectory.create(tmp_path, "again").path for _ in range(4)]
    assert len(set(runs)) == 4


def test_next_episode_number_counts_finished_and_partial_files(tmp_path):
    run = RunDirectory.create(tmp_path, "count")
    assert run.next_episode() == 1
    for name in ("0001.mcap", "0001.rrd", "0003.mcap.partial", "0007.rrd.partial", "notes.txt", "0099.txt"):
        (run.episodes / name).touch()
    assert run.next_episode() == 8
    assert run.episode_path(8) == run.episodes / "0008.mcap"
    assert run.episode_path(12345, ".rrd").name == "12345.rrd"
    assert [p.name for p in run.recordings()] == ["0001.mcap"]
    assert [p.name for p in run.recordings(partial=True)] == ["0001.mcap", "0003.mcap.partial"]


def test_file_without_the_number_of_an_episode_is_no_recording(tmp_path):
    run = RunDirectory.create(tmp_path, "foreign")
    for name in ("0001.mcap", "0001 (copy).mcap", "notes.mcap", "notes.mcap.partial", "0002.mcap"):
        (run.episodes / name).touch()
    for partial in (False, True):
        assert [path.name for path in run.recordings(partial=partial)] == ["0001.mcap", "0002.mcap"]


def test_log_has_one_json_object_per_line(tmp_path):
    run = RunDirectory.create(tmp_path, "log")
    handler = run.log_handler()
    logger = logging.getLogger("carlab.test_run_directory")
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        logger.info("two\nlines and %d", 3)
        try:
            raise RuntimeError("why")
        except RuntimeError:
            logger.exception("it broke")
    finally:
        logger.removeHandler(handler)
        handler.close()
    lines = [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]
    assert [(line["level"], line["message"]) for line in lines] == [("INFO", "two\nlines and 3"), ("ERROR", "it broke")]
    assert "RuntimeError: why" in lines[1]["traceback"]


def test_result_is_written_without_a_partial_file(tmp_path):
    run = RunDirectory.create(tmp_path, "result")
    run.write_json("result.json", {"episodes": 3, "path": tmp_path})
    assert json.loads((run.path / "result.json").read_text()) == {"episodes": 3, "path": str(tmp_path)}
    assert not list(run.path.glob("*.partial"))


def test_folder_that_cannot_be_created_is_reported_in_one_sentence(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="a file has the path of its folder") as caught:
        RunDirectory.create(tmp_path / "file" / "runs", "x")
    assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="not a run's folder"):
        RunDirectory.open_existing(tmp_path)


@pytest.mark.parametrize("name", ["log.jsonl", "learn.json.partial", "models/0001/diagnosis.json.partial", ".lock"])
def test_folder_with_a_symbolic_link_is_not_resumed(tmp_path: Path, name: str) -> None:
    """A folder from another person could otherwise change a file of this one."""
    run = RunDirectory.create(tmp_path, "foreign")
    (run.models / "0001").mkdir(parents=True)
    own_file = tmp_path / "profile"
    own_file.write_text("own")
    (run.path / name).symlink_to(own_file)
    with pytest.raises(DataError, match=rf"{name} is a symbolic link, .*; replace it by a copy\.$"):
        RunDirectory.open_existing(run.path)
    assert own_file.read_text() == "own"


def test_git_state_distinguishes_changed_and_clean_trees(tmp_path):
    def git(*arguments):
        identity = ("-c", "user.name=n", "-c", "user.email=e@example.org")
        subprocess.run(["git", *identity, "-C", tmp_path, *arguments], check=True, capture_output=True)

    assert git_state(tmp_path) is None
    git("init")
    (tmp_path / "a").write_text("1")
    git("add", "a")
    git("commit", "-m", "one")
    clean = git_state(tmp_path)
    assert len(clean["sha"]) == 40
    assert clean["dirty"] is False
    (tmp_path / "a").write_text("2")
    assert git_state(tmp_path) == {**clean, "dirty": True}
    assert environment()["carlab"]


def test_git_state_writes_nothing_to_the_repository(tmp_path: Path) -> None:
    """git status saves new time stamps of files under index.lock, which stays if ^C ends git meanwhile."""
    identity = ("-c", "user.name=n", "-c", "user.email=e@example.org")
    (tmp_path / "a").write_text("1")
    for arguments in (("init",), ("add", "a"), ("commit", "-m", "one")):
        subprocess.run(["git", *identity, "-C", tmp_path, *arguments], check=True, capture_output=True)
    os.utime(tmp_path / "a", (1e9, 1e9))
    index = (tmp_path / ".git" / "index").read_bytes()
    state = git_state(tmp_path)
    assert state is not None
    assert state["dirty"] is False
    assert (tmp_path / ".git" / "index").read_bytes() == index


@pytest.mark.parametrize("name", ["Übung 1", unicodedata.normalize("NFD", "Übung 1")])
def test_name_of_a_run_keeps_letters_of_every_language(name: str, tmp_path: Path) -> None:
    assert RunDirectory.create(tmp_path, name).path.name.endswith("_Übung-1")
