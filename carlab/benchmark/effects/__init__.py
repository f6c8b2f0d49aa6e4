"""Physics that a case may conceal, written independently of the simulator's own effects."""
