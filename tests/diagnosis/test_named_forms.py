"""Named forms of measured curves: curves of known forms with noise, and random smooth curves."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.curves.form_fit import identify_form
from carlab.diagnosis.curves.named_forms import FORMS, TYRE_FORMS
from carlab.diagnosis.findings import CurveAxis, CurveFinding
from carlab.diagnosis.report.curves import form_sentence
from carlab.diagnosis.settings import DEFAULT
from sim_backends.effects import CURVES, EFFECTS


def speed_controller(u, v):
    target = 8.0 * np.sign(u) * np.clip((np.abs(u) - 0.08) / 0.92, 0.0, None)
    return np.minimum(np.maximum(5.0 * (target - v), -4.2), 6.0)


def friction_of(v):
    return np.where(np.abs(v) < 0.1, v / 0.1, np.sign(v))


TRUTHS = {
    "linear_drive": ("drive_map", lambda u, v: 7.0 * u - 0.8 * v, {"gain": 7.0, "damping": 0.8}),
    "throttle_deadband": (
        "drive_map",
        lambda u, v: np.where(np.abs(u) < 0.2, 0.0, 9.0 * (u - 0.2 * np.sign(u)) / 0.8) - v,
        {"gain": 9.0, "dead band": 0.2, "damping": 1.0},
    ),
    "throttle_nonlinearity": (
        "drive_map",
        lambda u, v: 8.0 * u * np.abs(u) - 0.7 * v,
        {"gain": 8.0, "exponent": 2.0, "damping": 0.7},
    ),
    "motor_saturation": (
        "drive_map",
        lambda u, v: np.minimum(np.maximum(14.0 * u, -4.0), 6.0) - 0.5 * v,
        {"gain": 14.0, "braking limit": 4.0, "driving limit": 6.0, "damping": 0.5},
    ),
    "throttle_asymmetry": (
        "drive_map",
        lambda u, v: np.maximum(u, 0.0) * 12.0 + np.minimum(u, 0.0) * 7.0 - 1.2 * v,
        {"forward gain": 12.0, "gain in reverse": 7.0, "damping": 1.2},
    ),
    "drag_brake": (
        "drive_map",
        lambda u, v: (
            np.where(np.abs(u) < 0.15, 0.0, 9.0 * (u - 0.15 * np.sign(u)) / 0.85)
            - 0.5 * v
            - 3.0 * np.maximum(1.0 - np.abs(u) / 0.15, 0.0) * friction_of(v)
        ),
        {"brake": 3.0, "gain": 9.0, "dead band": 0.15},
    ),
    "speed_controller": (
        "drive_map",
        speed_controller,
        {"speed at full throttle": 8.0, "dead band": 0.08, "controller gain": 5.0, "braking limit": 4.2},
    ),
    "dc_motor": (
        "drive_map",
        lambda u, v: (
            np.where(np.abs(u) < 0.16, 0.0, (13.0 - 3.0 * v) * (u - 0.16 * np.sign(u)) / 0.84)
            - 0.8 * friction_of(v)
            - 0.3 * v
        ),
        {"acceleration at rest": 13.0, "fall with speed": 3.0, "dead band": 0.16, "dry friction": 0.8},
    ),
    "linear_steering": ("steering_curve", lambda d: 0.8 * d, {"gain": 0.8}),
    "steering_asymmetry": (
        "steering_curve",
        lambda d: np.maximum(d, 0.0) * 1.1 + np.minimum(d, 0.0) * 0.8,
        {"gain to the left": 1.1, "gain to the right": 0.8},
    ),
    "steering_nonlinearity": ("steering_curve", lambda d: 0.35 * np.tanh(d / 0.35), {"gain": 1.0, "limit": 0.35}),
    "steering_deadband": (
        "steering_curve",
        lambda d: d - np.clip(d, -0.08, 0.08),
        {"gain": 1.0, "dead band": 0.08},
    ),
    "steering_exponent": ("steering_curve", lambda d: 1.4 * d * np.sqrt(np.abs(d)), {"exponent": 1.5}),
    "linear_tyre": ("front_tyre_map", lambda x, a: 2.2 * a, {"cornering stiffness per load": 2.2}),
    "limited_tyre": (
        "front_tyre_map",
        lambda x, a: np.where(a < 0.1, 6.0 * a, 0.6),
        {"cornering stiffness per load": 6.0, "grip": 0.6},
    ),
    "saturating_tyre": (
        "front_tyre_map",
        lambda x, a: 0.7 * np.tanh(3.5 * a / 0.7),
        {"cornering stiffness per load": 3.5, "grip": 0.7},
    ),
    "pacejka_tyre": (
        "front_tyre_map",
        lambda x, a: 0.8 * np.sin(1.9 * np.arctan(9.0 * a)),
        {"grip": 0.8, "C": 1.9, "B": 9.0},
    ),
    "limited_tyre_friction_ellipse": (
        "rear_tyre_map",
        lambda x, a: np.where(a < 0.1, 6.0 * a, 0.6) * np.sqrt(1.0 - x**2 / 81.0),
        {"cornering stiffness per load": 6.0, "grip": 0.6, "longitudinal limit": 9.0},
    ),
    "pacejka_tyre_friction_ellipse": (
        "rear_tyre_map",
        lambda x, a: 0.9 * np.sin(1.9 * np.arctan(7.0 * a)) * np.sqrt(np.clip(1.0 - x**2 / 49.0, 0.0, None)),
        {"grip": 0.9, "C": 1.9, "B": 7.0, "longitudinal limit": 7.0},
    ),
    "saturating_tyre_two_limits": (
        "rear_tyre_map",
        lambda x, a: 0.7 * np.tanh(5.0 * a) * np.sqrt(np.clip(1.0 - (x / np.where(x < 0.0, 5.0, 9.0)) ** 2, 0.0, None)),
        {"grip": 0.7, "braking limit": 5.0, "driving limit": 9.0},
    ),
}
NOISE = {"drive_map": 1.6, "steering_curve": 0.04, "front_tyre_map": 0.08, "rear_tyre_map": 0.16}
"""Standard deviation of a sample; a curve is regressed on this many samples."""
SAMPLES = 6000


def measured_curve(curve_id, truth, seed, anchored=True):
    """A piecewise linear regression of noisy samples of a function, with its covariance."""
    curve, rng = EFFECTS[curve_id], np.random.default_rng(seed)
    knots = [np.array(axis.knots) for axis in curve.axes]
    x = [rng.uniform(k[0], k[-1], SAMPLES) for k in knots]
    noise = NOISE[curve_id]
    y = truth(*x) + noise * rng.normal(size=SAMPLES)
    hats = [np.stack([np.interp(v, k, row) for row in np.eye(len(k))], axis=1) for v, k in zip(x, knots, strict=True)]
    design = hats[0] if len(hats) == 1 else (hats[0][:, :, None] * hats[1][:, None]).reshape(SAMPLES, -1)
    grid = np.meshgrid(*knots, indexing="ij")
    shape = grid[0].shape
    value = np.array(truth(*(g.ravel() for g in grid)))
    anchor = [g.ravel() == axis.anchor for g, axis in zip(grid, curve.axes, strict=True)]
    free = ~np.any(anchor, axis=0) if anchored else np.ones(len(value), bool)
    inverse = np.linalg.inv(design[:, free].T @ design[:, free])
    value[free] = inverse @ (design[:, free].T @ (y - design[:, ~free] @ value[~free]))
    covariance = np.zeros((len(value), len(value)))
    covariance[np.ix_(free, free)] = noise**2 * inverse
    finding = CurveFinding(
        curve_id, curve.quantity, curve.unit, tuple(CurveAxis(a.name, a.unit, a.knots) for a in curve.axes),
        np.zeros(shape), value.reshape(shape), np.sqrt(np.diag(covariance)).reshape(shape), np.full(shape, 9.0),
    )  # fmt: skip
    return finding, covariance


def test_every_form_of_one_cause_has_a_truth():
    assert {form.id for name, forms in FORMS.items() for form in forms if "_tyre_map" not in name} <= set(TRUTHS)
    assert {form.id for form in TYRE_FORMS} <= set(TRUTHS)
    assert {curve_id for curve_id, *_ in TRUTHS.values()} == set(FORMS)
    assert set(FORMS) == {curve.id for curve in CURVES if curve.in_fits_of_curves}


@pytest.mark.parametrize("form_id", TRUTHS)
def test_the_true_form_is_named_with_its_parameters(form_id):
    """The form is named for four of five curves, and for all of three maps, whose fits take longer."""
    curve_id, truth, expected = TRUTHS[form_id]
    named, z = [], []
    for seed in range(5 if len(EFFECTS[curve_id].axes) == 1 else 3):
        form = identify_form(*measured_curve(curve_id, truth, seed), DEFAULT.curves)
        named.append(form.id if form.is_within_band else "")
        if form.id == form_id:
            z += [(form.parameters[name].value - value) / form.parameters[name].std for name, value in expected.items()]
            assert all(e.low90 < e.value < e.high90 for e in form.parameters.values())
    assert named.count(form_id) >= 0.8 * len(named), named
    assert not z or (np.abs(z).max() < 4.0 and np.mean(np.abs(z) < 1.645) >= 0.6)


def random_smooth(curve_id, seed):
    """A sum of sines of random direction, with one to two periods over the range, on a linear trend."""
    rng = np.random.default_rng(seed)
    size = {"drive_map": 3.0, "steering_curve": 0.1, "rear_tyre_map": 0.25}.get(curve_id, 0.2)
    span = [axis.knots[-1] - axis.knots[0] for axis in EFFECTS[curve_id].axes]
    waves = rng.uniform(1.0, 2.0, (3, len(span))) * rng.choice([-1, 1], (3, len(span))) * 2 * np.pi
    phase, slope = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.5, 1.5, len(span))

    def truth(*x):
        trend = sum(s * v / n for s, v, n in zip(slope, x, span, strict=True))
        return size * (
            trend + sum(np.sin(sum(k * v / n for k, v, n in zip(w, x, span, strict=True)) + p)
                        for w, p in zip(waves, phase, strict=True)) / np.sqrt(3)
        )  # fmt: skip

    return truth


@pytest.mark.parametrize(
    "curve_id", ["front_tyre_map", *(pytest.param(c, marks=pytest.mark.slow) for c in FORMS if c != "front_tyre_map")]
)
def test_random_smooth_curves_are_not_named(curve_id):
    forms = [
        identify_form(*measured_curve(curve_id, random_smooth(curve_id, seed), seed, anchored=False), DEFAULT.curves)
        for seed in range(10)
    ]
    assert sum(form.is_within_band for form in forms) <= 1
    curve = replace(measured_curve(curve_id, random_smooth(curve_id, 0), 0, anchored=False)[0], form=forms[0])
    assert form_sentence(curve).startswith(f"No named form fits the {curve.quantity} within its band. The closest ")


def test_true_forms_have_the_nominal_level():
    """Of curves of a true form, at most a few in a hundred lie outside of the band."""
    curve_id, truth, _ = TRUTHS["steering_asymmetry"]
    inside = [
        identify_form(*measured_curve(curve_id, truth, seed), DEFAULT.curves).is_within_band for seed in range(100)
    ]
    assert np.mean(inside) >= 0.94


def test_forms_that_a_wide_band_does_not_distinguish_are_all_named():
    curve, covariance = measured_curve("front_tyre_map", TRUTHS["saturating_tyre"][1], 0)
    wide = replace(curve, std=12.0 * curve.std)
    form = identify_form(wide, 144.0 * covariance, DEFAULT.curves)
    assert form.is_within_band
    assert len(form.indistinguishable_from) >= 1
    assert "Also within the band: a " in form_sentence(replace(wide, form=form))


def test_knots_without_data_are_not_compared_and_too_few_have_no_form():
    curve, covariance = measured_curve("steering_curve", TRUTHS["steering_asymmetry"][1], 1)
    wrong = curve.measured.copy()
    wrong[-1] = np.nan
    form = identify_form(replace(curve, measured=wrong), covariance, DEFAULT.curves)
    assert form.knots == 7  # of nine knots, one is anchored at 0
    assert form.id == "steering_asymmetry"
    wrong[3:] = np.nan
    form = identify_form(replace(curve, measured=wrong), covariance, DEFAULT.curves)
    assert (form.knots, form.id) == (3, "linear_steering")  # others have two parameters
    wrong[2:] = np.nan
    assert identify_form(replace(curve, measured=wrong), covariance, DEFAULT.curves) is None
    assert form_sentence(curve) == ""


def test_sentence_of_a_named_form_has_parameters_with_units_and_intervals():
    curve, covariance = measured_curve("steering_curve", TRUTHS["steering_nonlinearity"][1], 2)
    form = identify_form(curve, covariance, DEFAULT.curves)
    sentence = form_sentence(replace(curve, form=form))
    assert sentence.startswith("The wheel angle has the form of a saturation of the steering towards full lock: gain ")
    assert "limit 0.3" in sentence
    assert " rad (0.3" in sentence
    assert f"at {form.knots} knots" in sentence
