"""Test that options of verbs and arguments of API calls agree."""

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path

import pytest

import carlab
from carlab.api.recordings import CHANNEL_OPTIONS, RENAMED_OPTIONS
from carlab.cli.check import Check
from carlab.cli.diagnose import Diagnose
from carlab.cli.drive import Drive
from carlab.cli.import_ import Import
from carlab.cli.learn import Learn
from carlab.cli.options import CarOptions, TaskOptions
from carlab.cli.replay import Replay
from carlab.recording.column_mapping import CHANNELS, ColumnMapping

CASES = [
    (Drive, carlab.drive, {"verbose"}),
    (Learn, carlab.learn, {"verbose"}),
    # --decisions is DiagnosisReport.save_decisions.
    (Diagnose, carlab.diagnose, {"verbose", "decisions"}),
    # Without --drive, replay predicts with a simulator; with it, it drives, which is carlab.replay.
    (Replay, carlab.predict, {"verbose", "save", "drive", "seconds", "seed", "out", "vehicle", "dry_run", "reality"}),
    (
        Replay,
        carlab.replay,
        {"verbose", "save", "drive", "horizon_s", "stride_s", "holdout_share", "adapt", "keep_events"},
    ),
    (Check, carlab.check, {"verbose"}),
]

GROUPS = {"which_car": CarOptions, "which_task": TaskOptions}


def options_of(verb: type) -> dict[str, object]:
    """Return the options of a verb with their defaults, including those of car and task."""
    found: dict[str, object] = {}
    for option in dataclasses.fields(verb):
        if option.name in GROUPS:
            found |= options_of(GROUPS[option.name])
        else:
            found[option.name] = option.default
    return found


@pytest.mark.parametrize(("verb", "call", "only_in_the_verb"), CASES)
def test_each_option_is_an_argument_of_the_call(
    verb: type, call: Callable[..., object], only_in_the_verb: set[str]
) -> None:
    arguments = inspect.signature(call).parameters
    missing = set(options_of(verb)) - set(arguments) - only_in_the_verb
    assert missing == set()


@pytest.mark.parametrize(("verb", "call"), [(verb, call) for verb, call, _ in CASES if verb is not Diagnose])
def test_option_and_argument_have_the_same_default(verb: type, call: Callable[..., object]) -> None:
    arguments = inspect.signature(call).parameters
    for name, default in options_of(verb).items():
        if name in arguments and arguments[name].default is not inspect.Parameter.empty:
            assert str(arguments[name].default) == str(default), name


def test_each_option_of_import_is_an_option_of_load() -> None:
    mapping = {field.name for field in dataclasses.fields(ColumnMapping)}
    for name in set(options_of(Import)) - {"recording", "out", "mapping", "report", "verbose"}:
        channel, _, part = name.rpartition("_")
        is_channel_option = part in CHANNEL_OPTIONS and channel in CHANNELS
        assert is_channel_option or RENAMED_OPTIONS.get(name, name) in mapping, name


@pytest.mark.parametrize("name", carlab.__all__)
def test_each_public_name_exists_and_is_documented(name: str) -> None:
    value = getattr(carlab, name)
    if inspect.isfunction(value) or inspect.isclass(value):
        assert value.__doc__
        if inspect.isfunction(value):
            assert all(f"        {argument}: " in value.__doc__ for argument in named_arguments(value))
            assert "Returns:" in value.__doc__
            assert "Raises:" in value.__doc__


def named_arguments(call: Callable[..., object]) -> list[str]:
    return [p.name for p in inspect.signature(call).parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]


def test_check_of_the_simulated_car_reports_ready() -> None:
    found = carlab.check("sim", seconds=0.2)
    assert found.is_ready
    assert found.problems == ()
    assert "ready" in repr(found)
    assert "<table>" in found._repr_html_()


def test_replay_of_recorded_actions_reaches_the_same_position(tmp_path: Path) -> None:
    driven = carlab.drive("sim", policy="slow_circle", ticks=40, out=tmp_path, rerun=False, picture=False)
    episode, replayed = carlab.replay(driven.recordings[0], "sim", seconds=1.0, out=tmp_path)
    assert replayed.folder.name.endswith("replay")
    assert replayed.episodes[0].data.ticks == 30
    assert replayed.episodes[0].data.states[-1, :2] == pytest.approx(episode.states[30, :2], abs=0.02)
