# SPDX-License-Identifier: Apache-2.0
"""Session of an arm that moved while it was measured: rows of 0.1 s, in segments of 0.5 s.

A row is a configuration on the path: joint positions, velocities and accelerations at the middle
of its frames, by splines of the joint states, and the marker's position there: the mean of the
frames' deviations from the robot's own prediction for their times, so that the path's curvature
within the row has no effect. A segment takes the place of a pose: its rows have a common error of
the sensor and of the arm.

*Clocks.* The stamps of marker and joint states are of two computers, tens of milliseconds apart.
In that time an arm moves by a centimetre, which no tangent follows: the offset is found here, by
Gauss-Newton steps of robust fits with the offset as a parameter, from the offset with which the
speeds of marker and tool are most alike; the remaining offset is an effect of `discover` and a
parameter of `fit`.

*Stamps.* A node that stamps frames by their arrival, or by an estimate of the clocks' offset that
is renewed all the time, adds milliseconds of its own, of which one makes 0.15 mm at 0.15 m/s. A
camera's frames come at a constant rate: if the frames at such a rate fit better, they are taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from remaster_ros.calibration.dynamics import ROW_S, TRAVELS_RAD
from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.initial_guess import CAUCHY_WIDTH, closest_start, robust_spread
from remaster_ros.calibration.mistakes import UNKNOWN_MARKER_STD_M
from remaster_ros.calibration.priors import prior_rows
from remaster_ros.errors import InputError
from remaster_ros.importing.joint_motion import JointMotion
from remaster_ros.importing.standstills import Stream
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.session.records.observations import stacked
from remaster_ros.types import (
    AccuracyOption,
    BoolArray,
    FloatArray,
    IntArray,
    Measurements,
    Session,
)

BLOCK_S = ROW_S
# Rows of a segment: an arm at 0.25 m/s moves 0.1 m in 0.5 s, the range of errors that depend on
# its position.
SEGMENT_ROWS = 5
# A sensor with fewer frames in a second measures single points.
LEAST_FRAMES_HZ = 10.0
# A row with fewer frames than this share of the usual number is left out.
LEAST_FRAMES = 0.5
# An arm whose joints are all slower than this stands still, rad/s.
STILL_RAD_S = 0.02
# Fewest rows of a sensor, 6 s of motion.
FEWEST_ROWS = 60
# Largest offset of the clocks in the search by speeds, s; steps and smoothing of the speeds, s.
FARTHEST_CLOCK_S, SPEED_STEP_S, SPEED_SMOOTHING_S = 3.0, 0.005, 0.05
# Smallest correlation of the speeds of marker and tool that shows the offset of the clocks.
LEAST_ALIKE = 0.5
# Length of a step below which the offset of the clocks is found, s.
CLOCK_SETTLED_S = 2e-5
MOST_CLOCK_STEPS = 12
# A gap of more periods is counted only with the period that frames on either side of it have: the
# median of their gaps is off by some thousandths, which over so many is a tenth of a period.
LONGEST_COUNTED = 100
# Number of frames whose median delay counts: a host that was held up for less than half of them,
# 0.4 s at 120 Hz, does not change it.
DELAY_FRAMES = 101
# The number of a frame is sure if the rise of the delay is within this share of a period of a
# whole number: of frames at no constant rate that is one half. Frames come at one if this share is
# sure, and comes in time.
SURE_PERIODS, AT_A_RATE = 0.25, 0.9
# Longest step, s: beyond it the tangent is not valid.
LONGEST_CLOCK_STEP_S = 0.05
# Largest number of rows of a robust fit for the clocks.
MOST_FITTED = 1_500
# The way of an arm before it rests is followed for so much time, in such steps, s. A joint whose
# spline moves by less than this share of the noise of its reports stands.
ARRIVAL_S, WAY_STEP_S, STANDS_NOISE = 6.0, 2e-3, 0.5
# Travel within which friction turns round, rad: between those that every fit has.
FRICTION_TRAVEL_RAD = float(np.sqrt(np.prod(TRAVELS_RAD)))
# Largest share that is told from full friction.
FULL_SHARE = 1.0 - 1e-6
# Distance of a frame from the others of its row, in robust standard deviations, from which it is
# of another marker.
GROSS = 8.0


@dataclass(frozen=True, eq=False)
class MarkerStream:
    """Positions of one marker by one sensor, m, in the sensor's frame and by its stamps."""

    sensor: str
    marker: str
    stream: Stream


@dataclass(frozen=True)
class MovingOptions:
    """User's options for a session of a moving arm: marker positions, clock offset, hold-out."""

    # Marker -> nominal position in the tool frame, m; others are unknown
    places: Mapping[str, FloatArray] = field(default_factory=dict)
    marker_std_m: float | None = None  # None: 0.5 mm if all positions are known, else 0.3 m
    # Added to the stamps of all sensors to have those of the joint states, s; None to find it
    clock_offset_s: float | None = None
    hold_out: float = 0.25  # Share of the segments
    notes: str = ''
    accuracy_option: AccuracyOption = ''


class _Guess(NamedTuple):
    """Result of a robust fit, from which the markers' measured positions are predicted."""

    joint_offsets: FloatArray  # rad, (k,)
    markers: FloatArray  # In T, m, (markers, 3)
    T_N_R: FloatArray  # (sensors, 4, 4)


@dataclass(frozen=True, eq=False)
class _Frames:
    """Camera frames of one sensor: positions of m markers at f stamps."""

    stamps: FloatArray  # s, rising, (f,)
    positions: FloatArray  # m, NaN of a marker that was not seen, (f, m, 3)
    markers: IntArray  # Indices of the m markers
    scatter_s: float = 0.0  # Of the stamps that constant ones took the place of, s

    @classmethod
    def of(cls, streams: Sequence[MarkerStream], markers: Sequence[str]) -> _Frames:
        """Frames of a sensor from its markers' streams: positions with equal stamps are one frame.

        ``streams``: of this sensor; ``markers``: names of all markers of the recording; the
        frames hold each marker's index in it.
        """
        stamps = np.unique(np.concatenate([stream.stream.stamps for stream in streams]))
        positions = np.full((len(stamps), len(streams), 3), np.nan)
        for index, stream in enumerate(streams):
            positions[np.searchsorted(stamps, stream.stream.stamps), index] = stream.stream.values
        return cls(
            stamps, positions, np.array([markers.index(stream.marker) for stream in streams])
        )

    def at_constant_rate(self) -> _Frames | None:
        """Same frames with stamps at a constant rate; None if the camera has no such rate.

        Each frame gets a number, which counts the frames before it and those that were lost; a
        delay on the way, however long, does not change a frame's number. None unless nine
        tenths of the numbers are certain, and nine tenths of these frames are within half a
        period of the constant rate. Frames without a certain number are left out.
        """
        stamps = self.stamps
        gaps = np.diff(stamps)
        period = float(np.median(gaps)) if len(gaps) else 0.0
        if period <= 0.0:
            return None
        short_gaps = gaps < LONGEST_COUNTED * period
        for _ in range(2):
            # Of runs without a long gap, each with a beginning of its own.
            run = np.concatenate(([0], np.cumsum(~short_gaps)))
            count = np.concatenate(
                ([0.0], np.cumsum(np.where(short_gaps, np.round(gaps / period), 0.0)))
            )
            here, times = _less_mean(count, run), _less_mean(stamps, run)
            square = float(here @ here)
            if square == 0.0:
                return None
            period = float(here @ times) / square
        index = np.arange(len(stamps))
        delay = (stamps - stamps[0]) / period - index
        delay -= np.angle(np.mean(np.exp(2j * np.pi * delay))) / (2.0 * np.pi)
        median = median_filter(delay, DELAY_FRAMES, mode='nearest')
        # What is lost does not come back, as a delay does.
        rising = _rising(median)
        lost = np.round(rising)
        kept = np.abs(rising - lost) < SURE_PERIODS
        if np.mean(kept) < AT_A_RATE:
            return None
        ticks, stamps = (index + lost)[kept], stamps[kept]
        late = stamps - np.polynomial.Polynomial.fit(ticks, stamps, 1)(ticks)
        usual = np.abs(late - np.median(late)) < 0.5 * period
        if np.mean(usual) < AT_A_RATE:
            return None
        steady = np.polynomial.Polynomial.fit(ticks[usual], stamps[usual], 1)(ticks)
        scatter_s = float(np.std((stamps - steady)[usual]))
        return _Frames(steady, self.positions[kept], self.markers, scatter_s)


def _rising(values: FloatArray) -> FloatArray:
    """Least-squares fit to values (n,) by a sequence that never falls, (n,).

    Pool adjacent violators: Ayer et al. (1955), doi:10.1214/aoms/1177728423; SciPy has it from
    1.12 on, Ubuntu 24.04 1.11.
    """
    pools: list[tuple[float, int]] = []
    for value in values.tolist():
        mean, count = value, 1
        while pools and pools[-1][0] > mean:
            earlier, number = pools.pop()
            mean = (earlier * number + mean * count) / (number + count)
            count += number
        pools.append((mean, count))
    means, counts = zip(*pools, strict=True)
    return np.repeat(means, counts)


def _less_mean(values: FloatArray, run: IntArray) -> FloatArray:
    """Values (n,) less the mean of their run, (n,).

    ``run``: index of each value's run, from 0 without gaps, (n,).
    """
    means = np.bincount(run, values) / np.bincount(run)
    result: FloatArray = values - means[run]
    return result


@dataclass(frozen=True, eq=False)
class _Block:
    """Rows of one sensor: b blocks of 0.1 s with joint motion and mean positions of m markers."""

    number: IntArray  # Of the block in the whole record, rising, (b,)
    times: FloatArray  # By the joints' clock, s, (b,)
    q: FloatArray  # And its derivatives at those times, (b, k)
    velocity: FloatArray
    acceleration: FloatArray
    position: FloatArray  # NaN where too few frames saw the marker, (b, m, 3)
    std: FloatArray
    samples: IntArray  # (b, m)


class _Recording:
    """Joint motion and camera frames; makes rows of them for any offset between the clocks."""

    def __init__(
        self,
        where: str,
        motion: JointMotion,
        frames: Mapping[str, _Frames],
        markers: Sequence[str],
        chain: SerialChain,
        urdf: str,
        options: MovingOptions,
    ) -> None:
        self.where, self.motion, self.frames = where, motion, frames
        self.markers, self.chain, self.urdf, self.options = markers, chain, urdf, options
        self.dropped = 0

    def blocks(self, sensor: int, clock_s: float, guess: _Guess | None) -> _Block:
        """Rows of a sensor, one for each 0.1 s (`BLOCK_S`), with an offset added to its stamps.

        ``sensor``: its index; ``clock_s``: the offset, s; ``guess``: fit whose prediction is
        taken off before the mean, None for plain means of the frames. Left out are blocks with
        under half of the usual frames, or in which all joints are slower than `STILL_RAD_S`;
        with a guess also frames far from their row (`GROSS` times the median distance), which
        `dropped` counts.
        """
        frames, motion = self.frames[list(self.frames)[sensor]], self.motion
        times = frames.stamps + clock_s
        inside = motion.stretch(times) >= 0
        times, positions = times[inside], frames.positions[inside]
        number = np.floor((times - motion.begin[0]) / BLOCK_S).astype(np.int64)
        # A block that has the end of a stretch in it is two.
        new = (np.diff(number) != 0) | (np.diff(motion.stretch(times)) != 0)
        first = np.concatenate(([0], np.flatnonzero(new) + 1)) if len(times) else np.zeros(0, int)
        count = np.diff(np.append(first, len(times)))
        usual = BLOCK_S / np.median(np.diff(frames.stamps))
        middle = np.add.reduceat(times, first) / count if len(times) else times
        velocity = motion.at(middle, 1)
        kept = (count >= LEAST_FRAMES * usual) & (np.abs(velocity).max(axis=1) > STILL_RAD_S)
        block = np.repeat(np.arange(len(first)), count)
        used = kept[block]
        block = (np.cumsum(kept) - 1)[block[used]]
        times, positions = times[used], positions[used]
        middle, velocity = middle[kept], velocity[kept]
        q = motion.at(middle)
        at_frames = np.zeros_like(positions)
        at_middle = np.zeros((len(middle), positions.shape[1], 3))
        if guess is not None:
            at_frames = self._seen(motion.at(times), frames.markers, sensor, guess)
            at_middle = self._seen(q, frames.markers, sensor, guess)
        residuals = positions - at_frames
        mean, std, samples = _means(residuals, block, len(middle))
        if guess is not None:
            length = np.linalg.norm(residuals - mean[block], axis=2)
            far = length > GROSS * max(float(np.nanmedian(length)), 1e-6)
            self.dropped += int(np.sum(far))
            mean, std, samples = _means(
                np.where(far[..., None], np.nan, residuals), block, len(middle)
            )
        few = samples < max(1.0, LEAST_FRAMES * usual)
        mean[few], std[few] = np.nan, np.nan
        return _Block(
            number[first[kept]],
            middle,
            q,
            velocity,
            motion.at(middle, 2),
            at_middle + mean,
            std,
            samples,
        )

    def fitted(self, clocks_s: FloatArray, found: bool) -> tuple[FloatArray, _Guess, float]:
        """Clock offset of each sensor, s, (sensors,), robust fit, and median residual, m.

        The residual is the distance of the measured from the fitted positions of markers.
        ``clocks_s``: offsets to begin with; ``found``: whether to improve them, in up to 12
        steps until all steps are below 20 µs, else they are returned as given. Raises
        InputError as `session`.
        """
        guess: _Guess | None = None
        error_m = np.inf
        for _ in range(MOST_CLOCK_STEPS if found else 2):
            guess, steps_s, error_m = _robust_fit(self.session(clocks_s, guess))
            if found:
                clocks_s = clocks_s + np.clip(steps_s, -LONGEST_CLOCK_STEP_S, LONGEST_CLOCK_STEP_S)
                if np.all(np.abs(steps_s) < CLOCK_SETTLED_S):
                    break
        assert guess is not None
        return clocks_s, guess, error_m

    def _seen(self, q: FloatArray, markers: IntArray, sensor: int, guess: _Guess) -> FloatArray:
        """Predicted positions of markers in a sensor's frame, m, (n, m, 3).

        ``q``: rad, (n, k); ``markers``: indices, (m,); ``sensor``: index; ``guess``: fit to
        predict by.
        """
        points = self.chain.positions(
            q[:, None, :], guess.markers[markers], guess.joint_offsets[None, None, :]
        )
        return apply(guess.T_N_R[sensor], points)

    def session(
        self, clocks_s: FloatArray, guess: _Guess | None, rng: np.random.Generator | None = None
    ) -> Session:
        """Session of the rows of all sensors, with offsets added to the sensors' stamps.

        ``clocks_s``: the offsets, s, (sensors,); ``guess``: as in `blocks`; ``rng``: draws the
        held-out segments, None to hold none out. `dropped` counts the frames left out. Raises
        InputError if a sensor saw the arm move in fewer than 60 rows.
        """
        self.dropped = 0
        names = list(self.frames)
        blocks = [self.blocks(i, float(clock), guess) for i, clock in enumerate(clocks_s)]
        number = np.unique(np.concatenate([block.number for block in blocks]))
        segment = _segments(number)
        parts, configurations = [], 0
        for sensor, (name, block) in enumerate(zip(names, blocks, strict=True)):
            rows, columns = np.nonzero(np.isfinite(block.position[..., 0]))
            if len(np.unique(rows)) < FEWEST_ROWS:
                raise InputError(
                    f'{self.where}: {name} saw the arm move for '
                    f'{BLOCK_S * len(np.unique(rows)):.1f} s; at least '
                    f'{BLOCK_S * FEWEST_ROWS:.0f} s are needed, and some 30 for good '
                    'zero-offsets; are the clocks of both the same (--clock-offset)?'
                )
            n, k = len(rows), len(self.chain)
            parts.append(
                Measurements(
                    observation=np.zeros(n, np.int64),
                    pose=segment[np.searchsorted(number, block.number)][rows],
                    configuration=configurations + rows,
                    is_validation=np.zeros(n, bool),
                    stamp_s=block.times[rows],
                    sensor=np.full(n, sensor),
                    marker=self.frames[name].markers[columns],
                    q=block.q[rows],
                    from_q=np.full((n, k), np.nan),
                    position=block.position[rows, columns],
                    std=block.std[rows, columns],
                    samples=block.samples[rows, columns],
                    temperature_c=np.full(n, np.nan),
                    frame=rows,
                    velocity=block.velocity[rows],
                    acceleration=block.acceleration[rows],
                )
            )
            configurations += len(block.times)
        joined = _joined(parts)
        if rng is not None:
            joined = replace(joined, is_validation=self._held_out(joined.pose, rng))
        return self._session(joined, dict(zip(names, clocks_s.tolist(), strict=True)))

    def _held_out(self, pose: IntArray, rng: np.random.Generator) -> BoolArray:
        """Mask of the held-out rows, (n,): one random segment of each run of consecutive segments.

        ``pose``: index of the segment of each row, (n,). Runs are about as many as the
        `hold_out` of the options times the segments; nothing is held out if that is 0.
        """
        segments = np.unique(pose)
        if not self.options.hold_out:
            return np.zeros(len(pose), bool)
        runs = np.array_split(segments, max(1, round(self.options.hold_out * len(segments))))
        return np.isin(pose, [rng.choice(run) for run in runs])

    def _session(self, measurements: Measurements, clock_offset_s: dict[str, float]) -> Session:
        """Session of rows; markers without a stated position are put at the tip.

        If there is such a marker, `marker_std_m` is `UNKNOWN_MARKER_STD_M`, else 0.5 mm,
        unless the user stated it. ``clock_offset_s``: by sensor.
        """
        options = self.options
        known = all(name in options.places for name in self.markers)
        std = 0.5e-3 if known else UNKNOWN_MARKER_STD_M
        of_sensor = {
            name: [self.markers[i] for i in frames.markers] for name, frames in self.frames.items()
        }
        return Session(
            urdf=self.urdf,
            base_link=self.chain.base_link,
            tip_link=self.chain.tip_link,
            markers={name: options.places.get(name, np.zeros(3)) for name in self.markers},
            sensors={name: markers[0] for name, markers in of_sensor.items()},
            further_markers={
                name: tuple(markers[1:]) for name, markers in of_sensor.items() if markers[1:]
            },
            measurements=measurements,
            marker_std_m=std if options.marker_std_m is None else options.marker_std_m,
            settle_s=None,
            exit_status='complete',
            notes=options.notes,
            accuracy_option=options.accuracy_option,
            clock_offset_s=clock_offset_s,
        )


def moving_session(
    where: str,
    joints: Stream,
    streams: Sequence[MarkerStream],
    chain: SerialChain,
    urdf: str,
    options: MovingOptions,
    rng: np.random.Generator,
) -> tuple[Session, list[str]]:
    """Session of the continuous motions in a recording, and sentences on how it was made.

    Parameters
    ----------
    where
        Name of the recording in messages.
    joints
        Joint positions, rad, (n, k), by their stamps.
    streams
        Measurements of the sensors, at least one; sensors of under 10 frames/s are left out.
    chain, urdf
        Nominal arm.
    options
        The user's statements.
    rng
        Draws the held-out segments.

    Returns
    -------
    Session, list of str
        A sentence each: rates and noise, clocks, rows and segments, what was left out.

    Raises
    ------
    InputError
        If joint states are too rare, no sensor is fast enough, a sensor saw hardly any motion,
        or a joint of the arm slides.
    """
    for joint in np.flatnonzero(chain.slides)[:1]:
        raise InputError(
            f"{where}: joint '{chain.joint_names[joint]}' slides; moving rows are made for arms "
            'whose joints all turn: import the standstills, without --moving'
        )
    motion = JointMotion.of(joints, where)
    shots = {track.sensor for track in streams if _rate_hz(track.stream) < LEAST_FRAMES_HZ}
    streams = [track for track in streams if track.sensor not in shots]
    if not streams:
        raise InputError(
            f'{where}: {", ".join(sorted(shots))} measured single points, fewer than '
            f'{LEAST_FRAMES_HZ:.0f} in a second, and while the arm moves nothing is measured by '
            'one point; import the standstills, without --moving'
        )
    markers = list(dict.fromkeys(track.marker for track in streams))
    frames = {
        sensor: _Frames.of([track for track in streams if track.sensor == sensor], markers)
        for sensor in dict.fromkeys(track.sensor for track in streams)
    }
    recording = _Recording(where, motion, frames, markers, chain, urdf, options)
    found = options.clock_offset_s is None
    clocks_s = np.array(
        [
            _clock_by_speeds(motion, sensor_frames, chain, options, markers) if found else 0.0
            for sensor_frames in frames.values()
        ]
    ) + (options.clock_offset_s or 0.0)
    clocks_s, guess, error_m = recording.fitted(clocks_s, found)
    steady = {
        name: sensor_frames.at_constant_rate() or sensor_frames
        for name, sensor_frames in frames.items()
    }
    restamped: list[str] = []
    if any(steady[name] is not sensor_frames for name, sensor_frames in frames.items()):
        other = _Recording(where, motion, steady, markers, chain, urdf, options)
        again = other.fitted(clocks_s, found)
        if again[2] < error_m:
            restamped = [
                _restamped(name, sensor_frames, steady[name])
                for name, sensor_frames in frames.items()
            ]
            recording, (clocks_s, guess, _) = other, again
    session = recording.session(clocks_s, guess, rng)
    m = session.measurements
    assert m.velocity is not None
    noise = np.degrees(motion.noise)
    how = [
        f'joint states at {motion.rate_hz:.0f} Hz, their noise {noise.min():.5f} to '
        f'{noise.max():.5f} degrees',
        *(f'{name} measured single points, which are left out' for name in sorted(shots)),
        *(
            f'{counted(len(np.unique(m.configuration[m.sensor == i])), "row")} of {BLOCK_S:g} s '
            f'by {name}, whose stamps are {_late(-clock)}' + ('' if found else ', as told')
            for i, (name, clock) in enumerate(zip(frames, clocks_s))
        ),
        *(text for text in restamped if text),
        f'{counted(len(np.unique(m.pose)), "segment")} of about {BLOCK_S * SEGMENT_ROWS:g} s, '
        f'{len(np.unique(m.pose[m.is_validation]))} of them held out; the arm moves at up to '
        f'{np.degrees(np.abs(m.velocity).max()):.0f} degrees/s',
    ]
    if recording.dropped:
        how.append(f'{recording.dropped} points far from all others of their row were left out')
    return session, how


def with_proof(session: Session, joints: Stream, name: str, standing: Session) -> Session:
    """Return a moving session with the held-out rows of a standstill session added to its rows.

    The added rows are held out and have velocity 0; their ``from_q`` is the joint position
    from which the friction at rest follows (`effective_turns`).

    Parameters
    ----------
    session
        Of the arm that moved.
    joints
        Joint positions, rad, (n, k), by the stamps of both sessions.
    name, standing
        Session whose poses were measured at standstill by the same sensors and markers, none
        of which was moved in between; its name, for messages.

    Raises
    ------
    InputError
        Another arm, no sensor or marker in common, or no held-out pose.
    """
    if standing.urdf_sha256 != session.urdf_sha256 or standing.is_moving:
        what = 'is itself of a moving arm' if standing.is_moving else 'has another URDF'
        raise InputError(
            f'{name} {what}, and proves nothing here: name the session of the standstills, with '
            'the same arm'
        )
    m, s = session.measurements, standing.measurements
    assert m.frame is not None
    sensors, markers = list(session.sensors), list(session.markers)
    of_sensor = [sensors.index(n) if n in sensors else -1 for n in standing.sensors]
    of_marker = [markers.index(n) if n in markers else -1 for n in standing.markers]
    sensor, marker = np.array(of_sensor)[s.sensor], np.array(of_marker)[s.marker]
    kept = np.flatnonzero(s.is_validation & (sensor >= 0) & (marker >= 0))
    if not len(kept):
        raise InputError(
            f'{name} has no held-out pose of {", ".join(sensors)} with the markers '
            f'{", ".join(markers)}: there is nothing to prove the motion by'
        )
    chosen = s.select(kept)
    zeros = np.zeros_like(chosen.q)
    configurations, index = np.unique(chosen.configuration, return_inverse=True)
    stamps = np.array([chosen.stamp_s[chosen.configuration == c].min() for c in configurations])
    turned = effective_turns(JointMotion.of(joints, name), stamps)[index.reshape(-1)]
    rows = replace(
        chosen,
        pose=1 + m.pose.max() + chosen.pose - chosen.pose.min(),
        configuration=1 + m.configuration.max() + chosen.configuration - s.configuration.min(),
        sensor=sensor[kept],
        marker=marker[kept],
        frame=None if chosen.frame is None else 1 + int(m.frame.max()) + chosen.frame,
        from_q=turned,
        velocity=zeros,
        acceleration=zeros,
    )
    return replace(session, measurements=_in_order(stacked([m, rows])))


def effective_turns(motion: JointMotion, stamps: FloatArray) -> FloatArray:
    """Return the last turning point of each joint that explains its friction at rest, rad, (n, k).

    A move from there straight to the joint's present position would leave the same friction as
    the real way before each of the times, in Dahl's model with the travel
    `FRICTION_TRAVEL_RAD`: a servo overshoots and goes back by about that. NaN outside the
    record. ``stamps``: the times, s, (n,).
    """
    turns = np.full((len(stamps), len(motion.noise)), np.nan)
    for row, stamp in enumerate(stamps):
        way = motion.at(np.append(np.arange(stamp - ARRIVAL_S, stamp, WAY_STEP_S), stamp))
        way = way[np.isfinite(way[:, 0])]
        if not len(way):
            continue
        share, last = np.zeros(way.shape[1]), way[0].copy()
        for place in way:
            step = place - last
            step[np.abs(step) < STANDS_NOISE * motion.noise] = 0.0
            last += step
            side = np.sign(step)
            share = side + (share - side) * np.exp(-np.abs(step) / FRICTION_TRAVEL_RAD)
        back = FRICTION_TRAVEL_RAD * np.log(0.5 * (1.0 - np.minimum(np.abs(share), FULL_SHARE)))
        turns[row] = way[-1] + np.sign(share) * back
    return turns


def _restamped(name: str, frames: _Frames, steady: _Frames) -> str:
    """Sentence on a sensor's stamps that were replaced by a constant rate; '' if they were not.

    ``name``: of the sensor; ``steady``: frames with the new stamps, the same object if not
    replaced.
    """
    if steady is frames:
        return ''
    rate_hz = 1.0 / float(np.median(np.diff(steady.stamps)))
    left_out = len(frames.stamps) - len(steady.stamps)
    without = f'; {counted(left_out, "frame")} far from it left out' if left_out else ''
    return (
        f'the stamps of {name} scatter by {1e3 * steady.scatter_s:.2f} ms about a constant rate '
        f'of {rate_hz:.2f} Hz, with which the robot fits better: they are replaced by it'
        f'{without}'
    )


def _rate_hz(stream: Stream) -> float:
    """Rate by the median step between different stamps, Hz; 0 if there is no such step."""
    steps = np.diff(stream.stamps)
    steps = steps[steps > 0.0]
    return float(1.0 / np.median(steps)) if len(steps) else 0.0


def _late(seconds: float) -> str:
    """Delay of stamps, s, in words: '1.25 ms late', or 'early' if it is negative."""
    return f'{1e3 * abs(seconds):.2f} ms {"late" if seconds >= 0.0 else "early"}'


def _segments(number: IntArray) -> IntArray:
    """Index, from 0, of the segment of each time block, (b,): about five successive blocks.

    ``number``: of each block in the record, rising, (b,). A gap in the numbers ends a segment.
    """
    runs = np.split(np.arange(len(number)), np.flatnonzero(np.diff(number) > 1) + 1)
    segment, count = np.zeros(len(number), np.int64), 0
    for run in runs:
        for part in np.array_split(run, max(1, round(len(run) / SEGMENT_ROWS))):
            segment[part] = count
            count += 1
    return segment


def _means(
    values: FloatArray, block: IntArray, blocks: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Mean and standard deviation in each block, (b, m, 3), and number of samples, (b, m).

    ``values``: (f, m, 3), NaN for a marker that was not visible; ``block``: index of the block
    of each frame, rising, (f,); ``blocks``: b. The mean is NaN without a sample, the deviation
    with up to one.
    """
    seen = np.isfinite(values[..., 0])
    first = np.searchsorted(block, np.arange(blocks))

    def total(part: FloatArray) -> FloatArray:
        return np.add.reduceat(part, first, axis=0) if blocks else part[:0]

    samples = total(seen.astype(float))
    with np.errstate(invalid='ignore', divide='ignore'):
        mean = total(np.where(seen[..., None], values, 0.0)) / samples[..., None]
        differences = np.where(seen[..., None], values - mean[block], 0.0)
        std = np.sqrt(total(differences**2) / (samples[..., None] - 1.0))
    return mean, np.where(samples[..., None] > 1, std, np.nan), samples.astype(np.int64)


def _joined(parts: Sequence[Measurements]) -> Measurements:
    """Rows of all parts by time, sensor and marker, their observations numbered anew from 0."""
    columns = {
        name: None
        if getattr(parts[0], name) is None
        else np.concatenate([getattr(part, name) for part in parts])
        for name in vars(parts[0])
    }
    return _in_order(Measurements(**columns))  # type: ignore[arg-type]


def _in_order(measurements: Measurements) -> Measurements:
    """Rows by time, sensor and marker, their observations numbered anew from 0."""
    order = np.lexsort((measurements.marker, measurements.sensor, measurements.stamp_s))
    return replace(measurements.select(order), observation=np.arange(len(measurements)))


def _clock_by_speeds(
    motion: JointMotion,
    frames: _Frames,
    chain: SerialChain,
    options: MovingOptions,
    markers: Sequence[str],
) -> float:
    """Offset to be added to a sensor's stamps, s, by the speeds of its first marker and the tool.

    That of the largest correlation, within 3 s in steps of 5 ms. 0 if no correlation is above
    0.5, or the marker is in fewer than 60 frames. ``markers``: names of all markers, by index.
    """
    grid = np.arange(motion.begin[0], motion.end[-1], SPEED_STEP_S)
    name = markers[frames.markers[0]]
    place = options.places.get(name, np.zeros(3))
    with np.errstate(invalid='ignore'):
        points = chain.positions(np.nan_to_num(motion.at(grid)), place)
    modelled = np.linalg.norm(np.diff(points, axis=0), axis=1) / SPEED_STEP_S
    modelled[~np.isfinite(motion.at(grid[1:])[:, 0])] = 0.0
    modelled = np.minimum(modelled, 10.0)
    positions = frames.positions[:, 0]
    seen = np.isfinite(positions[:, 0])
    if seen.sum() < FEWEST_ROWS:
        return 0.0
    stamps = frames.stamps[seen]
    times = np.arange(stamps[0], stamps[-1], SPEED_STEP_S)
    path = np.stack([np.interp(times, stamps, column) for column in positions[seen].T], axis=1)
    width = max(1, round(2.0 * SPEED_SMOOTHING_S / SPEED_STEP_S))
    measured = np.linalg.norm(path[width:] - path[:-width], axis=1) / (width * SPEED_STEP_S)
    kernel = np.ones(width) / width
    modelled = np.convolve(modelled, kernel, 'same')
    middle = times[: len(measured)] + 0.5 * width * SPEED_STEP_S
    alike = []
    offsets = np.arange(-FARTHEST_CLOCK_S, FARTHEST_CLOCK_S, SPEED_STEP_S)
    for offset in offsets:
        at = np.interp(middle + offset, grid[1:], modelled, left=np.nan, right=np.nan)
        both = np.isfinite(at)
        if both.sum() < 0.5 * len(at) or not (np.std(at[both]) and np.std(measured[both])):
            alike.append(-1.0)
            continue
        alike.append(float(np.corrcoef(at[both], measured[both])[0, 1]))
    best = int(np.argmax(alike))
    return float(offsets[best]) if alike[best] > LEAST_ALIKE else 0.0


def _robust_fit(session: Session) -> tuple[_Guess, FloatArray, float]:
    """Robust fit of a session, remaining offset of each sensor's clock, s, and median residual, m.

    The offsets, (sensors,), are to be added to the stamps; the residual is the distance of the
    measured from the fitted positions. At most 1,500 of the rows that are not held out are
    used.
    """
    problem = Problem.of(session)
    measurements, rows = problem.measurements, problem.fitted
    chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_FITTED)).astype(np.int64)]
    empty = problem.empty_model()
    # Offsets of degrees do not affect the clocks, and would slow the first search down.
    priors = problem.marker_priors(empty) + problem.plausibility(
        empty, np.arange(len(problem.chain))
    )
    model, z = closest_start(
        empty,
        measurements,
        chosen,
        problem.markers,
        float(np.max(problem.marker_std_m)),
        priors,
    )
    found = Rows.of(measurements, chosen, model.reference)
    errors = found.target - model.predict(z, found)
    jacobian = model.jacobian(z, found)
    by_joints = jacobian[:, :, : model.joints].copy()
    # The outer two joints' columns are zero in these coordinates.
    pose = model.inner_pose(z, found)
    correction = model.corrections(z)
    clocks = np.zeros((len(found), 3, len(model.sensor_names)))
    assert measurements.velocity is not None
    for sensor, span in found.spans:
        by_joints[span] = correction[sensor, :3, :3] @ pose.by_joints[span]
        velocity = measurements.velocity[found.source[span]]
        clocks[span, :, sensor] = np.einsum('nik,nk->ni', by_joints[span], velocity)
    free = np.setdiff1d(np.arange(model.size), (0, model.joints - 1))
    design = np.concatenate((jacobian[:, :, free], clocks), axis=2)
    spread = robust_spread(errors, found)
    scale = np.concatenate(
        [np.full(span.stop - span.start, sigma) for sigma, (_, span) in zip(spread, found.spans)]
    )
    residual, by_z = prior_rows(model, priors, z)
    pull = np.concatenate((by_z[:, free], np.zeros((len(by_z), len(model.sensor_names)))), axis=1)
    misfits, solution = errors, np.zeros(design.shape[2])
    for _ in range(10):
        width = CAUCHY_WIDTH * scale
        root = 1.0 / np.sqrt(1.0 + np.sum(misfits**2, axis=1) / width**2) / scale
        matrix = np.concatenate(
            ((design * root[:, None, None]).reshape(-1, design.shape[2]), pull)
        )
        right = np.concatenate(((errors * root[:, None]).ravel(), -residual))
        unit = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        solution = np.linalg.lstsq(matrix / unit, right, rcond=1e-12)[0] / unit
        misfits = errors - design @ solution
        spread = robust_spread(misfits, found)
        scale = np.concatenate(
            [
                np.full(span.stop - span.start, sigma)
                for sigma, (_, span) in zip(spread, found.spans)
            ]
        )
    moved = z.copy()
    moved[free] += solution[: len(free)]
    # Far from the right clock the step of the rest goes too far.
    x = model.natural(moved if np.all(np.abs(solution[len(free) :]) < 5e-3) else z)
    guess = _Guess(model.offsets(x), model.markers(x), inverse(model.T_R_N(x)))
    return guess, solution[len(free) :], float(np.median(np.linalg.norm(misfits, axis=1)))
