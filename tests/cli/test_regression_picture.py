"""The picture of a regression study: lines, colours, axes, error bands and the saved file."""

import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from carlab.studies.regression.methods import METHODS
from carlab.studies.regression.picture import MAX_SHOWN_NAT, SIZE_INCHES, draw, picture
from carlab.studies.regression.scores import FIGURES, Row


def row(method, rows, nll, calibration=0.05, **others):
    errors = {"rmse_standard_error": 0.02, "calibration_standard_error": 0.01, "seconds_standard_error": 1.5}
    return Row(method, rows, 3, nll, 0.1, 0.2, calibration, 1.0, **(errors | others))


ROWS = [
    row("gp-sim-posterior", 5, -6.4),
    row("sim-posterior", 5, -4.5),
    row("SysID", 5, -4.4),
    row("ridge", 5, 314.7, 0.49),
    row("gp-sim-posterior", 50, -7.2),
    row("sim-posterior", 50, -4.8),
    row("SysID", 50, -4.7),
    row("ridge", 50, -1.9),
]


@pytest.fixture
def panels():
    return picture(ROWS)


def test_each_method_has_a_line_and_its_variant_another_line_style(panels):
    lines = {line.get_label(): line for line in panels.axes[0].get_lines()}
    assert list(lines) == ["gp-sim-posterior", "sim-posterior", "SysID", "ridge"]
    assert [text.get_text() for text in panels.legends[0].get_texts()] == list(lines)
    for name, line in lines.items():
        assert list(line.get_ydata()) == [r.nll for r in ROWS if r.method == name]
    full, without_gap = lines["gp-sim-posterior"], lines["sim-posterior"]
    assert full.get_color() == without_gap.get_color()
    assert full.get_linestyle() != without_gap.get_linestyle()


@pytest.mark.parametrize("known", [(), ("gp-sim-posterior", "SysID")])
def test_methods_of_another_study_have_different_colours(known):
    priors = ("none (gp-posterior)", "kinematic", "nominal", "diagnosed")
    figure = picture([row(name, n, -6.0 - k) for k, name in enumerate(known + priors) for n in (20, 50)])
    lines = figure.axes[0].get_lines()
    assert len({line.get_color() for line in lines}) == len(known + priors) == len(lines)
    widths = {line.get_label(): line.get_linewidth() for line in lines}
    assert widths["diagnosed"] > widths["kinematic"]


def test_outlier_is_printed_at_the_edge_and_does_not_stretch_the_axis(panels):
    for axis, text, name in ((panels.axes[0], "↑ 315", "nll"), (panels.axes[2], "↑ 0.49", "calibration")):
        assert [t.get_text() for t in axis.texts] == [text]
        low, high = axis.get_ylim()
        others = [getattr(r, name) for r in ROWS if r.rows == 50]
        assert low < min(others)
        assert max(others) < high
    assert panels.axes[0].get_ylim()[1] < -6.4 + 1.2 * MAX_SHOWN_NAT


def test_axis_covers_all_values_if_most_of_them_are_outliers():
    figure = picture([row("gp-sim-posterior", 2, -0.2), row("FSVGD", 2, 168.0), row("GreyBox", 2, 36.0)])
    assert figure.axes[0].get_ylim()[1] > 168.0
    assert not figure.axes[0].texts


def test_axis_of_distant_likelihoods_has_at_least_three_ticks():
    values = {"gp-sim-posterior": (-23.5, -25.3), "ridge": (-12.6, -15.8)}
    figure = picture([row(m, n, nll) for m, both in values.items() for n, nll in zip((50, 800), both, strict=True)])
    axis = figure.axes[0]
    low, high = axis.get_ylim()
    assert sum(low <= tick <= high for tick in axis.get_yticks()) >= 3


def test_colour_of_a_method_is_unique_and_the_same_in_every_picture():
    colours = {}
    for names in (list(METHODS), list(METHODS)[::-2]):
        figure = picture([row(name, 5, -1.0) for name in names])
        for line in figure.axes[1].get_lines():
            assert colours.setdefault(line.get_label(), line.get_color()) == line.get_color()
    variants = 3  # sim-posterior, sim-fsvgd-corrected and fsvgd-corrected have the colour of the whole method.
    assert len(set(colours.values())) == len(METHODS) - variants


def test_saved_file_is_an_image_of_the_expected_size(tmp_path):
    draw(ROWS, tmp_path / "study.png")
    pixels = imread(tmp_path / "study.png")
    assert pixels.shape[:2] == (round(130 * SIZE_INCHES[1]), round(130 * SIZE_INCHES[0]))
    assert pixels[..., :3].std() > 0.05


def test_every_figure_has_a_panel_with_standard_error_bands(panels):
    assert len(panels.axes) == len(FIGURES) == 4
    for axis, name in zip(panels.axes, FIGURES, strict=True):
        lines = {line.get_label(): line for line in axis.get_lines()}
        assert list(lines) == ["gp-sim-posterior", "sim-posterior", "SysID", "ridge"]
        for (method, line), band in zip(lines.items(), axis.collections, strict=True):
            assert list(line.get_ydata()) == [getattr(r, name) for r in ROWS if r.method == method]
            edges = {tuple(corner) for corner in np.round(band.get_paths()[0].vertices, 6)}
            for r in ROWS:
                value, error = getattr(r, name), getattr(r, f"{name}_standard_error")
                if r.method == method:
                    assert {(r.rows, round(value - error, 6)), (r.rows, round(value + error, 6))} <= edges
    assert panels.axes[3].get_ylabel() == "seconds a fit"


def test_single_seed_has_no_band_and_failed_fit_no_point():
    no_errors = {f"{name}_standard_error": math.nan for name in FIGURES}
    failed_row = Row("SysID", 50, 0, *(math.nan,) * 5, math.nan, failed=3)
    figure = picture(
        [*(replace(r, seeds=1, **no_errors) for r in ROWS if (r.method, r.rows) != ("SysID", 50)), failed_row]
    )
    for axis in figure.axes:
        assert not axis.collections
        assert [len(line.get_ydata()) for line in axis.get_lines()] == [2, 2, 1, 2]


def test_durations_far_apart_are_all_visible(tmp_path):
    """Ridge takes milliseconds; its band reaches below zero, which a logarithmic axis cannot show."""
    fast = {"seconds": 0.002, "seconds_standard_error": 0.003}
    slow = {"seconds": 900.0, "seconds_standard_error": 20.0}
    rows = [replace(r, **(fast if r.method == "ridge" else slow)) for r in ROWS]
    figure = picture(rows)
    axis = figure.axes[3]
    assert axis.get_yscale() == "log"
    low, high = axis.get_ylim()
    assert 0.0 < low < 0.002
    assert high > 900.0
    draw(rows, tmp_path / "study.png")
