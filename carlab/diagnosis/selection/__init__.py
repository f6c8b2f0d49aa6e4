"""Model selection: screening, forward search, pairwise tests, elimination, rival physics."""
