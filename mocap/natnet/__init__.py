"""The NatNet protocol: codec (pure) and sockets."""
