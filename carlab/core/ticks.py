"""Range of the number of ticks of an episode."""

MAX_TICKS = 10**6
"""Most ticks of an episode: nine hours at 30 Hz. A program keeps about 2 kB for each tick, so 2 GB for that many."""
