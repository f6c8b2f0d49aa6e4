"""Rows with missing numbers: they are left out and reported, and all checks run on the other rows."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.recording_faults.find import check
from carlab.prediction.windows import segments_of
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

NOMINAL = SimulatorConfig(control_period_s=PERIOD_S)
X, YAW = 0, 2


@pytest.fixture(scope="module")
def clean() -> EpisodeData:
    return drive(NOMINAL, 45.0, 1)


def test_all_checks_run_on_the_rows_without_missing_numbers(clean: EpisodeData) -> None:
    """The checks repair degrees and a wrong sign; each row that remains has the numbers before these faults."""
    incomplete, without_command = [0, 500, *range(900, 912)], 1200
    states, sent = clean.states.copy(), clean.sent * [-1.0, 1.0]
    states[:, YAW] = np.rad2deg(states[:, YAW])
    states[incomplete, X] = np.nan
    sent[without_command] = np.nan
    (fit,), _, faults = check([replace(clean, states=states, sent=sent)], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [
        ("not_a_number", "x, steering, throttle"),
        ("wrong_unit", "yaw"),
        ("wrong_sign", "steering"),
    ]
    assert faults[0].rows == len(incomplete) + 1
    remaining = np.setdiff1d(np.arange(len(states)), [*incomplete, without_command])
    np.testing.assert_array_equal(fit.times_s, clean.times_s[remaining])
    np.testing.assert_allclose(fit.states, clean.states[remaining], atol=1e-9)
    np.testing.assert_array_equal(fit.sent, clean.sent[remaining[:-1]])
    cuts = np.flatnonzero(np.diff(fit.extra["segment"]))
    np.testing.assert_array_equal(cuts, np.flatnonzero(np.diff(remaining) > 1))


def test_missing_numbers_are_reported_if_too_few_rows_remain_to_check(clean: EpisodeData) -> None:
    states = clean.states.copy()
    states[50:] = np.inf
    sparse = replace(clean, states=states)
    fit, _, faults = check([sparse], [], NOMINAL)
    assert fit[0] is sparse
    assert [(f.id, f.rows) for f in faults] == [("not_a_number", len(states) - 50)]


def test_a_recording_without_commands_is_unchanged(clean: EpisodeData) -> None:
    none = clean.sent[:0]
    empty = replace(
        clean, times_s=clean.times_s[:1], states=clean.states[:1], requested=none, sent=none, rewards=clean.rewards[:0]
    )
    fit, _, faults = check([clean, empty], [], NOMINAL)
    assert fit[1] is empty
    assert faults == []


def test_a_missing_command_cuts_the_recording(clean: EpisodeData) -> None:
    sent = clean.sent.copy()
    sent[700] = np.nan
    first, second = segments_of([replace(clean, sent=sent)])
    assert np.isfinite(first.commands).all()
    assert np.isfinite(second.commands).all()
    assert first.t_s[-1] < clean.times_s[700] < second.t_s[0]
