"""Predictions of recordings by a simulator: prediction windows, initial states, predictions, errors."""
