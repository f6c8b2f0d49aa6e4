"""The correction of the prior after an episode, in another process: test of the corrections, and diagnosis.

The result is a file in the model folder of the episode (``models/0003/repair.json``). A failure leaves the prior
unchanged; the run continues.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.core.errors import CarlabError, DataError
from carlab.core.json_files import read_json
from carlab.core.toml_files import toml_tables
from carlab.experiment.campaign.child_process import ChildError, run_in_child
from carlab.experiment.campaign.prior_correction import (
    PARAMETERS,
    Correction,
    Findings,
    PriorVersion,
    corrected,
    next_version,
    without_ranges,
)
from carlab.experiment.campaign.quick_check import CHECK_FILE, MIN_DIAGNOSIS_EPISODES
from carlab.recording.atomic_files import write_json
from carlab.recording.mcap.source import has_ticks, read_episode
from carlab.recording.run_folder import RunDirectory
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.registry import REGISTRY

if TYPE_CHECKING:
    from carlab.core.episode_data import EpisodeData
    from carlab.diagnosis.findings import Diagnosis

CORRECTION_FILE = "repair.json"  # Older run folders have files of this name.
DIAGNOSIS_BUDGET_S = 60.0
"""Time limit of a diagnosis between two episodes [s]."""
EPISODES_BETWEEN_DIAGNOSES = 3
HELD_OUT_EVERY = 3
"""Every third episode is held out from a diagnosis."""


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Input of a correction of the prior.

    Attributes:
        recordings: all recordings of the run.
        car_toml: simulator of the car file.
        before: the current version of the prior.
        folder: model folder of the newest episode, with the file of its quick check.
        budget_s: time limit of a diagnosis [s].
    """

    recordings: tuple[Path, ...]
    car_toml: str
    before: PriorVersion
    folder: Path
    budget_s: float = DIAGNOSIS_BUDGET_S


def correction_path(run: RunDirectory, episode: int) -> Path:
    """File of the correction after an episode."""
    return run.models / f"{episode:04d}" / CORRECTION_FILE


def read_version(run: RunDirectory, episode: int) -> PriorVersion | None:
    """The version of the prior after an episode; None if there is none. Raises DataError for an invalid file."""
    path = correction_path(run, episode)
    if not path.is_file():
        return None
    try:
        return PriorVersion.from_dict(read_json(path, keep_infinite=True))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise DataError(f"{path} cannot be read ({error}); remove it, and the run repeats the correction.") from error


def run_correction_subprocess(
    request: CorrectionRequest, stop: Callable[[], bool] = lambda: False
) -> PriorVersion | None:
    """Correct the prior in another process, and save the new version; None if ``stop`` ended it.

    Raises:
        DataError: the file cannot be written.
    """
    try:
        version: PriorVersion | None = run_in_child(
            "correction of the prior", correct_prior, (request,), stop, expected=(CarlabError, OSError, ValueError)
        )
    except ChildError as error:
        version = _failed(request, f"its process died ({error})" if error.end == "died" else str(error))
    if version is None:
        return None
    write_json(request.folder / CORRECTION_FILE, version.to_dict())
    return version


def correct_prior(request: CorrectionRequest) -> PriorVersion:
    """The next version of the prior. Raises CarlabError if a recording cannot be read."""
    car = SimulatorConfig.from_tables(toml_tables(request.car_toml))
    episodes = [read_episode(path) for path in request.recordings if has_ticks(path)]
    number = len(request.recordings)
    check: dict[str, Any] = read_json(request.folder / CHECK_FILE, keep_infinite=True)
    newest = episodes[-1] if episodes and has_ticks(request.recordings[-1]) else None
    tested = [c for c in request.before.corrections if c.episodes < number]
    contradicted = contradicted_by(newest, car, request.before.corrections, tested) if newest is not None else ()
    found = Findings(number, check, contradicted)
    is_due = number - max(request.before.diagnosed, 1) >= EPISODES_BETWEEN_DIAGNOSES
    is_needed = check.get("verdict") == "left" or bool(contradicted)
    if len(episodes) >= MIN_DIAGNOSIS_EPISODES and is_due and is_needed:
        found = diagnosed(found, episodes, without_ranges(car), request.budget_s)
    return next_version(request.before, car, found)


def contradicted_by(
    newest: EpisodeData, car: SimulatorConfig, corrections: Sequence[Correction], tested: Sequence[Correction]
) -> tuple[str, ...]:
    """Ids of the corrections without which an episode is predicted better, by backward elimination.

    The loss is Huber's over the windows of the episode, which no tested correction was fitted to. The other
    corrections of the current prior remain.
    """
    from carlab.diagnosis.quick.quick_check import held_out_loss

    kept, removed = list(corrections), []
    while candidates := [c for c in kept if c in tested]:
        without = [[other for other in kept if other is not c] for c in candidates]
        losses = held_out_loss(newest, [corrected(car, each) for each in (kept, *without)])
        if losses is None or min(losses[1:]) >= losses[0]:
            break
        worst = losses.index(min(losses[1:])) - 1
        kept = without[worst]
        removed.append(candidates[worst].id)
    return tuple(removed)


def diagnosed(found: Findings, episodes: Sequence[EpisodeData], car: SimulatorConfig, budget_s: float) -> Findings:
    """The findings with a diagnosis of all episodes, of which every third is held out."""
    from carlab.diagnosis.diagnose import diagnose
    from carlab.diagnosis.recordings import Inconclusive
    from carlab.diagnosis.state_alignment import align_states

    aligned = [align_states(e, car.latency_s()) for e in episodes]
    held_out = aligned[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY]
    fit = [e for k, e in enumerate(aligned) if k % HELD_OUT_EVERY != HELD_OUT_EVERY - 1]
    try:
        outcome = diagnose(fit, held_out, car, budget_s=budget_s)
    except Inconclusive as error:
        return replace(found, diagnosis=error.verdict)
    verdict, is_complete = outcome.diagnosis.verdict, outcome.diagnosis.search.is_complete
    supported = verdict in ("mismatch", "parameters", "none")
    corrections = corrections_of(outcome.diagnosis, outcome.model, found.episodes) if supported else None
    return replace(found, diagnosed=corrections, diagnosis=verdict, is_complete=is_complete)


def corrections_of(diagnosis: Diagnosis, model: SimulatorConfig, episodes: int) -> tuple[Correction, ...]:
    """Effects of a diagnosis that hold on its held-out episodes, and its parameters; none for the verdict "none"."""
    if diagnosis.verdict == "none":
        return ()
    values = model.values()
    corrections = []
    for effect in diagnosis.effects:
        if effect.evidence.held_out_error_reduction <= 0.0:
            continue
        own = {name: value for name, value in values.items() if name.startswith(f"effects.{effect.id}.")}
        std = {f"effects.{effect.id}.{name}": estimate.std for name, estimate in effect.parameters.items()}
        rise = 100.0 * effect.evidence.held_out_error_reduction
        why = f"its removal raises the error of held-out episodes by {rise:.0f} %"
        corrections.append(Correction(effect.id, own, _valid(std, values), episodes, "diagnosis", why))
    refitted = {name: values[name] for name in diagnosis.parameters if name in values}
    std = _valid({name: estimate.std for name, estimate in diagnosis.parameters.items()}, values)
    if refitted:
        why = f"fitted to {episodes} episodes"
        corrections.append(Correction(PARAMETERS, refitted, std, episodes, "diagnosis", why))
    return tuple(corrections)


def _valid(std: dict[str, float], values: dict[str, float]) -> dict[str, float]:
    return {
        name: s
        for name, s in std.items()
        if name in values and not REGISTRY[name].choices and 0.0 < s < math.inf and math.isfinite(values[name])
    }


def _failed(request: CorrectionRequest, reason: str) -> PriorVersion:
    text = f"The correction of the prior after episode {len(request.recordings)} failed ({reason.rstrip('.')})"
    return replace(request.before, sentence=f"{text}; the prior is unchanged.")
