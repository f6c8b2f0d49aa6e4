"""Drive with your own policy: a circle at constant speed, by feedback. Takes two seconds.

A policy has a name, ``reset`` (a new episode begins) and ``act`` (the action of this tick, or None to end). The same
object drives the emulated and the real car: ``python examples/own_policy.py --car emulated``.
"""

import argparse

import carlab
from carlab.core.policy import PolicyInput


class ConstantSpeed:
    """Controls the speed with the throttle at constant steering (a PI controller)."""

    name = "constant_speed"

    def __init__(self, speed_mps: float, steering: float) -> None:
        self.speed_mps, self.steering = speed_mps, steering
        self.integral = 0.0

    def reset(self) -> None:
        self.integral = 0.0

    def act(self, view: PolicyInput) -> carlab.Action:
        error_mps = self.speed_mps - view.observation.state.vx_mps
        self.integral += 0.02 * error_mps
        throttle = 0.4 * error_mps + self.integral
        return carlab.Action(steering=self.steering, throttle=min(max(throttle, -1.0), 1.0))


def main() -> None:
    """Drive one episode and print the final speed of the car."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--car", default="sim")
    parser.add_argument("--out", default="runs")
    options = parser.parse_args()
    run = carlab.drive(options.car, policy=ConstantSpeed(0.8, steering=0.8), ticks=150, out=options.out)
    speeds = run.episodes[0].data.states[-30:, 3]
    print(f"Speed in the last second: {speeds.mean():.2f} m/s. Recorded in {run.recordings[0]}")


if __name__ == "__main__":
    main()
