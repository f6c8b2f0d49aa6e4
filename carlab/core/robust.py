"""Constants of robust statistics."""

STD_OVER_MAD = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""
