"""Experiments that produce tables and pictures."""
