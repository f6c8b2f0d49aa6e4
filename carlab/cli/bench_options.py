"""Which options of ``carlab bench`` count for what it measures; every other one is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cli.bench import Bench


@dataclass(frozen=True, slots=True)
class Place:
    """Where options count.

    Attributes:
        words: in which it is told.
        holds: whether it is what was asked for.
    """

    words: str
    holds: Callable[[Bench], bool]


SPEED = Place("'bench speed'", lambda asked: asked.what == "speed")
REGRESSION = Place("'bench regression'", lambda asked: asked.what == "regression")
REALCAR = Place("'bench regression --case realcar'", lambda asked: REGRESSION.holds(asked) and asked.case == "realcar")
PRIORS = Place("'bench priors'", lambda asked: asked.what == "priors")
READ = Place("'bench priors --data FOLDER'", lambda asked: PRIORS.holds(asked) and asked.data is not None)
CONCEALED = Place("'bench priors' without --data", lambda asked: PRIORS.holds(asked) and asked.data is None)
PARKING = Place("'bench parking'", lambda asked: asked.what == "parking")

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
"""Where each option counts that does not count everywhere."""


def check_options(asked: Bench) -> None:
    """Raise ConfigError for an option that was given and would not be heard."""
    for option in fields(asked):
        name = option.name
        if name in EVERYWHERE or getattr(asked, name) == option.default:
            continue
        if not any(place.holds(asked) for place in PLACES[name]):
            places = " and ".join(place.words for place in PLACES[name])
            raise ConfigError(f"--{name.replace('_', '-')} is no option of '{_typed(asked)}'; it counts for {places}.")


def _typed(asked: Bench) -> str:
    """What was asked for, as far as it tells which options count."""
    words = f"bench {asked.what}"
    if REGRESSION.holds(asked):
        return f"{words} --case {asked.case}"
    return f"{words} --data {asked.data}" if READ.holds(asked) else words


__all__ = ["EVERYWHERE", "PLACES", "check_options"]
