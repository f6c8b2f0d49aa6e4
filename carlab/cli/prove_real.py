"""``carlab prove --set real``."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from carlab.api.cars import load_car
from carlab.api.recordings import load
from carlab.benchmark.real.runner import RealProof
from carlab.benchmark.real.scores import add_visibility, kind_rows, rate_rows, real_results_page, score_comparison
from carlab.benchmark.world.measurement import COLUMNS
from carlab.cli.console import console, fail, table
from carlab.cli.recordings import recordings_in
from carlab.core.errors import ConfigError, DataError
from carlab.core.quantities import FloatArray
from carlab.recording.csv.export import table_of


def car_path(car: str, folder: Path) -> Path:
    """The car file, written to the folder if it is a preset."""
    if not car:
        raise ConfigError("--set real needs the car file of the recordings; add --car FILE.")
    if Path(car).is_file():
        return Path(car)
    file = load_car(car)
    text = file.text or tomli_w.dumps(file.simulator.to_tables())
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{car}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def tables_in(folder: Path | None) -> dict[str, dict[str, FloatArray]]:
    """Columns of the longest episode of each recording of a folder, rows with missing values left out.

    Raises:
        ConfigError: no folder is given, or it does not exist.
        DataError: it has no recording.
    """
    if folder is None:
        raise ConfigError("--set real needs --data FOLDER with recordings of one car; add it.")
    tables = {}
    for path in recordings_in(folder, min_count=1):
        try:
            whole = table_of(load(path).episode)
        except DataError as error:
            console.print(f"{path.name} is left out: {error}")
            continue
        columns = np.stack([whole[name] for name in COLUMNS])
        columns = columns[:, np.isfinite(columns).all(axis=0)]
        tables[path.name] = dict(zip(COLUMNS, columns, strict=True))
    return tables


def run_stages(proof: RealProof) -> bool:
    """Make and seal the cases, diagnose the references, and let the tool answer; whether all is done."""
    proof.make()
    return proof.diagnose_references() and proof.answer()


def score(proof: RealProof, out: Path, facts: Callable[[Mapping[str, Any]], dict[str, str]]) -> int:
    """Open the seal, score, print, and write scores.json and results.md."""
    answers = proof.open_seal()
    console.print("The seal is intact: the answers match the hash.")
    runs, models = proof.reports(), proof.models()
    rows = {
        name: score_comparison(answers[name], run["report"], models[name], run["seconds"]) for name, run in runs.items()
    }
    add_visibility(rows)
    table(f"{len(rows)} cases", ["figure", "value (95 %)", "n", "target"], rate_rows(rows))
    columns = ["kind", "small", "middle", "large", "size in its interval"]
    table("Named first, sets allowed, by size", columns, kind_rows(rows.values()))
    unreported = sum(row["verdict"] == "no report" for row in rows.values())
    if unreported:
        fail(f"{unreported} cases have no report; results.md lists them with the reasons.")
    (proof.root / "scores.json").write_text(json.dumps({"cases": rows}, indent=1) + "\n", encoding="utf-8")
    page = real_results_page(facts(runs), rows, runs)
    (proof.root / "results.md").write_text(page, encoding="utf-8")
    console.print(f"Read {out / 'results.md'}; all figures: scores.json.")
    return 0
