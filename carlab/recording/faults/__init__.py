"""Fault detection on arrays, one module a concept: stamps, pose, heading, velocity columns, commands."""
