"""Sentences about events of recordings."""

from __future__ import annotations

from carlab.diagnosis.events import Event, EventUse
from carlab.diagnosis.findings import Diagnosis, FitErrors, final_model_name
from carlab.diagnosis.report.numbers import number, with_unit

KINDS = {"impact": "impact", "carried": "carried sideways"}


def event_sentences(use: EventUse, without: FitErrors | None = None, with_them: FitErrors | None = None) -> list[str]:
    """What was done about the events, the errors of a model without and with them, and a line for each event."""
    count = len(use.found)
    if not count:
        return []
    head = "One event that no tyre can cause" if count == 1 else f"{count} events that no tyre can cause"
    if not use.are_left_out:
        head += f" (collision, hand). {'It is' if count == 1 else 'They are'} kept in fit and score."
    else:
        windows = [f"{n} {name}" for n, name in ((use.fit_windows, "fitted"), (use.held_out_windows, "scored")) if n]
        head += f" (collision, hand). {' and '.join(windows) or 'No'} prediction windows are left out."
    if without is not None and with_them is not None:
        head += (
            f" With them, the position error of the model is {with_unit(with_them.position_m, 'm')} instead of "
            f"{with_unit(without.position_m, 'm')}, and its score {number(with_them.score)} instead of "
            f"{number(without.score)}."
        )
    return [head, *(_line(event) for event in use.found)]


def diagnosed_event_sentences(diagnosis: Diagnosis) -> list[str]:
    """The same for the most complete model of a diagnosis, which model.toml contains."""
    name = final_model_name(diagnosis.held_out)
    return event_sentences(diagnosis.events, diagnosis.held_out.get(name), diagnosis.held_out_with_events.get(name))


def event_label(event: Event) -> str:
    """Kind and size of an event."""
    change = f"{with_unit(event.velocity_change_mps, 'm/s')}, {with_unit(event.yaw_rate_change_radps, 'rad/s')}"
    return f"{KINDS[event.kind]} ({change})"


def _line(event: Event) -> str:
    role = f", {event.role}" if event.role else ""
    span = f"{event.from_s:.2f} to {event.to_s:.2f} s"
    place = f"x {with_unit(round(event.x_m, 2), 'm')}, y {with_unit(round(event.y_m, 2), 'm')}"
    return f"Recording {event.recording}{role}, {span}, {place}: {event_label(event)}."
