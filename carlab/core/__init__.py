"""Interfaces and quantities for all packages; depends on NumPy and the standard library only."""
