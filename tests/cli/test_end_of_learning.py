"""``carlab learn`` states why a safety stop has ended a run, as ``carlab drive`` does."""

from pathlib import Path

import numpy as np
import pytest

from carlab.api.learning import LearnRun
from carlab.cli.learn import Learn
from carlab.core.episode_data import EpisodeData
from carlab.core.outcome import EndReason
from carlab.experiment.episodes.result import EpisodeResult

DETAIL = "the VESC reports under-voltage."
SENTENCE = (
    "Episode 1: The actuator link or its firmware failed; check power, cable and the log, then start again. The VESC"
)


@pytest.mark.parametrize(
    ("reason", "target_episodes", "code", "sentence"),
    [
        (EndReason.ACTUATOR_FAULT, 1, 4, SENTENCE),
        (EndReason.ACTUATOR_FAULT, 2, 4, SENTENCE),
        (EndReason.GEOFENCE, 1, 0, ""),
        (EndReason.GEOFENCE, 2, 130, "Episode 1: The car could not have stopped inside the arena"),
        (EndReason.COMPLETED, 1, 0, ""),
    ],
)
def test_safety_stop_that_ends_a_run_is_explained(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    reason: EndReason,
    target_episodes: int,
    code: int,
    sentence: str,
) -> None:
    recording = tmp_path / "episodes" / "0001.mcap"
    recording.parent.mkdir()
    recording.touch()
    columns = np.zeros((1, 2))
    data = EpisodeData(np.arange(2.0), np.zeros((2, 6)), columns, columns, np.zeros(1), metadata=reason.texts(DETAIL))
    result = EpisodeResult(1, data, reason, {}, recording)
    monkeypatch.setattr(Learn, "_print_episodes", lambda self, run: None)
    assert Learn(place=False)._report(LearnRun(tmp_path, target_episodes, (), (result,))) == code
    errors = " ".join(capsys.readouterr().err.split())
    assert sentence in errors
    assert bool(sentence) == bool(errors)
