"""Policies in the folder of a run of ``carlab learn``."""

from __future__ import annotations

from pathlib import Path

from carlab.core.observation import ACTION_SIZE, STATE_FEATURES
from learning.policy.sac_agent import AGENT_FILE, SacAgent


def policy_folders(run: Path) -> list[Path]:
    """Folders ``models/NNNN`` of a run that contain a policy, in the order of their episodes."""
    return sorted(p for p in run.glob("models/*") if p.name.isdecimal() and has_policy(p))


def has_policy(folder: Path) -> bool:
    """Whether a folder contains a policy."""
    return (folder / AGENT_FILE).is_file()


def observed_history(agent: SacAgent) -> int:
    """Number of past commands in the observations of a policy."""
    return (agent.observation_size - STATE_FEATURES) // ACTION_SIZE
