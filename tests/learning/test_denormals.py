"""Numbers too small to be normal: zero while a policy learns, and themselves again afterwards."""

import pytest
import torch

from learning.devices import denormals_flushed

CHOLESKY_JITTER = torch.tensor([1e-39, 1.0])


def counted() -> bool:
    return bool((CHOLESKY_JITTER * 1.0)[0])


def test_they_are_zero_inside_and_nowhere_else() -> None:
    assert counted()
    with denormals_flushed():
        assert not counted()
        with denormals_flushed():
            assert not counted()
        assert not counted(), "what was outside stays"
    assert counted()


def test_they_come_back_after_an_error() -> None:
    with pytest.raises(ZeroDivisionError), denormals_flushed():
        raise ZeroDivisionError
    assert counted()
