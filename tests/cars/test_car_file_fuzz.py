"""Mutations of valid car files: the loader raises only ConfigError, with one sentence."""

import os
import random
import re
from importlib import resources
from pathlib import Path

import pytest

from carlab.cars import load_car_file
from carlab.core.errors import ConfigError

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "car-file.md"
ROUNDS = int(os.environ.get("CARLAB_FUZZ_ROUNDS", "1500"))
VALUES = (
    "true", "false", '""', '"x"', "nan", "inf", "-inf", "-1", "0", "1e400", "1" + "0" * 400, "[]", "[[]]", "{}",
    "[[0, 0], [1], [1, 1]]", '[["a", 0], [1, 0], [1, 1]]', "[[0, 0], [1, 0], [1, inf]]", "[1, 2, 3]", "{value = 1}",
    "{value = 1, low = 2, high = 3}", "{low = 1}", '{value = "a"}', "{value = 1, std = -1}", "1979-05-27", "07:32:00",
    "[{a = 1}]", "9223372036854775808", "-0.0", '"\\u0000"', "{value = [1]}", "{value = 1, low = nan, high = 2}",
    "[[[0, 0]], [[1, 0]], [[1, 1]]]", "[[0, 0], [1, 0], {a = 1}]",
)  # fmt: skip


def valid_car_files() -> list[str]:
    block = re.search(r"<!-- test: car file -->\n```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.S)
    assert block is not None
    presets = (resources.files("sim_backends") / "presets").iterdir()
    noise = "[recording_noise]\nmeasured_std = [1e-3, 1e-3, 2e-3, 0.01, 0.01, 0.02]\n"
    noise += "initial_state_std = [1e-3, 1e-3, 2e-3, 0.01, 0.01, 0.02]\nvelocity_window_s2 = 1e-4\n"
    noise += "floor_std = [0.01, 0.01, 0.02, 0.03, 0.03, 0.1]\nfloor_horizon_s = 1.0\n"
    return [block[1] + noise, *(p.read_text(encoding="utf-8") for p in presets if p.name.endswith(".toml"))]


def mutate(text: str, rng: random.Random) -> str:
    """Change one to three values, keys, table headers, lines or characters."""
    for _ in range(rng.randint(1, 3)):
        lines = text.split("\n")
        k = rng.randrange(len(lines))
        match rng.randrange(7):
            case 0 | 1 | 2:
                keyed = [n for n, line in enumerate(lines) if "=" in line and not line.lstrip().startswith("#")]
                k = rng.choice(keyed) if keyed else k
                lines[k] = lines[k].split("=")[0] + "= " + rng.choice(VALUES)
            case 3:
                lines[k] = lines[k].replace("_", "", 1) if "_" in lines[k] else "x" + lines[k]
            case 4:
                lines.insert(k, f"[{rng.choice(('vehicle', 'effects', 'hardware', 'mocap', 'hardware.limits', 'x'))}]")
            case 5:
                lines.insert(k, lines.pop(rng.randrange(len(lines))))
            case _:
                line = lines[k]
                at = rng.randrange(len(line) + 1)
                lines[k] = line[:at] + chr(rng.choice((0, 34, 39, 91, 93, 123, 125, 61, 46, 233, 8232, 48))) + line[at:]
        text = "\n".join(lines)
    return text


def test_loader_raises_only_config_errors(tmp_path: Path) -> None:
    rng, files = random.Random(0), valid_car_files()
    path = tmp_path / "car.toml"
    refused = 0
    for _ in range(ROUNDS):
        text = mutate(rng.choice(files), rng)
        path.write_text(text, encoding="utf-8")
        try:
            load_car_file(path)
        except ConfigError as error:
            refused += 1
            assert "\n" not in str(error).strip(), text
        except Exception as error:
            pytest.fail(f"{type(error).__name__}: {error}\n{text}")
    assert 0.2 * ROUNDS < refused < ROUNDS


@pytest.mark.parametrize(
    "corners", ["[[0, 0], [1], [1, 1]]", '[["a", 0], [1, 0], [1, 1]]', "[[0, 0], [1, 0], {a = 1}]", "3", "[]"]
)
def test_invalid_corners_are_refused_with_one_sentence(corners: str, tmp_path: Path) -> None:
    text = re.sub(r"corners_m = .*", f"corners_m = {corners}", valid_car_files()[0])
    path = tmp_path / "car.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"corners_m .* must be at least three corners"):
        load_car_file(path)


def test_recording_noise_is_read_and_checked(tmp_path: Path) -> None:
    """A negative or a missing standard deviation is refused; a car file without the table has no noise."""
    path = tmp_path / "car.toml"
    text = valid_car_files()[0]
    path.write_text(text, encoding="utf-8")
    noise = load_car_file(path).recording_noise
    assert noise is not None
    assert noise.measured_std == (1e-3, 1e-3, 2e-3, 0.01, 0.01, 0.02)
    assert noise.velocity_window_s2 == 1e-4
    assert noise.floor_after(1.0) == (0.01, 0.01, 0.02, 0.03, 0.03, 0.1)
    assert noise.floor_after(0.5) is None
    assert noise.adaptation is None
    assert load_car_file(Path("eth_rc_car")).recording_noise is None
    table = "[recording_noise.adaptation]\nerror_std = [1, 2, 3, 4, 5, 6]\nwhite_share = 0.1\n"
    table += "loss_std = [6, 5, 4, 3, 2, 1]\nfeature_std = [1, 1, 1, 1, 1, 1, 1]\n"
    path.write_text(f"{text}\n{table}", encoding="utf-8")
    read = load_car_file(path).recording_noise
    assert read is not None
    assert read.adaptation is not None
    assert (read.adaptation.error_std[0], read.adaptation.white_share) == (1.0, 0.1)
    assert read.to_table()["adaptation"]["loss_std"] == (6.0, 5.0, 4.0, 3.0, 2.0, 1.0)
    path.write_text(f"{text}\n{table}".replace("0.1\nloss", "0\nloss"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"\[recording_noise.adaptation\] is 0; it must be > 0"):
        load_car_file(path)
    changes = {
        "measured_std = [1e-3": "measured_std = [-1.0",
        "velocity_window_s2 = 1e-4": "velocity_window_s2 = 1e4",
        "floor_std = [0.01": "floor_std = [0.0",
        "2e-3, 0.01, 0.01, 0.02]": "2e-3]",
    }
    for old, new in changes.items():
        path.write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(ConfigError, match="recording_noise"):
            load_car_file(path)
