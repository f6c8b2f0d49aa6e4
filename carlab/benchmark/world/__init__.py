"""The generator: equations of motion, adaptive integration, driver and measurement."""
