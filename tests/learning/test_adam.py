"""Test Adam on one tensor against torch's Adam and AdamW."""

import pytest
import torch

from learning.networks.adam import Adam
from tests.helpers.seeded import generator


def gradients(count, shape=(3, 4)):
    """Return gradients of sizes from 1e-8, where Adam's epsilon matters, to 1."""
    sizes = torch.logspace(-8, 0, shape[1], dtype=torch.float64)
    return [sizes * torch.randn(shape, generator=generator(k), dtype=torch.float64) for k in range(count)]


def rate(step):
    return 0.05 / (1 + step)


def numbers(shape=(3, 4)):
    return torch.randn(shape, generator=generator(99), dtype=torch.float64)


def test_fifty_steps_with_a_decreasing_rate_equal_torch():
    parameters, reference = numbers(), numbers().requires_grad_()
    adam = Adam(parameters)
    torch_optimiser = torch.optim.Adam([reference], lr=1.0)
    for step, gradient in enumerate(gradients(50)):
        before = gradient.clone()
        adam.step(gradient, rate(step))
        torch_optimiser.param_groups[0]["lr"] = rate(step)
        reference.grad = before
        torch_optimiser.step()
        assert torch.equal(gradient, before)
        torch.testing.assert_close(parameters, reference.detach(), rtol=1e-12, atol=1e-12)
    assert not torch.allclose(parameters, numbers(), atol=0.01)


def test_optimiser_with_a_loaded_state_continues_as_uninterrupted_torch():
    reference = numbers().requires_grad_()
    torch_optimiser = torch.optim.Adam([reference], lr=0.01)
    first = Adam(numbers())
    second = None
    for step, gradient in enumerate(gradients(30)):
        if step == 10:
            second = Adam(first.parameters.clone())
            state = first.state()
            first.step(gradient, 1.0)  # Later steps of the first optimiser do not change its saved state.
            second.load(state)
        (second or first).step(gradient, 0.01)
        reference.grad = gradient.clone()
        torch_optimiser.step()
    torch.testing.assert_close(second.parameters, reference.detach(), rtol=1e-12, atol=1e-12)


def test_loaded_state_is_a_copy():
    adam, other = Adam(numbers()), Adam(numbers())
    state = adam.state()
    other.load(state)
    other.step(gradients(1)[0], 0.1)
    assert not state["mean"].any()
    assert not state["square"].any()
    assert state["steps"] == 0


@pytest.mark.parametrize("shape", [(4, 3), (3, 5), (12,), (1, 4)])
def test_state_of_another_shape_is_refused(shape):
    with pytest.raises(ValueError, match="shape"):
        Adam(numbers()).load(Adam(numbers(shape)).state())
