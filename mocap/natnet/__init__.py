"""The NatNet protocol: codec (pure), sockets, discovery and client."""
