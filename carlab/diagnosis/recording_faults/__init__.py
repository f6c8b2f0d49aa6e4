"""Detection and repair of faults of recordings: stamps, pose, velocities, commands."""
