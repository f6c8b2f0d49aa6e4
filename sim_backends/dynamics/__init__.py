"""The single-track model, its actuators, integration and hooks for effects."""
