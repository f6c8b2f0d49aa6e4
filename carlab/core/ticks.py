"""Range of the number of ticks of an episode."""

MAX_TICKS = 10**6
"""Maximum number of ticks of an episode: nine hours at 30 Hz. A tick needs 2 kB of memory, so an episode up to 2 GB."""
