"""Study on a public simulator: drive, write a car file of measurable facts, diagnose in a temporary folder, report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from carlab.benchmark.proof.runner import DIAGNOSE
from carlab.benchmark.proof.worker import FILES, write_json
from carlab.benchmark.public_simulators.commonroad import (
    SCALE,
    AbandonedError,
    Model,
    PublicCar,
    PublicDrive,
    drive_public,
)
from carlab.benchmark.public_simulators.commonroad_effects import physics_of, true_values
from carlab.benchmark.public_simulators.study_page import TARGET_RATIO, study_page
from carlab.benchmark.world.measurement import as_table, write_csv
from carlab.core.errors import DataError
from carlab.core.json_files import read_json
from carlab.jobs.child_jobs import ChildJob, run_job

PACKAGE = "commonroad-vehicle-models"
REPORT_FILES = ("report.json", "report.html", "model.toml")


def nominal_text(car: PublicCar) -> str:
    """Car file with measured mass and lengths; the other parameters are guesses with wide ranges."""
    p, base = car.p, car.car
    mass, front, rear = round(p.m, 3), round(p.a, 4), round(p.b, 4)
    return f"""# A 1:10 car of the package {PACKAGE} ({car.model}) as its owner knows it.
# [1] Scale and tape. [2] Rule of thumb, mass * front_axle * rear_axle, rounded; half to three times that. [3] A guess:
# rubber on a floor; a middling tyre curve. [4] A guess: half the car's weight at full command, a top speed of 5 m/s.
# [5] A guess: 20 to 30 degrees. [6] Measured by the maker of the radio and of the cameras.

[vehicle]
mass = {mass}  # kg, [1]
yaw_inertia = {{ value = 0.02, low = 0.008, high = 0.06 }}  # kg m^2, [2]
front_axle = {front}  # m, [1]
rear_axle = {rear}  # m, [1]

[tyre.front]
B = {{ value = 5.0, low = 1.0, high = 20.0 }}  # [3]
C = {{ value = 1.5, low = 1.0, high = 2.2 }}  # [3]
mu = {{ value = 0.8, low = 0.2, high = 1.8 }}  # [3]

[tyre.rear]
B = {{ value = 5.0, low = 1.0, high = 20.0 }}  # [3]
C = {{ value = 1.5, low = 1.0, high = 2.2 }}  # [3]
mu = {{ value = 0.8, low = 0.2, high = 1.8 }}  # [3]

[motor]
drive_gain = {{ value = 5.0, low = 1.0, high = 30.0 }}  # N per unit throttle, [4]
damping = {{ value = 1.0, low = 0.01, high = 10.0 }}  # N s/m, [4]

[steering]
max_angle = {{ value = 0.45, low = 0.2, high = 0.8 }}  # rad at full command, [5]

[timing]
control_period = {base.control_period!r}  # s, [6]
command_delay = {base.command_delay!r}  # s, [6]

[model]
kind = "dynamic"

[mocap]
rate = {base.mocap_rate!r}  # Hz, [6]
position_std = {base.position_std!r}  # m, [6]
yaw_std = {base.yaw_std!r}  # rad, [6]
latency = {base.latency!r}  # s, [6]
dropout = 0.0
"""


def write_inputs(
    car: PublicCar, seed: int, folder: Path, lengths_s: Sequence[float] = (100.0, 40.0),
    abandon: Callable[[], bool] = lambda: False,
) -> PublicDrive:  # fmt: skip
    """Drive twice and write fit.csv, hold.csv and car.toml; returns the drive to fit."""
    folder.mkdir(parents=True, exist_ok=True)
    drives = [drive_public(car, seed, part, length_s, abandon) for part, length_s in enumerate(lengths_s)]
    for drive, name in zip(drives, FILES[:2], strict=True):
        write_csv(folder / name, as_table(drive.recording))
    (folder / FILES[2]).write_text(nominal_text(car), encoding="utf-8")
    return drives[0]


def activity(car: PublicCar, drive: PublicDrive) -> dict[str, float]:
    """Extent of the drive in regimes that a single-track model does not cover."""
    motion, states = drive.drive.captures, drive.states
    rate = np.abs(np.gradient(states[:, 2], drive.drive.capture_s))
    slip = np.abs(car.rear_slip(states))
    found = {
        "share of time at the steering-rate limit": float(np.mean(rate > 0.95 * car.p.steering.v_max)),
        "share of time braking": float(np.mean(drive.recording.commands[:, 1] < 0.0)),
        "speed [m/s], 95th percentile": float(np.percentile(motion[:, 3], 95)),
        "lateral acceleration [m/s2], 95th percentile": float(np.percentile(np.abs(motion[:, 3] * motion[:, 5]), 95)),
        "rear wheels' longitudinal slip, 95th percentile": float(np.percentile(slip, 95)),
    }
    if car.model == "multi_body":
        p = car.p
        lift = p.R_w * (np.cos(states[:, 18]) - 1.0) - 0.5 * p.T_r * np.abs(np.sin(states[:, 18]))
        found["roll angle [rad], 95th percentile"] = float(np.percentile(np.abs(states[:, 6]), 95))
        found["share of time with a rear wheel off the ground"] = float(np.mean(states[:, 21] + lift < 0.0))
    return {name: round(value, 4) for name, value in found.items()}


def study(
    out: Path,
    model: Model,
    seeds: Sequence[int],
    *,
    command: Sequence[str] = DIAGNOSE,
    timeout_s: float = 1800.0,
    lengths_s: Sequence[float] = (100.0, 40.0),
    progress: Callable[[str], None] = lambda activity: None,
    abandon: Callable[[], bool] = lambda: False,
) -> list[dict[str, Any]]:
    """Drive, diagnose and report every seed; writes seed_N/, study.json and study.md into ``out``.

    Args:
        out: Folder; files of the same names are replaced.
        model: Model of the package.
        seeds: Each gives one drive to fit and one held-out drive.
        command: Command of a diagnosis, as for ``runner.Proof``.
        timeout_s: Time-out of a diagnosis, which then counts as failed.
        lengths_s: Durations of the drive to fit and of the held-out drive [s].
        progress: Called with the current activity.
        abandon: Polled; True ends the study, and the finished seeds are written.

    Returns:
        One row per seed, as in study.json; a seed that cannot be driven has the reason instead of a verdict.

    Raises:
        ConfigError: the package is not installed.
        DataError: a diagnosis wrote a file that is no report.
    """
    facts = {
        "package": f"{PACKAGE} {version(PACKAGE)}, model {model}, vehicle 2 (BMW 320i)",
        "scale": SCALE,
        "seconds_to_fit": lengths_s[0],
        "seconds_held_out": lengths_s[1],
    }
    rows: list[dict[str, Any]] = []
    for seed in seeds:
        car = PublicCar(model)
        folder = out / f"seed_{seed}"
        progress(f"seed {seed}: driving the package's {model} car")
        try:
            drive = write_inputs(car, seed, folder, lengths_s, abandon)
        except AbandonedError:
            break
        except DataError as error:
            rows.append({"seed": seed, "verdict": None, "exit_status": None, "seconds": 0.0, "output": str(error)})
            continue
        progress(f"seed {seed}: diagnosing")
        run = _diagnose(folder, command, timeout_s, abandon)
        if run is None:
            break
        rows.append(_row(car, seed, run, folder / "report.json") | {"activity": activity(car, drive)})
    write_json(out / "study.json", {"facts": facts, "target_ratio": TARGET_RATIO, "seeds": rows})
    (out / "study.md").write_text(study_page(facts, rows), encoding="utf-8")
    return rows


def _diagnose(
    folder: Path, command: Sequence[str], timeout_s: float, abandon: Callable[[], bool]
) -> dict[str, Any] | None:
    arguments = (*command, "fit.csv", "--car", "car.toml", "--holdout", "hold.csv", "--out", "out")
    inputs = {file: (folder / file).read_bytes() for file in FILES}
    outputs = tuple(f"out/{file}" for file in REPORT_FILES)
    done = run_job(ChildJob(arguments, timeout_s, inputs, outputs), abandon)
    if done.end.abandoned:
        return None
    for file in REPORT_FILES:
        (folder / file).unlink(missing_ok=True)
    done.write_outputs(folder)
    return {"exit_status": done.end.exit_status, "seconds": round(done.end.seconds, 1), "output": done.end.output}


def _row(car: PublicCar, seed: int, run: dict[str, Any], path: Path) -> dict[str, Any]:
    if not path.exists():
        return {"seed": seed, "verdict": None, **run}
    try:
        report = read_json(path)
        held = report.get("fit", {}).get("held_out", {})
        scores = {name: held[name]["score"] for name in ("nominal", "refit", "with_effects") if name in held}
        named = [_named(car, effect) for effect in report["effects"]]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is not a report of the schema carlab.diagnosis/1 ({error!r}).") from error
    ratio = scores["with_effects"] / scores["refit"] if {"with_effects", "refit"} <= set(scores) else None
    return {
        "seed": seed, "verdict": report["verdict"], "scores": scores, "ratio": ratio, "named": named,
        "unexplained": report.get("unexplained"), "data_faults": [f["id"] for f in report.get("data_faults", [])],
        **run,
    }  # fmt: skip


def _named(car: PublicCar, effect: dict[str, Any]) -> dict[str, Any]:
    physics = physics_of(effect["id"], car.model)
    others = effect.get("indistinguishable_from", [])
    truth = {name: value for (owner, name), value in true_values(car).items() if owner == effect["id"]}
    return {
        **{k: effect.get(k) for k in ("id", "confidence", "parameters", "where", "evidence", "sentence")},
        "indistinguishable_from": others,
        "in_equations": physics.presence,
        "why": physics.why,
        "true_values": truth,
        "others": {name: physics_of(name, car.model).presence for name in others},
    }
