"""The policy of a run of ``carlab learn``, to drive it again. Reading a run folder runs no code of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from carlab.core.errors import DataError
from carlab.core.observation import feature_size
from carlab.core.policy import Policy
from carlab.experiment.campaign.campaign import saved_plan
from carlab.experiment.campaign.policy_folders import has_policy, observed_history, policy_folders
from carlab.experiment.campaign.prior_correction import LARGEST_GIVEN_HISTORY
from carlab.experiment.campaign.training_plan import TrainingPlan
from learning.policy.sac_agent import SacAgent, SacSettings


@dataclass(frozen=True, slots=True)
class LearnedPolicy:
    """A learned policy.

    Attributes:
        policy: the policy.
        plan: plan of its run.
        history: number of past commands that it observes; a corrected prior may need more than the plan states.
    """

    policy: Policy
    plan: TrainingPlan
    history: int


def load_policy(folder: Path) -> LearnedPolicy:
    """Read the newest policy of a run, or that of an episode (``RUN/models/0003``).

    Raises:
        DataError: the folder has no policy, or it cannot be read.
    """
    is_model = folder.parent.name == "models" and folder.name.isdecimal()
    run = folder.parent.parent if is_model else folder
    plan = saved_plan(run)
    folders = policy_folders(run)
    if is_model:
        folders = [folder] if has_policy(folder) else []
    if not folders:
        raise DataError(f"{folder} has no policy; name the folder of a run of carlab learn with a finished training.")
    agent = SacAgent.load(folders[-1], SacSettings(), plan.seed)
    history = observed_history(agent)
    if not plan.history <= history <= LARGEST_GIVEN_HISTORY or agent.observation_size != feature_size(history):
        raise DataError(
            f"The policy in {folders[-1]} has {agent.observation_size} features, its run at least "
            f"{feature_size(plan.history)}; remove the folder to train again."
        )
    return LearnedPolicy(agent.policy(), plan, history)
