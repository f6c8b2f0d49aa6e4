"""``carlab import`` of ROS bags: names of files and folders."""

from __future__ import annotations

from pathlib import Path

import foreign_drive as foreign
import numpy as np
import pytest
import ros_bags

from carlab.recording.mcap.source import read_episode
from tests.helpers.command_line import Carlab


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (tmp_path / "columns.toml").write_text(ros_bags.MAPPING)
    return ros_bags.write_bag(tmp_path / "drive_sqlite3", foreign.drive(np.arange(100) / 30.0))


@pytest.mark.parametrize("name", [".", "../drive_sqlite3", "../drive_sqlite3/", "sub/.."])
def test_folder_may_be_named_from_inside(
    carlab: Carlab, bag: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    monkeypatch.chdir(bag)
    (bag / "sub").mkdir()
    code, text = carlab("import", name, "--mapping", tmp_path / "columns.toml")
    assert code == 0, text
    assert read_episode(tmp_path / "drive_sqlite3.mcap").ticks == 94


def test_folder_without_metadata_has_its_remedy(carlab: Carlab, bag: Path, tmp_path: Path) -> None:
    (bag / "metadata.yaml").unlink()
    code, text = carlab("import", bag, "--mapping", tmp_path / "columns.toml")
    assert code == 2
    assert "is a folder; name a file in it" in text
    assert "The folder of a ROS 2 bag needs its metadata.yaml, which 'ros2 bag reindex' writes." in text
