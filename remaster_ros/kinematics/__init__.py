# SPDX-License-Identifier: Apache-2.0
"""The arm: chain, inverse kinematics, bodies and the free paths between configurations."""
