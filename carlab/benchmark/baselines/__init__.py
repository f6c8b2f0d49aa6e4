"""Methods that the diagnosis is compared with, on the same cases and with the same noise model."""
