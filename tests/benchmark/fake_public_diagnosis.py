"""Fake diagnosis of the public simulator: check the input files and name two effects."""

import json
import os
import sys
from pathlib import Path

arguments = sys.argv[1:]
out = Path(arguments[arguments.index("--out") + 1])
out.mkdir()


def effect(name: str, others: tuple[str, ...] = ()) -> dict[str, object]:
    value = {"value": 1.25, "low90": 1.2, "high90": 1.3, "unit": "rad/s"}
    evidence = {"held_out_error_reduction": 0.4, "deletion_fingerprint": {"yaw_rate": 0.3}}
    return {"id": name, "confidence": 0.9, "parameters": {"rate": value}, "indistinguishable_from": list(others),
            "where": {"channels": ["yaw_rate"]}, "evidence": evidence, "sentence": f"Left out: {name}."}  # fmt: skip


report = {
    "schema": "carlab.diagnosis/1",
    "verdict": "mismatch",
    "effects": [effect("steering_rate_limit", ("steering_lag",)), effect("battery_sag")],
    "fit": {"held_out": {"nominal": {"score": 9.0}, "refit": {"score": 4.0}, "with_effects": {"score": 1.5}}},
    "unexplained": None,
    "data_faults": [],
    "seen": {"files": sorted(os.listdir()), "arguments": arguments},
}
(out / "report.json").write_text(json.dumps(report))
