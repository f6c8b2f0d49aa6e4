"""Fake carlab: the diagnosis of a reference copies the car file; any other answer names a steering offset."""

import json
import os
import shutil
import sys
from pathlib import Path

arguments = sys.argv[1:]
out = Path(arguments[arguments.index("--out") + 1])
car = arguments[arguments.index("--car") + 1]
out.mkdir()
if arguments[0] == "diagnose" and "--curves" in arguments:
    shutil.copyfile(car, out / "model.toml")
else:
    angle = {"value": 0.02, "std": 0.01, "low90": 0.0, "high90": 0.04, "unit": "rad"}
    change = {"id": "steering_offset", "parameters": {"angle": angle}, "indistinguishable_from": []}
    report = {"schema": "carlab.compare/1", "verdict": "changed", "changes": [change]}
    seen = {"folder": str(Path.cwd()), "files": sorted(os.listdir()), "arguments": arguments}
    (out / "compare.json").write_text(json.dumps({**report, "seen": seen}))
    diagnosis = {"schema": "carlab.diagnosis/1", "verdict": "mismatch", "effects": [change]}
    (out / "report.json").write_text(json.dumps(diagnosis))
