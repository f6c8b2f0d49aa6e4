"""Statistics of a comparison against distributions that scipy draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from carlab.core.quantities import FloatArray
from carlab.diagnosis.comparison.difference import Difference, GroupErrors, difference, p_value
from carlab.diagnosis.comparison.drive_spread import DriveSpread, parts_of, spread_prior
from carlab.diagnosis.identification.error_model import CrossFittedErrors, ErrorModel
from carlab.prediction.windows import PredictionWindows

SIZE = 12
PARTS, BLOCKS, WINDOWS = 8, 4, 6
"""Parts of a group, blocks of a part, and windows of a block."""
UNIT = ErrorModel(np.eye(SIZE), 1e6)
"""Independent errors with unit variance, almost Gaussian."""


def windows(recording: list[int], block: list[int]) -> PredictionWindows:
    """Windows with these recordings and blocks, and nothing else."""
    empty = np.zeros((len(block), 0))
    return PredictionWindows(
        0.1, empty, empty, empty, empty, empty, empty, np.zeros(len(block)), np.array(recording), np.array(block),
        np.zeros(len(block), dtype=bool),
    )  # fmt: skip


def group(rng: np.random.Generator, deviation: float, secant: FloatArray, windows_per_block: int) -> GroupErrors:
    """Independent errors in which each part has its own parameter along the secant."""
    block = np.repeat(np.arange(len(secant) // windows_per_block), windows_per_block)
    part = block // BLOCKS
    of_part = deviation * rng.standard_normal(int(part.max()) + 1)
    return GroupErrors(rng.standard_normal(secant.shape) - of_part[part, None] * secant, block, part)


def p_values(deviation: float, *, with_spread: bool, count: int = 300) -> FloatArray:
    """P-values of comparisons of groups without a difference."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(count):
        secant = rng.standard_normal((PARTS * BLOCKS * WINDOWS, SIZE))
        both = [group(rng, deviation, secant, WINDOWS) for _ in range(2)]
        one = difference([secant, secant], both, UNIT)
        assert isinstance(one, Difference)
        used = one if with_spread else replace(one, spread=DriveSpread(1.0, 1e6))
        found.append(p_value(used, one.likelihood_ratio, 1))
    return np.array(found)


def test_p_value_of_independent_errors_is_uniform() -> None:
    assert stats.kstest(p_values(0.0, with_spread=False), "uniform").pvalue > 0.01


def test_spread_of_parts_keeps_the_rate_of_false_changes() -> None:
    """Each part has another true value, with three times the standard error of a part."""
    deviation = 3.0 / np.sqrt(BLOCKS * WINDOWS * SIZE)
    assert np.mean(p_values(deviation, with_spread=False) < 0.05) > 0.2
    assert np.mean(p_values(deviation, with_spread=True) < 0.05) == pytest.approx(0.05, abs=0.03)


def test_shorter_group_with_more_windows_per_block_keeps_the_rate_of_false_changes() -> None:
    """A parameter that differs from block to block: 60 blocks of 5 windows against 12 blocks of 12 windows."""
    rng = np.random.default_rng(6)
    found = []
    for _ in range(500):
        secants = [rng.standard_normal((blocks * windows, SIZE)) for blocks, windows in ((60, 5), (12, 12))]
        both = []
        for secant, windows in zip(secants, (5, 12), strict=True):
            one = group(rng, 0.0, secant, windows)
            of_block = 0.3 * rng.standard_normal(int(one.block.max()) + 1)
            both.append(replace(one, errors=one.errors - of_block[one.block, None] * secant))
        change = difference(secants, both, UNIT)
        assert change is not None
        found.append(p_value(replace(change, spread=DriveSpread(1.0, 1e6)), change.likelihood_ratio, 1))
    assert np.mean(np.array(found) < 0.05) == pytest.approx(0.05, abs=0.025)


def test_candidate_that_acts_in_few_blocks_is_left_out() -> None:
    rng = np.random.default_rng(2)
    secant = rng.standard_normal((PARTS * BLOCKS * WINDOWS, SIZE))
    both = [group(rng, 0.0, secant, WINDOWS) for _ in range(2)]
    few = np.where(both[0].block[:, None] < 3, secant, 0.0)
    assert difference([few, secant], both, UNIT) is None


@pytest.mark.parametrize(("ratio", "dof"), [(1.0, 4.0), (2.5, 10.0)])
def test_prior_of_the_spread_is_that_of_its_sample(ratio: float, dof: float) -> None:
    """Spreads with d degrees of freedom and a scaled inverse chi-squared prior have an F-distribution."""
    sample = ratio * stats.f.rvs(6, dof, size=20_000, random_state=3)
    prior = spread_prior([DriveSpread(float(s), 6.0) for s in sample])
    assert prior.ratio == pytest.approx(ratio, rel=0.05)
    assert prior.dof == pytest.approx(dof, rel=0.15)


def test_moderated_spread_lies_between_prior_and_estimate() -> None:
    prior = spread_prior([DriveSpread(float(s), 3.0) for s in stats.f.rvs(3, 5, size=2000, random_state=4)])
    assert prior.ratio < prior.moderated(DriveSpread(9.0, 3.0), 1.0).ratio < 9.0
    assert prior.moderated(DriveSpread(0.1, 3.0), 1.0).ratio == 1.0
    long_drive = prior.moderated(DriveSpread(9.0, 3.0), 2.0).ratio
    assert long_drive - 1.0 == pytest.approx(2.0 * (prior.moderated(DriveSpread(9.0, 3.0), 1.0).ratio - 1.0))


def test_part_lies_in_one_drive() -> None:
    drives = windows([0] * 10 + [1] * 4 + [2] * 6, [*range(10), *range(20, 24), *range(30, 36)])
    assert parts_of(drives, 5).tolist() == [0] * 5 + [1] * 5 + [2] * 4 + [3] * 6


def test_errors_of_the_first_group_are_as_large_as_those_of_new_windows() -> None:
    """60 windows of 12 channels: the covariance of all windows makes them smaller than new ones."""
    rng = np.random.default_rng(5)
    mixing = rng.standard_normal((SIZE, SIZE)) + 3.0 * np.eye(SIZE)
    draws = [stats.multivariate_t(shape=mixing @ mixing.T, df=5.0, seed=k).rvs(size=60) for k in range(20)]
    new = stats.multivariate_t(shape=mixing @ mixing.T, df=5.0, seed=99).rvs(size=2000)

    def median_distance(errors: FloatArray) -> float:
        return float(np.median((errors**2).sum(axis=1)))

    ratios = []
    for errors in draws:
        models = CrossFittedErrors.of(errors, np.arange(60) // 12)
        of_new = median_distance(models.whole.decorrelated(new))
        ratios.append(
            [
                median_distance(models.whole.decorrelated(errors)) / of_new,
                median_distance(models.decorrelated(errors)) / of_new,
            ]
        )
    same, cross_fitted = np.mean(ratios, axis=0)
    assert same < 0.9
    assert cross_fitted == pytest.approx(1.0, abs=0.15)
