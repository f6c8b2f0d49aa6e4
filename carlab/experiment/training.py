"""Between two episodes: learn the car from all that was recorded, and a policy in the learned car, in another process.

The process that drives only waits, its car in neutral. What was learned appears in the run's folder at once and whole
(``models/0003``), or not at all.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import shutil
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from carlab.core.clock import MonotonicClock
from carlab.core.documents import EpisodeEnded, Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import CarlabError, DataError, DivergedError
from carlab.core.observation import encode
from carlab.core.quantities import FloatArray
from carlab.core.safety import SafetyEnvelope
from carlab.core.state_estimator import StateEstimator
from carlab.core.task import ParkingTask
from carlab.recording.episode_builder import VELOCITY_DELAY
from learning.car_fit import LearnedCar, Method
from learning.history import find_history
from learning.simulator_model import CarModel, known_ranges
from learning.transitions import Transitions, has_whole_step, transitions_of
from sim_backends.car_parameters import SimulatorConfig

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger(__name__)

DYNAMICS_FILE = "dynamics.pt"
FIGURES_FILE = "training.json"
POLL_S = 0.1
JUDGED_CARS = 64
PARKED_BONUS, PARKED_WORTH = 0.3, 10.0
"""What a policy gets in the learned car for each tick at which it counts as parked, beside the task's reward, and what
parking always is worth when it is judged. The paper's reward falls by 2 % from the goal to 0.2 m away: by it alone two
of four runs came to stand 0.21 m away in their third episode."""
LATER_S = 0.12
"""How much later the safety gate of the learned car reacts: at 2 m/s a policy keeps a quarter of a metre more from
the edge than the real gate asks for, which otherwise ends the first episodes where the car slides a little more."""
EPISODES_TO_TELL_HISTORY = 3
"""After so many episodes it is found from them how many past commands count."""
SMALLER_STEPS = 0.25
"""By what steps are multiplied where something diverged."""
Tell = Callable[[str, int, int], None]
Learned = TypeVar("Learned")


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """What is learned before an episode, the same for every episode of a run.

    Attributes:
        prior_toml: car file of the simulator that is the prior, ranges and effects included.
        history: past commands that model and policy see.
        method: with the simulator as prior, or without; as carlab fits, or as the authors of Sim-FSVGD set FSVGD.
        model_steps: steps of the particles' optimiser; the method's own number unless given.
        updates: gradient steps of SAC (``updates_before``).
        ticks: of an episode; the task's unless given.
        seed: of everything.
        threads: of torch.
        device: where model and policy are learned; what drives is on the CPU.
    """

    prior_toml: str
    history: int = 3
    method: Method = "sim-fsvgd"
    model_steps: int | None = None
    updates: int = 30_000
    ticks: int | None = None
    seed: int = 0
    threads: int = 1
    device: str = "cpu"

    @property
    def task(self) -> ParkingTask:
        """The task, with the history of the model and the ticks of this run."""
        task = ParkingTask(history_length=self.history)
        return task if self.ticks is None else replace(task, max_ticks=self.ticks)

    def updates_before(self, episode: int) -> int:
        """Gradient steps of SAC before an episode.

        Half as many again before the first; after the third the fewer the smaller the share of new rows is in what is
        learned from, for the policy is kept.
        """
        if episode == 1:
            return self.updates * 3 // 2
        return self.updates * 3 // max(episode, 3)


def model_folder(models: Path, episode: int) -> Path:
    """Where what was learned before an episode lies."""
    return models / f"{episode:04d}"


def train(
    plan: TrainingPlan, models: Path, recordings: list[Path], envelope: SafetyEnvelope, tell: Tell
) -> dict[str, Any]:
    """Learn before the episode that follows the recordings.

    Args:
        plan: what.
        models: folder that gets the result.
        recordings: MCAP files of all episodes so far, in order.
        envelope: limits of the car's safety gate.
        tell: told what is done, how many steps of it, and of how many.

    Returns:
        Figures, also written beside the result.

    Raises:
        DataError: the recordings hold no row, or something diverged. Nothing is left behind.
    """
    import torch

    from carlab.recording.mcap_source import read_episode
    from learning.car_fit import load_car, save_car
    from learning.model_env import ModelEnv
    from learning.sac_agent import SacAgent, SacSettings

    torch.set_num_threads(plan.threads)
    clock = MonotonicClock()
    number = len(recordings) + 1
    tell("reading the recordings", 0, 1)
    read = [read_episode(path) if has_ticks(path) else None for path in recordings]
    episodes, last = [e for e in read if e is not None], read[-1] if read else None
    simulator = SimulatorConfig.from_tables(tomllib.loads(plan.prior_toml))
    usable = [e for e in episodes if has_whole_step(e, plan.history)]
    late_s = velocity_delay_s(usable)
    model = CarModel(simulator, plan.history, known_ranges(simulator), velocity_delay_s=late_s)
    rows = transitions_of(usable, plan.history) if usable else None
    figures: dict[str, Any] = {"episode": number, "rows": 0 if rows is None else len(rows)}
    earlier = model_folder(models, number - 1)
    before = load_car(earlier / DYNAMICS_FILE, plan.device) if earlier.is_dir() else None
    if before is not None and usable and usable[-1] is last:
        nll, off = before.surprise(last)
        figures |= {"last_episode_nll": nll, "last_episode_calibration_error": off}

    began_s = clock.now_s()
    if len(recordings) == EPISODES_TO_TELL_HISTORY:
        tell("how many past commands count", 0, 1)
        asked = find_history(usable)
        figures |= {} if asked is None else {"history_asked": asked.history, "history_words": asked.words()}
    seed = plan.seed + 1000 * number
    dynamics = _fitted(plan, model, usable, rows, before, seed, tell)
    figures["model_seconds"] = clock.now_s() - began_s

    began_s = clock.now_s()
    updates = plan.updates_before(number)
    sac = SacSettings()
    recorded = recorded_features(usable, plan.history) if usable else None
    careful = replace(envelope, reaction_s=envelope.reaction_s + LATER_S)
    gate: dict[str, Any] = {"envelope": careful, "period_s": simulator.control_period_s, "device": plan.device}
    task = plan.task

    def parked(features: Tensor) -> Tensor:
        found: Tensor = PARKED_BONUS * task.parked(features).to(features)
        return found

    world = ModelEnv(dynamics, task, sac.cars, recorded=recorded, bonus=parked, seed=seed, **gate)
    judging = ModelEnv(dynamics, task, JUDGED_CARS, seed=seed + 1, **gate)

    def judge(candidate: SacAgent) -> float:
        total, last = judging.rolled_out(candidate.act)
        return float(total.mean() + PARKED_WORTH * task.parked(last).float().mean())

    def trained(slower: float) -> SacAgent:
        settings = replace(sac, learning_rate=slower * sac.learning_rate)
        agent = SacAgent(settings, plan.seed, plan.device)
        if before is not None:
            agent = SacAgent.load(earlier, settings, plan.seed, plan.device)
        tell("learning to drive", 0, updates)
        figures.update(agent.train(world, updates, lambda done: tell("learning to drive", done, updates), judge))
        return agent

    agent = _with_smaller_steps(trained, "policy")
    total, ends = judging.rolled_out(agent.act)
    figures |= {
        "policy_seconds": clock.now_s() - began_s,
        "updates": updates,
        "return_in_model": float(total.mean()),
        "parked_in_model": float(task.parked(ends).float().mean()),
    }

    def write(folder: Path) -> None:
        save_car(dynamics, folder / DYNAMICS_FILE)
        agent.save(folder)

    _publish(model_folder(models, number), figures, write)
    return figures


def _fitted(
    plan: TrainingPlan,
    model: CarModel,
    episodes: list[EpisodeData],
    rows: Transitions | None,
    before: LearnedCar | None,
    seed: int,
    tell: Tell,
) -> LearnedCar:
    """The car as the plan's method learns it."""
    from learning.authors_fsvgd import STEPS, fit_authors_fsvgd
    from learning.car_dynamics import CarDynamics
    from learning.car_fit import CarFitSettings, fit_car

    ours = plan.method != "fsvgd-authors"
    steps = plan.model_steps or (CarFitSettings().steps if ours else STEPS)

    def at(done: int) -> None:
        tell("learning the car", done, steps)

    at(0)
    if not ours:
        return fit_authors_fsvgd(episodes, plan.history, steps, seed, at, plan.device)
    settings = CarFitSettings(plan.method, steps, seed=seed)
    earlier = before if isinstance(before, CarDynamics) else None

    def fitted(slower: float) -> LearnedCar:
        own = replace(settings, learning_rate=slower * settings.learning_rate)
        return fit_car(rows, model, own, before=earlier, progress=at, device=plan.device)

    return _with_smaller_steps(fitted, "model")


def _with_smaller_steps(learn: Callable[[float], Learned], what: str) -> Learned:
    """What is learned with usual steps, or with smaller ones where it diverged by those.

    Raises:
        DivergedError: by those as well.
    """
    try:
        return learn(1.0)
    except DivergedError as error:
        log.warning("The %s diverged (%s); it is learned again with steps of %g.", what, error, SMALLER_STEPS)
    try:
        return learn(SMALLER_STEPS)
    except DivergedError as error:
        raise DivergedError(
            f"The {what} diverged, with smaller steps as well; what was recorded is kept: if the last recording shows "
            "what no car does (carlab replay), take it out of the run's folder, or start a run with another --prior."
        ) from error


def velocity_delay_s(episodes: Sequence[EpisodeData]) -> float:
    """By how much measured velocities lag behind poses, as recordings say it; without any, as the estimator has it."""
    import numpy as np

    told = [np.asarray(e.extra[VELOCITY_DELAY], dtype=np.float64) for e in episodes if VELOCITY_DELAY in e.extra]
    known = np.concatenate([t[np.isfinite(t)] for t in told]) if told else np.zeros(0)
    return float(np.median(known)) if len(known) else 0.5 * StateEstimator().window_s


def has_ticks(recording: Path) -> bool:
    """Whether anything was driven and seen: the gate may end an episode before its first tick, or a hang in it."""
    from carlab.recording.mcap_source import read_documents

    documents = read_documents(recording)
    steps = [document.step for document in documents if isinstance(document, Tick)]
    seen = [d.steps for d in documents if isinstance(d, EpisodeEnded) and d.last is not None]
    return len(steps) > 1 or bool(steps and seen and seen[0] > steps[-1])


def recorded_features(episodes: list[EpisodeData], history: int) -> FloatArray:
    """Features (R, 7 + 2 H) of recorded states with the commands before them."""
    import numpy as np

    found = []
    for episode in episodes:
        rows = np.arange(history, episode.ticks)
        found.append(encode(episode.states[rows], episode.sent[rows[:, None] - np.arange(history, 0, -1)]))
    features: FloatArray = np.concatenate(found)
    return features[np.isfinite(features).all(axis=1)]


def _publish(folder: Path, figures: dict[str, Any], write: Callable[[Path], None]) -> None:
    from carlab.recording.sink import describe_os_error

    unfinished = folder.with_name(f"{folder.name}.partial")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        write(unfinished)
        (unfinished / FIGURES_FILE).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        os.replace(unfinished, folder)
    except OSError as error:
        raise DataError(describe_os_error(error, folder)) from error


def train_beside(
    plan: TrainingPlan,
    models: Path,
    recordings: list[Path],
    envelope: SafetyEnvelope,
    tell: Tell,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """``train`` in a process of its own, while this one waits.

    Args:
        plan: as for ``train``.
        models: as for ``train``.
        recordings: as for ``train``.
        envelope: as for ``train``.
        tell: as for ``train``.
        stop: asked again and again; once true the process is ended and nothing is left behind.

    Returns:
        The figures; None where it was stopped.

    Raises:
        DataError: what ``train`` says, or that its process died.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(
        target=_child, args=(theirs, plan, models, recordings, envelope), daemon=True, name="training"
    )
    child.start()
    theirs.close()
    try:
        while True:
            if stop():
                return None
            if ours.poll(POLL_S):
                try:
                    kind, content = ours.recv()
                except EOFError:
                    child.join()
                    raise DataError(
                        f"The training process died (exit code {child.exitcode}; -9 is often too little memory); "
                        "what was recorded is kept, take the run up again."
                    ) from None
                if kind == "done":
                    figures: dict[str, Any] = content
                    return figures
                if kind == "failed":
                    raise DataError(str(content))
                tell(*content)
    finally:
        if child.is_alive():
            child.terminate()
        child.join()
        ours.close()
        for left in models.glob("*.partial"):
            shutil.rmtree(left, ignore_errors=True)


def _child(
    pipe: Connection, plan: TrainingPlan, models: Path, recordings: list[Path], envelope: SafetyEnvelope
) -> None:
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ^C is for the process that drives; it ends this one.
    try:
        pipe.send(("done", train(plan, models, recordings, envelope, lambda *what: pipe.send(("at", what)))))
    except CarlabError as error:
        pipe.send(("failed", str(error)))
    except BrokenPipeError:
        pass
    except Exception as error:
        log.exception("Training failed")
        pipe.send(("failed", f"Training failed: {type(error).__name__}: {error}; what was recorded is kept."))
    finally:
        pipe.close()


def plan_as_json(plan: TrainingPlan) -> dict[str, Any]:
    """The plan for a file."""
    return asdict(plan)


__all__ = [
    "DYNAMICS_FILE",
    "FIGURES_FILE",
    "TrainingPlan",
    "has_ticks",
    "model_folder",
    "plan_as_json",
    "recorded_features",
    "train",
    "train_beside",
]
