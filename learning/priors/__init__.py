"""Simulators with unknown parameters as priors over functions."""
