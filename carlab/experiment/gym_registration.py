"""Makes the environments known to Gymnasium by its plug-in entry point: ``gymnasium.make`` needs no import."""

from __future__ import annotations


def register_environments() -> None:
    """Register ``carlab/Parking-v0`` and ``carlab/Path-v0`` (Gymnasium adds the namespace of the entry point)."""
    from gymnasium.envs.registration import register

    for task in ("parking", "path"):
        register(
            id=f"{task.capitalize()}-v0",
            entry_point="carlab.experiment.gym_env:make_env",
            kwargs={"task": task},
        )
