"""Complete example: a car that differs from its car file learns to park, and a diagnosis identifies the differences.

The servo of the emulated car lags by 70 ms, and its motor is weaker than in the car file. carlab reads only the car
file and the measurements of the emulated hardware. Takes five to seven minutes on two idle cores, or one or two with
``--car sim --updates 300``.
"""

import argparse
from pathlib import Path

import carlab
from carlab.cars import CarFile

CONCEALED = {"effects.steering_lag.time_constant": 0.07, "motor.drive_gain": 6.8}
UNITS = {"effects.steering_lag.time_constant": "s", "motor.drive_gain": "N"}
DRIVE_TICKS = 600


def progress_hooks() -> carlab.LearnHooks:
    """Hooks that print the progress of learning."""
    hooks = carlab.LearnHooks()
    hooks.on_figures = lambda row: print(
        f"  episode {row.episode}: {row.outcome}, trained for {row.model_seconds + row.policy_seconds:.0f} s"
    )
    hooks.on_training = lambda activity, done, total: print(f"  {activity} ...") if done == 0 else None
    hooks.on_check = lambda check: print(*(f"    {sentence}" for sentence in check.sentences), sep="\n")
    return hooks


def print_comparison(report: carlab.DiagnosisReport, nominal: CarFile) -> None:
    """Print the concealed parameters and their estimates."""
    print(f"\n{report}\n")
    found = report.parameters | {
        f"effects.{effect.id}.{name}": estimate
        for effect in report.effects.values()
        for name, estimate in effect.parameters.items()
    }
    print(f"{'':36}{'car file':>10}{'concealed':>11}{'found':>9}   90 % interval")
    for name, value in CONCEALED.items():
        known = nominal.simulator.values().get(name)
        nominal_value = "none" if known is None else f"{known:.3g}"
        e = found.get(name)
        estimate_text = "not found" if e is None else f"{e.value:9.3g}   {e.low90:.3g} to {e.high90:.3g}"
        print(f"{f'{name} [{UNITS[name]}]':36}{nominal_value:>10}{value:>11.3g}{estimate_text}")
    for effect in report.effects.values():
        if effect.indistinguishable_from:
            print(f"These recordings do not separate {effect.id} from {', '.join(effect.indistinguishable_from)}.")
    if "with_effects" in report.held_out:
        before, after = report.held_out["nominal"].position_m, report.held_out["with_effects"].position_m
        print(
            f"\nHeld-out position error after 1 s: {before:.4f} m before (car file), {after:.4f} m after (model.toml)"
        )


def main() -> None:
    """Learn, drive, diagnose, and print the paths of the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--car", default="emulated", choices=("sim", "emulated", "emulated-can"))
    parser.add_argument("--updates", type=int, default=12000, help="gradient steps of the policy before an episode")
    parser.add_argument("--model-steps", type=int, default=None, help="optimiser steps of the learned car")
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--effects", nargs="*", default=(), help="try only these effects, which is faster")
    parser.add_argument("--out", type=Path, default=Path("runs"))
    options = parser.parse_args()

    nominal = carlab.load_car("sim")
    reality = nominal.with_values(CONCEALED)
    print(f"Learning to park in {options.episodes} episodes ({options.car} car; it differs from its car file)")
    learned = carlab.learn(
        options.car, reality=reality, episodes=options.episodes, prior="nominal", updates=options.updates,
        model_steps=options.model_steps, out=options.out, name="demo", hooks=progress_hooks(),
    )  # fmt: skip
    if not learned.is_complete:
        raise SystemExit(f"The run ended early; resume it with carlab learn --resume {learned.folder}")
    print("Recording two drives with random commands, 20 s each; the second is held out")
    drive = carlab.drive(
        options.car, reality=reality, policy="excitation", ticks=DRIVE_TICKS, episodes=2, out=options.out,
        name="excitation",
    )  # fmt: skip
    if len(drive.recordings) < 2:
        raise SystemExit(f"The drive ended early: {'nothing was driven' if drive.end is None else drive.end.value}")
    print("Diagnosing")
    report = carlab.diagnose(
        [*learned.recordings, drive.recordings[0]],
        nominal,
        held_out=drive.recordings[1:],
        effects=options.effects,
        out=learned.folder / "diagnosis",
    )
    print_comparison(report, nominal)
    print(f"\nReport      {learned.folder}/diagnosis/report.html, .json; model.toml is the corrected car file")
    print(f"Recordings  {learned.folder}/episodes, {drive.folder}/episodes (carlab view FILE.mcap)")
    print(f"Pictures    {learned.picture}, {drive.picture}, {learned.folder}/diagnosis/summary.png")


if __name__ == "__main__":
    main()
