# SPDX-License-Identifier: Apache-2.0
"""What the controller has of a move: a piece of a short time, which ends at rest on the way.

A bridge that is killed, or whose host or cable fails, sends no stop. So the controller never has
more of a move than what is over soon, with a stop at its end that stays on the line; while the
bridge lives each piece is replaced by a later one before its stop begins.

With a controller that keeps the stamp of a trajectory all pieces of a move are the same function
of time up to there, and it goes on as if it had all of it from the start. Another one begins a
trajectory when it comes, where the arm is or where it has led the arm to, which is not known of an
arm that moves: it is given a long line in steps, each from rest to rest, and each when the arm
stands at the end of the one before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from remaster_ros.motion.trajectory import RAMP_S, Line, Trajectory, Waypoint
from remaster_ros.types import FloatArray

HORIZON_S = 1.6
"""A piece is over so long after it was sent, s. The first one begins `AHEAD_S` later: an arm that
lags by 0.1 s, and settles, stands within 2 s; one that lags by more as much later.
"""
LEAST_HORIZON_S = 1.4
"""With less of a move a busy machine would let the arm stop again and again, s."""
RENEWED_S = 0.4
"""A piece is replaced so long after it was sent, s."""
GUARD_S = 0.2
"""And not in the last moments before its stop begins, s of robot time: one that comes behind that
would ask for a place that the arm has left. `following.LATENCY_S` and as much again."""
AHEAD_S = 0.1
"""With a stamp a move begins so long after it was decided, s: it may come at once, or twice as
late as that, and no joint is faster or harder on its first ramp than its limits allow."""
STOP_AHEAD_S = 0.1
"""On a curve a stop begins so long after it was decided, s: as late as one may be published
(`LATE_WALL_S` of the bridge); the arm is still on the curve then."""
LEAST_PAST_S = 0.1
"""So long before at the least, s."""
JOINED_S = RAMP_S + LEAST_PAST_S
"""Until `RAMP_S` the controller joins the line from where the arm stands: only a piece that begins
behind that is the same function of time as the first one. None replaces it before this, s."""
PAST_S = 0.3
"""A piece that replaces another begins so long before it is sent, s: where the controller is in it
when it arrives, it is on the way already, and nothing is joined to where the arm is reported. As
late as reports may come and be believed (`joint_reports.LATE_S`, `LATE_WALL_S`), and more."""
STEP_REST_S = 1.5
"""How long an arm may rest between two steps until the next one comes too late, s: it has to come
to rest after its lag, to stand for `following.STANDING_S`, and to be seen to."""
SAME_S = 1e-6
"""Times that are no further apart are one, s: controllers count nanoseconds."""


@dataclass(frozen=True)
class Piece:
    """A part of a move that the controller is sent as one trajectory; it ends at rest."""

    waypoints: tuple[Waypoint, ...]  # At times from the trajectory's start
    # Until when the arm is on the trajectory, s from its start; infinite for the last piece
    cut_s: float
    # Where the next piece ends, rad or m, (k,); of the last one its own end
    next_end: FloatArray

    @property
    def end(self) -> FloatArray:
        """Joint positions at the end of the piece, rad or m, (k,)."""
        return self.waypoints[-1].q

    @property
    def end_s(self) -> float:
        """Time of the end, s from the trajectory's start."""
        return self.waypoints[-1].time_s

    @property
    def is_last(self) -> bool:
        """Whether the piece ends with the trajectory."""
        return not np.isfinite(self.cut_s)


def piece_of(trajectory: Trajectory, sent_s: float, horizon_s: float) -> Piece:
    """Return the piece of a trajectory to be sent at `sent_s`, s from its start.

    ``horizon_s``: longest time from then to the piece's end, s. The piece begins up to
    `PAST_S` before `sent_s`, and is the last one if the trajectory ends within the horizon.
    """
    piece = _piece(trajectory, sent_s, horizon_s)
    following = _piece(trajectory, sent_s + RENEWED_S, horizon_s)[0]
    return Piece(*piece, following[-1].q)


def stop_of(trajectory: Trajectory, sent_s: float, cut_s: float) -> Piece:
    """Return the piece by which an arm on a curve stops, or ends with the curve if that is sooner.

    ``sent_s``: when the piece is sent; ``cut_s``: when the stop begins; s from the
    trajectory's start. Until `cut_s` the piece is the curve itself, which the controller
    follows already when the piece comes.
    """
    points, cut_s = _piece(trajectory, sent_s, cut_s - sent_s + RAMP_S)
    return Piece(points, cut_s, points[-1].q)


def in_steps(trajectory: Trajectory, horizon_s: float) -> Trajectory:
    """Return a trajectory along the same lines that comes to rest every `horizon_s` at the latest.

    Each line is cut into equal steps, from rest to rest, with rests of `STEP_REST_S` between
    them. AssertionError for a curve.
    """
    lines: list[Line] = []
    for line in trajectory.lines:
        assert isinstance(line, Line), 'a curve is not cut into steps'
        count = max(int(np.ceil((1.0 / line.rate) / (horizon_s - RAMP_S) - SAME_S)), 1)
        places = line.start + np.linspace(0.0, 1.0, count + 1)[:, None] * line.way
        # The ends as they are, to the last bit.
        places[0], places[-1] = line.start, line.end
        rate = min(line.rate * count, 1.0 / RAMP_S)
        lines += [Line(start, end, rate) for start, end in pairwise(places)]
    return Trajectory(tuple(lines), STEP_REST_S)


def step_of(trajectory: Trajectory, index: int) -> Piece:
    """Piece of a trajectory that is one of its lines, with times from the trajectory's start.

    ``index``: of the line, from 0; the piece of the last line is the last one.
    """
    line, start_s = trajectory.lines[index], trajectory.starts_s[index]
    points = tuple(replace(p, time_s=start_s + p.time_s) for p in line.waypoints())
    is_last = index + 1 == len(trajectory.lines)
    following = line if is_last else trajectory.lines[index + 1]
    cut_s = np.inf if is_last else trajectory.starts_s[index + 1]
    return Piece(points, cut_s, following.end)


def _piece(
    trajectory: Trajectory, sent_s: float, horizon_s: float
) -> tuple[tuple[Waypoint, ...], float]:
    """Return waypoints of a piece, and until when it follows the trajectory, s (inf for the last).

    After that it stops in `RAMP_S` along the line. If the stop would begin within the line's
    own ramp down, the piece ends with the line instead, and follows the trajectory until the
    rest there is over. ``sent_s``: s from the trajectory's start; ``horizon_s``: longest time
    from then to the piece's end, s.
    """
    begins_s = max(sent_s - PAST_S, min(sent_s - LEAST_PAST_S, RAMP_S), 0.0)
    points = [p for p in trajectory.waypoints() if p.time_s > begins_s + SAME_S]
    if begins_s > 0.0:
        points.insert(0, Waypoint(begins_s, *trajectory.at(begins_s)))
    if sent_s + horizon_s >= trajectory.duration_s:
        return tuple(points), np.inf
    cut_s = sent_s + horizon_s - RAMP_S
    index, since_s = trajectory.line_at(cut_s)
    line, start_s = trajectory.lines[index], trajectory.starts_s[index]
    if since_s >= line.duration_s - RAMP_S:
        # The ramp at the end of the line is the stop, and the arm rests behind it.
        over_s = start_s + line.duration_s
        resting_s = trajectory.starts_s[index + 1] if index + 1 < len(trajectory.lines) else np.inf
        return tuple(p for p in points if p.time_s <= over_s + SAME_S), resting_s
    points = [p for p in points if p.time_s < cut_s - SAME_S]
    stop = (replace(p, time_s=cut_s + p.time_s) for p in line.brake(since_s))
    return (*points, Waypoint(cut_s, *trajectory.at(cut_s)), *stop), cut_s
