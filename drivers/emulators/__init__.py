"""Emulated firmware with the real protocol over a pseudo-terminal or a CAN bus. Import the modules by name."""
