"""An emulated NatNet server for tests, CI and laptops."""
