"""Parameter identification: fit of a simulator to prediction windows, measurement noise, velocity window."""
