"""Join poses of Motive and a log of commands, two files of two programs, to one CSV of carlab.

``python examples/join_logs.py take.csv commands.csv --body car --out folder`` joins your files. Without files the
script makes both from a drive of the simulated car.

Motive: export the take as CSV with rigid bodies, rotation type Quaternion and unit Meters. Log of commands: edit
``COMMANDS`` and ``STAMP`` below. ``carlab import`` reads ROS bags directly.
"""

import argparse
import csv
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import carlab
from mocap.axes import base_link_pose, y_up_quaternion, y_up_vector, yaw_quaternion, z_up_quaternion, z_up_vector

Array = NDArray[np.float64]
STAMP = ("stamp_ns", 1e-9)
"""Column of the stamps, and its unit [s]."""
COMMANDS = {"steering": ("servo_us", 1500.0, -500.0), "throttle": ("motor_us", 1500.0, 500.0)}
"""Column, value of the neutral command, and change of the value for the command +1 (steering: full left)."""
MIN_ROWS = 3
"""Minimum number of rows of a recording."""


def motive_poses(path: Path, body: str, up_axis: str) -> Array:
    """Rows t [s], x, y [m], yaw [rad] (N, 4) of a rigid body, without frames in which the cameras do not see it."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = [line for line in csv.reader(file) if any(map(str.strip, line))]
    settings = dict(zip(lines[0][::2], lines[0][1::2], strict=False)) if lines else {}
    if settings.get("Rotation Type") != "Quaternion" or settings.get("Length Units") != "Meters":
        raise SystemExit(f"{path}: export the take again with rotation type Quaternion and unit Meters.")
    first = next((k for k, line in enumerate(lines) if line[:1] == ["Frame"]), None)
    if first is None:
        raise SystemExit(f"{path} has no line 'Frame,Time (Seconds),...'; export the take again.")
    header = lines[1:first]
    types, names = (next(line for line in header if line[1:2] == [key]) for key in ("Type", "Name"))
    columns = {
        (kind, axis): k
        for k, (type_, name, kind, axis) in enumerate(zip(types, names, header[-1], lines[first], strict=False))
        if type_ == "Rigid Body" and name == body
    }
    if not columns:
        bodies = sorted({name for type_, name in zip(types, names, strict=True) if type_ == "Rigid Body"})
        raise SystemExit(f"{path} has no rigid body '{body}'; it has {', '.join(bodies)}.")
    keys = [("Position", axis) for axis in "XYZ"] + [("Rotation", axis) for axis in "XYZW"]
    rows = []
    for line in lines[first + 1 :]:
        cells = [line[columns[key]] if columns[key] < len(line) else "" for key in keys]  # the last line may be cut
        if not all(cells):
            continue
        x, y, z, *rotation = map(float, cells)
        position, quaternion = (x, y, z), (rotation[0], rotation[1], rotation[2], rotation[3])
        if up_axis == "y":
            position, quaternion = z_up_vector(position), z_up_quaternion(quaternion)
        (x, y, _), yaw = base_link_pose(position, quaternion, 0.0, (0.0, 0.0, 0.0))
        rows.append((float(line[1]), x, y, yaw))
    if not rows:
        raise SystemExit(f"{path}: the cameras see '{body}' in no frame.")
    return np.array(rows)


def commands(path: Path) -> Array:
    """Rows t [s], steering, throttle (M, 3) in the order of the stamps, commands in [-1, 1]."""
    names = [STAMP[0], *(name for name, _, _ in COMMANDS.values())]
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise SystemExit(f"{path} has no commands.")
    if missing := [name for name in names if name not in rows[0]]:
        raise SystemExit(f"{path} has no column {', '.join(missing)}; edit the names at the top of the script.")
    rows.sort(key=lambda row: float(row[STAMP[0]]))
    columns = [np.array([float(row[name]) for row in rows]) for name in names]
    scaled = [(column - c[1]) / c[2] for column, c in zip(columns[1:], COMMANDS.values(), strict=True)]
    return np.column_stack([columns[0] * STAMP[1], *scaled])


def joined(poses: Array, sent: Array) -> Array:
    """One row t, x, y, yaw, steering, throttle for each pose, with the newest command before it."""
    during = (poses[:, 0] >= sent[0, 0]) & (poses[:, 0] <= sent[-1, 0])
    if during.sum() < MIN_ROWS:
        raise SystemExit(f"{during.sum()} poses lie between the first and the last command; correct --first-pose.")
    newest = np.searchsorted(sent[:, 0], poses[during, 0], side="right") - 1
    return np.column_stack([poses[during], sent[newest, 1:]])


def example_files(folder: Path) -> tuple[Path, Path, float]:
    """Drive, and write the files of both programs. Returns them and the stamp of the first pose [s]."""
    run = carlab.drive("sim", policy="excitation", ticks=600, task=None, out=folder)
    episode = carlab.load(run.recordings[0]).episodes[0]
    take, log, first_s = run.folder / "take.csv", run.folder / "commands.csv", 1.7e9 + float(episode.poses[0, 0])
    lines = ["Format Version,1.23,Rotation Type,Quaternion,Length Units,Meters", ""]
    lines += [f",{key}" + f",{value}" * 7 for key, value in (("Type", "Rigid Body"), ("Name", "car"))]
    lines += [",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position", "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z"]
    for frame, (t_s, x, y, yaw) in enumerate(episode.poses):
        numbers = (*y_up_quaternion(yaw_quaternion(yaw)), *y_up_vector((x, y, 0.05)))
        lines.append(f"{frame},{t_s - episode.poses[0, 0]:.6f}," + ",".join(f"{number:.6f}" for number in numbers))
    take.write_text("\n".join(lines) + "\n", encoding="utf-8")
    lines = ["stamp_ns,servo_us,motor_us"]
    for t_s, (steering, throttle) in zip(episode.times_s, episode.sent, strict=False):
        pulses = (1500.0 - 500.0 * steering, 1500.0 + 500.0 * throttle)
        lines.append(f"{round((1.7e9 + t_s) * 1e9)},{pulses[0]:.2f},{pulses[1]:.2f}")
    log.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return take, log, first_s


def main() -> None:
    """Read both files, join them, write a CSV of carlab and load it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="CSV of Motive and log of the commands")
    parser.add_argument("--body", default="car", help="name of the rigid body")
    parser.add_argument("--up-axis", choices=("y", "z"), default="y", help="axis that points up in Motive's export")
    parser.add_argument("--first-pose", type=float, default=math.nan, help="time of Motive's 0 s in the log [s]")
    parser.add_argument("--out", type=Path, default=Path("runs"))
    options = parser.parse_args()
    if options.files and (len(options.files) != 2 or math.isnan(options.first_pose)):
        parser.error("give the CSV of Motive, the log of the commands, and --first-pose.")
    take, log, first_s = example_files(options.out) if not options.files else (*options.files, options.first_pose)
    for file in (take, log):
        if not file.is_file():
            raise SystemExit(f"{file} does not exist.")

    poses, sent = motive_poses(take, options.body, options.up_axis), commands(log)
    poses[:, 0] += first_s - sent[0, 0]
    sent[:, 0] -= sent[0, 0]
    path = options.out / "joined.csv"
    options.out.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, joined(poses, sent), "%.9g", ",", header="t,x,y,yaw,steering,throttle", comments="")
    print(carlab.load(path))
    print(f"Check units, signs and clock: carlab import {path}")


if __name__ == "__main__":
    main()
