"""Sentences about what a diagnosis did not search or measure."""

from __future__ import annotations

from carlab.diagnosis.findings import SearchExtent
from carlab.diagnosis.report.numbers import listed, with_unit


def search_sentences(search: SearchExtent) -> str:
    """What the search and the stages after it omitted, with the remedy; empty after a complete diagnosis."""
    text = ""
    if search.effects:
        text += f" The search was restricted to these effects: {listed(search.effects)}."
    if search.stopped_by == "budget" and search.budget_s is not None:
        text += (
            f" The search for effects was cut short by the time limit of {with_unit(search.budget_s, 's')}, so it may "
            "have missed some. With --budget inf (Python: budget_s=math.inf) it runs to its end."
        )
    elif not search.is_complete:
        text += (
            " The user stopped the search for effects or the checks after it, so effects may be missing, and named "
            "ones may be wrong. Diagnose again for a complete search."
        )
    if search.omitted:
        text += f" The user ended the diagnosis, so this report has no {listed(search.omitted, 'and no')}."
    return text
