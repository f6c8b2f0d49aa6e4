"""Diagnose a CSV: which effects in this drive does the car file not model? Takes one or two minutes.

``python examples/diagnose_csv.py drive.csv --car my_car.toml`` diagnoses your file. Without a file the script records
one: a simulated car whose servo lags by 90 ms, which its car file does not state.
"""

import argparse
import math
from pathlib import Path

import carlab
from carlab.core.geofence import rectangle
from carlab.core.manoeuvres import Manoeuvre
from carlab.core.task import RecordedTask
from carlab.experiment.episodes.scripted_policies import ManoeuvrePolicy


def example_csv(folder: Path, seconds: float) -> Path:
    """Drive steps of steering at changing speed with a servo that lags by 90 ms, and write the drive as CSV."""

    def steps(t_s: float) -> carlab.Action:
        return carlab.Action(math.copysign(0.6, math.sin(2.1 * t_s)), 0.3 + 0.15 * math.sin(0.5 * t_s))

    run = carlab.drive(
        "sim",
        reality=carlab.load_car("sim").with_values({"effects.steering_lag.time_constant": 0.09}),
        policy=ManoeuvrePolicy(Manoeuvre("steps", seconds, steps)),
        task=RecordedTask(carlab.CarState(), max_ticks=int(30 * seconds), arena_m=rectangle(-60.0, 60.0, -60.0, 60.0)),
        out=folder,
    )
    return carlab.load(run.recordings[0]).save(run.folder / "drive.csv")


def main() -> None:
    """Load, predict, diagnose, save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("csv", nargs="?", type=Path, help="the drive; by default one is recorded")
    parser.add_argument("--car", default="sim", help="car file, or the name of a preset")
    parser.add_argument("--effects", nargs="*", default=(), help="try only these effects, which is faster")
    parser.add_argument("--seconds", type=float, default=40.0, help="length of the recorded drive")
    parser.add_argument("--out", type=Path, default=Path("runs"))
    options = parser.parse_args()

    recording = carlab.load(options.csv or example_csv(options.out, options.seconds))
    car = carlab.load_car(options.car)
    print(recording)
    print(f"Errors of the car file:\n{carlab.predict(recording, car)}")
    report = carlab.diagnose(recording, car, effects=options.effects)
    print(report)
    print(f"Report in {report.save(options.out / 'diagnosis') / 'report.html'}")
    print(f"Errors of the diagnosed model:\n{carlab.predict(recording, report.model)}")


if __name__ == "__main__":
    main()
