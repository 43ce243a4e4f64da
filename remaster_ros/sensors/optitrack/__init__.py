"""OptiTrack cameras by NatNet."""
