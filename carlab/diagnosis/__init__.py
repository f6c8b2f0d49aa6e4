"""Locate, name, model and prove what a simulator leaves out."""
