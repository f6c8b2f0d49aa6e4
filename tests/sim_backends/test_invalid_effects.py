"""Effects with an error in their class are refused with the remedy, and not simulated as something else."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from carlab.core.errors import ConfigError
from sim_backends import EFFECTS, SimulatorConfig, registered, rollout
from sim_backends.effects import DynamicsEffect, Effect, EffectParameter, ObservationEffect

PARAMETERS = (EffectParameter("coefficient", "N", 0.0, -1.0, 1.0, 0.03),)


@pytest.mark.parametrize(("kind", "method"), [(DynamicsEffect, "on_body"), (ObservationEffect, "observe")])
def test_effect_that_changes_nothing_is_refused(kind: type[Effect], method: str) -> None:
    """No method of the base class calls a method with a misspelt name."""
    content = {"id": "misspelt", "parameters": PARAMETERS, "on_bodies": lambda *arguments: None}
    misspelt = type("Misspelt", (kind,), content)()
    with pytest.raises(ConfigError, match=f"changes nothing; define at least one of .*{method}"), registered(misspelt):
        pass
    assert "misspelt" not in EFFECTS


@pytest.mark.parametrize("content", [{}, {"id": ""}, {"id": "cubic drag"}, {"id": "drag.cubic"}])
def test_effect_without_a_valid_id_is_refused(content: dict[str, str]) -> None:
    effect = type("Nameless", (DynamicsEffect,), {"parameters": PARAMETERS, **content})
    with (
        pytest.raises(ConfigError, match=r"id of the effect Nameless is .*; set id in its class"),
        registered(effect()),
    ):
        pass
    with (
        pytest.raises(ConfigError, match=r"Nameless is a class; give an object of it, Nameless\(\)"),
        registered(effect),
    ):
        pass


@pytest.mark.parametrize(
    "drag",
    [
        lambda vx: vx if vx > 0.0 else 0.0,
        lambda vx: vx > 0.0 and vx,
        lambda vx: vx**2,
        lambda vx: abs(vx),
        lambda vx: math.sin(vx),
    ],
)
def test_equation_with_a_branch_or_a_function_of_python_is_refused(drag: Callable[[Any], Any]) -> None:
    """A branch would be taken once, while the equation is traced, for all cars and all times."""

    class PlainPython(DynamicsEffect):
        id = "plain_python"
        parameters = PARAMETERS

        def on_body(self, ops, forces, values):
            forces.force_x = forces.force_x - values["coefficient"] * drag(forces.vx)

    with registered(PlainPython()):
        config = SimulatorConfig(effects={"plain_python": {"coefficient": 0.1}})
        with pytest.raises(ConfigError, match=r"use ops\.where, ops\.pow"):
            rollout(config, torch.zeros((1, 6), dtype=torch.float64), torch.ones((1, 5, 2), dtype=torch.float64))
