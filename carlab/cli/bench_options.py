"""Options of ``carlab bench``, and which of them count for which use; every other one is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from carlab.core.errors import ConfigError


@dataclass
class BenchOptions:
    """Options of all uses of ``carlab bench``."""

    what: Positional[Literal["speed", "regression", "priors", "parking"]] = "speed"
    """speed: simulator, gradients, learning, NatNet decoding, lateness of the command sender; ratios taken in one run.
    regression: Sim-FSVGD and its baselines on the cases of the paper. priors: what a diagnosed simulator is worth:
    Sim-FSVGD without a prior, with the kinematic, the nominal and the diagnosed one, on a simulated car with two
    concealed effects, or on the recordings in --data. parking: carlab learn on the simulated car, method beside method;
    runs that are in --runs already are continued."""

    out: Path | None = None
    """Write the figures as JSON into FILE.json (regression and priors after each fit); all but speed draw a picture of
    the same name beside it, and priors keeps its recordings and the diagnosis in a folder of that name."""

    seconds: float = 10.0
    """speed: length of each condition of the sender's measurement [s]."""

    case: Literal["1d", "pendulum", "pendulum_motor", "car", "racecar", "realcar"] = "1d"
    """regression: the system. 1d: sinusoids, two points. pendulum: friction and drag hidden from the prior, as in
    the authors' code. pendulum_motor: as in the paper; drag that brakes, dry friction and the motor's lag hidden. car:
    one step of a car with Pacejka tyres, kinematic prior. racecar: the authors' arrays of theirs (with --data).
    realcar: recordings in the folder --data, the last one held out."""

    rows: tuple[int, ...] = ()
    """regression and priors: numbers of rows to learn from; those of the paper's figure unless given."""

    seeds: int = 3
    """Repetitions of each fit: with other true systems, other rows of a recording, or (parking) other runs."""

    methods: tuple[str, ...] = ()
    """regression: some of Sim-FSVGD, "Sim-FSVGD without gap", FSVGD, SysID, GreyBox, ensemble, ridge; parking: some of
    sim-fsvgd, fsvgd, fsvgd-authors. All unless given."""

    way: Literal["ours", "authors"] = "ours"
    """regression: ours fits particles to a Gaussian-process posterior with simulator parameters (carlab's own method,
    also in the rows named Sim-FSVGD); authors is functional SVGD as published, with the sizes of the authors' code."""

    data: Path | None = None
    """regression: folder with the authors' arrays (pendulum_seed0_n5.npz and so on); rows are drawn here without it.
    realcar and priors: folder with recordings, the last one held out."""

    car: Path = Path("eth_rc_car")
    """realcar: the car file whose simulator is the prior, with its ranges and the standard deviations of a diagnosis.
    priors with --data: the nominal car, which is diagnosed."""

    history: int | None = None
    """realcar and priors: past commands; found from the recordings unless given (the paper has 3)."""

    diagnosed: Path | None = None
    """priors: model.toml of a diagnosis without the last recording; diagnosed here unless given."""

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
    """Device of the models. speed: of the learning benchmarks alone; all others run on the CPU."""

    verbose: bool = False
    """Show the whole log."""


@dataclass(frozen=True, slots=True)
class Place:
    """A use of ``carlab bench`` in which some options count.

    Attributes:
        command: as it is typed.
        holds: whether given options are this use.
    """

    command: str
    holds: Callable[[BenchOptions], bool]


SPEED = Place("'bench speed'", lambda given: given.what == "speed")
REGRESSION = Place("'bench regression'", lambda given: given.what == "regression")
REALCAR = Place("'bench regression --case realcar'", lambda given: REGRESSION.holds(given) and given.case == "realcar")
PRIORS = Place("'bench priors'", lambda given: given.what == "priors")
READ = Place("'bench priors --data FOLDER'", lambda given: PRIORS.holds(given) and given.data is not None)
CONCEALED = Place("'bench priors' without --data", lambda given: PRIORS.holds(given) and given.data is None)
PARKING = Place("'bench parking'", lambda given: given.what == "parking")

EVERYWHERE = frozenset({"what", "out", "device", "verbose"})
PLACES = {
    "seconds": (SPEED,),
    "case": (REGRESSION,),
    "rows": (REGRESSION, PRIORS),
    "seeds": (REGRESSION, PRIORS, PARKING),
    "methods": (REGRESSION, PARKING),
    "way": (REGRESSION,),
    "data": (REGRESSION, PRIORS),
    "car": (REALCAR, READ),
    "history": (REALCAR, PRIORS),
    "diagnosed": (PRIORS,),
    "pair": (CONCEALED,),
    "recorded_s": (CONCEALED,),
    "runs": (PARKING,),
    "episodes": (PARKING,),
    "updates": (PARKING,),
    "steps": (REGRESSION, PRIORS, PARKING),
}
"""Uses in which an option counts, for options that do not count everywhere."""


def check_options(given: BenchOptions) -> None:
    """Check that every given option counts.

    Raises:
        ConfigError: one would be ignored; the sentence names its uses.
    """
    for option in fields(given):
        name = option.name
        if name in EVERYWHERE or getattr(given, name) == option.default:
            continue
        if not any(place.holds(given) for place in PLACES[name]):
            places = " and ".join(place.command for place in PLACES[name])
            raise ConfigError(
                f"--{name.replace('_', '-')} is no option of '{_command(given)}'; it counts for {places}."
            )


def _command(given: BenchOptions) -> str:
    """The command with the options that decide which others count."""
    command = f"bench {given.what}"
    if REGRESSION.holds(given):
        return f"{command} --case {given.case}"
    return f"{command} --data {given.data}" if READ.holds(given) else command


__all__ = ["EVERYWHERE", "PLACES", "BenchOptions", "check_options"]
