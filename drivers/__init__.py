"""Actuators and cars made of hardware."""
