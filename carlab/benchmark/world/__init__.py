"""The generator's own car: equations of motion, adaptive integration, driver and measurement."""
