"""Page of the study on a public simulator: drive, diagnosis, and comparison with the equations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from carlab.benchmark.proof.results_page import markdown
from carlab.benchmark.public_simulators.commonroad import DRIVER_GRIP, FULL_THROTTLE_MPS2, MAX_ANGLE_RAD, SCALE

TARGET_RATIO = 0.5
PRESENCE_TEXTS = {
    "yes": "in the equations",
    "similar": "resembles a term of the equations",
    "no": "not in the equations",
}


def study_page(facts: dict[str, Any], rows: Sequence[dict[str, Any]]) -> str:
    """Page from the content of study.json."""
    parts = [
        "# Diagnosis of recordings of an independent simulator",
        f"{facts['package']}, scaled by {SCALE:g} in length and by dynamic similarity in all else. Full steering is "
        f"{MAX_ANGLE_RAD:g} rad, full throttle requests {FULL_THROTTLE_MPS2:g} m/s2; the package limits both. A "
        f"simulated person drives without stopping and uses {DRIVER_GRIP:.0%} of the grip of the tyres. "
        f"{facts['seconds_to_fit']:g} s are fitted and {facts['seconds_held_out']:g} s held out, at 30 Hz, with noise "
        "on the pose and velocities differentiated from it. The nominal car file has measured mass, axle distances "
        "and delays, and guesses for all other parameters.",
        f"Target: held-out error with effects at most {TARGET_RATIO:g} of the refit's. {_verdict(rows)}",
        markdown(
            ("seed", "verdict", "nominal", "refit", "with effects", "ratio", "named", "seconds"),
            [_score_cells(row) for row in rows],
        ),
    ]
    for row in rows:
        parts.append(f"## Seed {row['seed']}")
        if row["verdict"] is None:
            last = str(row["output"]).strip().splitlines()[-1:] or ["no output"]
            parts.append(f"No report (exit status {row['exit_status']}): {last[0]}")
            continue
        parts += [f"**{e['id']}**: {e['sentence'] or 'no sentence'}\n\n{_evidence(e)}" for e in row["named"]]
        if row["unexplained"]:
            left = row["unexplained"]
            parts.append(
                f"Unexplained: {left.get('share', math.nan):.0%} of the refit's squared excess, channels "
                f"{', '.join(left.get('channels', [])) or 'none'}; {left.get('class') or 'no class'}"
                + (f"; {left['formula']}" if left.get("formula") else "")
                + "."
            )
        if row["data_faults"]:
            parts.append(f"Data faults reported: {', '.join(row['data_faults'])}. The recording has none.")
        parts.append(markdown(("range of the drive", "value"), [(k, f"{v:g}") for k, v in row["activity"].items()]))
    return "\n\n".join(parts) + "\n"


def _verdict(rows: Sequence[dict[str, Any]]) -> str:
    met = [row for row in rows if row.get("ratio") is not None and row["ratio"] <= TARGET_RATIO]
    named = [effect["in_equations"] for row in rows for effect in row.get("named", [])]
    counts = ", ".join(f"{named.count(presence)} {words}" for presence, words in PRESENCE_TEXTS.items())
    return f"Met for {len(met)} of {len(rows)} seeds. Names given: {len(named)} ({counts})."


def _score_cells(row: dict[str, Any]) -> tuple[str, ...]:
    scores = row.get("scores", {})
    values = [f"{scores[name]:.2f}" if name in scores else "" for name in ("nominal", "refit", "with_effects")]
    ratio = f"{row['ratio']:.2f}" if row.get("ratio") is not None else ""
    names = ", ".join(effect["id"] for effect in row.get("named", [])) or "nothing"
    return (str(row["seed"]), row["verdict"] or "no report", *values, ratio, names, f"{row['seconds']:.0f}")


def _evidence(effect: dict[str, Any]) -> str:
    given = {k: v for k, v in (effect["evidence"] or {}).items() if isinstance(v, int | float)}
    cells = [(k.replace("_", " "), f"{v:.3g}") for k, v in given.items()]
    cells += [(name, _value(p, effect["true_values"].get(name))) for name, p in (effect["parameters"] or {}).items()]
    others = [f"{name} ({PRESENCE_TEXTS[presence]})" for name, presence in effect["others"].items()]
    cells += [("indistinguishable from", ", ".join(others))] if others else []
    cells.append((f"the package: {PRESENCE_TEXTS[effect['in_equations']]}", effect["why"]))
    return markdown(("evidence", "value"), cells)


def _value(parameter: dict[str, Any], truth: float | None) -> str:
    unit = f" {parameter['unit']}" if parameter.get("unit") else ""
    words = f"{parameter['value']:.3g}{unit}"
    if parameter.get("low90") is not None and parameter.get("high90") is not None:
        words += f" ({parameter['low90']:.3g} to {parameter['high90']:.3g})"
    return words if truth is None else f"{words}; in the package {truth:.3g}"
