"""NatNet: bytes to events and back; no sockets."""
