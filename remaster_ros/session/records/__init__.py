# SPDX-License-Identifier: Apache-2.0
"""Records of a session folder: session.yaml, observations.csv, and the journals before them."""
