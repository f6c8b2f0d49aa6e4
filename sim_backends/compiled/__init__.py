"""Compiled Runge-Kutta step: tracing of the model's equations, code generation, stepping."""
