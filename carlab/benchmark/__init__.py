"""Proof on concealed effects: generator, sealed answers and scores, independent of the diagnosis that they test."""
