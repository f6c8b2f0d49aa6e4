"""Arrival stamps with jitter are replaced by the even frame times of the camera."""

import numpy as np

from carlab.recording.audit.report import Severity
from carlab.recording.csv.clocks import even_clock


class TestEvenClock:
    """Frames of a camera at exactly 100 Hz, stamped at arrival, with random delays, lost frames and a gap."""

    def test_frame_times_are_found_with_jitter_lost_frames_and_late_arrivals(self):
        rng = np.random.default_rng(3)
        frame = np.delete(np.arange(6000), [700, 2500, 2501])
        true_s = 0.01 * frame
        arrived_s = true_s + 0.004 + 0.0005 * np.abs(rng.normal(size=len(frame)))
        # Four frames arrive almost together.
        arrived_s[1000:1004] = np.maximum(arrived_s[1000:1004], arrived_s[1003] + 0.0001 * np.arange(4))
        even_s, (finding,) = even_clock(np.sort(arrived_s))
        assert finding.severity is Severity.REPAIRED
        np.testing.assert_allclose(even_s, true_s, atol=1e-4)

    def test_gap_keeps_its_length(self):
        rng = np.random.default_rng(4)
        true_s = 0.01 * np.arange(2000)
        true_s[1200:] += 3.1234
        even_s, _ = even_clock(true_s + 0.0003 * rng.normal(size=2000))
        np.testing.assert_allclose(even_s, true_s, atol=3e-4)

    def test_stamps_are_unchanged_with_too_few_rows(self):
        stamps = np.cumsum(np.full(50, 0.01))
        even_s, findings = even_clock(stamps)
        np.testing.assert_array_equal(even_s, stamps)
        assert findings == []
