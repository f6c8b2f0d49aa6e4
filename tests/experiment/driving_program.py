"""Drive the emulated car with one configured misbehaviour; the tests run this program as a process.

python driving_program.py RUNS_FOLDER MISBEHAVIOUR
Prints one JSON line with its process ids and run folder, then ``tick N`` per tick.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from carlab.cars import default_car
from carlab.cars.emulated_car import EmulatedCar
from carlab.core.documents import Tick
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, CarState
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import RecordedTask
from carlab.experiment.episodes.hooks import RunHooks
from carlab.experiment.episodes.session import Session
from carlab.recording.run_folder import RunDirectory

MISBEHAVE_AT_TICK = 20
FOREVER_TICKS = 3000


class MisbehavingPolicy:
    """Drives a circle and misbehaves at tick ``MISBEHAVE_AT_TICK``."""

    name = "misbehaving"

    def __init__(self, misbehaviour: str) -> None:
        self.misbehaviour = misbehaviour

    def reset(self) -> None: ...

    def act(self, view: PolicyInput) -> Action | None:
        if view.step == MISBEHAVE_AT_TICK:
            if self.misbehaviour == "policy_error":
                raise RuntimeError("the policy has a bug")
            if self.misbehaviour == "nan":
                return Action(float("nan"), 0.3)
            if self.misbehaviour == "hang_sleep":
                time.sleep(3600)
            if self.misbehaviour == "hang_busy":
                while True:
                    pass
            if self.misbehaviour == "exit":
                os._exit(7)
        return Action(1.0, 0.3)


def main(folder: str, misbehaviour: str) -> int:
    run = RunDirectory.create(folder, misbehaviour)
    car = EmulatedCar(default_car())
    car.log_to(run.path)
    if misbehaviour == "recorder_error":
        from carlab.recording.rerun.sink import RerunSink

        original_write = RerunSink._write
        n_writes = [0]

        def failing_write(self: RerunSink, item: object) -> None:
            n_writes[0] += 1
            if n_writes[0] > 3 * MISBEHAVE_AT_TICK:
                raise OSError(28, "No space left on device")
            original_write(self, item)  # type: ignore[arg-type]

        RerunSink._write = failing_write  # type: ignore[method-assign,assignment]

    def on_tick(tick: Tick) -> None:
        print(f"tick {tick.step}", flush=True)
        if tick.step == MISBEHAVE_AT_TICK:
            if misbehaviour == "unplug":
                car.world.request(do="unplug")
            if misbehaviour == "mocap_silent":
                car.world.request(do="mocap", faults={"no_frames": True})
            if misbehaviour == "mocap_hidden":
                car.world.request(do="mocap", faults={"occlusion": 1.0})
            if misbehaviour == "mocap_jump":
                car.world.request(do="place", state=[1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
            if misbehaviour == "world_dies":
                os.kill(car.world.addresses["pid"], signal.SIGKILL)
            if misbehaviour == "mocap_error":
                car.hardware.pose_source.since = None  # type: ignore[assignment,method-assign]

    def on_abandon(reason: EndReason, detail: str) -> None:
        print(f"abandoned {reason.name}", flush=True)
        os._exit(4)

    with car:
        sender = car.hardware.actuator._sender
        world = car.world.addresses["pid"]
        print(json.dumps({"run": str(run.path), "main": os.getpid(), "sender": sender.pid, "world": world}), flush=True)  # type: ignore[union-attr]
        session = Session(
            car,
            MisbehavingPolicy(misbehaviour),
            RecordedTask(CarState(), max_ticks=FOREVER_TICKS),
            SafetyEnvelope(),
            run,
            1 / 30,
            record_rerun=misbehaviour == "recorder_error",
            hooks=RunHooks(on_tick=on_tick, on_abandon=on_abandon),
            hang_timeout_s=1.0,
        )
        results = session.drive(1)
    print(f"ended {results[0].reason.name}", flush=True)
    return 4 if results[0].reason.is_safety_stop else 0


if __name__ == "__main__":
    sys.exit(main(str(Path(sys.argv[1])), sys.argv[2]))
