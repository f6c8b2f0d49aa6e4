"""Interfaces and quantities for all packages; depends on NumPy, array-api-compat and the standard library only."""
