"""Arrays of a program of one's own as recordings: accepted as EpisodeData, otherwise refused with the remedy."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import carlab
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError


@pytest.fixture(scope="module")
def episode() -> EpisodeData:
    """A straight drive at 1 m/s, 4 s at 30 Hz."""
    times_s = np.arange(121) / 30.0
    states = np.stack([times_s, *np.zeros((2, 121)), np.ones(121), *np.zeros((2, 121))], axis=1)
    commands = np.full((120, 2), 0.1)
    return EpisodeData(times_s, states, commands, commands, np.full(120, np.nan))


def test_own_arrays_are_predicted(episode: EpisodeData) -> None:
    assert carlab.predict(episode, "sim").summary["constant velocity"].position_m < 0.01


@pytest.mark.parametrize("call", [carlab.predict, carlab.diagnose])
@pytest.mark.parametrize("given", [np.zeros((10, 9)), [np.zeros((10, 9))], 5])
def test_other_objects_are_no_recording(call: Callable[[Any, str], Any], given: Any) -> None:
    with pytest.raises(ConfigError, match="is no recording; give a path, a Recording, or an EpisodeData"):
        call(given, "sim")


def test_load_reads_only_files() -> None:
    with pytest.raises(ConfigError, match="has the type ndarray; give a path"):
        carlab.load(np.zeros((10, 9)))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["times_s", "states", "requested", "sent", "rewards"])
def test_other_arrays_than_those_of_numpy_are_refused(episode: EpisodeData, name: str) -> None:
    with pytest.raises(DataError, match=f"{name} has the type list; give a NumPy array"):
        replace(episode, **{name: getattr(episode, name).tolist()})


def test_commands_in_other_units_are_refused_as_in_a_csv(episode: EpisodeData) -> None:
    percent = replace(episode, sent=100.0 * episode.sent)
    for call in (carlab.predict, carlab.diagnose):
        with pytest.raises(DataError, match=r"reach 10 where commands lie in \[-1, 1\]; divide them"):
            call(percent, "sim")


@pytest.mark.parametrize(("factor", "message"), [(1000.0, "33.33 s apart; give times_s in seconds"), (0.0, "sort")])
def test_times_increase_and_are_in_seconds(episode: EpisodeData, factor: float, message: str) -> None:
    with pytest.raises(DataError, match=message):
        carlab.predict(replace(episode, times_s=factor * episode.times_s), "sim")
