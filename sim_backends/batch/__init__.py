"""Batched rollouts in torch, differentiable in states, commands and parameters."""
