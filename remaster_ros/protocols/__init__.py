"""Wire formats: bytes to events and back; no sockets."""
