"""The results of a proof as Markdown: what was run, every figure, every effect, every failure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from carlab.concealment.baseline_scores import COLUMNS, comparison_rows
from carlab.concealment.scores import per_effect, table_rows

Row = Mapping[str, Any]


def results_page(
    facts: Mapping[str, str],
    rows: Mapping[str, Row],
    runs: Mapping[str, Mapping[str, Any]],
    summary: Mapping[str, Any],
    comparison: Sequence[Mapping[str, Any]],
) -> str:
    """The page.

    Args:
        facts: What was run, as pairs of a word and a value.
        rows: One row a case from ``judge_all``.
        runs: What ``Proof.reports`` gave.
        summary: From ``summarise``.
        comparison: From ``compare``; empty where no baselines were run.
    """
    parts = ["# Proof on concealed effects", "\n".join(f"* {name}: {value}" for name, value in facts.items())]
    parts.append(markdown(("figure", "value", "n", "asked"), table_rows(summary)))
    if comparison:
        parts += [
            "## Beside the baselines",
            "Sets are not available to the baselines, so the tool's names count strictly here. Their scores are by the "
            "generator's model and the true noise floor, the tool's by its own of both.",
            markdown(("figure", *COLUMNS), comparison_rows(comparison)),
        ]
    found = [
        (name, str(e["strict"]), str(e["with_sets"]), str(e["cases"])) for name, e in per_effect(rows.values()).items()
    ]
    parts += ["## Effect by effect", markdown(("effect", "strictly first", "with sets", "cases"), found)]
    parts += ["## What went wrong", failures(rows, runs)]
    return "\n\n".join(parts) + "\n"


def failures(rows: Mapping[str, Row], runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Every case that was not answered rightly, one line each."""
    lines = []
    for name, row in sorted(rows.items(), key=lambda item: (item[1]["kind"], item[1]["true"], item[0])):
        run = runs.get(name, {})
        true = " + ".join(row["true"]) or row["kind"]
        said = " + ".join(row["named"]) or row["verdict"]
        strength = f", excess {row['excess']:.1f}" if row["excess"] else ""
        if not row["reported"]:
            words = str(run.get("words", "")).strip().splitlines()
            why = "took too long" if run.get("exit_status") is None else f"exit status {run['exit_status']}"
            lines.append(f"* {name}: {row['kind']} {true}: no report ({why}): {words[-1] if words else ''}")
        elif not right(row):
            lines.append(f"* {name}: {row['kind']} {true}{strength}: said {said}")
    return "\n".join(lines) or "Nothing."


def right(row: Row) -> bool:
    """Whether a case was answered rightly, by the measure of its kind."""
    if row["kind"] == "single":
        return bool(row["set_top1"])
    if row["kind"] == "pair":
        return bool(row["both_found"])
    if row["kind"] == "outside":
        return not row["forced"] and bool(row["main_channel_right"])
    return bool(row["verdict_right"])


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join(["| " + " | ".join(cells) + " |" for cells in (columns, ["---"] * len(columns), *rows)])
