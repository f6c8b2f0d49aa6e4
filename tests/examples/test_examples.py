"""Test that each script in examples/ runs with small settings and prints its results."""

import re
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import carlab
from carlab.core.angles import wrap
from carlab.core.observation import encode
from carlab.core.task import Task
from learning.policy.sac_agent import SacSettings
from sim_backends.effects import CATALOGUE, EFFECTS
from sim_backends.registry import REGISTRY

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
FEW_STEPS = ["--updates", "64", "--model-steps", "20"]
SCRIPTS = {
    "own_policy.py": [],
    "write_task.py": [],
    "fit_sim_fsvgd.py": ["--steps", "400"],
    "add_effect.py": ["--seconds", "20"],
    "join_logs.py": [],
    "diagnose_csv.py": ["--seconds", "20", "--effects", "steering_lag"],
    "train_in_learned_car.py": FEW_STEPS,
    "demo.py": ["--car", "sim", "--episodes", "1", *FEW_STEPS, "--effects", "steering_lag"],
}


Example = Callable[[str], str]


@pytest.fixture
def output_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Example:
    """Run a script in this process, which has imported carlab, in the folder of the test; returns what it prints."""

    def run(script: str) -> str:
        monkeypatch.chdir(tmp_path)
        out = [] if script == "fit_sim_fsvgd.py" else ["--out", "runs"]
        monkeypatch.setattr(sys, "argv", [script, *SCRIPTS[script], *out])
        runpy.run_path(str(EXAMPLES / script), run_name="__main__")
        return capfd.readouterr().out

    return run


@pytest.fixture
def registries() -> Iterator[None]:
    """Remove what the test registers."""
    before = [(registry, dict(registry)) for registry in (EFFECTS, CATALOGUE, REGISTRY)]
    yield
    for registry, entries in before:
        registry.clear()
        registry.update(entries)


def test_each_example_has_settings() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SCRIPTS)


def test_posterior_of_own_arrays_predicts_between_the_rows(output_of: Example) -> None:
    line = next(line for line in output_of("fit_sim_fsvgd.py").splitlines() if line.startswith("x +0.5"))
    predicted, std, true = map(float, re.findall(r"[+-]?\d\.\d\d", line))
    assert predicted == pytest.approx(true, abs=0.1)
    assert 0.0 < std < 0.2


def test_poses_and_commands_of_two_programs_are_joined(output_of: Example, tmp_path: Path) -> None:
    assert "1 episode" in output_of("join_logs.py")
    drive = carlab.load(next(tmp_path.glob("runs/*/episodes/0001.mcap"))).episodes[0]
    table = np.genfromtxt(tmp_path / "runs" / "joined.csv", delimiter=",", names=True)
    t_s = table["t"] + drive.times_s[0]  # the log of the commands begins with the first tick
    poses = np.array([np.interp(t_s, drive.poses[:, 0], np.unwrap(drive.poses[:, k])) for k in (1, 2, 3)])
    assert np.abs(table["x"] - poses[0]).max() < 1e-5
    assert np.abs(table["y"] - poses[1]).max() < 1e-5
    assert np.abs(wrap(table["yaw"] - poses[2])).max() < 1e-5
    for time_s, steering, throttle in zip(t_s, table["steering"], table["throttle"], strict=True):
        sent = drive.sent[np.flatnonzero(drive.times_s <= time_s + 1e-6)[-1]]
        assert (steering, throttle) == pytest.approx(sent, abs=1e-4)


def test_pose_of_a_motive_export_is_that_of_the_rigid_body(tmp_path: Path) -> None:
    """Y up: a car at X = 1 m, Z = -2 m with a heading of 90 degrees is at x = 1 m, y = 2 m."""
    motive_poses = runpy.run_path(str(EXAMPLES / "join_logs.py"))["motive_poses"]
    half = np.sqrt(0.5)
    take = tmp_path / "take.csv"
    take.write_text(
        "Format Version,1.23,Rotation Type,Quaternion,Length Units,Meters\n\n"
        f",Type{',Rigid Body' * 8},Marker\n,Name{',other'}{',car' * 7},car:1\n,ID{',1' * 9}\n,Parent{',' * 9}\n"
        ",,Position,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Position\n"
        "Frame,Time (Seconds),X,X,Y,Z,W,X,Y,Z,X\n"
        f"0,0.0,9,0,{half},0,{half},1,0.05,-2,8\n1,0.5,9,,,,,,,,8\n2,1.0,9,0,0,0,1,3,0.05,0,8\n",
        encoding="utf-8",
    )
    assert motive_poses(take, "car", "y") == pytest.approx(np.array([[0, 1, 2, np.pi / 2], [1, 3, 0, 0]]))


def motive_take(frames: str) -> str:
    """A take of one rigid body."""
    return (
        "Format Version,1.23,Rotation Type,Quaternion,Length Units,Meters\n\n"
        f",Type{',Rigid Body' * 7}\n,Name{',car' * 7}\n"
        ",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position\n"
        f"Frame,Time (Seconds),X,Y,Z,W,X,Y,Z\n{frames}"
    )


POSES = "".join(f"{k},{0.1 * k:.1f},0,0,0,1,{0.1 * k:.1f},0,0\n" for k in range(20))
LOG = "stamp_ns,servo_us,motor_us\n" + "".join(f"{k}00000000,1500,{1500 + 10 * k}\n" for k in range(20))
Join = Callable[..., np.ndarray]


@pytest.fixture
def join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Join:
    """Write both files, run join_logs.py, and return the rows of its CSV."""

    def run(take: str | None = motive_take(POSES), log: str = LOG, first_pose: str = "0") -> np.ndarray:
        monkeypatch.chdir(tmp_path)
        if take is not None:
            Path("take.csv").write_text(take, encoding="utf-8")
        Path("log.csv").write_text(log, encoding="utf-8")
        monkeypatch.setattr(sys, "argv", ["", "take.csv", "log.csv", f"--first-pose={first_pose}", "--out", "out"])
        runpy.run_path(str(EXAMPLES / "join_logs.py"), run_name="__main__")
        return np.genfromtxt("out/joined.csv", delimiter=",", skip_header=1)

    return run


def test_join_reads_blank_lines_and_commands_in_any_order(join: Join) -> None:
    """Pose k is at 0.1 k metres and 0.1 k seconds, and throttle k is 0.02 k."""
    header, *lines = LOG.splitlines()
    rows = join(motive_take(POSES) + "\n \n", "\n".join([header, *reversed(lines), "", ""]), "0.05")
    assert len(rows) == 19
    assert rows[:, 1] == pytest.approx(0.1 * np.arange(19))
    assert rows[:, 5] == pytest.approx(0.02 * np.arange(19))


def test_join_leaves_out_a_cut_last_line(join: Join) -> None:
    assert (
        len(join(motive_take(POSES + "20,2.0,0,0,0,1,2"), "stamp_ns,servo_us,motor_us\n0,1500,1500\n3e9,1500,1500"))
        == 20
    )


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ({"take": motive_take("0,0.0,,,,,,,\n1,0.1,,,,,,,\n")}, r"take.csv: the cameras see 'car' in no frame\."),
        ({"take": None}, r"take.csv does not exist\."),
        ({"take": ""}, "export the take again"),
        ({"take": motive_take("").replace("Frame,", "Number,")}, "no line 'Frame,Time .*export the take again"),
        ({"log": LOG.replace("servo_us", "servo")}, "log.csv has no column servo_us; edit the names"),
        ({"log": "stamp_ns,servo_us,motor_us\n"}, r"log.csv has no commands\."),
        ({"first_pose": "1.9"}, r"^1 poses lie between .* correct --first-pose\."),
    ],
)
def test_join_states_what_is_missing(join: Join, files: dict[str, str | None], sentence: str) -> None:
    with pytest.raises(SystemExit, match=sentence):
        join(**files)


def test_own_policy_holds_its_target_speed(output_of: Example) -> None:
    text = output_of("own_policy.py")
    speed = float(text.partition("last second: ")[2].split()[0])
    assert speed == pytest.approx(0.8, abs=0.1)


def test_own_task_ends_at_the_goal(output_of: Example) -> None:
    text = output_of("write_task.py")
    assert text.startswith("GOAL_REACHED")


def test_own_task_rewards_its_end_more_than_waiting_or_leaving() -> None:
    """Returns with the discount of the policy's training, in which no reward follows an end."""
    task: Task = runpy.run_path(str(EXAMPLES / "write_task.py"))["StopAfterOneMetre"]()

    def discounted_return(stop_m: float) -> float:
        x = np.sign(stop_m) * np.minimum(np.arange(task.max_ticks + 1) / 30.0, abs(stop_m))
        states = np.zeros((len(x), 6))
        states[:, 0], states[:-1, 3] = x, 30.0 * np.diff(x)
        features = encode(states, np.zeros((len(x), task.history_length, 2)))
        rewards = task.reward(features[:-1], np.zeros((task.max_ticks, 2)), features[1:])
        left = np.abs(x[1:] - 1.0) > 2.9  # The safety gate stops the car at the edge of the arena.
        ends = np.flatnonzero(task.terminated(features[1:]) | left)
        ticks = int(ends[0]) + 1 if len(ends) else task.max_ticks
        return float(rewards[:ticks] @ SacSettings().discount ** np.arange(ticks))

    parked = discounted_return(1.0)
    assert parked > 1.2 * discounted_return(0.94), "waiting beside the goal"
    assert 0.0 == discounted_return(0.0) > discounted_return(-2.0), "leaving the arena"


@pytest.mark.timeout(900)
@pytest.mark.usefixtures("registries")
def test_own_effect_is_identified(output_of: Example) -> None:
    text = output_of("add_effect.py")
    estimated = text.partition("a drag of ")[2].split()[0]
    assert float(estimated) == pytest.approx(0.5, abs=0.1)


@pytest.mark.timeout(900)
def test_csv_diagnosis_reduces_the_model_error(output_of: Example, tmp_path: Path) -> None:
    text = output_of("diagnose_csv.py")
    assert "steering" in text
    assert (tmp_path / "runs" / "diagnosis" / "model.toml").is_file()
    before, after = (float(line.split()[1]) for line in text.splitlines() if line.startswith("model  "))
    assert after < before


@pytest.mark.timeout(900)
def test_policy_training_in_the_learned_car_prints_returns(output_of: Example) -> None:
    text = output_of("train_in_learned_car.py")
    assert "Mean return" in text
    assert "from the goal" in text


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_demo_prints_concealed_and_estimated_values(output_of: Example) -> None:
    text = output_of("demo.py")
    row = next(line for line in text.splitlines() if line.startswith("effects.steering_lag.time_constant [s]"))
    prior, concealed, estimated = row.split()[2:5]
    assert (prior, float(concealed)) == ("none", 0.07)
    assert float(estimated) == pytest.approx(0.07, abs=0.02)
    assert "Held-out position error" in text
