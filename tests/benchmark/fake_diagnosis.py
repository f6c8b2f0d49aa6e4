"""Fake diagnosis: read the input files, record the visible files, write a report."""

import json
import os
import sys
from pathlib import Path

arguments = sys.argv[1:]
out = Path(arguments[arguments.index("--out") + 1])
given_effects = arguments[arguments.index("--effects") + 1 :] if "--effects" in arguments else []
out.mkdir()
held_out = {"refit": {"score": 3.0}, "with_effects": {"score": 1.2 if given_effects else 1.6}}
report = {
    "schema": "carlab.diagnosis/1",
    "verdict": "mismatch",
    "effects": [
        {
            "id": given_effects[0] if given_effects else "steering_lag",
            "parameters": {},
            "indistinguishable_from": [],
            "where": {},
        }
    ],
    "fit": {"held_out": held_out},
    "data_faults": [],
    "seen": {"folder": str(Path.cwd()), "files": sorted(os.listdir()), "arguments": arguments},
}
(out / "report.json").write_text(json.dumps(report))
