"""The learned car: dynamics, fit, and the vectorised environment for the training by SAC."""
