"""Child processes of a run: the imports are done, and the files of the parent are closed."""

from __future__ import annotations

import json
from pathlib import Path

from carlab.experiment.campaign.child_process import child_context

SOURCE = """
import json, os, pathlib, sys
names = [os.readlink(f"/proc/self/fd/{k}") for k in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{k}")]
pathlib.Path(%r).write_text(json.dumps({"modules": list(sys.modules), "open": names}))
"""


def test_child_has_the_imports_and_no_open_file_of_its_parent(tmp_path: Path) -> None:
    with (tmp_path / "port").open("w") as port:
        child = child_context().Process(target=exec, args=(SOURCE % str(tmp_path / "seen.json"),))
        child.start()
        child.join()
    seen = json.loads((tmp_path / "seen.json").read_text())
    assert {"torch", "carlab.experiment.campaign.training", "learning.policy.sac_agent"} <= set(seen["modules"])
    assert seen["open"]
    assert port.name not in seen["open"]
