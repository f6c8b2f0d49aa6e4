"""The correction of the simulator prior: what enters, what leaves, resuming, and one real diagnosis of a lag."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import parking_drives as drives
import pytest
import tomli_w
from learning_runs import TICKS, tiny_plan

from carlab.api.driving import drive
from carlab.cars import choose_car
from carlab.core.documents import Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.diagnosis.diagnose import diagnose
from carlab.experiment.campaign.campaign import Campaign, resumed_campaign
from carlab.experiment.campaign.figures import EpisodeFigures
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.campaign.learned_policy import load_policy
from carlab.experiment.campaign.prior_correction import (
    PARAMETERS,
    Correction,
    Findings,
    PriorVersion,
    corrected,
    needed_history,
    next_version,
)
from carlab.experiment.campaign.prior_correction_process import (
    CorrectionRequest,
    contradicted_by,
    correct_prior,
    correction_path,
    diagnosed,
    read_version,
    run_correction_subprocess,
)
from carlab.experiment.campaign.quick_check import check_path, run_check_subprocess
from carlab.recording.mcap.source import read_documents, read_episode
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent, SacSettings, _without_environment
from sim_backends.car_parameters import SimulatorConfig

CAR = SimulatorConfig.from_preset()
PLAIN = replace(CAR, priors={})
LAG = "effects.motor_lag.time_constant"
DELAY = "effects.command_delay.extra_delay"
MOTOR_LAG = Correction("motor_lag", {LAG: 0.08}, {LAG: 0.01}, 1, "quick check", "it explains 90 %")


def cause(name: str, share: float, *, tie: bool = False, **values: float) -> dict[str, Any]:
    """A cause in the format of the quick check's file."""
    parameters = {
        key: {"value": value, "halves": [0.9 * value, 1.1 * value], "before": None, "unit": "s"}
        for key, value in values.items()
    }
    return {"id": name, "share": share, "like_the_first": tie, "parameters": parameters}


def left(episodes: int, *causes: dict[str, Any], **others: Any) -> Findings:
    return Findings(episodes, {"verdict": "left", "causes": list(causes)}, **others)


def test_effect_with_cross_validated_support_enters_with_its_uncertainty() -> None:
    version = next_version(PriorVersion(history=4), CAR, left(1, cause("motor_lag", 0.9, **{LAG: 0.08})))
    (entered,) = version.corrections
    assert (entered.id, entered.values, entered.episodes) == ("motor_lag", {LAG: 0.08}, 1)
    assert entered.std[LAG] == pytest.approx(0.016), "the difference of the halves"
    assert version.sentence.startswith("The prior changes after episode 1: motor_lag (time_constant 0.08 s) is added")
    assert "\n" not in version.sentence
    prior = corrected(CAR, version.corrections)
    assert prior.effects == {"motor_lag": {"time_constant": 0.08}}
    assert prior.parameter_std == {LAG: entered.std[LAG]}
    assert prior.priors == CAR.priors


@pytest.mark.parametrize(
    "found",
    [
        Findings(2, {"verdict": "explains", "causes": []}),
        Findings(2, {"verdict": "undecided", "causes": []}),
        left(2),
        left(2, cause("motor_lag", 0.2, **{LAG: 0.08})),
        left(2, cause("low_friction_patch", 0.9, **{"effects.low_friction_patch.loss": 0.4})),
        left(2, cause("low_friction_patch", 0.9), cause("motor_lag", 0.8, **{LAG: 0.08})),
    ],
    ids=["explained", "undecided", "no cause", "weak cause", "depends on the place", "less likely than the first"],
)
def test_prior_is_unchanged_without_a_usable_cause(found: Findings) -> None:
    before = PriorVersion((MOTOR_LAG,), 8)
    version = next_version(before, CAR, found)
    assert version.corrections == before.corrections
    assert version.sentence.startswith("The prior is unchanged after episode 2: ")


def test_cause_that_ties_with_an_unusable_first_one_enters() -> None:
    found = left(
        1, cause("low_friction_patch", 0.99), cause("tyre.mu", 0.98, tie=True, **{"tyre.front.mu": 0.26})
    )  # fmt: skip
    (entered,) = next_version(PriorVersion(history=4), CAR, found).corrections
    assert entered.id == PARAMETERS
    prior = corrected(CAR, [entered])
    assert prior.values()["tyre.front.mu"] == 0.26
    assert "tyre.front.mu" not in prior.priors, "the recordings replace the range of the car file"


def test_contradicted_effect_leaves() -> None:
    version = next_version(PriorVersion((MOTOR_LAG,), 4), CAR, left(3, contradicted=("motor_lag",)))
    assert version.corrections == ()
    assert "motor_lag is removed (episode 3 is predicted better without it)" in version.sentence


def test_complete_diagnosis_replaces_and_cut_one_only_adds() -> None:
    before = PriorVersion((MOTOR_LAG,), 4)
    delay = Correction("command_delay", {DELAY: 0.05}, {DELAY: 0.002}, 4, "diagnosis", "held out")
    complete = next_version(before, CAR, Findings(4, diagnosed=(delay,), diagnosis="mismatch"))
    assert [c.id for c in complete.corrections] == ["command_delay"]
    assert "motor_lag is removed (the diagnosis of 4 episodes does not confirm it)" in complete.sentence
    assert complete.diagnosed == 4
    cut = next_version(before, CAR, Findings(4, diagnosed=(delay,), diagnosis="mismatch", is_complete=False))
    assert {c.id for c in cut.corrections} == {"command_delay", "motor_lag"}
    none = next_version(before, CAR, Findings(4, diagnosed=(), diagnosis="none"))
    assert none.corrections == ()


def test_past_commands_follow_the_found_delay_and_never_decrease() -> None:
    assert needed_history(CAR) == 4
    version = next_version(PriorVersion(history=4), CAR, left(1, cause("command_delay", 0.99, **{DELAY: 0.08})))
    # 0.16 s of delay, 0.008 s of latency and half of the 0.1 s window are 6.5 periods of 1 / 30 s.
    assert version.history == needed_history(replace(CAR, command_delay_s=0.16)) > 4
    assert f"observe {version.history} past commands instead of 4" in version.sentence
    back = next_version(version, CAR, left(2, contradicted=("command_delay",)))
    assert (back.corrections, back.history) == ((), version.history)


def test_impossible_correction_changes_nothing() -> None:
    found = left(1, cause("command_delay", 0.99, **{DELAY: -0.5}))
    before = PriorVersion(history=4)
    version = next_version(before, CAR, found)
    assert version.corrections == ()
    assert "its correction is impossible" in version.sentence


IMPOSSIBLE_VALUES = (
    ("effects.renamed.gain", 1.0),
    ("motor.drive_gain", math.inf),
    ("vehicle.mass", math.nan),
    ("vehicle.mass", -1.0),
)


def test_version_is_read_as_it_was_written(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "run")
    path = correction_path(run, 1)
    path.parent.mkdir(parents=True)
    assert read_version(run, 1) is None
    saturation = {"effects.motor_saturation.force": math.inf}
    version = PriorVersion((MOTOR_LAG, Correction("motor_saturation", saturation, {}, 1, "diagnosis")), 5, "Why.", 1)
    path.write_text(json.dumps(version.to_dict()))
    assert read_version(run, 1) == version
    rest = '"sentence": "", "diagnosed": 0}'
    for content in (
        *("{", "[]", '{"corrections": [1], "history": 4, ' + rest),
        *('{"corrections": [], "history": ' + history + ", " + rest for history in ("-1", "1e9", "NaN", "1e999")),
        '{"corrections": [], "history": 4, "sentence": "", "diagnosed": 1e999}',
        *(
            json.dumps(PriorVersion((replace(MOTOR_LAG, **changed),)).to_dict())
            for changed in (
                *({"values": {name: value}} for name, value in IMPOSSIBLE_VALUES),
                *({"std": {"effects.motor_lag.time_constant": std}} for std in (-0.01, 0.0, math.nan, math.inf)),
            )
        ),
    ):
        path.write_text(content)
        with pytest.raises(DataError, match=r"repair\.json .*remove it, and the run repeats the correction\.$"):
            read_version(run, 1)


@pytest.fixture(scope="module")
def lagging(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """Four episodes of a car with a motor lag of 0.08 s."""
    true = replace(CAR, effects={"motor_lag": {"time_constant": 0.08}})
    run: RunDirectory = drives.drive_like_learning(true, tmp_path_factory.mktemp("lag"), 4, seed=5)
    for number in range(1, 5):
        (run.models / f"{number:04d}").mkdir(parents=True)
    return run


def test_newest_episode_contradicts_a_wrong_effect_only(lagging: RunDirectory) -> None:
    newest = read_episode(lagging.recordings()[-1])
    wrong = Correction("command_delay", {DELAY: 0.1}, {}, 3, "quick check")
    assert contradicted_by(newest, PLAIN, [MOTOR_LAG, wrong], [MOTOR_LAG, wrong]) == ("command_delay",)
    assert contradicted_by(newest, PLAIN, [MOTOR_LAG], [MOTOR_LAG]) == ()


def test_correction_in_another_process_enters_the_true_effect(lagging: RunDirectory) -> None:
    assert run_check_subprocess(lagging, PLAIN) is not None
    folder = check_path(lagging, 4).parent
    before = PriorVersion(history=4, diagnosed=4)
    request = CorrectionRequest(tuple(lagging.recordings()), tomli_w.dumps(CAR.to_tables()), before, folder)
    version = run_correction_subprocess(request)
    assert version is not None
    assert [c.id for c in version.corrections] == ["motor_lag"]
    assert version.corrections[0].values[LAG] == pytest.approx(0.08, abs=0.01)
    assert read_version(lagging, 4) == version
    correction_path(lagging, 4).unlink()
    assert run_correction_subprocess(request, stop=lambda: True) is None
    assert not correction_path(lagging, 4).exists()
    broken = replace(request, recordings=(*request.recordings[:3], folder / "missing.mcap"))
    failed = run_correction_subprocess(broken)
    assert failed is not None
    assert failed.corrections == before.corrections
    assert "failed" in failed.sentence
    assert "the prior is unchanged" in failed.sentence


def long_drives(episodes: list[EpisodeData]) -> list[EpisodeData]:
    """The episodes that are long enough for a diagnosis."""
    return [e for e in episodes if e.ticks > 60]


@pytest.mark.parametrize(
    "candidates",
    [
        pytest.param(("steering_lag", "motor_lag"), id="two effects"),
        pytest.param(None, id="catalogue", marks=pytest.mark.slow),
    ],
)
def test_real_diagnosis_of_a_run_finds_the_lag(
    candidates: tuple[str, ...] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carlab.diagnosis.diagnose.diagnose", partial(diagnose, effects=candidates))
    true = replace(CAR, effects={"motor_lag": {"time_constant": 0.08}})
    run = drives.drive_like_learning(true, tmp_path, 6, seed=5)
    episodes = long_drives([read_episode(path) for path in run.recordings()])
    found = diagnosed(Findings(6), episodes, PLAIN, math.inf)
    assert found.diagnosis == "mismatch"
    assert found.diagnosed is not None
    named = {c.id: c for c in found.diagnosed}
    assert named["motor_lag"].values[LAG] == pytest.approx(0.08, abs=0.01)
    assert 0.0 < named["motor_lag"].std[LAG] < 0.02
    short = diagnosed(Findings(1), episodes[:1], PLAIN, math.inf)
    assert (short.diagnosed, short.diagnosis) == (None, "inconclusive")


def test_run_uses_the_newest_version_of_the_prior_when_it_is_resumed(tmp_path: Path) -> None:
    choice = choose_car("sim", seed=0)
    run = RunDirectory.create(tmp_path, "auto")
    version = PriorVersion((MOTOR_LAG,), 4, "The prior changes after episode 1: motor_lag is added.")
    sentences: list[str] = []
    figures: list[EpisodeFigures] = []
    hooks = LearnHooks(on_prior=lambda v: sentences.append(v.sentence), on_figures=figures.append)

    def scripted(request: CorrectionRequest, stop: Callable[[], bool]) -> PriorVersion:
        assert (len(request.recordings), request.before) == (1, PriorVersion(history=2))
        (request.folder / "repair.json").write_text(json.dumps(version.to_dict()))
        return version

    plan = tiny_plan(choice)
    campaign = Campaign(choice, plan, 1, run, hooks, max_ticks=TICKS, record_rerun=False, corrects_prior=True)
    with choice.car:
        campaign.write_plan()
        assert len(list(campaign.run_episodes())) == 1
        resumed = resumed_campaign(run, choice)
        resumed.hooks, resumed.correct, resumed.episodes = hooks, scripted, 2
        assert len(list(resumed.run_episodes())) == 1
    assert sentences == [version.sentence]
    assert (run.models / "0001" / "prior.toml").read_text() == plan.prior_toml
    newest = SimulatorConfig.from_tables(tomllib.loads((run.models / "0002" / "prior.toml").read_text()))
    assert newest.effects == {"motor_lag": {"time_constant": 0.08}}
    ticks = [[d for d in read_documents(path) if isinstance(d, Tick)] for path in run.recordings()]
    assert [len(t[0].features) for t in ticks] == [7 + 2 * 2, 7 + 2 * 4], "the policy observes two more past commands"
    assert [f.prior_change for f in figures] == ["", version.sentence]
    assert all(f.predicted_low <= f.predicted_return <= f.predicted_high for f in figures)
    again = resumed_campaign(run, choice)
    assert again.current_plan(2).prior_toml == (run.models / "0002" / "prior.toml").read_text()
    for policy, history in ((run.path, 4), (run.models / "0002", 4), (run.models / "0001", 2)):
        driven = drive("sim", policy=policy, ticks=3, out=tmp_path / "driven", rerun=False, picture=False)
        (tick, *_) = [d for d in read_documents(driven.recordings[0]) if isinstance(d, Tick)]
        assert len(tick.features) == 7 + 2 * history, "each policy drives with its own number of past commands"


def test_policy_with_impossible_past_commands_is_refused(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "odd")
    Campaign(choice := choose_car("sim"), tiny_plan(choice), 1, run).write_plan()
    (run.models / "0001").mkdir(parents=True)
    for features in (3, 7 + 2 * 1, 7 + 2 * 2 + 1):
        agent = SacAgent(SacSettings(), 0)
        agent._sac = _without_environment(features, SacSettings(), 0)
        agent.save(run.models / "0001")
        with pytest.raises(DataError, match=rf"has {features} features, its run at least 11; remove the folder"):
            load_policy(run.path)


def test_correction_needs_the_file_of_the_check(lagging: RunDirectory, tmp_path: Path) -> None:
    request = CorrectionRequest(
        tuple(lagging.recordings()[:1]), tomli_w.dumps(CAR.to_tables()), PriorVersion(history=4), tmp_path
    )  # fmt: skip
    with pytest.raises(OSError, match=r"diagnosis\.json"):
        correct_prior(request)
