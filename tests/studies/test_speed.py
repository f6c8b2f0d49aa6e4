"""Test the measurement of ``carlab bench speed`` with replaced parts."""

from __future__ import annotations

import os

import pytest
import torch

import drivers.speed
import learning.speed
import mocap.speed
import sim_backends.speed
from carlab.studies.speed import measure_speed

ON_ONE_CORE = {
    sim_backends.speed: ("simulation_speed", "gradient_speed"),
    learning.speed: ("training_speed", "prediction_speed", "sac_speed"),
    mocap.speed: ("natnet_decode_speed",),
}


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system pins no process to a core")
def test_measurement_on_one_core_uses_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two torch threads on one core are about a hundred times slower."""

    def measured(*_: object) -> dict[str, int]:
        return {"threads": torch.get_num_threads(), "cores": len(os.sched_getaffinity(0))}

    for module, names in ON_ONE_CORE.items():
        for name in names:
            monkeypatch.setattr(module, name, measured)
    monkeypatch.setattr(drivers.speed, "sender_lateness", measured)
    cores, threads = os.sched_getaffinity(0), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = measure_speed(seconds=0.0)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert os.sched_getaffinity(0) == cores
    for part in ("simulation", "gradient", "training", "prediction", "sac"):
        assert found[part] == {"threads": 1, "cores": 1}, part
    assert found["natnet"]["cores"] == found["sender_one_core"]["cores"] == 1
    assert found["sender_all_cores"]["cores"] == len(cores)
