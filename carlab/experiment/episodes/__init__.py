"""Run episodes on any car: the control loop, sessions of several episodes, policies, interrupts."""
