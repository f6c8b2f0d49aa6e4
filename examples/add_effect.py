"""Add an effect: a drag that grows with the cube of speed, simulated and then identified. Takes one minute.

One class holds equation, parameters and texts. ``register`` adds it to car files, simulators, the diagnosis and the
prior of learning.
"""

import argparse
import math
from pathlib import Path

import carlab
from carlab.core.geofence import rectangle
from carlab.core.manoeuvres import Manoeuvre
from carlab.core.task import RecordedTask
from carlab.experiment.episodes.scripted_policies import ManoeuvrePolicy
from sim_backends.array_ops import Ops
from sim_backends.effects.base import DynamicsEffect, EffectParameter, Forces, Parameters
from sim_backends.registry import register


class CubicDrag(DynamicsEffect):
    """``F_x -= coefficient vx^3``."""

    id = "cubic_drag"
    command = "throttle"
    name = "a drag that grows with the cube of speed"
    summary = "A force against the motion that grows with the cube of speed."
    sentence = "a drag of {coefficient} times speed cubed holds the car back"
    refuted_if = "doubling the speed does not make the drag eight times as large"
    parameters = (EffectParameter("coefficient", "N s3/m3", identity=0.0, low=0.0, high=20.0, typical=0.3),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Brake; ``ops.fms(a, b, c)`` is c - a b, for floats, NumPy arrays and torch tensors."""
        forces.force_x = ops.fms(values["coefficient"], forces.vx * forces.vx * forces.vx, forces.force_x)


register(CubicDrag())  # at the top level, because the processes of carlab.learn import the script


def main() -> None:
    """Simulate a car with the effect, and diagnose the drive with a car file that does not state it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--seconds", type=float, default=40.0, help="length of the drive")
    options = parser.parse_args()
    nominal = carlab.load_car("sim")
    waves = Manoeuvre(
        "waves", options.seconds, lambda t: carlab.Action(0.5 * math.sin(1.7 * t), 0.4 + 0.3 * math.sin(0.5 * t))
    )  # fmt: skip
    hall = RecordedTask(
        carlab.CarState(), max_ticks=int(30 * options.seconds), arena_m=rectangle(-40.0, 40.0, -40.0, 40.0)
    )
    run = carlab.drive(
        "sim",
        reality=nominal.with_values({"effects.cubic_drag.coefficient": 0.5}),
        policy=ManoeuvrePolicy(waves),
        task=hall,
        out=options.out,
    )
    print(carlab.diagnose(run.recordings, nominal, effects=["cubic_drag"], out=options.out / "diagnosis"))
    print(f"Concealed: 0.5 N s3/m3. Report in {options.out / 'diagnosis' / 'report.html'}")


if __name__ == "__main__":
    main()
