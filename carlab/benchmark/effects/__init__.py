"""Physics that a case may conceal, implemented independently of the simulator."""
