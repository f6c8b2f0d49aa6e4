"""Test that denormal numbers are flushed to zero inside the context and kept outside."""

import pytest
import torch

from learning.devices import denormals_flushed

DENORMAL = torch.tensor([1e-39, 1.0])


def keeps_denormals() -> bool:
    return bool((DENORMAL * 1.0)[0])


def test_denormals_are_zero_inside_the_context_only() -> None:
    assert keeps_denormals()
    with denormals_flushed():
        assert not keeps_denormals()
        with denormals_flushed():
            assert not keeps_denormals()
        assert not keeps_denormals(), "the outer context still flushes"
    assert keeps_denormals()


def test_denormals_are_restored_after_an_error() -> None:
    with pytest.raises(ZeroDivisionError), denormals_flushed():
        raise ZeroDivisionError
    assert keeps_denormals()
