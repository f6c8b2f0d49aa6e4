"""Quick check after each episode of a campaign: whether the simulator differs from the recordings, where, and why."""
