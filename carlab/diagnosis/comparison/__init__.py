"""Comparison of two groups of recordings of one car: which numbers or effects differ."""
