"""Result of a comparison as data: the schema ``carlab.compare/1``, and its sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from carlab.diagnosis.findings import DataFault, Estimate
from carlab.diagnosis.report.numbers import listed, number, percent, unit_text
from carlab.diagnosis.report.sentences import effect_noun
from sim_backends.effects import EFFECTS

SCHEMA = "carlab.compare/1"
ComparisonVerdict = Literal["changed", "nothing", "inconclusive"]


@dataclass(frozen=True, slots=True)
class Change:
    """An effect or a base parameter that differs between the groups.

    Attributes:
        id: id of an effect, or dotted name of a base parameter.
        parameters: change of each parameter, second group minus first, with its 90 % interval.
        reference: value of each parameter in the first group.
        p_value: of no change, multiplied by the number of candidates.
        loss_share: fall of the negative log-likelihood of the second group, as a share of it.
        standard_errors: size of the change in standard errors, with the spread between blocks and between drives.
        indistinguishable_from: candidates that explain the second group as well.
    """

    id: str
    parameters: Mapping[str, Estimate]
    reference: Mapping[str, float]
    p_value: float
    loss_share: float
    standard_errors: float
    indistinguishable_from: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The effect's name, or the name of the base parameter."""
        return effect_noun(self.id) if self.id in EFFECTS else self.id

    @property
    def sentence(self) -> str:
        """The change with its numbers."""
        sizes = {}
        for name, e in self.parameters.items():
            unit = f" {unit_text(e.unit)}".rstrip()
            interval = f"{number(e.low90)} to {number(e.high90)} at 90 %"
            sizes[name] = f"by {number(e.value)}{unit} ({interval}), from {number(self.reference[name])}{unit}"
        if self.id in EFFECTS:
            parts = listed([f"{name} {size}" for name, size in sizes.items()])
            text = f"{self.name[0].upper()}{self.name[1:]} changed: {parts}"
        else:  # a base parameter, with its name as in the car file
            text = f"{self.id} changed {next(iter(sizes.values()))}"
        others = listed([effect_noun(n) if n in EFFECTS else n for n in self.indistinguishable_from], "or")
        also = f" These recordings do not distinguish it from {others}." if others else ""
        return f"{text}.{also}"


@dataclass(frozen=True, slots=True)
class Tested:
    """Linear estimate of a candidate's change: values of its parameters, and their size in standard errors."""

    id: str
    parameters: Mapping[str, float]
    standard_errors: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """The smallest set of changes that explains the difference between two groups of recordings.

    Attributes:
        verdict: "changed", "nothing", or "inconclusive" if it was stopped before it found a change.
        sentence: the verdict.
        changes: the changes, the strongest first.
        seconds: run time [s].
        tested: all candidates before any change is accepted, the most likely first.
        is_complete: whether the comparison ended by itself; after a stop there may be more changes.
        data_faults: faults of the recordings, with the action taken. A repair of one group can hide a change.
    """

    verdict: ComparisonVerdict
    sentence: str
    changes: tuple[Change, ...] = ()
    seconds: float = 0.0
    tested: tuple[Tested, ...] = ()
    is_complete: bool = True
    data_faults: tuple[DataFault, ...] = ()

    def __repr__(self) -> str:
        """The verdict, and one sentence for each change."""
        return "\n  ".join([self.sentence, *(change.sentence for change in self.changes)])

    def to_dict(self) -> dict[str, Any]:
        """Plain data in the schema, ready for JSON."""
        return {"schema": SCHEMA, **asdict(self)}


def verdict_sentence(verdict: ComparisonVerdict, changes: Sequence[Change], *, is_complete: bool) -> str:
    """The verdict of a comparison that has enough data; ``is_complete``: whether no stop ended it."""
    if verdict == "inconclusive":
        return "The comparison was stopped before it found a change. Compare again for a result."
    if not changes:
        return "No effect or parameter of the simulator changed significantly between the two groups."
    falls = percent(1.0 - math.prod(1.0 - c.loss_share for c in changes))
    names = listed([c.name for c in changes])
    text = f"Between the two groups changed: {names}. This lowers the loss of the second group by {falls}."
    return text if is_complete else f"{text} The comparison was stopped, so it may have missed further changes."
