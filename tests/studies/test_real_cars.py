"""Errors on held-out drives by recording and horizon, and the split of a folder by name."""

from types import SimpleNamespace

import numpy as np
import pytest

from carlab.core.errors import DataError
from carlab.prediction.predict import ConstantVelocity, NoChange
from carlab.prediction.windows import cut_windows, segments_of
from carlab.studies.real_cars import ALL, real_car_errors, split_by_name
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive


@pytest.fixture(scope="module")
def windows():
    config = SimulatorConfig(control_period_s=PERIOD_S)
    return cut_windows(segments_of([drive(config, 15.0, k, noise=0.0) for k in (1, 2)]), 1.0, 0.25)


def test_errors_of_a_still_car_are_the_distances_driven(windows):
    outcome = SimpleNamespace(models={"constant_velocity": NoChange()}, held_out_windows=windows)
    found = real_car_errors(outcome, ["a.csv", "b.csv"], horizons_s=(0.5, 1.0))
    assert [(e.recording, e.horizon_s) for e in found] == [(r, h) for r in ("a.csv", "b.csv", ALL) for h in (0.5, 1.0)]
    for error, rows in zip(
        found[::2], (windows.recording == 0, windows.recording == 1, windows.recording >= 0), strict=True
    ):
        step = round(0.5 / windows.period_s)
        driven = np.linalg.norm(windows.measured[rows, step, :2] - windows.initial_states[rows, :2], axis=1)
        assert error.position_rms_m == pytest.approx(np.sqrt(np.mean(driven**2)))
        assert error.position_median_m == pytest.approx(np.median(driven))
        assert error.windows == rows.sum()


def test_episodes_of_one_recording_are_one_row(windows):
    outcome = SimpleNamespace(models={"constant_velocity": ConstantVelocity()}, held_out_windows=windows)
    found = real_car_errors(outcome, ["a.csv", "a.csv"], horizons_s=(1.0,))
    assert [(e.recording, e.windows) for e in found] == [("a.csv", len(windows))]


def test_split_by_parts_of_names():
    names = ["a_1.csv", "a_2.csv", "b_1.csv", "c.csv"]
    assert split_by_name(names, ()) == (["a_1.csv", "a_2.csv", "b_1.csv"], ["c.csv"])
    assert split_by_name(names, ("b_1", "c.csv")) == (["a_1.csv", "a_2.csv"], ["b_1.csv", "c.csv"])
    assert split_by_name(names, ("a_2",), ("a_",)) == (["a_1.csv"], ["a_2.csv"])


@pytest.mark.parametrize(
    ("held_out", "message"), [(("x",), "No recording has 'x'"), (("csv",), "At least one recording")]
)
def test_impossible_split_is_refused(held_out, message):
    with pytest.raises(DataError, match=message):
        split_by_name(["a.csv", "b.csv"], held_out)
