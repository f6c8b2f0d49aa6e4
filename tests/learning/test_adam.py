"""Adam on one tensor against that of torch."""

import pytest
import torch

from learning.networks.adam import Adam


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def gradients(count, shape=(3, 4)):
    """Of sizes from 1e-8, where the smallest denominator counts, to 1."""
    sizes = torch.logspace(-8, 0, shape[1], dtype=torch.float64)
    return [sizes * torch.randn(shape, generator=generator(k), dtype=torch.float64) for k in range(count)]


def rate(step):
    return 0.05 / (1 + step)


def numbers(shape=(3, 4)):
    return torch.randn(shape, generator=generator(99), dtype=torch.float64)


@pytest.mark.parametrize("decay", [0.0, 0.3])
def test_fifty_steps_with_a_falling_rate_are_torchs(decay):
    ours, theirs = numbers(), numbers().requires_grad_()
    adam = Adam(ours, weight_decay=decay)
    kind = torch.optim.AdamW if decay else torch.optim.Adam
    stock = kind([theirs], lr=1.0, weight_decay=decay)
    for step, gradient in enumerate(gradients(50)):
        before = gradient.clone()
        adam.step(gradient, rate(step))
        stock.param_groups[0]["lr"] = rate(step)
        theirs.grad = before
        stock.step()
        assert torch.equal(gradient, before)
        torch.testing.assert_close(ours, theirs.detach(), rtol=1e-12, atol=1e-12)
    assert not torch.allclose(ours, numbers(), atol=0.01)


def test_with_the_state_of_another_it_goes_on_as_torch_without_a_break():
    theirs = numbers().requires_grad_()
    stock = torch.optim.Adam([theirs], lr=0.01)
    first = Adam(numbers())
    second = None
    for step, gradient in enumerate(gradients(30)):
        if step == 10:
            second = Adam(first.parameters.clone())
            state = first.state()
            first.step(gradient, 1.0)  # What a state has given is not moved any more.
            second.load(state)
        (second or first).step(gradient, 0.01)
        theirs.grad = gradient.clone()
        stock.step()
    torch.testing.assert_close(second.parameters, theirs.detach(), rtol=1e-12, atol=1e-12)


def test_loaded_moments_are_a_copy():
    adam, other = Adam(numbers()), Adam(numbers())
    state = adam.state()
    other.load(state)
    other.step(gradients(1)[0], 0.1)
    assert not state["mean"].any()
    assert not state["square"].any()
    assert state["steps"] == 0


@pytest.mark.parametrize("shape", [(4, 3), (3, 5), (12,), (1, 4)])
def test_moments_of_other_numbers_are_refused(shape):
    with pytest.raises(ValueError, match="shape"):
        Adam(numbers()).load(Adam(numbers(shape)).state())
