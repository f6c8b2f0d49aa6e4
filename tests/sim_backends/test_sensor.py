"""Test simulated motion capture: schedule, noise, losses, latency."""

import numpy as np
import pytest

from sim_backends.car_parameters import MocapParameters, SimulatorConfig
from sim_backends.plant import Plant, Pose
from sim_backends.sensor import MocapSensor


class Moving:
    """A point at x = t whose yaw crosses pi."""

    def measured_pose(self, t_s):
        return Pose(t_s, 0.0, -3.0)


def config(effects=None, **mocap):
    return SimulatorConfig(mocap=MocapParameters(**mocap), effects=effects or {})


def test_samples_come_at_the_rate_and_arrive_after_the_latency():
    sensor = MocapSensor(config(rate_hz=100.0, position_std_m=0.0, latency_s=0.025))
    sensor.reset(5.0)
    assert sensor.samples_until(5.0, Moving()) == []
    first = sensor.samples_until(5.05, Moving())
    assert [s.t_capture_s for s in first] == pytest.approx([5.0, 5.01, 5.02])
    later = sensor.samples_until(6.0, Moving())
    assert [s.sequence for s in first + later] == list(range(98))
    for s in first + later:
        assert s.x_m == s.t_capture_s
        assert s.t_receive_s == pytest.approx(s.t_capture_s + 0.025)


def test_frames_drift_through_a_control_period_that_is_no_whole_number_of_frames():
    for period_s, period_frames in ((0.033, 3.96), (0.001, 0.12)):
        sensor = MocapSensor(SimulatorConfig(control_period_s=period_s))
        sensor.reset(0.0)
        samples = sensor.samples_until(10.0, Moving())
        assert len(samples) == 1200
        assert period_s / (samples[1].t_capture_s - samples[0].t_capture_s) == pytest.approx(period_frames)


def test_samples_do_not_depend_on_the_times_of_the_calls():
    rows = []
    for stops in ([1.0], [*np.arange(0.0, 1.0, 0.0137).tolist(), 1.0]):
        sensor = MocapSensor(config(dropout=0.3), seed=4)
        sensor.reset(0.0)
        rows.append([s for t in stops for s in sensor.samples_until(t, Moving())])
    assert rows[0] == rows[1]
    other = MocapSensor(config(dropout=0.3), seed=5)
    other.reset(0.0)
    assert other.samples_until(1.0, Moving()) != rows[0]


def test_noise_and_losses_are_those_of_the_car_file():
    sensor = MocapSensor(config(rate_hz=1000.0, position_std_m=0.002, yaw_std_rad=0.01, dropout=0.2), seed=1)
    sensor.reset(0.0)
    samples = sensor.samples_until(20.0, Moving())
    x = np.array([s.x_m - s.t_capture_s for s in samples])
    y = np.array([s.y_m for s in samples])
    yaw = np.array([s.yaw_rad + 3.0 for s in samples])
    for values, std in ((x, 0.002), (y, 0.002), (yaw, 0.01)):
        assert np.std(values) == pytest.approx(std, rel=0.05)
        assert abs(np.mean(values)) < 4 * std / np.sqrt(len(values))
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.05
    assert sensor.lost / 20001 == pytest.approx(0.2, abs=0.02)
    assert len(samples) + sensor.lost == pytest.approx(20001, abs=10)
    assert np.diff([s.sequence for s in samples]).max() > 1


def test_latency_is_replaced_by_the_effect_and_wire_latency_is_added():
    assert MocapSensor(config()).latency_s == 0.008
    slow = config(effects={"mocap_latency": {"latency": 0.03}})
    assert MocapSensor(slow).latency_s == 0.03


def test_single_exposure_can_be_made_at_any_time():
    sensor = MocapSensor(config(position_std_m=0.0, yaw_std_rad=0.0))
    plant = Plant(SimulatorConfig())
    sample = sensor.expose(0.123, plant)
    assert (sample.t_capture_s, sample.x_m, sample.tracked) == (0.123, 0.0, True)
    assert plant.t_s == 0.123
    assert MocapSensor(config(dropout=1.0)).expose(0.0, plant) is None
