"""Score of one case: a report compared with the sealed answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from carlab.benchmark.effects.catalogue import CONFUSABLE
from carlab.benchmark.proof.matching import Correctness, assigned
from carlab.benchmark.proof.probabilities import stated_names
from carlab.core.errors import DataError

SCHEMA = "carlab.diagnosis/1"
LAG_WITHIN_S = 0.025
Json = Mapping[str, Any]
SeparationTest = Callable[[str, str], bool | None]


def check_report(report: Json) -> None:
    """Raise DataError if a report lacks data for scoring."""
    if report.get("schema") != SCHEMA:
        raise DataError(f"report.json has schema {report.get('schema')!r}; it must be '{SCHEMA}'.")
    for key in ("verdict", "effects", "fit"):
        if key not in report:
            raise DataError(f"report.json has no '{key}'; the schema requires it.")


def score_case(
    answer: Json,
    report: Json | None,
    oracle: Json | None = None,
    seconds: float | None = None,
    same: SeparationTest | None = None,
) -> dict[str, Any]:
    """Score one case.

    Args:
        answer: The answer of the case, from ``Case.answer``.
        report: The tool's report; None if there is none.
        oracle: The report of the same tool with the true names given, if there is one.
        seconds: Run time of the diagnosis [s].
        same: Whether the generator's refit finds two effects within two standard errors on this case; None if it
            does not cover them. Then only the list of confusable effects counts.

    Returns:
        A flat table; figures that do not apply to the kind of case are absent. Names that a wrong base model implies
        do not count. Without a report, ``false_alarm`` and ``is_spurious`` are None: the tool has not answered.
    """
    row: dict[str, Any] = {
        "kind": answer["kind"],
        "true": [e["id"] for e in answer["effects"]],
        "form": answer["effects"][0]["form"] if answer["effects"] else None,
        "target_excess": answer["target_excess"],
        "excess": answer["excess"],
        "seconds": seconds,
        "reported": report is not None,
    }
    if report is not None:
        check_report(report)
    row["verdict"] = report["verdict"] if report is not None else "no report"
    implied = answer.get("implied_effects", ())
    named = [dict(e) for e in report["effects"] if e["id"] not in implied] if report is not None else []
    row["named"] = [e["id"] for e in named]
    row["stated_names"] = stated_names(named, row["true"])
    row["implied"] = list(implied)
    row["conditions"] = list(answer.get("conditions", ()))
    if answer["fault"] is not None:
        faults = [f.get("id") for f in (report or {}).get("data_faults", [])]
        row["fault_found"] = answer["fault"]["id"] in faults
    _criteria_of_kind(row, answer, named, report, same)
    if answer["kind"] in ("single", "pair", "multiple"):
        _detections(row, answer, named, same)
        _ratios(row, report, oracle)
    return row


def _criteria_of_kind(
    row: dict[str, Any], answer: Json, named: list[dict[str, Any]], report: Json | None, same: SeparationTest | None
) -> None:
    kind = answer["kind"]
    if kind == "single":
        _single(row, answer, named, same)
    elif kind == "pair":
        found, _ = assigned(row["true"], named, partial(_correctness, same=same))
        strict = [true in row["named"] for true in row["true"]]
        row["both_found"], row["both_strict"] = all(found), all(strict)
    elif kind == "multiple":
        row["first_right"] = bool(named) and any(_found(named[0], true, same) for true in row["true"])
    elif kind == "outside":
        _outside(row, answer, report)
    else:
        row["false_alarm"] = bool(named) if row["reported"] else None
        if any(name.startswith("base model") for name in row["conditions"]):
            # The car file lacks physics, so every verdict without a name is correct.
            row["verdict_right"] = row["reported"] and not named
        elif kind == "parameters":
            row["verdict_right"] = row["verdict"] == "parameters"
        elif kind == "null":
            row["verdict_right"] = row["verdict"] in ("none", "parameters")
        else:
            row["verdict_right"] = row["verdict"] in ("data", "parameters", "none") and row["fault_found"]


def valid_set(effect: Json, same: SeparationTest | None = None) -> bool:
    """Return whether a set has at most two other members, each confusable with the named effect and not separated."""
    others = list(effect.get("indistinguishable_from") or [])
    if len(others) > 2 or any(other not in CONFUSABLE.get(effect["id"], ()) for other in others):
        return False
    return same is None or all(same(effect["id"], other) is not False for other in others)


def _correctness(effect: Json, true: str, same: SeparationTest | None) -> Correctness:
    if effect["id"] == true:
        return "exact"
    in_set = true in (effect.get("indistinguishable_from") or []) and valid_set(effect, same)
    return "in set" if in_set else "wrong"


def _found(effect: Json, true: str, same: SeparationTest | None) -> bool:
    return _correctness(effect, true, same) != "wrong"


def _detections(row: dict[str, Any], answer: Json, named: list[dict[str, Any]], same: SeparationTest | None) -> None:
    """Whether each concealed effect is named, at any rank, and whether each name is right; a name counts once."""
    found, row["names_right"] = assigned(row["true"], named, partial(_correctness, same=same))
    excesses = answer.get("single_excesses") or [answer["excess"]] * len(row["true"])
    row["detections"] = [
        {"id": true, "excess": excess, "found": is_found, "strict": true in row["named"]}
        for true, excess, is_found in zip(row["true"], excesses, found, strict=True)
    ]


def _single(row: dict[str, Any], answer: Json, named: list[dict[str, Any]], same: SeparationTest | None) -> None:
    truth = answer["effects"][0]
    first = named[0] if named else None
    row["strict_top1"] = first is not None and first["id"] == truth["id"]
    row["set_top1"] = first is not None and _found(first, truth["id"], same)
    row["set_size"] = len(first.get("indistinguishable_from") or []) if first is not None else 0
    if not row["set_top1"] or first is None:
        return
    where = first.get("where") or {}
    channels = list(where.get("channels") or [])
    row["channel_right"] = bool(channels) and channels[0] in answer["main_channels"]
    if truth["lag_s"] is not None:
        lag = where.get("lag_s")
        row["lag_error_s"] = abs(lag - truth["lag_s"]) if lag is not None else None
        row["lag_right"] = lag is not None and abs(lag - truth["lag_s"]) <= LAG_WITHIN_S
    if truth["time"] is not None:
        row["time_right"] = truth["time"] in str(where.get("time")).lower()
    if truth["place"] is not None:
        row["place_right"] = _near(where.get("place"), truth["place"])
    if row["strict_top1"] and truth["form"] == "catalogue":
        row["parameters"] = _parameters(first.get("parameters") or {}, truth["parameters"])


def _parameters(found: Json, true: Json) -> dict[str, dict[str, Any]]:
    rows = {}
    for name, value in true.items():
        entry = found.get(name)
        if entry is None or entry["value"] is None:
            continue
        error = entry["value"] - value
        if name == "direction":
            error = math.remainder(error, 2 * math.pi)
        low, high = entry.get("low90"), entry.get("high90")
        true_near_estimate = entry["value"] - error  # angles: same turn as the estimate
        rows[name] = {
            "true": value,
            "value": entry["value"],
            "relative_error": abs(error) / abs(value) if value else None,
            "covered": low <= true_near_estimate <= high if low is not None and high is not None else None,
        }
    return rows


def _outside(row: dict[str, Any], answer: Json, report: Json | None) -> None:
    row["is_spurious"] = bool(row["named"]) if row["reported"] else None
    row["is_random"] = answer["effects"][0]["form"] == "random"
    unexplained = (report or {}).get("unexplained") or {}
    channels = list(unexplained.get("channels") or [])
    row["main_channel_right"] = bool(channels) and channels[0] in answer["main_channels"]
    words = f"{unexplained.get('class') or ''} {unexplained.get('regime') or ''}".lower()
    groups = answer["effects"][0]["class_words"]
    row["class_right"] = bool(unexplained) and all(any(word in words for word in group) for group in groups)


def _ratios(row: dict[str, Any], report: Json | None, oracle: Json | None) -> None:
    refit, tool = _score(report, "refit"), _score(report, "with_effects")
    oracle_score = _score(oracle, "with_effects")
    if report is not None and report["verdict"] != "mismatch" and refit is not None:
        tool = refit  # no effect named
    if refit is None or tool is None:
        return
    row["refit_score"], row["tool_score"] = refit, tool
    if refit > 1.0:
        row["floor_ratio"] = (refit - tool) / (refit - 1.0)
    if oracle_score is not None and refit > oracle_score:
        row["oracle_ratio"] = (refit - tool) / (refit - oracle_score)


def _score(report: Json | None, which: str) -> float | None:
    held = ((report or {}).get("fit") or {}).get("held_out") or {}
    value = (held.get(which) or {}).get("score")
    return None if value is None else float(value)


def _near(place: Json | None, true: Json) -> bool:
    return place is not None and math.dist((place["x"], place["y"]), (true["x"], true["y"])) <= float(true["radius"])
