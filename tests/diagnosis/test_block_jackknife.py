"""Covariance by the jackknife over blocks, against fits that really leave each block out, and against its purpose."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.block_jackknife import (
    interval_quantile,
    jackknife_covariance,
    sandwich_design_effects,
)

ROWS, BLOCKS = 120, 8
OF_BLOCK = ROWS // BLOCKS
BLOCK = np.repeat(np.arange(BLOCKS), OF_BLOCK)


def linear_problem(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Regressors (ROWS, 2) of which one block has large values, and observations of a line with dependent errors."""
    x = rng.normal(size=(ROWS, 2))
    x[:OF_BLOCK] *= 2.5
    shared = rng.normal(size=BLOCKS)[BLOCK]
    return x, x @ np.array([1.0, -2.0]) + shared * x[:, 0] + rng.normal(size=ROWS)


def blocks_of(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information, scores and the precision of a flat prior."""
    residual = x @ np.linalg.lstsq(x, y, rcond=None)[0] - y
    of_blocks = x.reshape(BLOCKS, OF_BLOCK, 2)
    information = np.einsum("bri,brj->bij", of_blocks, of_blocks)
    scores = np.einsum("bri,br->bi", of_blocks, residual.reshape(BLOCKS, OF_BLOCK))
    return information, scores, np.zeros((2, 2))


def test_linear_fit_agrees_with_fits_without_each_block() -> None:
    x, y = linear_problem(np.random.default_rng(0))
    full = np.linalg.lstsq(x, y, rcond=None)[0]
    others = [np.flatnonzero(BLOCK - b) for b in range(BLOCKS)]
    changes = np.array([np.linalg.lstsq(x[rows], y[rows], rcond=None)[0] for rows in others]) - full
    expected = (BLOCKS - 1) / BLOCKS * changes.T @ changes
    assert jackknife_covariance(*blocks_of(x, y)) == pytest.approx(expected)


def test_intervals_contain_the_truth_although_one_block_dominates() -> None:
    rng = np.random.default_rng(1)
    contained = []
    for _ in range(400):
        x, y = linear_problem(rng)
        slope = np.linalg.lstsq(x, y, rcond=None)[0][0]
        half = interval_quantile(BLOCKS, 0.9) * math.sqrt(jackknife_covariance(*blocks_of(x, y))[0, 0])
        contained.append(abs(slope - 1.0) < half)
    assert np.mean(contained) >= 0.85


def test_single_block_counts_its_errors_as_independent() -> None:
    normal = np.array([[4.0, 1.0], [1.0, 3.0]])
    covariance = jackknife_covariance(normal[None], np.zeros((1, 2)), np.eye(2))
    assert covariance == pytest.approx(np.linalg.inv(normal + np.eye(2)))


def test_design_effects_are_one_for_independent_errors_and_the_block_size_for_equal_ones() -> None:
    rng = np.random.default_rng(2)
    x = np.ones((8000, 1))
    for size, errors in ((1, rng.normal(size=8000)), (40, np.repeat(rng.normal(size=200), 40))):
        scores = (x[:, 0] * (errors - errors.mean())).reshape(200, 40).sum(axis=1)[:, None]
        effects = sandwich_design_effects(np.full((200, 1, 1), 40.0), scores, np.zeros((1, 1)))
        assert effects == pytest.approx([size], rel=0.25)


def test_quantile_is_that_of_student_and_approaches_the_normal_one() -> None:
    assert interval_quantile(5, 0.9) == pytest.approx(2.1318, abs=1e-4)  # Student's table, 4 degrees of freedom
    assert interval_quantile(1, 0.9) == pytest.approx(stats.norm.ppf(0.95))
    assert interval_quantile(10_000, 0.9) == pytest.approx(1.6449, abs=1e-3)
