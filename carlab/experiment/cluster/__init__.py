"""Training of a run on a Ray cluster, while the car stays with this computer."""
