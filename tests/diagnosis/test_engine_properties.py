"""Test invariances of a diagnosis, uncatalogued physics, and linear approximations against exact results."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.cases.case import make_case
from carlab.benchmark.world.measurement import read_csv
from carlab.diagnosis.diagnose import Outcome, diagnose
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import base_parameters, effect_parameters, with_effect
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.selection.elimination import eliminate
from carlab.diagnosis.selection.problem import RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.unexplained.residual_terms import TERMS, responses
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from sim_backends.effects import EFFECTS, confusable_effects
from tests.helpers.case_files import Table, car_in, episodes_in, imported, write_case


def outcome(folder: Path, change: Callable[[Table], Table] = dict, effects: tuple[str, ...] | None = None) -> Outcome:
    fit, hold = (imported(change(read_csv(folder / name)), folder / f"_{name}") for name in ("fit.csv", "hold.csv"))
    return diagnose(fit, hold, car_in(folder), effects=effects)


@pytest.fixture(scope="module")
def drag(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """Aerodynamic drag concealed in 45 s of driving with wrong base parameters."""
    case = make_case("single", 21, effects=("aerodynamic_drag",), excess=2.0, fit_s=45, hold_s=20)
    folder = write_case(case, tmp_path_factory.mktemp("drag"))
    return folder, case.answer()["effects"][0]["parameters"]["coefficient"]


@pytest.fixture(scope="module")
def windows(drag: tuple[Path, float]) -> PredictionWindows:
    """Return prediction windows of the drive with drag."""
    return cut_windows(segments_of(episodes_in(drag[0] / "fit.csv")), 0.8, 0.5)


def rigidly_moved(table: Table, angle: float = 2.1, shift: tuple[float, float] = (3.0, -5.0)) -> Table:
    sin, cos = np.sin(angle), np.cos(angle)
    x, y = table["x"], table["y"]
    return {**table, "x": cos * x - sin * y + shift[0], "y": sin * x + cos * y + shift[1], "yaw": table["yaw"] + angle}


def moved_and_mirrored(table: Table) -> Table:
    table = rigidly_moved(table)
    return table | {name: -table[name] for name in ("y", "yaw", "vy", "yaw_rate", "steering")}


CANDIDATES = ("aerodynamic_drag", "rolling_resistance", "motor_saturation", "steering_offset", "road_slope")
NEAREST = ("lateral_bias", "marker_offset", "road_slope", "steering_asymmetry", "steering_offset", "yaw_damping")


def test_effect_is_named_and_estimated_in_a_rotated_translated_and_mirrored_frame(drag: tuple[Path, float]) -> None:
    """The halves of the recording are diagnosed in its own frame below."""
    folder, truth = drag
    found = outcome(folder, moved_and_mirrored, CANDIDATES).diagnosis
    assert [e.id for e in found.effects] == ["aerodynamic_drag"]
    assert found.effects[0].parameters["coefficient"].value == pytest.approx(truth, rel=0.06)
    assert found.effects[0].where.channels[0] in ("vx", "x")


@pytest.mark.slow
def test_diagnosis_is_deterministic(drag: tuple[Path, float]) -> None:
    first, second = (outcome(drag[0], effects=CANDIDATES).diagnosis for _ in range(2))
    assert replace(first, seconds=0.0) == replace(second, seconds=0.0)


@pytest.mark.slow
def test_halves_of_a_recording_agree(drag: tuple[Path, float], tmp_path: Path) -> None:
    folder = drag[0]
    table = read_csv(folder / "fit.csv")
    car = car_in(folder)
    hold = episodes_in(folder / "hold.csv")
    middle = len(table["t"]) // 2
    ranges = []
    for rows in (slice(None, middle), slice(middle, None)):
        half = {name: column[rows] for name, column in table.items()}
        found = diagnose(imported(half, tmp_path / "half.csv"), hold, car, effects=CANDIDATES).diagnosis
        assert [e.id for e in found.effects] == ["aerodynamic_drag"]
        ranges.append(found.effects[0].parameters["coefficient"])
    first, second = ranges
    difference = abs(first.value - second.value)
    assert difference < 3.0 * np.hypot(first.std, second.std)


@pytest.mark.parametrize(
    "candidates", [pytest.param(CANDIDATES[:3], id="few"), pytest.param(None, id="catalogue", marks=pytest.mark.slow)]
)
def test_no_effect_is_named_with_wrong_base_parameters(tmp_path: Path, candidates: tuple[str, ...] | None) -> None:
    case = make_case("parameters", 31, fit_s=45, hold_s=20)
    found = outcome(write_case(case, tmp_path), effects=candidates).diagnosis
    assert found.verdict == "parameters"
    assert found.effects == ()
    assert found.held_out["refit"].score < 0.5 * found.held_out["nominal"].score


@pytest.mark.parametrize(
    "candidates", [pytest.param(NEAREST, id="nearest"), pytest.param(None, id="catalogue", marks=pytest.mark.slow)]
)
def test_uncatalogued_physics_is_described_without_a_name(tmp_path: Path, candidates: tuple[str, ...] | None) -> None:
    """A cable that pulls the rear of the car towards a point resembles no effect of the catalogue."""
    case = make_case("outside", 41, effects=("cable_pull",), excess=4.0, fit_s=45, hold_s=20)
    found = outcome(write_case(case, tmp_path), effects=candidates).diagnosis
    assert found.verdict == "unexplained"
    assert found.effects == ()
    assert found.unexplained is not None
    assert "place" in found.unexplained.kind
    assert "x cos(yaw)" in found.unexplained.formula


@pytest.mark.parametrize(
    ("concealed", "spurious", "description"),
    [
        ("locked_differential", "yaw_damping", "curvature"),
        ("camber", "steering_offset", "front wheels"),
    ],
)
@pytest.mark.slow
def test_rival_physics_replaces_a_spurious_effect(
    concealed: str, spurious: str, description: str, tmp_path: Path
) -> None:
    """Without rivals the most similar effect of the catalogue is accepted."""
    case = make_case("outside", 43, effects=(concealed,), excess=1.5, fit_s=60, hold_s=30)
    folder = write_case(case, tmp_path)
    result = outcome(folder)
    found = result.diagnosis
    assert found.effects == ()
    assert found.unexplained is not None
    assert description in found.unexplained.kind
    assert {e for e in result.model.effects if not EFFECTS[e].catalogued}
    without_rivals = outcome(folder, effects=(spurious,)).diagnosis
    assert [e.id for e in without_rivals.effects] == [spurious]


def test_effect_without_gain_on_left_out_blocks_is_eliminated(
    drag: tuple[Path, float], windows: PredictionWindows
) -> None:
    car = car_in(drag[0])
    floor = np.array([0.006, 0.006, 0.005, 0.015, 0.015, 0.04])
    problem = SearchProblem(car, windows, floor, floor, confusable_effects())
    whole = problem.scale_of(car)
    scale = replace(whole, sigma=np.maximum(0.2 * whole.sigma, floor))
    named = ("aerodynamic_drag", "steering_asymmetry", "torque_steer")
    base = refit(problem, (), Fit(car, (), np.zeros(0), 0.0, np.zeros(0)), scale)
    remaining = eliminate(problem, refit(problem, named, base.fit, scale), RunControl())
    assert remaining.model.effects == ("aerodynamic_drag",)
    assert set(remaining.model.fit.config.effects) == {"aerodynamic_drag"}
    assert remaining.deletions["aerodynamic_drag"].standard_errors > 2.0


def test_impulse_responses_sum_to_the_simulated_change(drag: tuple[Path, float], windows: PredictionWindows) -> None:
    """The reference is a simulation with the drag -c v|v| / m."""
    car = car_in(drag[0])
    scale = Scale(np.array([8, 16, 24]), np.ones((3, 6)))
    coefficient = 0.02
    plain = prediction_errors(simulate_windows(windows, car), windows)[0]
    with_drag = with_effect(car, "aerodynamic_drag").with_values({"effects.aerodynamic_drag.coefficient": coefficient})
    dragged = prediction_errors(simulate_windows(windows, with_drag), windows)[0]
    term = next(t for t in TERMS if t.formula == "v |v|")
    linear = -coefficient / car.parameters.mass_kg * responses(windows, car, scale).of(term, 0)
    true = scale.white(dragged - plain)
    is_linear = np.abs(true).max(axis=(1, 2)) < 1.0  # the response of a car at the edge of a spin is not linear
    for channel in (0, 3):  # x and vx
        a, b = linear[is_linear][..., channel].ravel(), true[is_linear][..., channel].ravel()
        assert np.corrcoef(a, b)[0, 1] > 0.97
        assert a @ b / (b @ b) == pytest.approx(1.0, abs=0.1)


def test_one_step_without_a_fold_approximates_a_refit(drag: tuple[Path, float], windows: PredictionWindows) -> None:
    car = with_effect(car_in(drag[0]), "aerodynamic_drag")
    free = (*base_parameters(car), *effect_parameters("aerodynamic_drag", car))
    noise = estimate_noise(segments_of(episodes_in(drag[0] / "fit.csv")), windows.curvature_bias)
    fitter = Fitter(windows, Scale(np.array([8, 16, 24]), np.tile(3.0 * noise.measured, (3, 1))))
    fit = fitter.fit(car, free, iterations=30)
    folds = (windows.block // 2) % 3
    quick = fitter.leave_fold_out_loss(fit, folds, 12.0)
    for fold in range(3):
        is_held_out = folds == fold
        refitted = Fitter(windows.take(~is_held_out), fitter.scale).fit(fit.config, free, fit.z, iterations=30)
        exact = Fitter(windows.take(is_held_out), fitter.scale).loss(car, free, refitted.z, max_error=12.0).sum()
        assert quick[is_held_out].sum() == pytest.approx(exact, rel=0.1)
