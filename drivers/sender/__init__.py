"""The sender process: it sends commands at fixed deadlines, with watchdog and latched faults."""
