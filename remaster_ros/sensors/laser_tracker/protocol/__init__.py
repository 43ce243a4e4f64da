"""The emScon protocol: bytes to events and back; no sockets."""
