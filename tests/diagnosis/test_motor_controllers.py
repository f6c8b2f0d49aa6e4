"""Test that a diagnosis names a speed controller and a drag brake that an independent generator conceals."""

from pathlib import Path

import pytest

from carlab.benchmark.cases.case import make_case
from carlab.benchmark.world.measurement import write_csv
from carlab.cars import load_car_file
from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.evidence import Texts
from carlab.diagnosis.report.sentences import effect_sentence, separating_drive
from carlab.recording.csv.foreign import import_csv
from sim_backends.effects import confusable_effects

pytestmark = pytest.mark.timeout(900)
CANDIDATES = (
    "motor_saturation",
    "traction_limit",
    "speed_controller",
    "drag_brake",
    "rolling_resistance",
    "throttle_deadband",
)


def recorded(path: Path, columns: dict) -> EpisodeData:
    write_csv(path, columns)
    return import_csv(path).episodes[0]


@pytest.mark.parametrize(("effect", "seed"), [("speed_controller", 61), ("drag_brake", 62)])
def test_concealed_effect_of_the_motor_controller_is_named_with_its_numbers(
    effect: str, seed: int, tmp_path: Path
) -> None:
    case = make_case("single", seed, effects=(effect,), excess=4.0, fit_s=60, hold_s=20)
    case.nominal.write(tmp_path / "car.toml")
    nominal = load_car_file(tmp_path / "car.toml").simulator
    fit, held_out = (recorded(tmp_path / f"{k}.csv", table) for k, table in enumerate((case.fit, case.hold)))
    texts = Texts(effect_sentence, separating_drive, confusable_effects())
    found = diagnose([fit], [held_out], nominal, texts, effects=CANDIDATES).diagnosis
    assert [e.id for e in found.effects] == [effect]
    truth = case.answer()["effects"][0]["parameters"]
    for name, value in truth.items():
        assert found.effects[0].parameters[name].value == pytest.approx(value, rel=0.1), name
    assert found.held_out["with_effects"].score < 0.5 * found.held_out["refit"].score
