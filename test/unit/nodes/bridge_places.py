"""Where the arm of the bridge's tests goes: near and far targets, and low beside a post."""

import numpy as np
from bridge_rig import CHAIN, HOME

TARGET = HOME + np.array([0.1, 0.05, -0.1, 0.02, 0.15, -0.05, 0.3])
AWAY = HOME + np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
LOW = np.array([0.0, 0.9, 0.0, 1.2, 0.0, 0.3, 0.0])
POST = {'center_m': [*CHAIN.forward(LOW)[:2, 3].tolist(), 0.35], 'size_m': [0.06, 0.06, 0.7]}
TOOL = CHAIN.forward(HOME)[:3, 3]


def turned(q1):
    """Return the low place with joint 1 turned."""
    return np.array([q1, *LOW[1:]])
