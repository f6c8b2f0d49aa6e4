"""Scores of a proof on real recordings: names, sizes, spurious names and false alarms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from typing import Any

import numpy as np

from carlab.benchmark.intervals import share_text
from carlab.benchmark.proof.matching import Correctness, assigned
from carlab.benchmark.proof.results_page import markdown, no_report
from carlab.benchmark.real.kinds import KINDS
from carlab.core.errors import DataError

CHANGES = {"carlab.compare/1": "changes", "carlab.diagnosis/1": "effects"}
"""Key of the named changes by schema of the report."""
VISIBLE_STDS = 2.0
"""A size counts as visible from this many standard deviations of the tool's estimate on."""
NAMEABLE_STDS = 6.0
"""A size that a test of about 50 candidates with 5 % false alarms and 15 degrees of freedom finds in 9 of 10 cases: the
two-sided quantile of Student's distribution at 0.05 / 50 is 4.1, a power of 0.9 needs 1.3 more; rounded up."""
IDENTITIES = {name: kind.identity for kind in KINDS for name in kind.names}
Json = Mapping[str, Any]
Rows = Mapping[str, Json]


def score_comparison(answer: Json, report: Json | None, model: Json, seconds: float | None = None) -> dict[str, Any]:
    """Score one case.

    Args:
        answer: The sealed answer, from ``make_real_case``.
        report: ``compare.json``, or ``report.json`` of a diagnosis; None if there is none.
        model: The reference's car file, parsed.
        seconds: Run time [s].

    Returns:
        A flat table. ``first`` and ``first_with_sets``: the first name is correct (of a pair: one of both); ``found``:
        concealed effects that are named or in a set, each by another name; ``spurious``: names that are not concealed.
        Rates of false alarms and spurious names leave cases without a report out.

    Raises:
        DataError: the report has another schema.
    """
    if report is not None and report.get("schema") not in CHANGES:
        raise DataError(f"The report has schema {report.get('schema')!r}; known: {', '.join(CHANGES)}.")
    changes = [] if report is None else list(report[CHANGES[report["schema"]]])
    row: dict[str, Any] = {
        "kind": answer["kind"],
        "true": [e["id"] for e in answer["effects"]],
        "size_index": [e["size_index"] for e in answer["effects"]],
        "part": answer["part"],
        "seconds": seconds,
        "verdict": "no report" if report is None else report["verdict"],
        "named": [change["id"] for change in changes],
        "sets": [list(change.get("indistinguishable_from") or []) for change in changes],
    }
    if answer["kind"] == "null":
        return {**row, "false_alarm": bool(changes)}
    true = [set(e["names"]) for e in answer["effects"]]
    in_set = [{change["id"], *(change.get("indistinguishable_from") or [])} for change in changes]
    row["first"] = bool(changes) and any(changes[0]["id"] in names for names in true)
    row["first_with_sets"] = bool(changes) and any(in_set[0] & names for names in true)
    row["found"] = sum(assigned(true, changes, _correctness)[0])
    row["spurious"] = [
        c["id"] for c, members in zip(changes, in_set, strict=True) if not any(members & n for n in true)
    ]
    row["sizes"] = [
        size
        for effect in answer["effects"]
        for change in changes
        if change["id"] in effect["names"]
        for size in _sizes(effect, change, model)
    ]
    if len(answer["effects"]) == 1 and not row["sizes"]:
        row["unnamed_stds"] = _unnamed_stds(answer["effects"][0], report, model)
    return row


def _correctness(change: Json, names: Set[str]) -> Correctness:
    if change["id"] in names:
        return "exact"
    return "in set" if names & set(change.get("indistinguishable_from") or []) else "wrong"


def _unnamed_stds(effect: Json, report: Json | None, model: Json) -> float | None:
    """True size in standard deviations of the tool's estimate of an effect that it does not name."""
    truth, estimates = effect["truth"][0], report or {}
    for name in effect["names"]:
        limits = estimates.get("limits", {}).get(name, {})
        parameter = next(iter(limits)) if len(limits) == 1 else truth["parameter"]
        if parameter in limits:
            return _size({**truth, "parameter": parameter}, name, model) / max(float(limits[parameter]["std"]), 1e-12)
    for tested in estimates.get("tested", []):
        values = tested["parameters"]
        if tested["id"] in effect["names"] and len(values) == 1 and tested["standard_errors"] > 0.0:
            size = _size(truth, tested["id"], model)
            if math.isinf(size):
                return None
            return size * float(tested["standard_errors"]) / max(abs(float(next(iter(values.values())))), 1e-12)
    return None


def _size(truth: Json, name: str, model: Json) -> float:
    """Distance of the changed car's value from that of the reference's car file."""
    return abs(true_value(truth, name, model) - _before(name, truth["parameter"], model))


def _sizes(effect: Json, change: Json, model: Json) -> list[dict[str, Any]]:
    """True and estimated value of each parameter of a named effect."""
    found = []
    estimates = change["parameters"]
    for concealed in effect["truth"]:
        # Another correct name has another name of its only parameter.
        parameter = concealed["parameter"] if len(estimates) > 1 else next(iter(estimates), "")
        if parameter not in estimates:
            continue
        estimate, truth = estimates[parameter], {**concealed, "parameter": parameter}
        before = _before(change["id"], parameter, model)
        value = true_value(truth, change["id"], model)
        size = abs(value - before)
        if "reference" in change:  # a comparison reports changes
            value = _true_change(truth, change, value, before)
        found.append({
            "parameter": f"{change['id']}.{parameter}", "true": value, "value": estimate["value"],
            "std": estimate["std"], "covered": estimate["low90"] <= value <= estimate["high90"],
            "stds": size / max(estimate["std"], 1e-12) if math.isfinite(size) else None,
        })  # fmt: skip
    return found


def _true_change(truth: Json, change: Json, value: float, before: float) -> float:
    """Change of a parameter in a comparison, from its value in the first group."""
    reference = change["reference"]
    first = float(reference.get(truth["parameter"], next(iter(reference.values()))))
    changes = {"adds": value - before, "multiplies": first * (float(truth["size"]) - 1.0), "replaces": value - first}
    return changes[truth["composes"]]


def true_value(truth: Json, name: str, model: Json) -> float:
    """Value of a parameter for the changed car: the reference's value, changed by the concealed size."""
    size = float(truth["size"]) * (_base_value("steering.max_angle", model) if truth["per_lock"] else 1.0)
    before = _before(name, truth["parameter"], model)
    return {"adds": before + size, "multiplies": before * size, "replaces": size}[truth["composes"]]


def _before(name: str, parameter: str, model: Json) -> float:
    """The parameter in the reference's car file; its identity if the effect is absent."""
    if "." in name:
        return _base_value(name, model)
    entry = model.get("effects", {}).get(name, {}).get(parameter)
    if entry is None and parameter == "latency":
        entry = model.get("mocap", {}).get("latency", 0.0)
    return IDENTITIES.get(name, 0.0) if entry is None else _number(entry)


def _base_value(name: str, model: Json) -> float:
    entry: Any = model
    for key in name.split("."):
        entry = entry[key]
    return _number(entry)


def _number(entry: Any) -> float:
    return float(entry["value"] if isinstance(entry, Mapping) else entry)


def add_visibility(rows: Rows) -> None:
    """Set ``stds`` of each single case: its size in standard deviations of the tool.

    An effect that is not named takes its linear estimate, if the report has one. Otherwise it takes the median ratio of
    size to deviation of the named cases of its kind and size; without any such case it stays None. It stays None too
    for an effect with an infinite identity, whose size is not finite.
    """
    singles = [row for row in rows.values() if row["kind"] == "single"]
    for row in singles:
        own = [size["stds"] for size in row["sizes"] if size["stds"] is not None]
        row["stds"] = max(own) if own else row.get("unnamed_stds")  # type: ignore[index]
    for row in singles:
        if row["stds"] is None:
            alike = [
                other["stds"]
                for other in singles
                if other["true"] == row["true"]
                and other["sizes"]
                and other["size_index"] == row["size_index"]
                and other["stds"] is not None
            ]
            row["stds"] = float(np.median(alike)) if alike else None  # type: ignore[index]


def _single(row: Json) -> bool:
    return bool(row["kind"] == "single")


def _visible(row: Json, min_stds: float = VISIBLE_STDS) -> bool:
    return _single(row) and row["stds"] is not None and row["stds"] >= min_stds


def _reported(row: Json) -> bool:
    return bool(row["verdict"] != "no report")


def _nameable(row: Json) -> bool:
    return _visible(row, NAMEABLE_STDS)


def _untouched(row: Json) -> bool:
    return row["kind"] == "null" and _reported(row)


RATES: tuple[tuple[str, Callable[[Json], bool], Callable[[Json], Any], str], ...] = (
    ("named first, sets allowed, size at least 2 std", _visible, lambda r: r["first_with_sets"], ">= 0.90"),
    ("named first, strictly, size at least 2 std", _visible, lambda r: r["first"], ""),
    ("named first, sets allowed, size at least 6 std", _nameable, lambda r: r["first_with_sets"], ""),
    ("named first, sets allowed, all sizes", _single, lambda r: r["first_with_sets"], ""),
    ("named first, strictly, all sizes", _single, lambda r: r["first"], ""),
    ("cases with a spurious name", lambda r: r["kind"] != "null" and _reported(r), lambda r: bool(r["spurious"]), ""),
    ("pairs: both found", lambda r: r["kind"] == "pair", lambda r: r["found"] == 2, ""),
    ("false alarms, untouched recordings", _untouched, lambda r: r["false_alarm"], "<= 0.05"),
)


def rate_rows(rows: Rows) -> list[tuple[str, str, str, str]]:
    """Rows (figure, share with Wilson interval, cases, target)."""
    found = [
        _rate(title, [bool(hit(r)) for r in rows.values() if among(r)], target) for title, among, hit, target in RATES
    ]
    sizes = [size for r in rows.values() if r["kind"] != "null" for size in r["sizes"]]
    found.append(_rate("size within its 90 % interval", [s["covered"] for s in sizes], "0.80 to 0.97"))
    errors = [abs(s["value"] - s["true"]) / s["std"] for s in sizes if s["std"] > 0.0 and math.isfinite(s["value"])]
    seconds = [r["seconds"] for r in rows.values() if r["seconds"] is not None]
    for title, values in (("error of a size in its standard deviations, median", errors), ("seconds, median", seconds)):
        found.append((title, f"{np.median(values):.2g}" if values else "-", str(len(values)), ""))
    return found


def _rate(title: str, hits: Sequence[bool], target: str) -> tuple[str, str, str, str]:
    return title, share_text(sum(hits), len(hits)), f"{sum(hits)}/{len(hits)}", target


def kind_rows(rows: Iterable[Json]) -> list[tuple[str, ...]]:
    """One row per kind: correct first names (sets allowed) of cases at the small, middle and large size, and sizes."""
    table: dict[str, list[Json]] = {}
    for row in rows:
        if row["kind"] == "single":
            table.setdefault(row["true"][0], []).append(row)
    found = []
    for kind, cases in sorted(table.items()):
        by_size = [[c["first_with_sets"] for c in cases if c["size_index"] == [k]] for k in range(3)]
        sizes = [size["covered"] for c in cases for size in c["sizes"]]
        hits = [f"{sum(group)}/{len(group)}" if group else "-" for group in by_size]
        found.append((kind, *hits, f"{sum(sizes)}/{len(sizes)}" if sizes else "-"))
    return found


def real_results_page(facts: Mapping[str, str], rows: Rows, runs: Rows) -> str:
    """Results as Markdown: command, figures, kinds, failures."""
    parts = ["# Concealed in real recordings", "\n".join(f"* {name}: {value}" for name, value in facts.items())]
    parts.append(markdown(("figure", "value (95 %)", "n", "target"), rate_rows(rows)))
    parts.append("## Each kind: named first (sets allowed), by size")
    columns = ("kind", "small", "middle", "large", "size in its interval")
    parts += [markdown(columns, kind_rows(rows.values())), "## Failures", "\n".join(_failures(rows, runs)) or "None."]
    return "\n\n".join(parts) + "\n"


def _failures(rows: Rows, runs: Rows) -> list[str]:
    lines = []
    for name, row in sorted(rows.items(), key=lambda item: (item[1]["kind"], item[1]["true"], item[0])):
        is_right = not row["false_alarm"] if row["kind"] == "null" else row["first_with_sets"] and not row["spurious"]
        if is_right and _reported(row):
            continue
        sizes = ", ".join(("small", "middle", "large")[k] for k in row["size_index"])
        true = f"{' + '.join(row['true'])} ({sizes})" if row["true"] else "nothing"
        answered = f"answered {' + '.join(row['named']) or row['verdict']}" if _reported(row) else no_report(runs[name])
        lines.append(f"* {name}: {row['kind']}, {true}: {answered}")
    return lines
