"""Options of ``carlab bench``, and a check that each given option has an effect."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from carlab.core.errors import ConfigError

STUDIES = {
    "speed": "simulator, gradients, learning, NatNet decoding, lateness of the command sender",
    "regression": "models fitted to few rows, by carlab's methods, the paper's methods and baselines, on the cases of "
    "the paper",
    "priors": "carlab's method with four priors (none, kinematic, nominal, diagnosed), on a simulated car with two "
    "concealed effects or on the recordings in --data",
    "parking": "carlab learn on the simulated car, for each method; existing runs in --runs are continued",
    "realcars": "prediction errors on held-out recordings of a real car in --data, for constant velocity, the car "
    "file, refit, named effects, measured curves, a learned discrepancy, a black box and adaptation",
    "rollouts": "coverage and error of the rollouts of a learned car on the last recording in --data, with and without "
    "a disturbance",
}
"""What each study measures."""
_STUDY_HELP = "The study; without one, the command lists the studies. " + " ".join(
    f"{name}: {text}." for name, text in STUDIES.items()
)


@dataclass
class BenchOptions:
    """Options of all uses of ``carlab bench``."""

    what: Annotated[
        Positional[Literal["speed", "regression", "priors", "parking", "realcars", "rollouts"] | None],
        arg(help=_STUDY_HELP),
    ] = None

    out: Path | None = None
    """Write the figures to FILE.json (regression, priors and rollouts: after each fit). regression, priors and parking
    also draw FILE.png. priors stores its recordings and the diagnosis in the folder FILE."""

    seconds: float = 10.0
    """speed: duration of each measurement of the command sender [s]."""

    case: Literal[
        "1d", "pendulum", "pendulum_motor", "pendulum_detent", "pendulum_saturation", "pendulum_friction", "car",
        "racecar", "realcar",
    ] = "1d"  # fmt: skip
    """regression: the system. 1d: sinusoids, two points. pendulum: the prior has no friction and drag, as in the
    authors' code. pendulum_motor: as in the paper; the prior has no drag, dry friction and motor lag.
    pendulum_detent, pendulum_saturation, pendulum_friction: the prior has no detent, saturation of the motor, or
    friction that depends on the angle. car: one step of a car with Pacejka tyres, kinematic prior. racecar: the
    authors' arrays of their car (with --data). realcar: recordings in the folder --data, the last one held out."""

    rows: tuple[int | Literal["all"], ...] = ()
    """regression, priors and rollouts: numbers of training rows; by default those of the paper's figure, or 200, 800
    and all (rollouts). rollouts: "all" also fits the car to rollouts over all prediction windows."""

    seeds: int = 3
    """Number of repetitions of each fit, with other true systems or other rows of a recording; parking: number of
    runs."""

    first_seed: int = 0
    """Seed of the first repetition."""

    jobs: int = 1
    """Number of parallel jobs; with more than one, each has one thread. A job is one number of rows with one seed
    (regression: and one method), or one run. ^C ends the study after the running jobs, a second ^C at once."""

    ray: str = ""
    """Run the jobs on Ray in place of --jobs: local for the cores of this machine, or the address of a cluster with the
    same version of carlab. If a worker dies, its job runs again; a job that fails does not end the others. Needs the
    extra ray of carlab (see "Run on a Ray cluster")."""

    methods: tuple[str, ...] = ()
    """regression, carlab's methods: gp-sim-posterior (a simulator with a Gaussian-process discrepancy), sim-posterior
    (a simulator without a discrepancy), gp-posterior (a Gaussian process without a simulator), gp-sim-average (average
    of these three). The paper's: sim-fsvgd, fsvgd (as in the authors' code), sim-fsvgd-corrected, fsvgd-corrected
    (without the errors of that code). Only if named: sim-fsvgd-kde, sim-fsvgd-ssge, sim-fsvgd-nu (other estimators of
    the prior's score), sim-fsvgd-no-discrepancy. Baselines: SysID, GreyBox, ensemble, ridge. parking: some of
    gp-sim-posterior, gp-posterior, sim-fsvgd, sim-fsvgd-corrected, fsvgd. By default all others."""

    structure: bool = False
    """regression with a pendulum: give every method a simulator with further terms (friction by the rate; for
    pendulum_motor also its sign and both commands)."""

    data: Path | None = None
    """regression: folder with the authors' arrays (pendulum_seed0_n5.npz and so on); by default rows are generated.
    --case realcar, priors and rollouts: folder with recordings, the last one held out. realcars: folder with
    recordings."""

    held_out: tuple[str, ...] = ()
    """realcars: text that the names of the held-out recordings contain; by default the last recording is held out."""

    fit: tuple[str, ...] = ()
    """realcars: text that the names of the fitted recordings contain; by default all that are not held out."""

    effects: tuple[str, ...] = ()
    """realcars: restrict the search to these effects of the catalogue."""

    curves: bool = False
    """rollouts with --rows all: the prior simulator has measured curves (drive force, steering, tyres), which are
    fitted to the recordings to fit; each fold of the cross-validation has its own."""

    particles: Literal["network", "simulator"] = "network"
    """rollouts: what each particle of a car is. network: a network that predicts a step. simulator: the prior simulator
    with its own parameters, and a network that corrects its steps."""

    keep_events: bool = False
    """realcars: also fit and score prediction windows with events (collisions, a hand that moves the car)."""

    car: Path = Path("eth_rc_car")
    """--case realcar, and rollouts: car file of the prior simulator, with ranges or the standard deviations of a
    diagnosis. priors with --data, and realcars: car file of the nominal simulator, which is diagnosed."""

    history: int | None = None
    """--case realcar, priors and rollouts: number of past commands; by default estimated from the recordings (the paper
    has 3)."""

    diagnosed: Path | None = None
    """priors: model.toml of a diagnosis without the last recording; by default the study runs the diagnosis."""

    pair: int = 1
    """priors without --data: number of the pair of concealed effects (1, 2 or 3)."""

    recorded_s: tuple[float, float] = (100.0, 40.0)
    """priors without --data: durations of the training recording and of the held-out recording [s]."""

    runs: Path = Path("parking-runs")
    """parking: folder of the runs."""

    realities: int | None = None
    """parking: number of simulated cars that differ from the prior (at most 8: low grip, servo lag, long delay, weak
    motor, low-friction patch, two lags, slope, load transfer). --methods are then the priors nominal and auto (--prior
    of carlab learn), and no-simulator."""

    episodes: int = 20
    """parking: episodes of each run."""

    updates: int = 30000
    """parking: gradient steps of SAC before an episode, as for carlab learn."""

    steps: int | None = None
    """Steps of the model's optimiser. By default 12 000 for regression, priors and rollouts, 2500 for parking, or those
    of the authors' code."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the models; with --ray, each job on cuda has one GPU of the cluster. speed: device of the learning
    benchmarks; the others run on the CPU."""

    verbose: bool = False
    """Show the whole log."""

    @property
    def all_seeds(self) -> range:
        """Seeds of all repetitions."""
        return range(self.first_seed, self.first_seed + self.seeds)


SPEED, REGRESSION, PRIORS = "'bench speed'", "'bench regression'", "'bench priors'"
PARKING, ROLLOUTS, REALCARS = "'bench parking'", "'bench rollouts'", "'bench realcars'"
REALCAR, PENDULUM = "'bench regression --case realcar'", "'bench regression --case pendulum'"
READ, CONCEALED = "'bench priors --data FOLDER'", "'bench priors' without --data"

EVERYWHERE = frozenset({"what", "out", "device", "verbose"})
STUDIES_OF_OPTION = {
    "seconds": (SPEED,),
    "case": (REGRESSION,),
    "rows": (REGRESSION, PRIORS, ROLLOUTS),
    "seeds": (REGRESSION, PRIORS, PARKING, ROLLOUTS),
    "first_seed": (REGRESSION, PRIORS, PARKING, ROLLOUTS),
    "jobs": (REGRESSION, PRIORS, PARKING, ROLLOUTS),
    "ray": (REGRESSION, PRIORS, PARKING, ROLLOUTS),
    "methods": (REGRESSION, PARKING),
    "structure": (PENDULUM,),
    "data": (REGRESSION, PRIORS, REALCARS, ROLLOUTS),
    "held_out": (REALCARS,),
    "effects": (REALCARS,),
    "curves": (ROLLOUTS,),
    "particles": (ROLLOUTS,),
    "keep_events": (REALCARS,),
    "fit": (REALCARS,),
    "car": (REALCAR, READ, REALCARS, ROLLOUTS),
    "history": (REALCAR, PRIORS, ROLLOUTS),
    "diagnosed": (PRIORS,),
    "pair": (CONCEALED,),
    "recorded_s": (CONCEALED,),
    "runs": (PARKING,),
    "realities": (PARKING,),
    "episodes": (PARKING,),
    "updates": (PARKING,),
    "steps": (REGRESSION, PRIORS, PARKING, ROLLOUTS),
}
"""Uses in which an option has an effect, for options without an effect in all uses."""


def uses(given: BenchOptions) -> set[str]:
    """The uses of ``carlab bench`` that options belong to, as messages name them."""
    found = {f"'bench {given.what}'"}
    if given.what == "regression" and given.case == "realcar":
        found.add(REALCAR)
    if given.what == "regression" and given.case.startswith("pendulum"):
        found.add(PENDULUM)
    if given.what == "priors":
        found.add(CONCEALED if given.data is None else READ)
    return found


def check_options(given: BenchOptions) -> None:
    """Check that every given option has an effect.

    Raises:
        ConfigError: an option has no effect; the message lists the uses of the option.
    """
    for option in fields(given):
        name = option.name
        if name in EVERYWHERE or getattr(given, name) == option.default:
            continue
        if uses(given).isdisjoint(STUDIES_OF_OPTION[name]):
            studies = " and ".join(STUDIES_OF_OPTION[name])
            raise ConfigError(
                f"--{name.replace('_', '-')} has no effect in '{_command(given)}'; use it with {studies}."
            )
    if "all" in given.rows and given.what != "rollouts":
        raise ConfigError(f"--rows all has no effect in '{_command(given)}'; use it with {ROLLOUTS}.")


def row_counts(given: BenchOptions) -> tuple[int, ...]:
    """The numbers of rows that are given as numbers."""
    return tuple(count for count in given.rows if count != "all")


def _command(given: BenchOptions) -> str:
    """The command with the options that determine its use."""
    command = f"bench {given.what}"
    if given.what == "regression":
        return f"{command} --case {given.case}"
    return f"{command} --data {given.data}" if READ in uses(given) else command
