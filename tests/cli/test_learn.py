"""``carlab learn`` from the command line: refusals, output and resuming a run."""

from __future__ import annotations

import functools
import json
import math
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import carlab.cars as carlab_cars
from carlab.api import learning
from carlab.experiment.campaign.training import TrainingRequest
from carlab.recording.mcap.source import read_episode
from tests.helpers.command_line import Carlab, run_command

TICKS = 20
TINY = ("--ticks", TICKS, "--model-steps", 40, "--updates", 32, "--history", 1, "--no-rerun")


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Any:
    """Train with one thread of torch: more threads are slower if other processes compute."""
    plan = learning.training_plan
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning, "training_plan", lambda request, choice: replace(plan(request, choice), threads=1))
        yield


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, str, Path]:
    """A complete run of two episodes: exit code, output and folder."""
    out = tmp_path_factory.mktemp("runs")
    code, text = run_command("learn", "--car", "sim", "--episodes", 2, "--out", out, *TINY)
    (folder,) = out.iterdir()
    return code, text, folder


@pytest.fixture(scope="module")
def extended(learned: tuple[int, str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[int, str, Path]:
    """The same run, resumed with three episodes."""
    folder = tmp_path_factory.mktemp("longer") / learned[2].name
    shutil.copytree(learned[2], folder)
    result = *run_command("learn", "--resume", folder, "--episodes", 3), folder
    assert json.loads((folder / "campaign.json").read_text())["episodes"] == 3
    return result


@pytest.fixture
def copied(learned: tuple[int, str, Path], tmp_path: Path) -> Path:
    """A copy of the folder of that run, which a test may change."""
    return Path(shutil.copytree(learned[2], tmp_path / learned[2].name))


def file_contents(folder: Path) -> dict[Path, bytes]:
    """The content of each file of a run folder except its log."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "log.jsonl"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--episodes 0", "--episodes 0: give a number above zero."),
        ("--history -1", "--history -1: give at least 0."),
        ("--history 101", "--history 101: give at most 100."),
        ("--seed -1", "--seed -1: give at least 0."),
        ("--seed 4294967296", "--seed 4294967296: give at most 4294967295."),
        ("--ray local --ray-wait 0", "--ray-wait 0: give a number above zero."),
        ("--ticks 0", "--ticks 0: give a number above zero."),
        ("--history 100", "--ticks 100: give more than --history (100), for at least one transition."),
        ("--ticks 3", "--ticks 3: give more than --history (4), for at least one transition."),
        ("--prior Kinematic", "--prior Kinematic: give kinematic, nominal, auto or an existing car file."),
        (
            "--prior auto --method fsvgd",
            "--prior auto: its corrections are for --method gp-sim-posterior; fsvgd needs another --prior.",
        ),
        (
            "--particles simulator --method fsvgd",
            "--particles simulator corrects the simulator of --method gp-sim-posterior; fsvgd has none.",
        ),
        ("--updates -5", "--updates -5: give a number above zero."),
        ("--model-steps 0", "--model-steps 0: give a number above zero."),
        ("--prior missing.toml", "There is no car file 'missing.toml'"),
        ("--car nosuch", "There is no car 'nosuch'"),
        ("--method guessing", "--method guessing: choose one of gp-sim-posterior, gp-posterior, sim-fsvgd,"),
    ],
)
def test_invalid_options_are_refused_and_write_nothing(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str, message: str
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.chdir(tmp_path)
    code, text = carlab("learn", *options.split())
    assert code == 2
    assert message in text
    assert list(tmp_path.iterdir()) == []


def test_resume_refuses_another_car(carlab: Carlab, copied: Path, tmp_path: Path) -> None:
    files = file_contents(copied)
    for options in (("--car", "emulated"), ("--car", "eth_rc_car"), ("--dry-run",)):
        code, text = carlab("learn", "--resume", copied, *options)
        assert code == 2
        assert "was started with other options; resume it with '--car sim'" in text
    heavier = tmp_path / "heavier.toml"
    text = (copied / "config.toml").read_text()
    assert text.count("value = 1.65") == 1
    heavier.write_text(text.replace("value = 1.65", "value = 1.69"))
    code, text = carlab("learn", "--resume", copied, "--car", heavier)
    assert code == 2
    assert "was started with other options; resume it with '--car sim'" in text
    assert file_contents(copied) == files


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            "--method fsvgd",
            "--method fsvgd: this run was started with --method gp-sim-posterior; remove the option, or start a",
        ),
        ("--seed 7", "--seed 7: this run was started with --seed 0; remove the option, or start a new run."),
        ("--updates 30000", "--updates 30000: this run was started with --updates 32; remove the option"),
        ("--model-steps 2500", "--model-steps 2500: this run was started with --model-steps 40; remove the option"),
        ("--rerun", "--rerun: this run was started with --no-rerun; remove the option"),
        ("--no-place", "--no-place: this run was started with --place; remove the option"),
        ("--out runs", "--out: a resumed run stays in its folder; remove the option."),
        ("--name learn", "--name: a resumed run stays in its folder; remove the option."),
        ("--prior kinematic", "--prior: this run was started with another prior; remove the option, or start a new"),
        ("--prior auto", "--prior: this run was started with another prior; remove the option, or start a new"),
    ],
)
def test_resume_refuses_changed_options(
    carlab: Carlab, learned: tuple[int, str, Path], options: str, message: str
) -> None:
    code, text = carlab("learn", "--resume", learned[2], *options.split())
    assert code == 2
    assert message in text


def test_model_of_another_version_is_trained_again_after_its_folder_is_removed(carlab: Carlab, copied: Path) -> None:
    done = sorted(path.name for path in (copied / "models").iterdir())
    torch.save({"version": 1}, copied / "models" / done[-1] / "dynamics.pt")
    options = ("learn", "--resume", copied, "--episodes", len(done) + 1)
    code, text = carlab(*options)
    assert code == 1
    assert "has version 1" in text
    assert "remove its folder to train again." in text
    shutil.rmtree(copied / "models" / done[-1])
    code, text = carlab(*options)
    assert code == 0
    assert len(json.loads((copied / "learn.json").read_text())["episodes"]) == len(done) + 1


def test_resume_accepts_a_car_file_with_equal_parameters(carlab: Carlab, copied: Path, tmp_path: Path) -> None:
    same = tmp_path / "same.toml"
    same.write_text("# A remark.\n" + (copied / "config.toml").read_text())
    code, text = carlab("learn", "--resume", copied, "--car", same)
    assert code == 0
    assert "is complete" in text


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("episodes",), math.inf),
        (("episodes",), -1),
        (("ticks",), math.inf),
        (("ticks",), 0),
        (("place",), "no"),
        (("plan",), "x"),
        (("plan", "seed"), -1),
        (("plan", "seed"), math.inf),
        (("plan", "seed"), 2**32),
        (("plan", "history"), 101),
        (("plan", "prior_toml"), "x = " + "[" * 3000),
        (("plan", "updates"), 10**400),
    ],
)
def test_resume_refuses_an_edited_campaign(carlab: Carlab, copied: Path, keys: tuple[str, ...], value: object) -> None:
    content = json.loads((copied / "campaign.json").read_text())
    *parents, name = keys
    functools.reduce(lambda table, key: table[key], parents, content)[name] = value
    (copied / "campaign.json").write_text(json.dumps(content))
    code, text = carlab("learn", "--resume", copied)
    assert code == 1
    assert "cannot be resumed (campaign.json: " in text


@pytest.mark.parametrize(
    "content",
    ["x = [", "x = " + "[" * 3000, "x = " + "9" * 5000, None],
    ids=["cut", "nested", "long integer", "missing"],
)
def test_run_whose_car_is_unknown_is_not_resumed(carlab: Carlab, copied: Path, content: str | None) -> None:
    (copied / "config.toml").unlink()
    if content is not None:
        (copied / "config.toml").write_text(content)
    code, text = carlab("learn", "--resume", copied, "--car", "eth_rc_car")
    assert code == 1
    assert "its car is unknown (config.toml: " in text


def test_invalid_prior_file_is_refused_with_the_name_of_the_key(carlab: Carlab, tmp_path: Path) -> None:
    path = tmp_path / "model.toml"
    path.write_text("[vehicle]\nmas = 1.6\n", encoding="utf-8")
    code, text = carlab("learn", "--prior", path, "--out", tmp_path / "runs")
    assert code == 2
    assert "did you mean 'mass'?" in text
    assert not (tmp_path / "runs").exists()


def test_run_trains_drives_and_prints_its_results(learned: tuple[int, str, Path]) -> None:
    code, text, folder = learned
    assert code == 0
    assert "SIMULATED" in text
    rows = text.split("───")[-1]
    curve = json.loads((folder / "learn.json").read_text())["episodes"]
    for row in curve:
        episode = read_episode(folder / "episodes" / f"{row['episode']:04d}.mcap")
        assert episode.ticks == TICKS
        line = f"{row['episode']} {episode.rewards.sum():.1f} {row['predicted_return']:.1f} {row['distance_m']:.2f}"
        assert line in rows
        assert f"episode {row['episode']}: return {episode.rewards.sum():.1f}" in text
    assert f"learned from {TICKS - 1} rows" in text
    assert f"Learned and recorded in {folder} (learn.png, learn.rrd)." in text
    assert [e["ticks"] for e in json.loads((folder / "result.json").read_text())["episodes"]] == [TICKS, TICKS]
    assert not list(folder.glob("episodes/*.rrd"))
    assert sorted(p.name for p in folder.glob("models/*")) == ["0001", "0002"]


def test_resuming_a_complete_run_prints_a_message_and_changes_no_file(
    carlab: Carlab, learned: tuple[int, str, Path]
) -> None:
    folder = learned[2]
    before = file_contents(folder)
    code, text = carlab("learn", "--resume", folder)
    assert code == 0
    assert text.rpartition("╯")[2].strip()
    assert file_contents(folder) == before


def test_resume_and_view_of_a_run_name_a_truncated_recording(
    carlab: Carlab, copied: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recording = copied / "episodes" / "0001.mcap"
    recording.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    n_ticks = read_episode(recording).ticks
    for words in (("learn", "--resume", copied), ("view", copied, "--save", tmp_path / "run.rrd")):
        caplog.clear()
        assert carlab(*words)[0] == 0
        (warning,) = [record.getMessage() for record in caplog.records if "recovered" in record.getMessage()]
        assert warning.startswith(f"{recording} ends at byte")
        assert warning.endswith(f"{n_ticks} complete ticks were recovered; copy it again.")


@pytest.mark.parametrize("killed_before", ["row", "report", "result"])
def test_run_killed_after_a_recording_writes_its_report_when_it_is_resumed(
    carlab: Carlab, copied: Path, killed_before: str
) -> None:
    complete = json.loads((copied / "result.json").read_text())
    curve = json.loads((copied / "learn.json").read_text())
    (copied / "result.json").write_text(json.dumps({**complete, "episodes": complete["episodes"][:1]}))
    if killed_before != "result":
        (copied / "learn.png").unlink()
        (copied / "learn.rrd").unlink()
    if killed_before == "row":
        (copied / "learn.json").write_text(json.dumps({**curve, "episodes": curve["episodes"][:1]}))
    assert carlab("learn", "--resume", copied)[0] == 0
    assert json.loads((copied / "result.json").read_text()) == complete
    assert [row["total_reward"] for row in json.loads((copied / "learn.json").read_text())["episodes"]] == [
        row["total_reward"] for row in curve["episodes"]
    ]
    assert (copied / "learn.png").stat().st_size > 0
    assert (copied / "learn.rrd").stat().st_size > 0


def test_complete_run_is_resumed_with_more_episodes(extended: tuple[int, str, Path]) -> None:
    code, text, folder = extended
    assert code == 0
    assert "episode 3: return" in text
    assert [r["episode"] for r in json.loads((folder / "learn.json").read_text())["episodes"]] == [1, 2, 3]
    assert sorted(p.name for p in folder.glob("episodes/*.mcap")) == ["0001.mcap", "0002.mcap", "0003.mcap"]


def test_resumed_run_keeps_its_options(extended: tuple[int, str, Path]) -> None:
    folder = extended[2]
    assert read_episode(folder / "episodes" / "0003.mcap").ticks == TICKS
    assert not list(folder.glob("episodes/*.rrd"))


def test_resumed_run_keeps_its_seed_and_all_results(
    carlab: Carlab, extended: tuple[int, str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = extended[2]
    assert [e["episode"] for e in json.loads((folder / "result.json").read_text())["episodes"]] == [1, 2, 3]
    seeds: list[int] = []
    original_choose_car = carlab_cars.choose_car

    def log_seed(car: str, **others: Any) -> Any:
        seeds.append(others["seed"])
        return original_choose_car(car, **others)

    monkeypatch.setattr(carlab_cars, "choose_car", log_seed)
    original = json.loads((folder / "campaign.json").read_text())
    with_seed_7 = {**original, "plan": {**original["plan"], "seed": 7}}
    (folder / "campaign.json").write_text(json.dumps(with_seed_7))
    try:
        assert carlab("learn", "--resume", folder)[0] == 0
    finally:
        (folder / "campaign.json").write_text(json.dumps(original))
    assert seeds == [7]


def interrupted(request: TrainingRequest, progress: Any, stop: Callable[[], bool]) -> dict[str, Any] | None:
    """A training during which the user presses ^C."""
    signal.raise_signal(signal.SIGINT)
    assert stop(), "the training sees the stop request"
    return None


def test_interrupted_run_prints_the_command_that_resumes_it(
    carlab: Carlab, copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carlab.experiment.campaign.campaign.train_in_subprocess", interrupted)
    campaign = json.loads((copied / "campaign.json").read_text())
    (copied / "campaign.json").write_text(json.dumps(campaign | {"episodes": 5}))
    code, text = carlab("learn", "--resume", copied)
    assert code == 130
    assert f"2 of 5 episodes; resume with: carlab learn --resume {copied}" in text


def test_training_on_ray_gives_the_run_without_ray(
    carlab: Carlab, learned: tuple[int, str, Path], tmp_path: Path
) -> None:
    """The same seed gives the same policies and drives; the second training starts from the first one's files."""
    pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[ray]'")
    code, text = carlab("learn", "--ray", "local", "--car", "sim", "--episodes", 2, "--out", tmp_path, *TINY)
    assert code == 0, text
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    for name in ("0001", "0002"):
        file = f"models/{name}/policy.npz"
        with np.load(folder / file) as found, np.load(learned[2] / file) as expected:
            assert all(np.array_equal(found[key], expected[key]) for key in expected)
        one, other = (read_episode(path / "episodes" / f"{name}.mcap") for path in (folder, learned[2]))
        np.testing.assert_array_equal(one.states, other.states)


def test_resume_command_is_printed_only_if_the_run_folder_exists(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that is interrupted before its first model may have no folder to resume."""
    monkeypatch.setattr("carlab.experiment.campaign.campaign.train_in_subprocess", interrupted)
    code, text = carlab("learn", "--out", tmp_path / "runs", *TINY)
    assert code == 130
    folders = list((tmp_path / "runs").iterdir())
    assert [f"--resume {folder}" in text for folder in folders] == [True] * len(folders)
    assert ("--resume" in text) == bool(folders)


@pytest.mark.parametrize("name", ["agent.zip", "policy.npz", "dynamics.pt"])
def test_resume_executes_no_pickled_code_of_the_run_folder(
    carlab: Carlab, copied: Path, tmp_path: Path, name: str
) -> None:
    """The last model of the run contains a pickle that would create a folder."""
    created_by_pickle = tmp_path / "made"
    model = copied / "models" / "0002"
    for file in ("policy.npz",) if name == "agent.zip" else (name,):
        (model / file).unlink()
    (model / name).write_bytes(b"cposix\nmkdir\n(V" + str(created_by_pickle).encode() + b"\ntR.")
    code, text = carlab("learn", "--resume", copied, "--episodes", 3)
    assert not created_by_pickle.exists()
    assert code == 1
    assert "Traceback" not in text
    assert "to train again." in text
