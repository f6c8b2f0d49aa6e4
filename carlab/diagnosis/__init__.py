"""Find physics that a simulator lacks: locate it, name it, model it and test it on held-out recordings."""
