"""Measured curves: knots, interpolation, roughness, and their tables in car files."""

import tomllib

import numpy as np
import pytest
import tomli_w
from scipy.interpolate import RegularGridInterpolator

from carlab.core.errors import ConfigError
from sim_backends.array_ops import ARRAYS
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CURVES
from sim_backends.effects.curves import free_knots, weights

BY_ID = {curve.id: curve for curve in CURVES}
IDS = list(BY_ID)


def deviations(curve, seed=0):
    """Random deviations at all free knots, by parameter name."""
    rng = np.random.default_rng(seed)
    return {p.name: float(v) for p, v in zip(curve.parameters, rng.normal(size=len(curve.parameters)), strict=True)}


@pytest.mark.parametrize("curve_id", IDS)
def test_deviation_equals_interpolation_by_scipy(curve_id):
    curve, rng = BY_ID[curve_id], np.random.default_rng(1)
    values = deviations(curve)
    knots = [np.array(axis.knots) for axis in curve.axes]
    points = [rng.uniform(1.3 * k[0] - 0.3, 1.3 * k[-1], 200) for k in knots]
    within = np.stack([np.clip(p, k[0], k[-1]) for p, k in zip(points, knots, strict=True)], axis=1)
    expected = RegularGridInterpolator(knots, np.array(curve.table(values)))(within)
    assert curve.deviation(ARRAYS, points, curve.coefficients(values)) == pytest.approx(expected, abs=1e-12)


def test_interpolation_weights_sum_to_one_and_pick_single_knots():
    knots = (-1.0, 0.0, 0.3, 2.0)
    x = np.linspace(-3.0, 4.0, 50)
    assert sum(weights(ARRAYS, x, knots)) == pytest.approx(np.ones(50))
    assert np.stack(weights(ARRAYS, np.array(knots), knots)) == pytest.approx(np.eye(4))


@pytest.mark.parametrize("curve_id", IDS)
def test_roughness_vanishes_for_linear_deviations_only(curve_id):
    """A deviation that is linear in each axis (and 0 at anchors) has no change of slope."""
    curve = BY_ID[curve_id]
    places = free_knots(curve.axes)
    linear = np.array([sum(a.knots[k] for a, k in zip(curve.axes, place, strict=True)) for place in places])
    if len(curve.axes) == 2 and curve.axes[1].anchor is not None:
        linear = np.array([curve.axes[1].knots[k] for _, k in places])
    assert curve.roughness() @ linear == pytest.approx(0.0, abs=1e-12)
    bent = np.array([abs(curve.axes[0].knots[place[0]] - curve.axes[0].knots[1]) for place in places])
    assert np.abs(curve.roughness() @ bent).max() > 1e-3


def test_roughness_is_the_change_of_slope_times_the_mean_distance():
    curve = BY_ID["steering_curve"]
    knots, values = curve.axes[0].knots, np.array([0.3, -0.2, 0.5, 0.1, 0.7, -0.4, 0.2, 0.6])
    slopes = np.diff([*values[:4], 0.0, *values[4:]]) / np.diff(knots)
    distances = np.diff(knots)
    expected = np.diff(slopes) * 0.5 * (distances[:-1] + distances[1:])
    assert curve.roughness() @ values == pytest.approx(expected)


@pytest.mark.parametrize("curve_id", IDS)
def test_table_of_a_car_file_has_every_knot(curve_id):
    curve = BY_ID[curve_id]
    values = {f"effects.{curve_id}.{name}": 0.1 * v for name, v in deviations(curve).items()}
    config = SimulatorConfig(parameter_std=dict.fromkeys(values, 0.05)).with_values(values)
    text = tomli_w.dumps(config.to_tables())
    table = tomllib.loads(text)["effects"][curve_id]
    assert np.shape(table["values"]) == np.shape(table["std"]) == tuple(len(a.knots) for a in curve.axes)
    again = SimulatorConfig.from_tables(tomllib.loads(text))
    assert again.values() == config.values()
    assert again.parameter_std == config.parameter_std


@pytest.mark.parametrize(
    "wrong", [3.0, "flat", [1.0, 2.0], [[0.0] * 7] * 8, [[float("nan")] * 11] * 13, [["a"] * 11] * 13]
)
def test_table_of_a_wrong_shape_is_refused_in_one_sentence(wrong):
    with pytest.raises(
        ConfigError, match=r"'values' in \[effects.drive_map\] of car.toml must be a list of 13 lists of 11"
    ):
        SimulatorConfig.from_tables({"effects": {"drive_map": {"values": wrong}}}, "car.toml")


def test_unknown_key_of_a_curve_is_refused():
    with pytest.raises(ConfigError, match="did you mean 'values'"):
        SimulatorConfig.from_tables({"effects": {"drive_map": {"value": []}}})
