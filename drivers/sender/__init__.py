"""The sender process: decides and sends commands at fixed deadlines, with watchdog and latch."""
