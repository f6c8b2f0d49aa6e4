"""Test estimates from a recording: noise, bias of initial states, velocity window, vibration.

The reference is the independent generator, which records the added noise.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.cases.case import Case, make_case
from carlab.benchmark.world.driver import HumanDriver, Track
from carlab.benchmark.world.measurement import Noise, as_table, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive as SimulatedDrive
from carlab.benchmark.world.simulation import drive as simulated_drive
from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.identification.held_out_errors import noise_floor
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.identification.velocity_window import velocity_window_variance_s2
from carlab.diagnosis.unexplained.vibration import find_vibration
from carlab.prediction import initial_states
from carlab.prediction.initial_states import without_curvature_bias
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows, RecordingSegment, cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.case_files import car_in, episodes_in, imported, write_case

SEEDS = (61, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (62, 63)))


@dataclass(frozen=True)
class Drive:
    """A case with its recording to fit as input of the diagnosis."""

    case: Case
    folder: Path
    segments: list[RecordingSegment]
    nominal: SimulatorConfig

    def clean_at(self, windows: PredictionWindows) -> np.ndarray:
        """Noise-free states at the starts of windows (S, 6)."""
        recording = self.case.recordings[0]
        rows = np.round(windows.t0_s * 30.0).astype(int)
        assert np.allclose(recording.t_s[rows] - recording.t_s[0], windows.t0_s, atol=1e-3)
        return recording.clean[rows]


def drive(folder: Path, case: Case) -> Drive:
    write_case(case, folder)
    return Drive(case, folder, segments_of(episodes_in(folder / "fit.csv")), car_in(folder))


@pytest.fixture(scope="module", params=SEEDS)
def plain(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """A case with wrong base parameters only."""
    return drive(tmp_path_factory.mktemp("plain"), make_case("parameters", request.param))


@pytest.fixture(scope="module")
def shaking(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """A bent wheel of 60 mm radius."""
    return drive(
        tmp_path_factory.mktemp("shaking"), make_case("outside", 64, effects=("wheel_imbalance",), fit_s=60, hold_s=30)
    )


def test_estimated_noise_equals_the_added_noise(plain: Drive) -> None:
    """Differentiated velocities have coloured noise; the formula for white noise is 15 % too high."""
    windows = cut_windows(plain.segments, 0.8, 0.3)
    found = estimate_noise(plain.segments, windows.curvature_bias).measured
    added = np.std(plain.case.recordings[0].error, axis=0)
    assert np.allclose(found[:3] / added[:3], 1.0, atol=0.1)
    assert np.allclose(found[3:] / added[3:], 1.0, atol=0.15)
    assert np.mean(found[3:] / added[3:]) == pytest.approx(1.0, abs=0.08)


def test_estimated_floor_equals_that_of_the_generator(plain: Drive) -> None:
    """The reference floor after 1 s uses the generator's true car and initial states."""
    windows = cut_windows(plain.segments, 1.0, 0.25)
    floor = noise_floor(windows, estimate_noise(plain.segments, windows.curvature_bias), plain.nominal)[-1]
    assert np.exp(np.mean(np.log(floor / np.array(plain.case.floor)))) == pytest.approx(1.0, abs=0.15)


def test_initial_states_are_more_accurate_without_curvature_bias(plain: Drive) -> None:
    windows = cut_windows(plain.segments, 0.8, 0.3)
    better = without_curvature_bias(windows, plain.nominal)
    truth = plain.clean_at(windows)
    before, after = (np.sqrt(np.mean((s.initial_states - truth) ** 2, axis=0)) for s in (windows, better))
    assert np.all(after[3:] < before[3:])
    assert after[5] < 0.95 * before[5]
    noise = estimate_noise(plain.segments, better.curvature_bias).initial_state
    assert np.allclose(noise[[0, 1, 3, 4]] / after[[0, 1, 3, 4]], 1.0, atol=0.25)


@pytest.mark.parametrize("periods", [-1.0, 1.0, 2.0])
def test_wrong_command_delay_hardly_changes_the_initial_states(plain: Drive, periods: float) -> None:
    """The correction uses the delay that the recording shows, not that of the car file."""
    delay_s = plain.nominal.command_delay_s + periods * plain.nominal.control_period_s
    wrong = plain.nominal.with_values({"timing.command_delay": delay_s})
    windows = cut_windows(plain.segments, 0.8, 0.3)
    truth = plain.clean_at(windows)
    uncorrected, expected, found = (
        np.sqrt(np.mean((w.initial_states - truth) ** 2, axis=0))
        for w in (windows, without_curvature_bias(windows, plain.nominal), without_curvature_bias(windows, wrong))
    )
    turning = [2, 4, 5]
    assert np.all(found[turning] < uncorrected[turning] - 0.7 * (uncorrected - expected)[turning])


def test_order_of_the_changed_delays_does_not_matter(plain: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay that explains most is used, not the first one that explains more than the simulator's."""
    short = plain.nominal.with_values({"timing.command_delay": plain.nominal.command_delay_s - 0.03})
    windows = cut_windows(plain.segments, 0.8, 0.3)
    found = without_curvature_bias(windows, short).initial_states
    reversed_changes = initial_states.DELAY_CHANGES_PERIODS[::-1]
    monkeypatch.setattr(initial_states, "DELAY_CHANGES_PERIODS", reversed_changes)
    np.testing.assert_allclose(without_curvature_bias(windows, short).initial_states, found, atol=1e-6)


def test_range_of_the_command_delay_does_not_limit_the_initial_states(plain: Drive) -> None:
    """The car file allows 60 to 100 ms. A delay outside of this range serves the initial states only."""
    delay_s = plain.nominal.command_delay_s
    ranged = replace(plain.nominal, priors={"timing.command_delay": (delay_s - 0.02, delay_s + 0.02)})
    windows = cut_windows(plain.segments, 0.8, 0.3)
    expected = without_curvature_bias(windows, plain.nominal).initial_states
    np.testing.assert_array_equal(without_curvature_bias(windows, ranged).initial_states, expected)


def test_delay_effect_of_the_car_file_counts_as_a_command_delay(plain: Drive) -> None:
    """The command delay alone is shorter than its changes, and negative with them."""
    delay_s = plain.nominal.command_delay_s
    stated = plain.nominal.with_values({"timing.command_delay": 0.0, "effects.command_delay.extra_delay": delay_s})
    windows = cut_windows(plain.segments, 0.8, 0.3)
    expected = without_curvature_bias(windows, plain.nominal).initial_states
    np.testing.assert_allclose(without_curvature_bias(windows, stated).initial_states, expected, atol=1e-6)


def test_wrong_steering_commands_reduce_the_correction(plain: Drive) -> None:
    """Modified commands disagree with the recording, so they hardly change the initial states."""
    windows = cut_windows(plain.segments, 0.8, 0.3)
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(len(windows))
    wrong = replace(windows, past_commands=windows.past_commands[shuffled], commands=windows.commands[shuffled])
    wrong_correction = np.sqrt(
        np.mean((without_curvature_bias(wrong, plain.nominal).initial_states - windows.initial_states) ** 2, axis=0)
    )
    right_correction = np.sqrt(
        np.mean((without_curvature_bias(windows, plain.nominal).initial_states - windows.initial_states) ** 2, axis=0)
    )
    assert wrong_correction[5] < 0.3 * right_correction[5]


@pytest.fixture(scope="module")
def finely_driven(plain: Drive) -> tuple[World, SimulatedDrive]:
    """A drive of a minute with the true car of the case."""
    car = plain.case.true_car
    world, course = World(car), Track(np.random.default_rng(5))
    human = HumanDriver(car, course, np.random.default_rng(6))
    return world, simulated_drive(world, human, 60.0, start=human.start())


@pytest.mark.parametrize("window_s", [0.06, 0.075, 0.09])
def test_velocity_window_is_estimated(
    plain: Drive, finely_driven: tuple[World, SimulatedDrive], tmp_path: Path, window_s: float
) -> None:
    """A drive at 120 Hz is differentiated by parabolas over a window; the variance is width^2 / 20."""
    car, (world, driven) = plain.case.true_car, finely_driven
    noise = Noise(car.position_std, car.yaw_std, window_s)
    table = as_table(record(driven, world, noise, np.random.default_rng(7)))
    windows = cut_windows(segments_of(imported(table, tmp_path / "drive.csv")), 0.8, 0.3)
    assert np.sqrt(20.0 * velocity_window_variance_s2(windows, plain.nominal)) == pytest.approx(window_s, abs=0.025)


def test_instantaneous_velocities_have_no_window(plain: Drive) -> None:
    windows = cut_windows(plain.segments, 0.8, 0.3)
    exact = replace(windows, measured=simulate_windows(windows, plain.nominal)[0])
    assert np.sqrt(20.0 * velocity_window_variance_s2(exact, plain.nominal)) < 0.03


def test_vibration_of_a_wheel_is_found_with_its_radius(shaking: Drive, plain: Drive) -> None:
    found = find_vibration(shaking.segments)
    assert found is not None
    assert 1.0 / (2.0 * np.pi * found.periods_per_m) == pytest.approx(0.06, rel=0.02)
    assert re.search("6[01] mm", found.class_statement())
    assert find_vibration(plain.segments) is None


@pytest.mark.parametrize(("fixed_frequency", "is_found"), [(True, False), (False, True)])
def test_fixed_frequency_is_not_attributed_to_a_wheel(plain: Drive, fixed_frequency: bool, is_found: bool) -> None:
    """The yaw rate vibrates at 6 Hz or at 4 periods per metre."""
    segments = []
    for segment in plain.segments:
        cycles = 6.0 * np.arange(len(segment.speed)) if fixed_frequency else 4.0 * np.cumsum(segment.speed)
        residual = segment.residual.copy()
        residual[:, 5] += 3.0 * np.std(residual[:, 5]) * np.sin(2.0 * np.pi * cycles * segment.sampled_s)
        segments.append(replace(segment, residual=residual))
    found = find_vibration(segments)
    assert (found is not None) == is_found
    if found is not None:
        assert found.periods_per_m == pytest.approx(4.0, abs=0.05)


def test_line_in_differentiated_poses_is_no_vibration(plain: Drive) -> None:
    """Differences over five poses at 60 Hz amplify noise at 7.6 Hz, which resembles a wheel at steady speed."""
    segments = []
    for segment in plain.segments:
        residual = segment.residual.copy()
        cycles = 4.0 * np.cumsum(segment.speed) * segment.sampled_s
        residual[:, 5] += 3.0 * np.std(residual[:, 5]) * np.sin(2.0 * np.pi * cycles)
        segments.append(replace(segment, residual=residual))
    assert find_vibration(segments) is not None
    assert find_vibration([replace(segment, has_velocity_columns=False) for segment in segments]) is None


@pytest.mark.parametrize(
    "effects", [("aerodynamic_drag", "velocity_filter_lag", "yaw_damping"), pytest.param(None, marks=pytest.mark.slow)]
)
def test_vibration_is_described_without_an_effect(shaking: Drive, effects: tuple[str, ...] | None) -> None:
    fit, hold = (episodes_in(shaking.folder / name) for name in ("fit.csv", "hold.csv"))
    found = diagnose(fit, hold, shaking.nominal, effects=effects).diagnosis
    assert found.verdict == "unexplained"
    assert found.unexplained is not None
    assert found.unexplained.kind.startswith("vibration")
    assert found.unexplained.channels[0] in shaking.case.answer()["main_channels"]
