# SPDX-License-Identifier: Apache-2.0
"""OptiTrack cameras by NatNet."""
