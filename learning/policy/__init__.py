"""Soft actor-critic: fast gradient step, agent and policy."""
