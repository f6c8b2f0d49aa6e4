"""Particles of a Bayesian neural network: many small networks of one shape as one tensor of parameters.

Every particle is an MLP with a linear head. One tensor (L, P) holds all parameters, so that one batched
product evaluates all of them and an optimiser has one leaf.
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
        activation: of hidden units. A smooth activation (``silu``: Elfwing, Uchibe and Doya 2018) approximates smooth
            functions more closely; the authors use leaky ReLUs.
        slope: of the leaky ReLU below zero; 0 is a ReLU.
    """

    inputs: int
    outputs: int
    hidden: tuple[int, ...] = (64, 64, 64)
    activation: Activation = "leaky_relu"
    slope: float = LEAKY_RELU_SLOPE

    def __post_init__(self) -> None:
        if self.activation not in get_args(Activation):
            raise ValueError(f"unknown activation '{self.activation}'")

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """Inputs and outputs of each layer."""
        sizes = (self.inputs, *self.hidden, self.outputs)
        return tuple(pairwise(sizes))

    @property
    def parameters(self) -> int:
        """Number of parameters of one particle."""
        return sum((fan_in + 1) * fan_out for fan_in, fan_out in self.layers)

    def initial(self, particles: int, generator: torch.Generator, device: torch.device | str = "cpu") -> Tensor:
        """Parameters (L, P): He-uniform hidden weights, small uniform biases, a head whose biases are zero.

        He, Zhang, Ren and Sun 2015 ("Delving Deep into Rectifiers", equation 10).

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
        """Outputs (L, N, O) of all particles at common inputs (N, D), or at inputs of each particle (L, N, D)."""
        *hidden, (weights, biases) = self.split(parameters)
        activations = self._by_particle(inputs, len(parameters))
        inplace = not torch.is_grad_enabled()  # Autograd needs the preactivations.
        for w, b in hidden:
            activations = self._activated(torch.baddbmm(b, activations, w), inplace=inplace)
        return torch.baddbmm(biases, activations, weights)

    def values_and_pullback(self, parameters: Tensor, inputs: Tensor) -> tuple[Tensor, Pullback]:
        """Outputs (L, N, O) at inputs (N, D), or (L, N, D), and the pullback of directions on them to the parameters.

        The chain rule is explicit: for networks of this size it is much faster than autograd.
        """
        return self.through(self.split(parameters), inputs)

    def through(self, layers: Layers, inputs: Tensor) -> tuple[Tensor, Pullback]:
        """``values_and_pullback`` at inputs (N, D), or (L, N, D), for layers from ``split``."""
        layer_inputs, preactivations = [self._by_particle(inputs, len(layers[0][0]))], []
        *hidden, (weights, biases) = layers
        for w, b in hidden:
            preactivations.append(torch.baddbmm(b, layer_inputs[-1], w))
            layer_inputs.append(self._activated(preactivations[-1]))
        outputs = _linear_map(biases, layer_inputs[-1], weights)
        return outputs, Pullback(self, layers, layer_inputs, preactivations)

    @staticmethod
    def _by_particle(inputs: Tensor, particles: int) -> Tensor:
        """Inputs (L, N, D), expanded to all particles if they are common (N, D)."""
        return inputs if inputs.ndim == 3 else inputs.expand(particles, *inputs.shape)

    def _activated(self, preactivation: Tensor, *, inplace: bool = False) -> Tensor:
        """Activations of hidden units."""
        if self.activation == "silu":
            return functional.silu(preactivation, inplace=inplace)
        return functional.leaky_relu(preactivation, self.slope, inplace=inplace)

    def activation_pullback(self, direction: Tensor, preactivation: Tensor) -> Tensor:
        """Gradient with respect to preactivations, from one with respect to activations; all (L, N, H)."""
        gradient: Tensor
        if self.activation == "silu":
            gradient = torch.ops.aten.silu_backward(direction, preactivation)
        else:
            gradient = torch.ops.aten.leaky_relu_backward(direction, preactivation, self.slope, False)
        return gradient


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
        """Gradient (L, P) of ``sum(direction * outputs)`` with respect to the parameters; direction (L, N, O)."""
        parts: list[Tensor] = []
        for k in range(len(self.layers) - 1, -1, -1):
            parts += [direction.sum(dim=1), _weight_gradient(self.layer_inputs[k], direction)]
            if k:
                direction = self._through(k, direction)
        return torch.cat(parts[::-1], dim=1)

    def on_inputs(self, direction: Tensor) -> Tensor:
        """Gradient (L, N, D) of ``sum(direction * outputs)`` with respect to the inputs; direction (L, N, O)."""
        for k in range(len(self.layers) - 1, 0, -1):
            direction = self._through(k, direction)
        return _times_transpose(direction, self.layers[0][0])

    def of_first(self, count: int) -> Pullback:
        """The derivative for the first ``count`` inputs."""
        parts = ([v[:, :count] for v in each] for each in (self.layer_inputs, self.preactivations))
        return Pullback(self.network, self.layers, *parts)

    def _through(self, k: int, direction: Tensor) -> Tensor:
        """Gradient with respect to the preactivations of layer k - 1, from one with respect to those of layer k."""
        back = _times_transpose(direction, self.layers[k][0])
        return self.network.activation_pullback(back, self.preactivations[k - 1])


# A matrix product with one column has a large overhead: elementwise operations are two to seven times as fast there.


def _linear_map(biases: Tensor, inputs: Tensor, weights: Tensor) -> Tensor:
    """``inputs @ weights + biases`` (L, N, O) of inputs (L, N, I)."""
    if weights.shape[2] == 1:
        return (inputs * weights.transpose(1, 2)).sum(dim=2, keepdim=True) + biases
    return torch.baddbmm(biases, inputs, weights)


def _times_transpose(direction: Tensor, weights: Tensor) -> Tensor:
    """``direction @ weights^T`` (L, N, I) of a direction (L, N, O)."""
    if weights.shape[2] == 1:
        return direction * weights.transpose(1, 2)
    return torch.bmm(direction, weights.transpose(1, 2))


def _weight_gradient(inputs: Tensor, direction: Tensor) -> Tensor:
    """``inputs^T @ direction`` as rows (L, I O)."""
    if direction.shape[2] == 1:
        return torch.bmm(direction.transpose(1, 2), inputs).flatten(1)
    return torch.bmm(inputs.transpose(1, 2), direction).flatten(1)
