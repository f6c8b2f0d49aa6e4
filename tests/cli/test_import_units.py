"""``carlab import`` proposes the scale of commands, and the unit and the treatment of stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from carlab.recording.mcap.source import read_episode
from tests.cli.test_bad_input import canonical_csv, write
from tests.helpers.command_line import Carlab


def test_throttle_in_per_cent_has_the_scale_of_per_cent(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    data[:, 8] = 30.0 + np.sin(data[:, 0])
    code, text = carlab("import", write(path, data))
    assert code == 1
    assert "for example --throttle-scale 0.01." in text


def test_throttle_somewhat_beyond_one_is_not_in_per_cent(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    data[:, 8] = 1.25 * np.sin(data[:, 0])
    code, text = carlab("import", write(path, data))
    assert code == 1
    assert "say what full command is, for example --throttle-scale 0.8." in text


def test_pulse_widths_need_a_neutral_one_and_a_scale(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    steering = 0.8 * np.sin(data[:, 0])
    data[:, 7] = 1500.0 + 500.0 * steering
    code, text = carlab("import", write(path, data))
    assert code == 1
    assert "pulse widths in microseconds: give the neutral one and the scale" in text
    assert "--steering-neutral 1500 --steering-scale 0.002." in text
    code, text = carlab("import", path, "--steering-neutral", "1500", "--steering-scale", "0.002")
    assert code == 0, text
    assert "steering from ('steering' - 1500) times 0.002" in text
    np.testing.assert_allclose(read_episode(path.with_suffix(".mcap")).sent[:, 0], steering[:-1], atol=1e-9)


def test_only_commands_have_a_neutral_value(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    mapping = tmp_path / "columns.toml"
    mapping.write_text('[columns]\nx = "x"\n[columns.yaw]\nname = "yaw"\nneutral = 0.5\n')
    code, text = carlab("import", write(path, data), "--mapping", mapping)
    assert code == 2
    assert "yaw has no neutral value; only steering and throttle have one." in text


@pytest.mark.parametrize("largest", [1850.0, 35.03, 3.0])
def test_proposed_scale_brings_the_largest_command_to_at_most_one(
    carlab: Carlab, tmp_path: Path, largest: float
) -> None:
    path, data = canonical_csv(tmp_path)
    data[:, 7] = largest * np.linspace(-1.0, 1.0, len(data))
    code, text = carlab("import", write(path, data))
    assert code == 1
    scale = float(text.split("--steering-scale ")[1].split()[0].rstrip(".,;"))
    assert 0.99 < scale * largest <= 1.0


@pytest.mark.parametrize(("unit", "per_second"), [("us", 1e6), ("ns", 1e9)])
def test_stamps_since_1970_have_their_unit_proposed(
    carlab: Carlab, tmp_path: Path, unit: str, per_second: float
) -> None:
    path, data = canonical_csv(tmp_path)
    data[:, 0] = (data[:, 0] + 1.7e9) * per_second
    code, text = carlab("import", write(path, data))
    assert code == 1
    assert f"--t-unit {unit}" in text
    assert "has no number" not in text


def test_declared_unit_that_gives_rows_half_a_minute_apart_is_a_warning(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    data[:, 0] *= 1e3
    code, text = carlab("import", write(path, data), "--t-unit", "s", "--out", tmp_path / "a.mcap")
    assert code == 0, text
    assert "s apart in the unit s; check the unit" in text


def test_clock_that_starts_again_is_cut_and_not_dropped(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    half = len(data) // 2
    data[half:, 0] -= data[half, 0]
    code, text = carlab("import", write(path, data))
    assert code == 1
    assert f"the clock starts again in row {half + 1}, so cut the file in front of it" in text
    assert f"would leave out {len(data) - half} of {len(data)} rows" in text
