"""An arm on a path, as its reports show it."""

import numpy as np

from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.following import (
    Following,
    Seen,
)
from remaster_ros.motion.joint_reports import JointReport
from remaster_ros.motion.settling import SettleRules
from remaster_ros.motion.trajectory import Line, Trajectory

RULES = SupervisorRules(settle=SettleRules(settle_s=1.0, still_tolerance=2.0**-12))
AT = np.array([0.25, 0.5])
LINE = Line(np.array([0.25, -0.5]), np.array([1.25, -0.5]), 0.5)
"""2.5 s, of which 1.5 s at half a radian a second."""


def see(stamp, q, wall=None, last=None, late=0.0):
    wall = stamp if wall is None else wall
    report = JointReport(stamp, np.asarray(q, float), stamp, wall)
    return Seen.after(last, report, RULES, late)


CORNERS = Trajectory((LINE, Line(LINE.end, np.array([1.25, 0.5]), 0.5)))


class Arm:
    """A trajectory sent at 64 s; reports at 50 Hz of an arm that is where a function tells."""

    def __init__(self, trajectory=None, rate=1.0, rules=RULES):
        self.trajectory = trajectory or Trajectory((LINE,))
        self.following = Following(self.trajectory, 64.0, 512.0, rules)
        self.rate, self.seen, self.said = rate, None, ''

    def run(self, until_s, where, dt=1 / 64):
        """Report up to `until_s`; return the time when it was said to be astray, or None."""
        first = 0.0 if self.seen is None else self.seen.time - 64.0 + dt
        for elapsed in np.arange(first, until_s + dt / 2, dt):
            q = np.asarray(where(elapsed), float)
            self.seen = see(64.0 + elapsed, q, 512.0 + elapsed / self.rate, self.seen)
            self.said = self.following.update(self.seen, self.rate)
            if self.said:
                return float(elapsed)
        return None

    @property
    def lost(self):
        return self.following.lost(self.seen, self.seen.wall)

    @property
    def window(self):
        return self.following.window(self.seen, self.seen.wall, self.rate)

    def lagging(self, lag_s):
        return lambda elapsed: self.trajectory.at(elapsed - lag_s)[0]
