"""Child process that makes a case or runs the baselines on it; it reads its arguments (JSON) from standard input.

python -m carlab.benchmark.proof.worker make|baselines
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.benchmark.cases.seal import file_digest
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import read_csv, write_csv
from carlab.core.errors import DataError

FILES = ("fit.csv", "hold.csv", "car.toml")
ANSWER, SCORES = "answer.json", "scores.json"
ANOTHER_SEED = 10_000_000  # no set contains such seeds
ATTEMPTS = 12
"""Seeds of a case that are tried. With one seed in two, 30 draws of a random throttle map all resemble an effect."""


def make(order: dict[str, Any]) -> None:
    """Make the case ``spec`` in the working directory: its files, and its answer.

    If the car cannot be driven with the effect at any strength, or all draws of random physics resemble an effect of
    the catalogue, the case gets another, fixed seed.
    """
    spec = CaseSpec.from_dict(order["spec"])
    begin = time.perf_counter()
    for attempt in range(ATTEMPTS):
        try:
            case = dataclasses.replace(spec, seed=spec.seed + attempt * ANOTHER_SEED).make()
            break
        except DataError:
            if attempt == ATTEMPTS - 1:
                raise
    fit, hold, car = map(Path, FILES)
    write_csv(fit, case.fit)
    write_csv(hold, case.hold)
    case.nominal.write(car)
    answer = case.answer()
    answer["files"] = {file: file_digest(Path(file)) for file in FILES}
    answer["seconds_to_make"] = round(time.perf_counter() - begin, 3)
    write_json(Path(ANSWER), answer)


def baselines(order: dict[str, Any]) -> None:
    """Run every baseline on the case in the working directory with its noise ``floor``, and write the results."""
    from carlab.benchmark.baselines.run import require_studies, run_baselines

    require_studies()
    fit, hold, car = map(Path, FILES)
    write_json(Path(SCORES), run_baselines(read_csv(fit), read_csv(hold), BaseCar.read(car), order["floor"]))


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON object whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".partial")
    draft.write_text(json.dumps(value, indent=1, allow_nan=False), encoding="utf-8")
    draft.replace(path)


def main() -> int:
    """Run the command of the argument; exit status 1 and one sentence if it fails."""
    order = json.loads(sys.stdin.read())
    try:
        {"make": make, "baselines": baselines}[sys.argv[1]](order)
    except DataError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
