"""Particles of a Bayesian neural network: many small networks of one shape as one tensor of parameters.

Every particle is an MLP with a linear head. Parameters of all particles lie in one tensor (L, P), so that one batched
product runs all of them and an optimiser sees one leaf.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional

Layers = Sequence[tuple[Tensor, Tensor]]
"""Weights (L, in, out) and biases (L, 1, out) of each layer."""

Activation = Literal["leaky_relu", "silu"]
LEAKY_RELU_SLOPE = 0.01


@dataclass(frozen=True, slots=True)
class Network:
    """Shape of a particle.

    Attributes:
        inputs: number of inputs.
        outputs: number of outputs.
        hidden: width of each hidden layer; the authors use three of 64.
        activation: of hidden units. Smooth ones (``silu``: Elfwing, Uchibe and Doya 2018) follow a smooth
            function more closely; the authors have leaky ReLUs.
        slope: of the leaky ReLU below zero; 0 is a ReLU.
    """

    inputs: int
    outputs: int
    hidden: tuple[int, ...] = (64, 64, 64)
    activation: Activation = "leaky_relu"
    slope: float = LEAKY_RELU_SLOPE

    def __post_init__(self) -> None:
        if self.activation not in get_args(Activation):
            raise ValueError(f"no activation '{self.activation}'")

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """Inputs and outputs of each layer."""
        sizes = (self.inputs, *self.hidden, self.outputs)
        return tuple(pairwise(sizes))

    @property
    def parameters(self) -> int:
        """Numbers of one particle."""
        return sum((fan_in + 1) * fan_out for fan_in, fan_out in self.layers)

    def initial(self, particles: int, generator: torch.Generator, device: torch.device | str = "cpu") -> Tensor:
        """Parameters (L, P): He-uniform hidden weights, small uniform biases, a head without bias.

        Drawn on the generator's device and moved, so that a seed means the same numbers everywhere.
        """
        parts: list[Tensor] = []
        last = len(self.layers) - 1
        for k, (fan_in, fan_out) in enumerate(self.layers):
            spread = math.sqrt((3.0 if k == last else 6.0) / fan_in)
            weights = torch.rand((particles, fan_in * fan_out), generator=generator) * 2.0 - 1.0
            biases = torch.rand((particles, fan_out), generator=generator) * 2.0 - 1.0
            parts += [weights * spread, biases * (0.0 if k == last else 1.0 / math.sqrt(fan_in))]
        return torch.cat(parts, dim=1).to(device)

    def split(self, parameters: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Weights (L, in, out) and biases (L, 1, out) of each layer, as views of the parameters (L, P)."""
        found, begin = [], 0
        for fan_in, fan_out in self.layers:
            weights = parameters[:, begin : begin + fan_in * fan_out].view(-1, fan_in, fan_out)
            begin += fan_in * fan_out
            found.append((weights, parameters[:, begin : begin + fan_out].unsqueeze(1)))
            begin += fan_out
        return found

    def __call__(self, parameters: Tensor, inputs: Tensor) -> Tensor:
        """Outputs (L, N, O) of all particles at inputs (N, D), or at inputs of their own (L, N, D)."""
        *hidden, (weights, biases) = self.split(parameters)
        given = self._by_particle(inputs, len(parameters))
        inplace = not torch.is_grad_enabled()  # Autograd needs the preactivations.
        for w, b in hidden:
            given = self._activated(torch.baddbmm(b, given, w), inplace=inplace)
        return torch.baddbmm(biases, given, weights)

    def values_and_pullback(self, parameters: Tensor, inputs: Tensor) -> tuple[Tensor, Pullback]:
        """Outputs (L, N, O) at inputs (N, D), or (L, N, D), and the pullback of directions on them to the parameters.

        The chain rule is written out: at these sizes it costs a fraction of autograd's bookkeeping.
        """
        return self.through(self.split(parameters), inputs)

    def through(self, layers: Layers, inputs: Tensor) -> tuple[Tensor, Pullback]:
        """The same of layers that are split already."""
        layer_inputs, preactivations = [self._by_particle(inputs, len(layers[0][0]))], []
        *hidden, (weights, biases) = layers
        for w, b in hidden:
            preactivations.append(torch.baddbmm(b, layer_inputs[-1], w))
            layer_inputs.append(self._activated(preactivations[-1]))
        outputs = torch.baddbmm(biases, layer_inputs[-1], weights)
        return outputs, Pullback(self, layers, layer_inputs, preactivations)

    @staticmethod
    def _by_particle(inputs: Tensor, particles: int) -> Tensor:
        """Inputs (L, N, D), the same for all particles unless each has its own."""
        return inputs if inputs.ndim == 3 else inputs.expand(particles, *inputs.shape)

    def _activated(self, summed: Tensor, *, inplace: bool = False) -> Tensor:
        """Activations of hidden units."""
        if self.activation == "silu":
            return functional.silu(summed, inplace=inplace)
        return functional.leaky_relu(summed, self.slope, inplace=inplace)

    def activation_pullback(self, direction: Tensor, summed: Tensor) -> Tensor:
        """Direction on preactivations, from one on activations; one pass over the memory."""
        found: Tensor
        if self.activation == "silu":
            found = torch.ops.aten.silu_backward(direction, summed)
        else:
            found = torch.ops.aten.leaky_relu_backward(direction, summed, self.slope, False)
        return found


@dataclass(frozen=True, slots=True)
class Pullback:
    """The derivative of a forward pass.

    Attributes:
        network: shape of a particle.
        layers: weights and biases.
        layer_inputs: of each layer (L, N, in).
        preactivations: of each hidden layer (L, N, out).
    """

    network: Network
    layers: Layers
    layer_inputs: Sequence[Tensor]
    preactivations: Sequence[Tensor]

    def __call__(self, direction: Tensor) -> Tensor:
        """Gradient (L, P) of ``sum(direction * outputs)`` by the parameters."""
        parts: list[Tensor] = []
        for k in range(len(self.layers) - 1, -1, -1):
            parts += [direction.sum(dim=1), torch.bmm(self.layer_inputs[k].transpose(1, 2), direction).flatten(1)]
            if k:
                direction = self._through(k, direction)
        return torch.cat(parts[::-1], dim=1)

    def on_inputs(self, direction: Tensor) -> Tensor:
        """Gradient (L, N, D) of ``sum(direction * outputs)`` by the inputs."""
        for k in range(len(self.layers) - 1, 0, -1):
            direction = self._through(k, direction)
        return torch.bmm(direction, self.layers[0][0].transpose(1, 2))

    def of_first(self, count: int) -> Pullback:
        """The derivative for the first ``count`` inputs alone."""
        parts = ([v[:, :count] for v in each] for each in (self.layer_inputs, self.preactivations))
        return Pullback(self.network, self.layers, *parts)

    def _through(self, k: int, direction: Tensor) -> Tensor:
        """Direction on the preactivations before layer k, from one on the output of layer k."""
        back = torch.bmm(direction, self.layers[k][0].transpose(1, 2))
        return self.network.activation_pullback(back, self.preactivations[k - 1])


__all__ = ["Activation", "Layers", "Network", "Pullback"]
