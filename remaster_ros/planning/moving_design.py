# SPDX-License-Identifier: Apache-2.0
"""Curves to be measured while the arm moves, chosen for information per second.

A session has a pose at which it begins, then curves, each from the pose before to a pose that is
measured at standstill and never fitted. Places of a curve are drawn in one part of joint space,
about the configurations in sight that have most others near them; they are exchanged, added and
left out one at a time as long as the expected variance of the offsets falls within the time that
is given. A curve counts only if it keeps joint limits, clearance and sight all along.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.linear_algebra import one_thread
from remaster_ros.motion.path_search import beside_chords_m
from remaster_ros.motion.spline import STRAIGHT_SHARE
from remaster_ros.motion.trajectory import HEADROOM, LEAD_S, RAMP_S, Curve, allowed_rates
from remaster_ros.planning.candidates import (
    CurvedWay,
    LineOfSight,
    PlannedPose,
    PlanningScene,
    is_hidden,
)
from remaster_ros.planning.expected_sensors import ExpectedSensor
from remaster_ros.planning.moving_information import (
    OWN_M,
    MotionRows,
    MovingExpected,
    MovingInformation,
    expected_along,
)
from remaster_ros.planning.planned_design import DesignSettings
from remaster_ros.planning.separating_design import scene_with_other_elbows
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.types import BoolArray, FloatArray

MOVING_S = 40.0
"""Default time of measured motion, s."""
PROOF_POSES = 8
"""Least number of curves: each ends at a pose at standstill that proves the fit."""
SHORTEST_S, CURVE_S, LONGEST_S = 3.0, 10.0, 12.0
"""Time of a curve, s: the least (its two straight ends take 2.5 s, `shared_curve`), that which is
aimed at if there are more than `PROOF_POSES`, and the most: an interruption loses no more."""
SHORTEST_MOVING_S, LONGEST_MOVING_S = PROOF_POSES * SHORTEST_S, 600.0
"""Least and most time of measured motion, s."""
APART_S = 1.0
"""Least time between two places of a curve, s: the bridge replaces pieces of curves, of which each
needs time to be sent."""
SAMPLE = 60
"""Number of configurations of the pool among which the next place of a curve is looked for: with
all 600 the plans are no better, and take 15 % longer."""
NEAR_S, FAR_S, FEWEST_NEAR = 0.6, 3.0, 10
"""Times between which the next place of a curve is, s; of how many nearest if there is none."""
FEWEST_MARKERS = 4
"""Fewest markers of a sensor: with one the same precision takes many times as long."""
POOL_CANDIDATES, DRAWN, POOL, FEWEST_POOL = 200, 20_000, 600, 30
"""Candidate poses, by which the part of joint space is chosen; configurations that are drawn in
it, the most that are kept, and the fewest."""
NEAR_RAD = 0.9
"""Half of the width of that part, for each joint: of one that slides `per_radian` times it."""
ENOUGH = 0.6
"""A part counts as well as the fullest if it has this share of its configurations."""
EXCHANGES = 2500
"""Changes that are tried, of which a hundred take a second: another thousand gains a tenth."""
BETWEEN_S = 2.2
"""Time between two places of the first curves, s, as at 0.25 m/s."""
TRIES, MOST_BEGINS = 150, 3
"""Draws of a first curve, until it is within all limits; beginnings of all of them."""
RESHARED, SHIFTED = 3, 0.7
"""Times that the shares of a curve are adjusted to the limits, and by which part of the way."""
SIGHT_S = 0.02
"""Times at which the sight along finished curves is looked at, s apart."""
OVERTIME = 30.0
"""Price of time beyond the given, as a power of the variance per share of the time."""


@dataclass(frozen=True, eq=False)
class MovingDesign:
    """Curves along which a session is measured in motion, and their expected precision."""

    begin: PlannedPose
    # Each with its way from the end of the one before
    ends: tuple[PlannedPose, ...]
    curves: tuple[Curve, ...]
    rows: MotionRows  # Of all curves
    expected: MovingExpected
    own_rms: float  # `joint_rms` if each marker errs by `OWN_M` by itself, too, rad
    max_joint_share: float  # Largest speed of a joint, as a share of its limit for this motion
    max_joint_speed: tuple[int, float]  # Joint and speed of it, rad/s or m/s
    max_tool_speed_m_s: float  # Of the fastest point of arm and tool
    share_in_sight: float  # Share of the motion's time in which every marker is in sight

    @property
    def moving_s(self) -> float:
        """Time of all curves, s."""
        return sum(curve.duration_s for curve in self.curves)


@dataclass(frozen=True, eq=False)
class _Piece:
    """A curve within joint, speed and acceleration limits, and its information."""

    points: FloatArray  # With begin and end, (n, k)
    shares: FloatArray
    curve: Curve
    q: FloatArray  # Of its rows, (n, k)
    tool_speed_m_s: float  # Largest speed of a point
    information: FloatArray


@one_thread
def design_moving(
    scene: PlanningScene,
    travel: TravelTime,
    settings: DesignSettings,
    sensors_R: Mapping[str, FloatArray],
    rng: np.random.Generator,
    moving_s: float = MOVING_S,
    before: FloatArray | None = None,
    exchanges: int | None = None,
) -> MovingDesign:
    """Choose curves of a total time, along which the arm is measured while it moves.

    Parameters
    ----------
    scene
        The arm, its obstacles, and the ranges of poses.
    travel
        Speed and acceleration limits, and times of measuring.
    settings
        Sensors with their noise, and priors.
    sensors_R
        Position in R of each sensor that has to see its markers, m, (3,).
    rng
        For the draws.
    moving_s
        Time of measured motion, s.
    before
        Configuration from which the arm comes, rad, (k,): the curves begin near it; None if
        that is unknown.
    exchanges
        Changes that are tried; None for `EXCHANGES`.

    Raises
    ------
    InputError
        Motion cannot be measured with these sensors or this arm, or the time is out of range.
    InsufficientDataError
        No curves are found, or they do not determine the offsets.
    """
    sensors = settings.with_sensors_at(sensors_R).sensors
    check_sensors(scene, sensors)
    if not SHORTEST_MOVING_S <= moving_s <= LONGEST_MOVING_S:
        raise InputError(
            f'{moving_s:g} s of measured motion; give {SHORTEST_MOVING_S:g} to '
            f'{LONGEST_MOVING_S:g} s'
        )
    search = _Search(scene, travel, settings.marker_std_m, sensors, rng, moving_s, before)
    search.begin()
    for _ in range(EXCHANGES if exchanges is None else exchanges):
        search.exchange()
    return search.result(settings, travel)


def check_sensors(scene: PlanningScene, sensors: Sequence[ExpectedSensor]) -> None:
    """Raise InputError if the sensors or the arm do not allow measuring in motion.

    That is: a joint slides, or a sensor measures on request, or has fewer than
    `FEWEST_MARKERS` markers.
    """
    slides = np.flatnonzero(scene.model.chain.slides)
    if len(slides):
        raise InputError(
            f'{scene.model.chain.joint_names[slides[0]]} slides, and what motion does to joints '
            'that slide is not modelled; measure by stop and go'
        )
    for sensor in sensors:
        if sensor.on_request:
            raise InputError(
                f'{sensor.name} measures on request, and motion takes a camera that streams; '
                'leave it out of the cell file, or measure by stop and go'
            )
        count = len(sensor.markers)
        if count < FEWEST_MARKERS:
            raise InputError(
                f'{sensor.name} sees {counted(count, "marker")}, and motion takes '
                f'{FEWEST_MARKERS} for its precision; put more on the tool (further_markers), or '
                'measure by stop and go'
            )


def sights_of(scene: PlanningScene, sensors: Sequence[ExpectedSensor]) -> list[LineOfSight]:
    """Lines of sight from each sensor to each of its markers.

    ``sensors``: with their positions; the largest angles of sight are those of the scene.
    """
    angles = {sight.sensor: sight.max_angle_rad for sight in scene.sights}
    return [
        LineOfSight(sensor.name, sensor.position_R, place, angles[sensor.name], marker)
        for sensor in sensors
        for marker, place in sensor.markers.items()
    ]


def stays_in_sight(
    design: MovingDesign,
    scene: PlanningScene,
    settings: DesignSettings,
    sensors_R: Mapping[str, FloatArray],
) -> bool:
    """Whether sensors see every marker all along the curves and at their ends.

    ``design``: has the curves; ``scene``: obstacles and largest angles of sight; ``settings``:
    have the sensors with their markers; ``sensors_R``: position of each sensor in the robot
    base frame R, m, (3,); sensors without one are left out.
    """
    sights = sights_of(scene, settings.with_sensors_at(sensors_R).sensors)
    ends = np.array([pose.solutions[0] for pose in (design.begin, *design.ends)])
    places = [ends, *map(_fine, design.curves)]
    return bool(np.all(in_sight(scene, sights, np.concatenate(places))))


class _Search:
    """Search for curves: first ones are drawn, then places on them are exchanged."""

    def __init__(
        self,
        scene: PlanningScene,
        travel: TravelTime,
        marker_std_m: float,
        sensors: Sequence[ExpectedSensor],
        rng: np.random.Generator,
        moving_s: float,
        before: FloatArray | None,
    ) -> None:
        self._travel = travel
        self._scene, self._rng, self._moving_s = scene, rng, moving_s
        self._model, self._chain = scene.model, scene.model.chain
        self._limits = travel.limits
        self._curves = max(PROOF_POSES, round(moving_s / CURVE_S))
        self._curve_s = moving_s / self._curves
        self._margin = scene.limit_margin_rad * self._chain.per_radian
        self._extra = beside_chords_m(self._model)
        self._sights = sights_of(scene, sensors)
        self._pool = self._drawn(sensors, before)
        middle = self._chain.positions(self._pool, np.zeros(3)).mean(axis=0)
        self._information = MovingInformation(self._chain, sensors, marker_std_m, middle, OWN_M)
        self._pieces: list[_Piece] = []

    def _drawn(self, sensors: Sequence[ExpectedSensor], before: FloatArray | None) -> FloatArray:
        """Draw configurations that are usable, from one part of joint space, rad or m, (n, k).

        The part is about a solution of a candidate pose with many others near it, and near to
        ``before``, where the arm comes from, unless that is None; this solution is the first
        row. At most `POOL`; raises InsufficientDataError if fewer than `FEWEST_POOL` are
        found.
        """
        sensors_R = {sensor.name: sensor.position_R for sensor in sensors}
        plan = scene_with_other_elbows(self._scene).plan(POOL_CANDIDATES, sensors_R, self._rng)
        half_width = NEAR_RAD * self._chain.per_radian
        solutions = [pose.solutions for pose in plan.poses]
        q = np.concatenate([np.empty((0, len(self._chain))), *solutions])
        q = q[self.usable(q)]
        if not len(q):
            raise InsufficientDataError(
                'no configuration is found in which every marker is in sight; correct '
                'rough_position_m and max_angle_deg of the sensors, or the ranges of poses'
            )
        neighbours = np.array(
            [np.sum(np.all(np.abs(q - each) <= half_width, axis=1)) for each in q]
        )
        if before is not None:
            # Of the centres with many neighbours that to which the way is short.
            q = q[neighbours >= ENOUGH * neighbours.max()]
            neighbours = -self._travel.straight(before, q)
        centre = q[int(np.argmax(neighbours))]
        low = np.maximum(centre - half_width, self._chain.lower + self._margin)
        high = np.minimum(centre + half_width, self._chain.upper - self._margin)
        drawn = self._rng.uniform(low, high, (DRAWN, len(centre)))
        pool = np.concatenate((centre[None], drawn[self.usable(drawn)][: POOL - 1]))
        if len(pool) < FEWEST_POOL:
            raise InsufficientDataError(
                f'{len(pool)} configurations are found in which every marker is in sight and the '
                f'arm is free, and motion takes {FEWEST_POOL}; widen the ranges of poses, or '
                'correct rough_position_m and max_angle_deg of the sensors'
            )
        return pool

    def usable(self, q: FloatArray) -> BoolArray:
        """Whether configurations (n, k) are usable, (n,).

        They are with the tool in the ranges of poses, joints within limits with their margin,
        every marker in sight, and the arm free of collisions with a reserve.
        """
        chain = self._chain
        good = chain.within_limits(q, -self._margin)
        good &= self._scene.ranges.contain(chain.positions(q, np.zeros(3)))
        good[good] = self.seen(q[good])
        good[good] = self._model.free_mask(q[good], RESERVE_M)
        return np.asarray(good)

    def seen(self, q: FloatArray) -> BoolArray:
        """Whether every marker is in sight at configurations (n, k), (n,)."""
        return in_sight(self._scene, self._sights, q)

    def piece(self, points: FloatArray, begin_s: float) -> _Piece | None:
        """Curve through configurations (n, k) with its information; None if it is not allowed.

        It is not if it leaves joint limits, takes more than `LONGEST_S`, or has places less
        than `APART_S` apart. Collisions and sight are checked by `_is_free`, which takes
        longer. ``begin_s``: time at which it begins, s.
        """
        found = shared_curve(points, self._travel)
        if found is None:
            return None
        shares, curve, fastest = found
        if curve.duration_s > LONGEST_S or np.min(np.diff(shares)) / curve.rate < APART_S:
            return None
        _, places = curve.spline.samples
        if not np.all(self._chain.within_limits(places, -self._margin)):
            return None
        rows = MotionRows.of(curve, begin_s)
        return _Piece(points, shares, curve, rows.q, fastest, self._information.of(rows))

    def begin(self) -> None:
        """Draw the first curves; raise InsufficientDataError if none are found."""
        for _ in range(MOST_BEGINS):
            self._pieces = []
            while len(self._pieces) < self._curves and (piece := self._first_piece()) is not None:
                self._pieces.append(piece)
            if len(self._pieces) == self._curves:
                self._cost = self._cost_of(self._pieces)
                return
        raise InsufficientDataError(
            'no curve is found along which every marker is in sight and the arm is free; correct '
            'rough_position_m and max_angle_deg of the sensors, widen the ranges of poses, or '
            'allow higher speeds'
        )

    def _first_piece(self) -> _Piece | None:
        """Draw a curve from the end of the last one (at first from the pool's first row).

        It is free of collisions and in sight. None if `TRIES` draws find none.
        """
        here = self._pieces[-1].points[-1] if self._pieces else self._pool[0]
        count = round(self._curve_s / BETWEEN_S)
        for attempt in range(TRIES):
            places = [here]
            # The fewer places, the more curves are short enough.
            for _ in range(max(2, count - attempt * count // TRIES)):
                places.append(self._near(places[-1], None))
            piece = self.piece(np.array(places), len(self._pieces) * self._curve_s)
            if piece is not None and self._is_free(piece):
                return piece
        return None

    def _is_free(self, piece: _Piece) -> bool:
        """Whether the arm is free of collisions and every marker in sight all along a curve."""
        if not self._model.free_mask(piece.q, RESERVE_M).all() or not self.seen(piece.q).all():
            return False
        return not self._model.path_trouble(piece.curve.spline.samples[1], self._extra)

    def _near(self, here: FloatArray, there: FloatArray | None) -> FloatArray:
        """Draw a configuration from the pool near to ``here``, and also to ``there`` if not None.

        Near is a travel time of `NEAR_S` to `FAR_S` (the longer of the two); if none is, one
        of the nearest. (k,).
        """
        sample = self._rng.permutation(self._pool)[:SAMPLE]
        ends = [here] if there is None else [here, there]
        # At full speed along straight lines.
        times = np.max([self._travel.straight(each, sample) - RAMP_S for each in ends], axis=0)
        neighbours = np.flatnonzero((times < FAR_S) & (times > NEAR_S))
        if not len(neighbours):
            neighbours = np.argsort(times)[1 : 1 + FEWEST_NEAR]
        return sample[int(self._rng.choice(neighbours))]

    def _cost_of(self, pieces: Sequence[_Piece]) -> float:
        """Cost of curves: log of the expected variance of the offsets, plus penalties on time.

        Penalised, by `OVERTIME` times the share in excess or missing, are a total time above
        that given for measured motion, and each curve shorter than `SHORTEST_S`.
        """
        total = np.sum([piece.information for piece in pieces], axis=0)
        seconds = [piece.curve.duration_s for piece in pieces]
        cost = float(np.log(self._information.variance(total)))
        cost += OVERTIME * max(sum(seconds) / self._moving_s - 1.0, 0.0)
        return cost + OVERTIME * sum(max(1.0 - each / SHORTEST_S, 0.0) for each in seconds)

    def exchange(self) -> None:
        """Try one random change of a place on a curve; keep it if the cost falls.

        A place is left out, inserted, drawn anew, or shifted; the end of a curve is the begin
        of the next one, too.
        """
        rng = self._rng
        number = int(rng.integers(len(self._pieces)))
        points = self._pieces[number].points
        at = int(rng.integers(0 if number == 0 else 1, len(points)))
        kind = rng.random()
        last = at == len(points) - 1
        before = points[at - 1] if at else None
        after = points[at + 1] if not last else None
        if kind < 0.12 and at and not last and len(points) > 3:
            changed = {number: np.delete(points, at, axis=0)}
        elif kind < 0.24 and at:
            new = self._near(points[at - 1], points[at])
            changed = {number: np.insert(points, at, new, axis=0)}
        else:
            if kind < 0.5:
                ends = [each for each in (before, after) if each is not None]
                new = self._near(ends[0], ends[1] if len(ends) > 1 else None)
            else:
                width = rng.choice([0.3, 0.1])
                new = points[at] + width * rng.standard_normal(len(self._chain)) * (
                    self._chain.per_radian
                )
                if not self.usable(new[None])[0]:
                    return
            changed = {number: _with(points, at, new)}
            if last and number + 1 < len(self._pieces):
                changed[number + 1] = _with(self._pieces[number + 1].points, 0, new)
        pieces = list(self._pieces)
        for index, places in changed.items():
            piece = self.piece(places, index * self._curve_s)
            if piece is None:
                return
            pieces[index] = piece
        cost = self._cost_of(pieces)
        if cost < self._cost and all(self._is_free(pieces[index]) for index in changed):
            self._pieces, self._cost = pieces, cost

    def result(self, settings: DesignSettings, travel: TravelTime) -> MovingDesign:
        """Return the design with the curves found so far, and its expected precision."""
        pieces = self._pieces
        begin = self._pose(pieces[0].points[0])
        ends = [
            replace(
                self._pose(piece.points[-1]), way=CurvedWay(piece.points[:-1], piece.shares[:-1])
            )
            for piece in pieces
        ]
        curves = tuple(piece.curve for piece in pieces)
        # As in the session: at the end of each curve the arm is measured at standstill.
        starts = np.cumsum(
            [0.0, *(curve.duration_s + travel.measuring_s for curve in curves[:-1])]
        )
        rows = MotionRows.joined(
            [MotionRows.of(curve, float(at)) for curve, at in zip(curves, starts)]
        )
        sensors = [
            replace(sensor, position_R=sight.sensor_R)
            for sensor in settings.sensors
            for sight in self._sights
            if sight.sensor == sensor.name and sight.marker == next(iter(sensor.markers))
        ]
        expected, with_own = (
            expected_along(
                self._chain, rows, sensors, settings.marker_std_m, settings.priors, own_m
            )
            for own_m in (0.0, OWN_M)
        )
        speeds = np.max(
            [
                np.max(curve.rate * np.abs(curve.spline.at(curve.spline.samples[0], 1)), axis=0)
                for curve in curves
            ],
            axis=0,
        )
        fastest = int(np.argmax(speeds))
        return MovingDesign(
            begin,
            tuple(ends),
            curves,
            rows,
            expected,
            with_own.joint_rms,
            float(np.max(speeds / self._limits.velocity)),
            (fastest, float(speeds[fastest])),
            max(piece.tool_speed_m_s for piece in pieces),
            float(np.mean(self.seen(np.concatenate([_fine(curve) for curve in curves])))),
        )

    def _pose(self, q: FloatArray) -> PlannedPose:
        """Planned pose of the tool at a configuration (k,), which is its only joint solution."""
        return PlannedPose(self._chain.forward(q), q[None])


def _fine(curve: Curve) -> FloatArray:
    """Configurations along a curve at times `SIGHT_S` apart, (n, k)."""
    times = np.arange(0.0, curve.duration_s, SIGHT_S)
    shares = np.array([curve.share(time_s)[0] for time_s in times.tolist()])
    return curve.spline.at(shares)


def _with(points: FloatArray, at: int, new: FloatArray) -> FloatArray:
    """Return a copy of points (n, k) with the one at an index replaced by ``new``, (k,)."""
    changed = points.copy()
    changed[at] = new
    return changed


def in_sight(scene: PlanningScene, sights: Sequence[LineOfSight], q: FloatArray) -> BoolArray:
    """Whether all markers face their sensors and nothing hides them, (n,).

    ``q``: configurations, rad or m, (n, k).
    """
    good = np.ones(len(q), bool)
    for sight in sights:
        good[good] = ~is_hidden(scene.model, q[good], sight)
    return good


def shared_curve(points: FloatArray, travel: TravelTime) -> tuple[FloatArray, Curve, float] | None:
    """Spline curve through configurations (n, k), timed so that its limits are used evenly.

    The curve parameter goes from 0 to 1. Between two configurations it first grows by the
    share of time that their straight line takes; then intervals in which the curve could be
    faster are made shorter, and the others longer.

    Returns the curve parameter at each configuration, (n,), from 0 to 1, the curve, and the
    largest speed of a point, m/s; None if the spline would have too many samples.
    """
    limits = travel.limits
    way = np.abs(np.diff(points, axis=0))
    times = np.max(
        np.maximum(way / limits.velocity, np.sqrt(6.0 * way / limits.acceleration)), axis=1
    )
    best: tuple[FloatArray, Curve, float] | None = None
    for _ in range(RESHARED + 1):
        least = np.full(len(times), APART_S * 1.02)
        least[0] = max(1.02 * LEAD_S / STRAIGHT_SHARE, APART_S)
        least[-1] = max(1.02 * RAMP_S / STRAIGHT_SHARE, APART_S)
        times = np.maximum(times, least)
        shares = np.concatenate(([0.0], np.cumsum(times) / times.sum()))
        shares[-1] = 1.0
        try:
            curve, fastest = travel.curve(points, shares[:-1])
        except ValueError:
            return best
        if best is None or curve.duration_s < best[1].duration_s:
            best = shares, curve, fastest
        at, places = curve.spline.samples
        speeds = np.maximum(travel.speeds.fastest(places, curve.spline.at(at, 1)), 1e-12)
        rates = np.minimum(
            allowed_rates(limits, curve.spline), HEADROOM * limits.tool_speed / speeds
        )
        begins = np.searchsorted(at, shares[:-1])
        allowed = np.minimum.reduceat(rates, begins)
        times = np.diff(shares) / (allowed**SHIFTED * curve.rate ** (1.0 - SHIFTED))
    return best
