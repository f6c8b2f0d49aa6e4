"""Run a set of cases: make, seal, diagnose in child processes, open the seal, score."""
