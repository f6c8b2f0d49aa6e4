"""Geometry against matplotlib's independent point-in-polygon test and hand-worked distances."""

import math

import numpy as np
import pytest
from matplotlib.path import Path as MplPath

from carlab.core.errors import ConfigError
from carlab.core.geofence import as_polygon, contains, free_distance_m, rectangle, stopping_distance_m

CONCAVE = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (2.0, 1.0), (0.0, 3.0))


def test_contains_agrees_with_matplotlib(rng: np.random.Generator) -> None:
    points = rng.uniform(-0.5, 4.5, (2000, 2))
    for corners in (CONCAVE, CONCAVE[::-1], rectangle(-1, 3, 0, 2)):
        ours = [contains(corners, *p) for p in points]
        assert ours == list(MplPath([*corners, corners[0]]).contains_points(points))


@pytest.mark.parametrize(
    ("heading_rad", "distance_m"),
    [(0.0, 2.0), (math.pi, 2.0), (math.pi / 2, 0.5), (-math.pi / 2, 0.5), (-math.atan2(0.5, 2.0), math.hypot(0.5, 2))],
)
def test_free_distance_inside_a_concave_polygon(heading_rad: float, distance_m: float) -> None:
    assert free_distance_m(CONCAVE, 2.0, 0.5, heading_rad) == pytest.approx(distance_m)


def test_stopping_distance_is_the_closed_form() -> None:
    # v t + v^2 / 2a: 3 m/s, 0.1 s, 3 m/s^2 is 0.3 + 1.5 m.
    assert stopping_distance_m(3.0, 0.1, 3.0) == pytest.approx(1.8)


@pytest.mark.parametrize("corners", [((0, 0), (1, 1)), ((0, 0), (1, 1), (2, 2)), ((0, 0), (1, math.nan), (2, 2))])
def test_a_polygon_without_area_is_refused(corners: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ConfigError):
        as_polygon(corners, "[hardware.arena]")
