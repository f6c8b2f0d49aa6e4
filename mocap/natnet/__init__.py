"""The NatNet protocol: pure functions between datagrams and values for bitstreams 2.6 to 4.1, and sockets.

The functions are in ``messages`` (header, handshake, requests, echo), ``descriptions`` (MODELDEF) and ``frames``
(FRAMEOFDATA).
"""
