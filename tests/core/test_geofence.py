"""Geometry against matplotlib's independent point-in-polygon test and hand-worked distances."""

import math

import numpy as np
import pytest
from matplotlib.path import Path as MplPath

from carlab.core.errors import ConfigError
from carlab.core.geofence import (
    as_polygon,
    can_stop_inside,
    can_stop_inside_batch,
    contains,
    free_distance_m,
    rectangle,
    stopping_distance_m,
)
from carlab.core.quantities import CarState

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


def test_free_distance_ends_at_the_nearest_edge_in_either_sense() -> None:
    # From the left arm of the W towards the right arm the ray leaves through the notch and enters again.
    for corners in (CONCAVE, CONCAVE[::-1]):
        assert free_distance_m(corners, 0.5, 2.0, 0.0) == pytest.approx(0.5)
        assert free_distance_m(corners, 3.5, 2.0, math.pi) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("state", "can"),
    [
        # 0.1 s of reaction and 2 m/s^2: 1 m/s takes 0.1 + 0.25 = 0.35 m.
        (CarState(0.64, 0.0, 0.0, 1.0), True),
        (CarState(0.66, 0.0, 0.0, 1.0), False),
        (CarState(0.66, 0.0, math.pi, 1.0), True),
        (CarState(0.66, 0.0, math.pi, -1.0), False),
        (CarState(0.0, 0.66, 0.0, 0.0, 1.0), False),
        (CarState(0.66, 0.0, -math.pi / 2, 0.0, 1.0), False),
        (CarState(0.999, 0.0), True),
        (CarState(1.001, 0.0), False),
        (CarState(1.5, 0.0, math.pi, 1.0), False),
        (CarState(math.nan, 0.0), False),
        (CarState(0.0, 0.0, math.nan, 1.0), False),
        (CarState(0.0, 0.0, 0.0, math.nan), False),
    ],
)
def test_car_can_stop_inside_if_the_free_distance_suffices(state: CarState, can: bool) -> None:
    assert can_stop_inside(rectangle(-1.0, 1.0, -1.0, 1.0), state, 0.1, 2.0) is can


def test_batch_of_cars_can_stop_if_their_paths_stay_inside(rng: np.random.Generator) -> None:
    """Against matplotlib at 400 points of each stopping path, except paths that end within a hundredth of an edge."""
    places, course = rng.uniform(-0.3, 4.3, (1500, 2)), rng.uniform(-4.0, 4.0, 1500)
    needed = rng.uniform(0.0, 2.0, 1500)

    def stays(corners: tuple[tuple[float, float], ...], share: float) -> np.ndarray:
        way = share * needed[:, None, None] * np.linspace(0.0, 1.0, 400)[None, :, None]
        points = places[:, None] + way * np.stack([np.cos(course), np.sin(course)], axis=1)[:, None]
        inside = MplPath([*corners, corners[0]]).contains_points(points.reshape(-1, 2)).reshape(1500, 400)
        return inside.all(axis=1)

    for corners in (CONCAVE, CONCAVE[::-1], rectangle(-0.2, 3.0, 0.5, 4.0)):
        found = can_stop_inside_batch(corners, places, course, needed)
        longer, shorter = stays(corners, 1.02), stays(corners, 0.98)
        clear = longer == shorter
        assert clear.sum() > 1400
        assert np.array_equal(found[clear], shorter[clear])
        assert 200 < found.sum() < 1300


def test_batch_agrees_with_single_cars(rng: np.random.Generator) -> None:
    places, course = rng.uniform(-0.3, 4.3, (300, 2)), rng.uniform(-4.0, 4.0, 300)
    speed = rng.uniform(-3.0, 3.0, 300)
    places[0, 0], course[1] = math.nan, math.nan
    needed = stopping_distance_m(np.abs(speed), 0.1, 2.0)
    # In reverse the course over ground is opposite to the heading.
    found = can_stop_inside_batch(CONCAVE, places, course + np.where(speed < 0.0, math.pi, 0.0), needed)
    states = [CarState(x, y, yaw, v) for (x, y), yaw, v in zip(places, course, speed, strict=True)]
    assert found.tolist() == [can_stop_inside(CONCAVE, s, 0.1, 2.0) for s in states]


def test_stopping_distance_is_the_closed_form() -> None:
    # v t + v^2 / 2a: 3 m/s, 0.1 s, 3 m/s^2 is 0.3 + 1.5 m.
    assert stopping_distance_m(3.0, 0.1, 3.0) == pytest.approx(1.8)


@pytest.mark.parametrize("corners", [((0, 0), (1, 1)), ((0, 0), (1, 1), (2, 2)), ((0, 0), (1, math.nan), (2, 2))])
def test_a_polygon_without_area_is_refused(corners: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ConfigError):
        as_polygon(corners, "[hardware.arena]")
