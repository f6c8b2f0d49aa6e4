"""Measured curves: a fit of curves where the named effects leave a residual, and what the recordings support."""
