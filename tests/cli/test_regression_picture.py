"""The picture of a regression study: who is in it, what can be read off, and that the file is what the screen shows."""

import pytest
from matplotlib import pyplot
from matplotlib.image import imread

from carlab.experiment.regression_picture import SHOWN_NAT, draw, picture
from carlab.experiment.regression_study import METHODS, Row


def row(method, rows, nll, calibration=0.05):
    return Row(method, rows, 3, nll, 0.1, 0.2, calibration, 1.0)


ROWS = [
    row("Sim-FSVGD", 5, -6.4),
    row("Sim-FSVGD without gap", 5, -4.5),
    row("SysID", 5, -4.4),
    row("ridge", 5, 314.7, 0.49),
    row("Sim-FSVGD", 50, -7.2),
    row("Sim-FSVGD without gap", 50, -4.8),
    row("SysID", 50, -4.7),
    row("ridge", 50, -1.9),
]


@pytest.fixture
def panels():
    figure = picture(ROWS)
    yield figure
    pyplot.close(figure)


def test_each_method_has_a_line_and_the_one_without_gap_is_told_from_the_one_with(panels):
    lines = {line.get_label(): line for line in panels.axes[0].get_lines()}
    assert list(lines) == ["Sim-FSVGD", "Sim-FSVGD without gap", "SysID", "ridge"]
    assert [text.get_text() for text in panels.legends[0].get_texts()] == list(lines)
    for name, line in lines.items():
        assert list(line.get_ydata()) == [r.nll for r in ROWS if r.method == name]
    whole, part = lines["Sim-FSVGD"], lines["Sim-FSVGD without gap"]
    assert whole.get_color() == part.get_color()
    assert whole.get_linestyle() != part.get_linestyle()


def test_a_value_far_off_is_a_number_at_the_edge_and_squeezes_no_other(panels):
    for axis, text, name in ((panels.axes[0], "↑ 315", "nll"), (panels.axes[2], "↑ 0.49", "calibration")):
        assert [t.get_text() for t in axis.texts] == [text]
        low, high = axis.get_ylim()
        others = [getattr(r, name) for r in ROWS if r.rows == 50]
        assert low < min(others)
        assert max(others) < high
    assert panels.axes[0].get_ylim()[1] < -6.4 + 1.2 * SHOWN_NAT


def test_where_most_are_far_off_none_is_cut():
    figure = picture([row("Sim-FSVGD", 2, -0.2), row("FSVGD", 2, 168.0), row("GreyBox", 2, 36.0)])
    try:
        assert figure.axes[0].get_ylim()[1] > 168.0
        assert not figure.axes[0].texts
    finally:
        pyplot.close(figure)


def test_likelihoods_that_lie_far_apart_can_be_read_off():
    values = {"Sim-FSVGD": (-23.5, -25.3), "ridge": (-12.6, -15.8)}
    figure = picture([row(m, n, nll) for m, both in values.items() for n, nll in zip((50, 800), both, strict=True)])
    axis = figure.axes[0]
    low, high = axis.get_ylim()
    assert sum(low <= tick <= high for tick in axis.get_yticks()) >= 3
    pyplot.close(figure)


def test_a_method_is_the_same_colour_in_every_picture_and_no_two_share_one():
    colours = {}
    for names in (list(METHODS), list(METHODS)[::-2]):
        figure = picture([row(name, 5, -1.0) for name in names])
        for line in figure.axes[1].get_lines():
            assert colours.setdefault(line.get_label(), line.get_color()) == line.get_color()
        pyplot.close(figure)
    assert len(set(colours.values())) == len(METHODS) - 1


def test_the_file_is_a_picture(tmp_path):
    draw(ROWS, tmp_path / "study.png")
    pixels = imread(tmp_path / "study.png")
    assert pixels.shape[:2] == (round(4.4 * 130), 13 * 130)
    assert pixels[..., :3].std() > 0.05
