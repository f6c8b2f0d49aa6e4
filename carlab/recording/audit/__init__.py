"""Audit of a foreign recording: stamps, units, frames, signs, spikes, delays."""
