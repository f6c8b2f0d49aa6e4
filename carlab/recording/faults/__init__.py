"""Fault detection on arrays, one module per concept: stamps, pose, heading, velocity columns, commands."""
