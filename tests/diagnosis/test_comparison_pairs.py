"""Study of comparisons on pairs of groups of drives from an independent generator, with one concealed change or none.

Run it with ``pytest -m slow tests/diagnosis/test_comparison_pairs.py -s``; it takes half an hour on one core.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.cases.scene import Concealed, Scene
from carlab.benchmark.effects.catalogue import EFFECT_IDS, are_confusable
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.measurement import as_table
from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.comparison.compare import compare
from carlab.diagnosis.comparison.result import Comparison
from tests.helpers.case_files import car_in, imported

LENGTHS_S = (60.0, 60.0, 60.0, 60.0)
"""Two drives of each group."""
PERIOD_S = 1.0 / 30.0
PAIRS, SAME = 30, 20
EXCESSES = (1.0, 2.0, 4.0)


def drives(scene: Scene, concealed: Sequence[Concealed], parts: slice, folder: Path) -> list[EpisodeData]:
    """Recordings of these parts of the scene, driven with the concealed effects, as a user would import them."""
    found = []
    for k, recording in enumerate(scene.drive(concealed)[1][parts]):
        found += imported(as_table(recording), folder / f"{k}.csv")
    return found


def compared(seed: int, change: str | None, excess: float, folder: Path) -> Comparison:
    """Compare two drives of a car whose base parameters are wrong with two others, with one more effect or without."""
    forms = all_forms()
    form = None
    if change is not None:  # one effect has another form only
        form = forms[(change, "catalogue" if (change, "catalogue") in forms else "other")]
    model = "linear_tyre" if form is not None and form.nominal_kind == "linear_tyre" else "dynamic"
    scene = Scene(seed, model, LENGTHS_S, PERIOD_S)
    concealed = [] if form is None else [scene.sized(form, excess)[0]]
    first = drives(scene, (), slice(0, 2), folder)
    second = drives(scene, concealed, slice(2, 4), folder)
    scene.nominal.write(folder / "car.toml")
    return compare(first, second, car_in(folder))


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_concealed_change_is_named_first(tmp_path: Path) -> None:
    """An effect of an excess of at least 1 is added in the second group."""
    rng = np.random.default_rng(7)
    names = [str(name) for name in rng.permutation(EFFECT_IDS)[:PAIRS]]
    in_sets = alike = 0
    for k, name in enumerate(names):
        excess = EXCESSES[k % len(EXCESSES)]
        found = compared(5000 + k, name, excess, tmp_path)
        first = found.changes[0] if found.changes else None
        named = () if first is None else (first.id, *first.indistinguishable_from)
        in_sets += name in named
        alike += first is not None and (first.id == name or are_confusable(first.id, name))
        changes = [(c.id, c.indistinguishable_from, round(c.standard_errors, 1)) for c in found.changes]
        print(f"{name} ({excess:g}): {changes}", flush=True)
    print(f"named first: {in_sets} of {PAIRS} with sets, {alike} of {PAIRS} itself or a confusable effect")
    assert in_sets >= 0.8 * PAIRS


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_same_car_shows_no_change(tmp_path: Path) -> None:
    verdicts = [compared(6000 + k, None, 0.0, tmp_path) for k in range(SAME)]
    changed = [[c.id for c in found.changes] for found in verdicts if found.changes]
    print(f"{len(changed)} of {SAME} pairs without a change have one: {changed}")
    assert len(changed) <= 0.1 * SAME
