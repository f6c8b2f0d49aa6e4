"""All forms of all effects that a case may conceal."""

from __future__ import annotations

from carlab.benchmark.effects import (
    alternative_command_forms,
    alternative_force_forms,
    command_forms,
    force_forms,
    geometry_forms,
    observation_forms,
    random_physics,
    tyre_forms,
    uncatalogued_forms,
)
from carlab.benchmark.effects.catalogue import Form, FormName

_MODULES = (
    command_forms,
    force_forms,
    tyre_forms,
    geometry_forms,
    observation_forms,
    alternative_command_forms,
    alternative_force_forms,
    uncatalogued_forms,
    random_physics,
)


def all_forms() -> dict[tuple[str, FormName], Form]:
    """Return every form by effect id and form name."""
    return {(form.id, form.form): form for module in _MODULES for form in module.FORMS}
