"""Range of seeds."""

MAX_SEED = 2**32 - 1
"""Largest seed of all commands: ``numpy.random.seed``, which stable-baselines3 calls, takes 32 bits."""
