"""Fixtures for the drivers: shared vectors, and an emulated VESC on a pseudo-terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.emulators.command_log import CommandLog
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.emulators.vesc_firmware import VescFirmware

VECTORS = Path(__file__).resolve().parents[2].parent / "shared" / "reference" / "actuator-vectors.json"


@pytest.fixture(scope="session")
def vesc_vectors() -> list[dict[str, Any]]:
    """The VESC entries of the shared vectors, made by independent implementations."""
    if not VECTORS.exists():
        pytest.skip(f"{VECTORS} does not exist")
    vectors = json.loads(VECTORS.read_text(encoding="utf-8"))["vectors"]
    return [v for v in vectors if v["protocol"].startswith("vesc-")]


@pytest.fixture
def serial_firmware(tmp_path: Path) -> Iterator[SerialFirmware]:
    """An emulated VESC on a pseudo-terminal with a stable name."""
    with SerialFirmware(VescFirmware(CommandLog()), link=tmp_path / "vesc") as firmware:
        yield firmware
