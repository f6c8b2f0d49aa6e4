"""Motion capture by NatNet: the pose of one rigid body, on the host's clock.

The emulated server is in ``mocap.emulators.natnet_server``, the codec in ``mocap.natnet``.
"""
