"""``carlab drive`` and ``learn`` state that and why neutral replaced commands, although the episode ended regularly."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

from carlab.cli.learn import Learn
from carlab.cli.neutral_warnings import TELEMETRY_REMEDY, neutral_warning
from carlab.core.documents import SafetyEvent
from carlab.core.episode_data import EpisodeData
from carlab.core.outcome import EndReason
from carlab.experiment.episodes.result import EpisodeResult
from tests.helpers.command_line import Carlab


def episode(n_moving: int, n_replaced: int) -> EpisodeData:
    """An episode of 40 ticks with moving commands, of which neutral replaced some."""
    requested, sent = np.zeros((40, 2)), np.zeros((40, 2))
    requested[:n_moving] = sent[n_replaced:n_moving] = 0.2
    return EpisodeData(np.arange(41.0), np.zeros((41, 6)), requested, sent, np.zeros(40))


def event(kind: str) -> SafetyEvent:
    return SafetyEvent(0.0, kind, f"Text of {kind}.")


@pytest.mark.parametrize(("n_moving", "n_replaced"), [(0, 0), (40, 0), (40, 4), (20, 2)])
def test_few_replaced_commands_need_no_warning(n_moving: int, n_replaced: int) -> None:
    assert neutral_warning(episode(n_moving, n_replaced), [event("stale_pose")]) == ""


def test_most_frequent_cause_is_stated() -> None:
    events = [event("limited"), event("stale_pose"), *[event("unknown_speed")] * 2, *[event("limited")] * 5]
    text = neutral_warning(episode(20, 3), events)
    assert text.startswith("Neutral replaced 3 of 20 moving commands. Text of unknown_speed. Measure rate")
    assert neutral_warning(episode(20, 3), [event("pose_problems")]).endswith("Text of pose_problems.")


def test_cause_without_an_event_is_late_telemetry() -> None:
    assert neutral_warning(episode(20, 20), [event("limited")]).endswith(TELEMETRY_REMEDY)


def test_learning_run_warns_after_each_episode_with_the_events_of_this_episode() -> None:
    out = io.StringIO()
    hooks = Learn()._hooks(Progress(console=Console(file=out, width=500), disable=True))
    warnings = []
    for number, (kind, n_replaced, reason) in enumerate([
        ("stale_pose", 3, EndReason.COMPLETED),
        ("pose_problems", 20, EndReason.COMPLETED),
        ("limited", 0, EndReason.COMPLETED),
        ("stale_pose", 20, EndReason.GEOFENCE),
    ], start=1):  # fmt: skip
        hooks.on_episode(number, 40)
        hooks.on_document(event(kind))
        hooks.on_result(EpisodeResult(number, episode(20, n_replaced), reason, {}, Path("episode.mcap")))
        warnings.append(out.getvalue().strip())
        out.seek(0)
        out.truncate()
    assert warnings == [
        "Warning: Episode 1: Neutral replaced 3 of 20 moving commands. Text of stale_pose. Measure rate, losses and "
        "latency of motion capture with carlab listen.",
        "Warning: Episode 2: Neutral replaced 20 of 20 moving commands. Text of pose_problems.",
        "",
        "",
    ]


def test_car_that_slow_motion_capture_stops_gets_a_warning(carlab: Carlab, tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text("[mocap]\nrate = 4.0\n", encoding="utf-8")
    options = ("--policy", "slow_circle", "--no-place", "--ticks", "60", "--no-rerun", "--no-picture")
    code, text = carlab("drive", "--car", path, *options, "--out", tmp_path)
    assert code == 0
    assert "Warning: Episode 1: Neutral replaced" in text
    assert "moving commands. The pose is" in text or "moving commands. Too few poses" in text
