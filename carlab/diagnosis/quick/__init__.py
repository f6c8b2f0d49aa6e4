"""Quick check after each episode of a campaign: whether, where and how the simulator differs from the recordings."""
