"""Results of a proof as Markdown: command, figures, effects, failures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from carlab.benchmark.baselines.scores import COLUMNS, comparison_rows
from carlab.benchmark.proof.detection import BINS, curve_rows, detection_curves, spurious_curves
from carlab.benchmark.proof.probabilities import bin_rows, brier_score, probability_bins
from carlab.benchmark.proof.scores import per_effect, table_rows

Row = Mapping[str, Any]
DETECTION = (
    "Share of concealed effects that are named (at any rank, sets allowed) by the excess of each effect alone, with "
    "95 % Wilson intervals and counts."
)
PROBABILITIES = (
    "Names of all reports by the probability that the report states, and the share that is correct. In a set of "
    "indistinguishable effects only the first name counts. Brier score {:.3f}."
)


def results_page(
    facts: Mapping[str, str],
    rows: Mapping[str, Row],
    runs: Mapping[str, Mapping[str, Any]],
    summary: Mapping[str, Any],
    comparison: Sequence[Mapping[str, Any]],
) -> str:
    """Return the page.

    Args:
        facts: Command, date, versions, as name and value.
        rows: Rows by case, from ``score_cases``.
        runs: Reports by case, from ``Proof.reports``.
        summary: From ``summarise``.
        comparison: From ``compare``; empty without baselines.
    """
    parts = ["# Proof on concealed effects", "\n".join(f"* {name}: {value}" for name, value in facts.items())]
    parts.append(markdown(("figure", "value", "n", "target"), table_rows(summary)))
    if comparison:
        parts += [
            "## Comparison with the baselines",
            "Baselines cannot answer with sets, so names count strictly here. Scores of the baselines use the "
            "generator's model and the true noise floor. Scores of the diagnosis (column tool) use neither.",
            markdown(("figure", *COLUMNS), comparison_rows(comparison)),
        ]
    parts += ["## Detection curves", DETECTION, "![Share of effects found over the excess](detection.png)"]
    parts.append(markdown(("cases", *BINS), curve_rows(detection_curves(rows.values()))))
    spurious = curve_rows(spurious_curves(rows.values()))
    if spurious:
        parts += ["Cases outside the catalogue with a spurious name:", markdown(("physics", *BINS), spurious)]
    bins = probability_bins(rows.values())
    if bins:
        parts += ["## Stated probabilities", PROBABILITIES.format(brier_score(rows.values()))]
        parts.append(markdown(("stated probability", "mean", "names that are correct", "n"), bin_rows(bins)))
    effects = [
        (name, f"{e['strict']}/{e['alone']}", f"{e['with_sets']}/{e['alone']}", f"{e['named']}/{e['cases']}")
        for name, e in per_effect(rows.values()).items()
    ]
    columns = ("effect", "alone: strictly first", "alone: first, with sets", "named, alone or with others")
    parts += ["## Each effect", markdown(columns, effects)]
    parts += ["## Failures", failures(rows, runs)]
    return "\n\n".join(parts) + "\n"


def failures(rows: Mapping[str, Row], runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Return one line for each case with a wrong answer."""
    lines = []
    for name, row in sorted(rows.items(), key=lambda item: (item[1]["kind"], item[1]["true"], item[0])):
        true = " + ".join(row["true"]) or row["kind"]
        answered = " + ".join(row["named"]) or row["verdict"]
        strength = f", excess {row['excess']:.1f}" if row["excess"] else ""
        strength += "".join(f", {condition}" for condition in row["conditions"])
        if not row["reported"]:
            lines.append(f"* {name}: {row['kind']} {true}: {no_report(runs[name])}")
        elif not right(row):
            lines.append(f"* {name}: {row['kind']} {true}{strength}: answered {answered}")
    return "\n".join(lines) or "None."


def no_report(run: Mapping[str, Any]) -> str:
    """Return why a case has no report: the exit status and the last line of the output, from ``run.json``."""
    status, lines = run.get("exit_status"), run.get("output", "").strip().splitlines()
    return f"no report{'' if status is None else f' (exit status {status})'}: {lines[-1] if lines else ''}"


def right(row: Row) -> bool:
    """Return whether the answer to a case is correct, by the criterion of its kind."""
    if row["kind"] == "single":
        return bool(row["set_top1"])
    if row["kind"] == "pair":
        return bool(row["both_found"])
    if row["kind"] == "multiple":
        return all(d["found"] for d in row["detections"]) and all(row["names_right"])
    if row["kind"] == "outside":
        return not row["is_spurious"] and bool(row["main_channel_right"])
    return bool(row["verdict_right"])


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join(["| " + " | ".join(cells) + " |" for cells in (columns, ["---"] * len(columns), *rows)])
