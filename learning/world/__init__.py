"""The learned car: transitions, dynamics, fit, and the vectorised environment that SAC trains in."""
