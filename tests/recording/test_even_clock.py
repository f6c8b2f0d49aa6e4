"""Stamps of arrival are put back on the beat of the camera that made the frames."""

import numpy as np

from carlab.recording.audit.report import Severity
from carlab.recording.csv.clocks import even_clock


class TestEvenClock:
    """Frames of a camera at exactly 100 Hz, stamped on arrival: late by chance, some lost, one long silence."""

    def test_the_beat_is_found_lost_frames_stay_lost_and_late_ones_do_not_count(self):
        rng = np.random.default_rng(3)
        frame = np.delete(np.arange(6000), [700, 2500, 2501])
        true_s = 0.01 * frame
        arrived_s = true_s + 0.004 + 0.0005 * np.abs(rng.normal(size=len(frame)))
        arrived_s[1000:1004] = np.maximum(arrived_s[1000:1004], arrived_s[1003] + 0.0001 * np.arange(4))  # a hiccup
        even_s, (finding,) = even_clock(np.sort(arrived_s))
        assert finding.severity is Severity.REPAIRED
        np.testing.assert_allclose(even_s, true_s, atol=1e-4)

    def test_a_gap_stays_a_gap_of_its_length(self):
        rng = np.random.default_rng(4)
        true_s = 0.01 * np.arange(2000)
        true_s[1200:] += 3.1234
        even_s, _ = even_clock(true_s + 0.0003 * rng.normal(size=2000))
        np.testing.assert_allclose(even_s, true_s, atol=3e-4)

    def test_too_few_rows_keep_their_stamps(self):
        stamps = np.cumsum(np.full(50, 0.01))
        even_s, findings = even_clock(stamps)
        np.testing.assert_array_equal(even_s, stamps)
        assert findings == []
