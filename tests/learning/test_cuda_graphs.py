"""Functions that are captured as CUDA graphs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from learning.devices import CapturedFunction


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_captured_function_has_the_results_of_its_calls() -> None:
    """A captured step with a state and a changing rate equals the same steps without a CUDA graph."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn((12, 8), generator=generator).cuda()
    rates = torch.linspace(0.1, 0.5, 12).cuda()

    def steps(captured: bool) -> tuple[Tensor, Tensor]:
        state = torch.zeros(8, device="cuda")

        def step(row: Tensor, rate: Tensor) -> dict[str, Tensor]:
            state.add_(rate * (row - state).tanh())
            return {"distance": (row - state).norm()}

        call = CapturedFunction(step) if captured else step
        distances = [call(row, rate)["distance"].clone() for row, rate in zip(inputs, rates, strict=True)]
        return state, torch.stack(distances)

    for found, expected in zip(steps(True), steps(False), strict=True):
        torch.testing.assert_close(found, expected)
