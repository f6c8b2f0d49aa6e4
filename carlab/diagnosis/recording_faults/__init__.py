"""Faults of the recordings themselves: stamps, pose, velocities, commands."""
