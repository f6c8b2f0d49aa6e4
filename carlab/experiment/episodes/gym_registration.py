"""Importing this module registers the Gymnasium environments: ``carlab/Parking-v0``, ``carlab/Laps-v0`` ...

    import gymnasium
    import carlab.experiment.episodes.gym_registration
    env = gymnasium.make("carlab/Parking-v0")

or in one step: ``gymnasium.make("carlab.experiment.episodes.gym_registration:carlab/Parking-v0")``.
"""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

from carlab.core.task_choice import TASKS

for _task in TASKS:
    _id = f"carlab/{_task.capitalize()}-v0"
    if _id not in registry:
        register(id=_id, entry_point="carlab.experiment.episodes.gym_env:make_env", kwargs={"task": _task})
