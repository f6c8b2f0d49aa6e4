"""Test that options of verbs and arguments of API calls agree."""

import dataclasses
import inspect
import math
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
import tyro

import carlab
from carlab.api.recordings import CHANNEL_OPTIONS, RENAMED_OPTIONS
from carlab.cli.check import Check
from carlab.cli.diagnose import Diagnose
from carlab.cli.drive import Drive
from carlab.cli.import_ import Import
from carlab.cli.learn import Learn
from carlab.cli.options import CarOptions, TaskOptions
from carlab.cli.replay import Replay
from carlab.core.errors import ConfigError
from carlab.diagnosis.score_recording import score_recording
from carlab.recording.column_mapping import CHANNELS, ColumnMapping
from sim_backends.car_parameters import SimulatorConfig

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

GROUPS = (CarOptions, TaskOptions)


def options_of(verb: type) -> dict[str, object]:
    """Return the options of a verb with their defaults, including those of car and task."""
    found: dict[str, object] = {}
    for option in dataclasses.fields(verb):
        if option.default_factory in GROUPS:
            found |= options_of(option.default_factory)
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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: carlab.drive("sim", episodes=1.5), "--episodes 1.5: give a whole number"),
        (lambda: carlab.drive("sim", ticks=2.5), "--ticks 2.5: give a whole number"),
        (lambda: carlab.drive("sim", ticks=10**9), "--ticks 1000000000: give at most 1000000."),
        (lambda: carlab.learn("sim", ticks=10**6 + 1), "--ticks 1000001: give at most 1000000."),
        (lambda: carlab.drive("sim", seed="x"), "--seed 'x': give a whole number"),
        (lambda: carlab.drive("sim", policy=5), "--policy 5: give a name"),
        (lambda: carlab.drive("sim", viewer=5), "--viewer 5: give the address"),
        (lambda: carlab.diagnose("drive.csv", jobs=0), "--jobs 0: give at least 1"),
        (lambda: carlab.diagnose("drive.csv", jobs=1.5), "--jobs 1.5: give a whole number"),
        (lambda: carlab.drive("sim", episodes="2"), "--episodes '2': give a whole number"),
        (lambda: carlab.learn("sim", updates=1.5), "--updates 1.5: give a whole number"),
        (lambda: carlab.learn("sim", episodes="a"), "--episodes 'a': give a number"),
        (lambda: carlab.learn("sim", method="x"), "--method x: choose one of gp-sim-posterior"),
        (lambda: carlab.learn("sim", device="tpu"), "--device tpu: choose one of cpu, cuda"),
    ],
)
def test_argument_of_a_wrong_type_is_refused_before_a_run_folder_is_made(
    call: Callable[[], object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        call()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gaps": "zz"}, "'gaps' in the mapping's options is 'zz'"),
        ({"rate": -5.0}, "The rate of the rows is -5 Hz"),
        ({"vx_scale": 0.0}, "The scale of vx is 0"),
        ({"vx_scale": math.inf}, "The scale of vx is inf"),
        ({"vx_scale": "a"}, "'scale' in the changes to vx must be a number"),
        ({"steering_sign": 3}, "'sign' in the changes to steering is 3"),
        ({"mapping": 5}, "mapping is 5"),
    ],
)
def test_invalid_options_of_a_csv_are_refused(options: dict[str, object], message: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_text(",".join(CHANNELS) + "\n" + "".join(f"{k / 30},0,0,0,0,0,0,0,0\n" for k in range(5)))
    with pytest.raises(ConfigError, match=message):
        carlab.load(path, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("horizon_s", [0.0, -1.0, math.nan, math.inf, "1", None])
def test_horizon_of_a_prediction_is_a_finite_number_above_zero(horizon_s: object) -> None:
    with pytest.raises(ConfigError, match="must be finite numbers above zero"):
        score_recording([], SimulatorConfig(), horizon_s=horizon_s)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [
        CarOptions(),
        CarOptions("emulated"),
        CarOptions("my car.toml", dry_run=True),
        CarOptions("sim", Path("a b.toml")),
    ],
)
def test_printed_car_options_parse_to_the_same_options(options: CarOptions) -> None:
    assert tyro.cli(CarOptions, args=shlex.split(options.to_text())) == options
