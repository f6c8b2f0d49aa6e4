"""Study of the quick check's error rates: pytest -m slow -s tests/diagnosis/test_quick_check_study.py (minutes)."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import parking_drives as drives
import pytest

from carlab.diagnosis.quick.quick_check import quick_check
from carlab.recording.mcap.source import read_episode
from sim_backends.car_parameters import SimulatorConfig

pytestmark = pytest.mark.slow

EFFECTS = {
    "steering_lag": 3.0,
    "steering_offset": 3.0,
    "steering_backlash": 4.0,
    "motor_lag": 1.0,
    "command_delay": 1.0,
    "rolling_resistance": 2.0,
    "throttle_deadband": 4.0,
    "marker_offset": 1.0,
    "road_slope": 2.0,
    "low_friction_patch": 2.0,
}
"""Sizes in typical sizes of the generator, set so that the errors are a few noise floors."""
SEEDS = (301, 302)
NULL_SEEDS = range(310, 320)


def test_false_alarms_without_an_effect(tmp_path: Path) -> None:
    simulator = SimulatorConfig.from_preset()
    alarms = 0
    for seed in NULL_SEEDS:
        run = drives.drive_like_learning(simulator, tmp_path, seed=seed)
        recordings = [read_episode(path) for path in run.recordings()]
        checks = [quick_check(recordings[:n], simulator) for n in (1, 2, 5)]
        other = drives.concealed_drives(None, 0.0, seed)
        checks.append(quick_check(other.episodes, other.simulator))
        print(f"none {seed}: " + ", ".join(f"{d.verdict} {d.score:.2f}" for d in checks))
        alarms += sum(d.verdict == "left" for d in checks)
    print(f"false alarms: {alarms} of {4 * len(NULL_SEEDS)}")
    assert alarms <= 1


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_hit_rates_with_concealed_effects(share: float) -> None:
    """``share`` is the maximum relative error of the base parameters of the true car."""
    rows, seconds = [], []
    for effect, size in EFFECTS.items():
        for seed in SEEDS:
            case = drives.concealed_drives(effect, size, seed, share=share)
            began_s = time.process_time()
            check = quick_check(case.episodes, case.simulator)
            seconds.append(time.process_time() - began_s)
            names = [c.id for c in check.causes]
            channel = check.channels[0].channel
            row = (check.verdict == "left", channel in case.main_channels, names[:1] == [effect], effect in names)
            rows.append(row)
            true = ", ".join(f"{k} {v:.3g}" for k, v in case.parameters.items())
            found = "; ".join(
                f"{c.id}{' with refit' if c.with_refit else ''} {c.share:.2f} "
                + ", ".join(f"{p.value:.3g}" for p in c.parameters.values())
                for c in check.causes
            )
            print(
                f"{effect} {seed} ({true}): {check.verdict} {check.score:.1f}, {channel} {case.main_channels}, {found}"
            )
    left, channel, first, in_top_three = np.sum(rows, axis=0)
    print(
        f"share {share}: left {left}, main channel {channel}, first {first}, "
        f"in top three {in_top_three} of {len(rows)}; {np.median(seconds):.1f} s of CPU ({max(seconds):.1f} at most)"
    )
    assert left >= 0.8 * len(rows)
    if share == 0.0:
        assert in_top_three >= 0.7 * len(rows)
