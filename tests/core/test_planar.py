"""Rotations and arcs in the plane, for NumPy and torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from carlab.core.planar import arc, to_body, to_world


@pytest.mark.parametrize("array", [np.asarray, torch.tensor])
def test_vector_to_the_left_of_a_car_that_faces_north_points_west(array: Any) -> None:
    x, y = to_world(array(0.0), array(2.0), array(0.5 * np.pi))
    assert (float(x), float(y)) == pytest.approx((-2.0, 0.0), abs=1e-6)
    ahead, left = to_body(x, y, array(0.5 * np.pi))
    assert (float(ahead), float(left)) == pytest.approx((0.0, 2.0), abs=1e-6)


@pytest.mark.parametrize("array", [np.asarray, torch.tensor])
def test_arc_is_the_integral_of_the_velocity(array: Any) -> None:
    vx, vy, rate, end_s = 1.5, -0.3, 2.0, 1.2
    time_s = np.linspace(0.0, end_s, 20001)
    velocity = to_world(np.full_like(time_s, vx), np.full_like(time_s, vy), rate * time_s)
    expected = [np.trapezoid(v, time_s) for v in velocity]
    ahead, left, turn = (float(v) for v in arc(array(vx), array(vy), array(rate), array(end_s)))
    assert (ahead, left, turn) == pytest.approx((*expected, rate * end_s), abs=1e-6)
    assert float(arc(array(vx), array(vy), array(0.0), array(end_s))[0]) == pytest.approx(vx * end_s)
