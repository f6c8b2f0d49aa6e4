"""A filter of the recorded velocities that is measured against the poses (``identification.velocity_filter``).

The simulator of the search has the measured filter, so that no other effect imitates it. The search does not decide
about the filter: the error of the simulator can hide it from the prediction windows, but not from this measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from carlab.diagnosis.identification.velocity_filter import VELOCITIES, VelocityFilter, velocity_filter
from carlab.diagnosis.naming import NamingResult
from carlab.diagnosis.selection.problem import SearchProblem
from carlab.diagnosis.selection.refit import fit_base
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.windows import RecordingSegment
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects.observations import VelocityFilterLag

FILTER = VelocityFilterLag.id
TIME_CONSTANT = f"effects.{FILTER}.{VelocityFilterLag.lag_parameter}"


def measured_filter(segments: Sequence[RecordingSegment], nominal: SimulatorConfig) -> VelocityFilter | None:
    """The filter of the velocities; None without one or without recorded velocities, or if the car file states it."""
    measured = velocity_filter(segments) if have_velocity_columns(segments) else None
    if measured is None:
        return None
    stated_s = nominal.effects.get(FILTER, {}).get(VelocityFilterLag.lag_parameter, 0.0)
    difference_s = abs(measured.time_constant_s - stated_s)
    return None if difference_s < IDENTIFICATION.filter_change_min_s else measured


def have_velocity_columns(segments: Sequence[RecordingSegment]) -> bool:
    """Whether all velocities were recorded; those that are differentiated poses went through no filter."""
    return all(segment.has_velocity_columns for segment in segments)


def with_filter(nominal: SimulatorConfig, measured: VelocityFilter | None) -> SimulatorConfig:
    """The simulator with the measured filter, if there is one."""
    if measured is None:
        return nominal
    values = {VelocityFilterLag.lag_parameter: measured.time_constant_s}
    return replace(nominal, effects={**nominal.effects, FILTER: values})


def name_filter(
    problem: SearchProblem, nominal: SimulatorConfig, naming: NamingResult, measured: VelocityFilter
) -> tuple[SearchProblem, NamingResult]:
    """Add the filter to the accepted effects, and fit its time constant together with their parameters.

    Each channel of a window counts as one observation in the likelihood ratio of the filter (``chi2``), because
    smoothed rows are dependent.

    Args:
        problem: the search, whose simulator has the filter.
        nominal: the simulator of the car file.
        naming: result of the search.
        measured: the filter.

    Returns:
        The search with the simulator of the car file, and the result with the filter as its first effect.
    """
    named = replace(problem, nominal=nominal)
    found = naming.found
    effects = (FILTER, *found.effects)
    free, known = named.free_parameters(effects), found.best.coordinates()
    start = [
        each.coordinate(measured.time_constant_s) if each.name == TIME_CONSTANT else known[each.name] for each in free
    ]
    fit = named.fitter(found.scale).fit(named.config_with(effects), free, np.array(start))
    chi2 = len(VELOCITIES) * len(problem.windows) * float(np.log(measured.unexplained_ratio))
    found = replace(
        found,
        base=fit_base(named).fit,
        best=fit,
        effects=effects,
        chi2={FILTER: chi2, **found.chi2},
        indistinguishable={FILTER: (), **found.indistinguishable},
        history=((FILTER, found.base), *found.history),
    )
    rival = naming.rival
    rival = None if rival is None else replace(rival, names=(FILTER, *rival.names))
    return named, replace(naming, found=found, rival=rival)
