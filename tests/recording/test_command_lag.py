"""The audit describes commands as they are imported: shifted by the declared lag of their columns."""

import foreign_drive as foreign
import numpy as np
import pytest

from carlab.recording.csv.foreign import import_csv
from carlab.recording.layouts import CANONICAL

PERIOD_S = 0.025
LATE_ROWS = 40
T_S = PERIOD_S * np.arange(2400)


@pytest.mark.parametrize("channel", ["steering", "throttle"])
def test_delay_after_the_correction_is_that_of_the_car(tmp_path, channel):
    """The log has each command 1 s after it was sent."""
    columns = foreign.drive(T_S)
    for name in ("steering", "throttle"):
        columns[name] = np.concatenate([np.full(LATE_ROWS, columns[name][0]), columns[name][:-LATE_ROWS]])
    path = foreign.write(tmp_path / "late.csv", columns)
    mapping = CANONICAL.with_options(command_lag_s=PERIOD_S * LATE_ROWS)
    (finding,) = import_csv(path, mapping=mapping).report.of("command_delay", channel)
    assert finding.evidence["delay_s"] == pytest.approx(foreign.DELAY_S, abs=0.03)
    assert "follows" in finding.sentence
