"""The contract that everything else stands on: NumPy and the standard library only."""
