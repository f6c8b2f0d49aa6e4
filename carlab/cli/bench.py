"""``carlab bench``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from carlab.cli.bench_options import check_options
from carlab.cli.bench_output import write_figures
from carlab.cli.console import console, table
from carlab.cli.options import above_zero, json_file


@dataclass
class Bench:
    """Measure how fast the parts are, or how well models learn from few rows."""

    what: Positional[Literal["speed", "regression", "priors", "parking"]] = "speed"
    """speed: simulator, gradients, learning, NatNet decoding, lateness of the command sender; ratios taken in one run.
    regression: Sim-FSVGD and its baselines on the cases of the paper. priors: what a diagnosed simulator is worth:
    Sim-FSVGD without a prior, with the kinematic, the nominal and the diagnosed one, on a simulated car with two
    concealed effects, or on the recordings in --data. parking: carlab learn on the simulated car, method beside method;
    runs that are in --runs already are taken up."""

    out: Path | None = None
    """Write the figures as JSON into FILE.json (regression and priors after each fit); all but speed draw a picture of
    the same name beside it, and priors keeps its recordings and the diagnosis in a folder of that name."""

    seconds: float = 10.0
    """speed: length of each condition of the sender's measurement [s]."""

    case: Literal["1d", "pendulum", "pendulum_motor", "car", "racecar", "realcar"] = "1d"
    """regression: what is learned. 1d: sinusoids, two points. pendulum: friction and drag hidden from the prior, as in
    the authors' code. pendulum_motor: as in the paper; drag that brakes, dry friction and the motor's lag hidden. car:
    one step of a car with Pacejka tyres, kinematic prior. racecar: the authors' arrays of theirs (with --data).
    realcar: recordings in the folder --data, the last one held out."""

    rows: tuple[int, ...] = ()
    """regression and priors: numbers of rows to learn from; those of the paper's figure unless given."""

    seeds: int = 3
    """How often each fit is made: with other true systems, other rows of a recording, or (parking) other runs."""

    methods: tuple[str, ...] = ()
    """regression: some of Sim-FSVGD, "Sim-FSVGD without gap", FSVGD, SysID, GreyBox, ensemble, ridge; parking: some of
    sim-fsvgd, fsvgd, fsvgd-authors. All unless given."""

    way: Literal["ours", "authors"] = "ours"
    """regression: how particles are fitted, as carlab does, or with the update and the sizes of the authors' code."""

    data: Path | None = None
    """regression: folder with the authors' arrays (pendulum_seed0_n5.npz and so on); rows are drawn here without it.
    realcar and priors: folder with recordings, the last one held out."""

    car: Path = Path("eth_rc_car")
    """realcar: the car file whose simulator is the prior, with its ranges and the doubts of a diagnosis. priors with
    --data: the nominal one, that is diagnosed."""

    history: int | None = None
    """realcar and priors: past commands; found from the recordings unless given (the paper has 3)."""

    diagnosed: Path | None = None
    """priors: model.toml of a diagnosis that did not see the last recording; diagnosed here unless given."""

    pair: int = 1
    """priors without --data: which two effects are concealed (1, 2 or 3)."""

    recorded_s: tuple[float, float] = (100.0, 40.0)
    """priors without --data: lengths of the recordings to learn from and of the one held out [s]."""

    runs: Path = Path("parking-runs")
    """parking: folder of its runs."""

    episodes: int = 20
    """parking: of each run."""

    updates: int = 30000
    """parking: gradient steps of SAC before an episode, as for carlab learn."""

    steps: int | None = None
    """Steps of the model's optimiser. Unless given: 12 000 for regression and priors, 2500 for parking, or what the
    authors' code has."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Where models learn. speed: of learning alone, the other parts are the CPU's."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Measure and print."""
        from learning.devices import available

        available(self.device)
        if self.out is not None:
            json_file(self.out, "--out")
        check_options(self)
        if self.what == "speed":
            return self._speed()
        above_zero(
            seeds=self.seeds, steps=self.steps, episodes=self.episodes, updates=self.updates,
            **{"rows": min(self.rows)} if self.rows else {},
        )  # fmt: skip
        if self.what == "priors":
            from carlab.cli.bench_priors import run_priors

            return run_priors(self)
        if self.what == "parking":
            from carlab.cli.bench_parking import run_parking

            return run_parking(self)
        from carlab.cli.bench_regression import run_regression

        return run_regression(self)

    def _speed(self) -> int:
        from carlab.experiment.speed import measure_speed

        above_zero(seconds=self.seconds)
        figures = measure_speed(seconds=self.seconds, device=self.device, note=lambda text: console.print(text))
        rows = [[part, name, f"{value:.4g}"] for part, values in figures.items() for name, value in _flat(values)]
        table("Speed", ["part", "figure", "value"], rows)
        if self.out is not None:
            write_figures(self.out, figures)
            console.print(f"{self.out}")
        return 0


def _flat(values: object, prefix: str = "") -> list[tuple[str, float]]:
    if isinstance(values, dict):
        return [row for name, value in values.items() for row in _flat(value, f"{prefix}{name}  ")]
    return [(prefix.strip(), float(values))] if isinstance(values, (int, float)) else []
