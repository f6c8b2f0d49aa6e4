"""Audit of a recording: findings with severity and remedy."""
