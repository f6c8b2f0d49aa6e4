"""The process of an emulated car: answers match their requests, and the process always ends."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from carlab.cars import default_car
from carlab.cars import emulated_car as emulated_car_module
from carlab.cars.emulated_car import EmulatedCar, EmulatedWorld
from carlab.cars.emulated_world import WorldConfig
from carlab.core.documents import SafetyEvent
from carlab.core.errors import NotOpenError, NotReadyError
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState
from carlab.core.safety import SafeCar, SafetyEnvelope, SafetyStop
from tests.helpers.pauses import RunningTime

TIMEOUT_S = 20.0


def config() -> WorldConfig:
    return WorldConfig(simulator=default_car().simulator.to_tables())


@pytest.fixture
def world() -> Iterator[EmulatedWorld]:
    opened = EmulatedWorld(config())
    opened.open()
    yield opened
    opened.close()


def test_world_of_a_serial_car_does_not_load_the_libraries_of_can() -> None:
    """They take two fifths of the time of its start."""
    code = (
        "import json, sys; from carlab.cars.emulated_world import World, WorldConfig; "
        "World(WorldConfig(json.loads(sys.argv[1]))); print({'can', 'cantools'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", code, json.dumps(config().simulator)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == "set()"


def test_late_answer_is_not_used_for_the_next_request(world: EmulatedWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    pid = world.addresses["pid"]
    os.kill(pid, signal.SIGSTOP)
    try:
        monkeypatch.setattr(emulated_car_module, "ANSWER_TIMEOUT_S", 0.2)
        with pytest.raises(NotReadyError, match="no answer within") as caught:
            world.request(do="log")
        assert len(caught.value.reasons) == 1
    finally:
        os.kill(pid, signal.SIGCONT)
        monkeypatch.undo()
    assert "state" in world.request(do="state")
    with pytest.raises(NotReadyError, match="no request 'somersault'"):
        world.request(do="somersault")
    assert "entries" in world.request(do="log")


@pytest.mark.realtime
def test_seed_restarts_the_noise_of_the_emulated_motion_capture() -> None:
    def positions_m(car: EmulatedCar) -> list[float]:
        """Measured x of a car at rest after seeding its noise."""
        car.seed_noise(7)
        car.observe()
        car.clock.sleep_until(car.clock.now_s() + 1.0)
        return [round(pose.x_m, 7) for pose in car.observe().poses]

    with EmulatedCar(default_car(), seed=1) as car:
        first, second = positions_m(car), positions_m(car)
    # The number of frames between the seeding and the first pose differs.
    windows = [first[k : k + 10] for k in range(len(first) - 10)]
    assert len(second) > 60
    assert second[50:60] in windows


def test_killed_world_is_reported_and_closes(world: EmulatedWorld) -> None:
    os.kill(world.addresses["pid"], signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(NotReadyError, match="world"):
            world.request(do="state")
    world.close()
    with pytest.raises(NotOpenError):
        world.request(do="state")


def test_car_closes_and_reopens_after_its_world_was_killed() -> None:
    car = EmulatedCar(default_car())
    try:
        car.open()
        first = car.world.addresses["pid"]
        os.kill(first, signal.SIGKILL)
        with pytest.raises(NotReadyError):
            car.place(CarState())
        car.stop(planned=False)
        car.close()
        assert_no_process(first)
        car.open()
        assert car.world.addresses["pid"] != first
        car.arm()
    finally:
        car.close()


def test_failed_opening_leaves_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    pids: list[int] = []

    def interrupted_driver(self: EmulatedCar, addresses: dict[str, int]) -> None:
        pids.append(addresses["pid"])
        raise KeyboardInterrupt

    monkeypatch.setattr(EmulatedCar, "_driver", interrupted_driver)
    with pytest.raises(KeyboardInterrupt):
        EmulatedCar(default_car()).open()
    assert_no_process(pids[0])


OPENER = """
import os
from carlab.cars import default_car
from carlab.cars.emulated_car import EmulatedCar
from carlab.core.quantities import CarState
car = EmulatedCar(default_car())
print(os.getpid(), flush=True)
with car:
    print("open", flush=True)
    while True:
        car.place(CarState())
"""


@pytest.mark.realtime
@pytest.mark.parametrize("after_s", [0.05, 0.3, 0.6, 1.0, None])
def test_kill_during_opening_or_placing_leaves_no_process(after_s: float | None) -> None:
    """Processes in separate sessions are found by the marker in their environment."""
    marker = f"CARLAB_TEST_MARKER_{os.getpid()}_{after_s}"
    process = subprocess.Popen(
        [sys.executable, "-c", OPENER], stdout=subprocess.PIPE, text=True, env={**os.environ, marker: "1"}
    )
    try:
        assert process.stdout is not None
        assert int(process.stdout.readline()) == process.pid
        if after_s is None:
            assert process.stdout.readline() == "open\n"
            time.sleep(0.1)
        else:
            time.sleep(after_s)
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
    end_s = time.monotonic() + TIMEOUT_S
    while remaining := pids_with(marker):
        assert time.monotonic() < end_s, f"processes still running: {remaining}"
        time.sleep(0.05)


def pids_with(marker: str) -> list[int]:
    """Ids of processes with the marker in their environment."""
    pids = []
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if marker.encode() in environment.read_bytes():
                pids.append(int(environment.parent.name))
    return pids


def assert_no_process(pid: int) -> None:
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("fault", "reason"), [({"frozen": True}, EndReason.POSE_FROZEN), ({"latency_s": 0.3}, EndReason.POSE_STALE)]
)
def test_fresh_arrivals_of_an_old_pose_end_the_episode(fault: dict[str, float], reason: EndReason) -> None:
    """Motion capture repeats one pose with new stamps, or delays its frames: the car stops in about half a second."""
    events: list[SafetyEvent] = []
    with EmulatedCar(default_car()) as car:
        car.place(CarState())
        safe = SafeCar(car, SafetyEnvelope(), events.append)
        safe.arm()

        def drive(ticks: int) -> None:
            for _ in range(ticks):
                safe.command(Action(0.3, 0.3), car.observe(), 1.0 / 30.0)
                time.sleep(1.0 / 30.0)

        drive(30)
        car.world.request(do="mocap", faults=fault)
        with RunningTime() as running, pytest.raises(SafetyStop) as stop:
            drive(90)
        assert running.seconds < 2.0
    assert stop.value.reason == reason
    assert events[-1].kind == reason.name.lower()
