"""Recordings of episodes: writing during the episode, reading, plotting, import and export."""
