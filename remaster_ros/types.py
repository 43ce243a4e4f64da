# SPDX-License-Identifier: Apache-2.0
"""Frozen records that pass between collection, storage and estimation. SI units throughout."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import nan
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

Split = Literal['optimization', 'validation', 'reference']
AngleUnit = Literal['deg', 'rad', 'gon']
SensorKind = Literal['camera', 'tracker', 'controller']
"""What may be wrong with an instrument: a camera has lenses, a tracker has none, and points that a
controller computed were seen by no instrument."""
AccuracyOption = Literal['', 'active', 'inactive']
"""Whether a controller corrects by a calibration of its maker's; '' where it is not known."""

FARTHEST_M = 200.0
"""More than any tracker's range: such a number is in millimetres, or broken."""


@dataclass(frozen=True)
class MarkerReading:
    """One marker position measured by one sensor, in the sensor's own frame N.

    Attributes
    ----------
    stamp_s
        Time of capture, s.
    position
        Marker position in N, m, shape (3,). NaN where other markers of the frame were seen and
        this one was not.
    temperature_c
        Of the air, by the sensor's own thermometer; NaN where it has none.
    marker
        Name of the marker, where the sensor measures several; '' for the one it follows. Those
        of one frame have equal stamps.
    orientation
        Of the body whose origin the marker is, in N: unit quaternion x, y, z, w, (4,). None where
        the sensor measures positions alone, or had none this time.
    """

    stamp_s: float
    position: FloatArray
    temperature_c: float = nan
    marker: str = ''
    orientation: FloatArray | None = None

    @property
    def seen(self) -> bool:
        """Whether the marker was measured."""
        return bool(np.isfinite(self.position[0]))


@dataclass(frozen=True)
class Observation:
    """One row of ``observations.csv``: the reported joint angles, and a measured marker.

    Attributes
    ----------
    q, from_q
        Reported joint positions, and those it came from (None if unknown), rad, (k,).
    position, std
        Mean marker position in N over the dwell, and the samples' standard deviation
        (None for a single shot), m, (3,).
    samples
        How many samples the mean has; None if unknown.
    frame
        Observations of one sensor with the same number come from one frame of it and share its
        error; None if this one shares none.
    orientation
        Mean orientation of the measured body in N over the dwell, unit quaternion x, y, z, w,
        (4,); None if it was not measured.
    wanted
        The reported joint positions less what a correction changed, rad, (k,); None if unknown.
    correction
        Whether a correction was on; None if unknown.
    effort
        Measured joint torques, N m, (k,), NaN where unknown; None if none is known.
    velocity, acceleration
        Of the joints when the marker was measured, rad/s and rad/s², (k,); None of an arm that
        stood still.
    """

    observation: int
    pose: int
    configuration: int
    split: Split
    stamp_s: float
    sensor: str
    marker: str
    q: FloatArray
    position: FloatArray
    from_q: FloatArray | None = None
    std: FloatArray | None = None
    samples: int | None = None
    temperature_c: float | None = None
    frame: int | None = None
    orientation: FloatArray | None = None
    wanted: FloatArray | None = None
    correction: bool | None = None
    effort: FloatArray | None = None
    velocity: FloatArray | None = None
    acceleration: FloatArray | None = None


@dataclass(frozen=True)
class BasePrior:
    """Prior of a sensor's registration T_R_N: pose of its frame N in the robot base frame R.

    Attributes
    ----------
    translation_m
        Sensor origin in R, m, (3,).
    rotation_xyzw
        Unit quaternion of R_R_N, (4,).
    std_m, std_rad
        Standard deviation per axis.
    """

    translation_m: FloatArray
    rotation_xyzw: FloatArray
    std_m: float
    std_rad: float


@dataclass(frozen=True)
class Priors:
    """What is known before a fit of offsets, markers and sensor poses, instead of the session's.

    Attributes
    ----------
    joint_offsets
        Joint name -> mean and standard deviation, rad; m of those in ``in_m``.
    in_m
        Names of the joints whose priors are lengths: of those that slide.
    markers
        Marker name -> position in the tool frame T, m, (3,), and standard deviation per axis, m.
    base
        Sensor name -> registration.
    geometry_tolerance_m
        Least error of the nominal geometry, m: RMS displacement of the marker by the error of each
        link length, and by that of each axis tilt. Links are machined and assembled to a tenth of
        a millimetre or so.
    """

    joint_offsets: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    markers: Mapping[str, tuple[FloatArray, float]] = field(default_factory=dict)
    base: Mapping[str, BasePrior] = field(default_factory=dict)
    geometry_tolerance_m: float = 1e-4
    in_m: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Measurements:
    """The observations of a session as columns; row i of every array is one observation.

    Attributes
    ----------
    observation, pose, configuration
        Integers as in the file, (n,).
    is_validation
        True where ``split`` is ``validation``, (n,).
    stamp_s
        Time of the measurement, s, (n,).
    sensor, marker
        Index into the session's ``sensors`` / ``markers`` (in their order), (n,).
    q, from_q
        Joint positions, rad, (n, k); ``from_q`` is NaN where unknown.
    position, std
        Marker in the sensor's own frame N and its dwell std, m, (n, 3); ``std`` NaN if unknown.
    samples
        Samples in the mean, (n,); -1 where unknown.
    temperature_c
        Degrees Celsius, (n,); NaN where unknown.
    effort
        Measured joint torques, N m, (n, k), NaN where unknown; None if the file has no column.
    is_reference
        True where ``split`` is ``reference``, (n,); None where none is, as in every session.
    frame
        Rows of one sensor with the same number come from one frame of it and share its error,
        (n,); -1 where a row shares none. None where the file has no such column.
    orientation
        Of the measured body in N, unit quaternions x, y, z, w, (n, 4); NaN where it was not
        measured. None where the file has no such columns.
    wanted
        Joint positions that were wanted before any correction, those at which the nominal robot
        has the pose, rad, (n, k); NaN where unknown. None where the file has no such columns.
    correction
        1 where a correction was on, 0 where it was off, (n,); -1 where unknown. None where the
        file has no such column.
    velocity, acceleration
        Of the joints when the markers were measured, rad/s and rad/s², (n, k); NaN where the arm
        stood still. None of a session whose arm always stood still.
    """

    observation: IntArray
    pose: IntArray
    configuration: IntArray
    is_validation: BoolArray
    stamp_s: FloatArray
    sensor: IntArray
    marker: IntArray
    q: FloatArray
    from_q: FloatArray
    position: FloatArray
    std: FloatArray
    samples: IntArray
    temperature_c: FloatArray
    effort: FloatArray | None = None
    is_reference: BoolArray | None = None
    frame: IntArray | None = None
    orientation: FloatArray | None = None
    wanted: FloatArray | None = None
    correction: IntArray | None = None
    velocity: FloatArray | None = None
    acceleration: FloatArray | None = None

    def __len__(self) -> int:
        """Return the number of observations."""
        return len(self.observation)

    @classmethod
    def empty(cls, joints: int) -> Measurements:
        """Return measurements without rows, n = 0, of an arm with this number of joints."""
        integers, numbers = np.zeros(0, np.int64), np.zeros(0)
        return cls(
            observation=integers,
            pose=integers,
            configuration=integers,
            is_validation=np.zeros(0, bool),
            stamp_s=numbers,
            sensor=integers,
            marker=integers,
            q=np.zeros((0, joints)),
            from_q=np.zeros((0, joints)),
            position=np.zeros((0, 3)),
            std=np.zeros((0, 3)),
            samples=integers,
            temperature_c=numbers,
        )

    def select(self, rows: BoolArray | IntArray) -> Measurements:
        """Return a copy with only the given rows (a mask or indices), in that order."""
        columns: dict[str, Any] = {
            name: None if value is None else value[rows] for name, value in vars(self).items()
        }
        return Measurements(**columns)


@dataclass(frozen=True)
class PadJoint:
    """Name, unit, sign and zero with which a robot's own pad (teach pendant) shows one joint.

    The URDF's angle is ``sign`` times the sum of the pad's angle and those coupled to it, plus
    ``zero_deg``.

    Attributes
    ----------
    name
        Of the joint on the pad, or in the table that came from it.
    unit
        In which the pad shows it.
    sign
        1 or -1.
    zero_deg
        The URDF's angle where the pad shows 0, degrees.
    coupling
        Joint of the URDF -> 1 or -1: sign with which the pad's angle of that joint is added to
        this one's.
    """

    name: str
    unit: AngleUnit = 'deg'
    sign: Literal[1, -1] = 1
    zero_deg: float = 0.0
    coupling: Mapping[str, Literal[1, -1]] = field(default_factory=dict)


@dataclass(frozen=True)
class Controller:
    """Conversion of joint angles between a robot's own pad (teach pendant) and the URDF.

    Attributes
    ----------
    joints
        Joint of the URDF -> how the pad writes it, base to tip.
    maker
        Of the controller; '' if it is not known.
    """

    joints: Mapping[str, PadJoint]
    maker: str = ''


BRIDGE = 'robot_bridge'
"""The form of a correction that the robot bridge makes of what it commands."""


@dataclass(frozen=True)
class Correction:
    """Correction (form and file) that was on while a session was measured.

    Attributes
    ----------
    form
        In which it was loaded, such as ``pad`` or ``urdf``.
    sha256
        Of its compensation.json; '' if unknown.
    """

    form: str
    sha256: str = ''

    @property
    def is_inside(self) -> bool:
        """Whether the correction is in the controller, so that reported joint angles contain it.

        True for the forms pad, rising and ros2_control; False for an unknown form.
        """
        return self.form in ('pad', 'rising', 'ros2_control')

    @property
    def is_beside(self) -> bool:
        """Whether the correction is outside of the controller, so that reported angles lack it.

        True for the forms of the bridge (`BRIDGE`), layer and urdf; False for an unknown form.
        """
        return self.form in (BRIDGE, 'layer', 'urdf')

    def __str__(self) -> str:
        return self.form + (f', checksum {self.sha256[:8]}' if self.sha256 else '')


def _end(joint: ElementTree.Element, end: str) -> str:
    """Name of the link at an end of a URDF's joint, ``parent`` or ``child``; '' if it has none."""
    found = joint.find(end)
    return '' if found is None else found.get('link', '')


@dataclass(frozen=True, repr=False)
class Session:
    """A session: the robot, the markers and sensors, and what was measured.

    Attributes
    ----------
    urdf
        Text of the nominal robot's URDF.
    markers
        Nominal marker positions in the tool frame T, m, name -> (3,).
    marker_std_m
        How well the nominal marker positions are known, per axis, m.
    sensors
        Sensor name -> the marker it follows while collecting.
    further_markers
        Sensor name -> further markers that it measures in the same frame, where it does.
    oriented
        Sensors that measure the orientation of a body, too.
    sensor_kinds
        Sensor name -> ``camera``, ``tracker``, or ``controller`` where the robot itself computed
        the points; without an entry where it is unknown.
    on_tool
        Those of the sensors that are on the tool, and measure a target beside the robot: their
        readings are positions of the sensor itself, in the frame of that target.
    measurements
        What is fitted and what is held out: no row of them is a reference.
    references
        Rows of configurations that were measured again and again, to watch for changes; neither
        fitted nor in any metric. None where there are none.
    base_prior
        Sensor name -> registration known beforehand.
    settle_s
        How long the arm stood still before a measurement, s; None where unknown.
    timed
        False where nothing is known of the times: ``stamp_s`` then only orders the rows.
    exit_status
        ``complete``, ``stopped``, ``aborted`` or '' where the file has none.
    operator, serial_number
        Who measured, and which arm; '' where the file has none.
    controller
        How the robot's own pad writes the joints; None where it writes them as the URDF, in
        degrees, or nothing is known.
    correction
        That was on while it was measured; None where none is stated.
    accuracy_option
        Whether the maker's own accuracy option was on in the controller.
    extra
        Keys of session.yaml this version does not know, kept as they are.
    observations_sha256
        Of the file that the rows were read from; '' where they were not read, or are a part of it.
    disagreements
        What the sessions that it was made of disagree in, a sentence each.
    clock_offset_s
        Sensor name -> what was added to its stamps to have those of the joint states, s.
    """

    urdf: str
    base_link: str
    tip_link: str
    markers: Mapping[str, FloatArray]
    sensors: Mapping[str, str]
    measurements: Measurements
    marker_std_m: float = 0.5e-3
    settle_s: float | None = 3.0
    timed: bool = True
    base_prior: Mapping[str, BasePrior] = field(default_factory=dict)
    exit_status: str = ''
    operator: str = ''
    serial_number: str = ''
    notes: str = ''
    created: str = ''
    extra: Mapping[str, Any] = field(default_factory=dict)
    references: Measurements | None = None
    further_markers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    oriented: frozenset[str] = frozenset()
    on_tool: frozenset[str] = frozenset()
    observations_sha256: str = ''
    controller: Controller | None = None
    correction: Correction | None = None
    accuracy_option: AccuracyOption = ''
    disagreements: tuple[str, ...] = ()
    sensor_kinds: Mapping[str, SensorKind] = field(default_factory=dict)
    clock_offset_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_moving(self) -> bool:
        """Whether markers were measured while the arm moved."""
        return self.measurements.velocity is not None

    @property
    def urdf_sha256(self) -> str:
        """SHA-256 of the URDF's text, which identifies the robot that a result belongs to."""
        return hashlib.sha256(self.urdf.encode()).hexdigest()

    @property
    def slides(self) -> tuple[bool, ...]:
        """Whether each joint slides (is prismatic, positions in m), base to tip, (k,)."""
        joints = ElementTree.fromstring(self.urdf).findall('joint')
        carrying = {_end(joint, 'child'): joint for joint in joints}
        kinds, link = list[str | None](), self.tip_link
        while link != self.base_link:
            kinds.insert(0, carrying[link].get('type'))
            link = _end(carrying[link], 'parent')
        return tuple(kind == 'prismatic' for kind in kinds if kind != 'fixed')

    def __repr__(self) -> str:
        m = self.measurements
        sensors = ', '.join(f'{name} (marker {marker})' for name, marker in self.sensors.items())
        held_out = int(m.is_validation.sum())
        return (
            f'Session of the arm from {self.base_link} to {self.tip_link}: {m.q.shape[1]} joints, '
            f'{len(m) - held_out} rows to fit, {held_out} held out; sensors {sensors}'
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the measurements as columns by their names in observations.csv, for a data frame.

        References are left out, and columns that no row has; an unknown number is NaN, an
        unknown count -1.

        Returns
        -------
        dict of (n,) arrays
            In s, rad, m, degrees Celsius, N m and N, as the names say.
        """
        m = self.measurements
        joints = [
            (i, *(('m', 'n') if slides else ('rad', 'nm')))
            for i, slides in enumerate(self.slides, start=1)
        ]
        found: dict[str, NDArray[Any]] = {
            'observation': m.observation,
            'pose': m.pose,
            'configuration': m.configuration,
            'split': np.where(m.is_validation, 'validation', 'optimization'),
            'stamp_s': m.stamp_s,
            'sensor': np.array(self.sensor_names)[m.sensor],
            'marker': np.array(self.marker_names)[m.marker],
        }
        for names, values in (
            ([f'q{i}_{unit}' for i, unit, _ in joints], m.q),
            ([f'from_q{i}_{unit}' for i, unit, _ in joints], m.from_q),
            (['x_m', 'y_m', 'z_m'], m.position),
            (['std_x_m', 'std_y_m', 'std_z_m'], m.std),
            ([f'orientation_{axis}' for axis in 'xyzw'], m.orientation),
            ([f'effort{i}_{unit}' for i, _, unit in joints], m.effort),
            ([f'wanted{i}_{unit}' for i, unit, _ in joints], m.wanted),
            ([f'velocity{i}_{unit}_s' for i, unit, _ in joints], m.velocity),
            ([f'acceleration{i}_{unit}_s2' for i, unit, _ in joints], m.acceleration),
        ):
            if values is not None and not np.isnan(values).all():
                found |= dict(zip(names, values.T, strict=True))
        if (m.samples >= 0).any():
            found['samples'] = m.samples
        if not np.isnan(m.temperature_c).all():
            found['temperature_c'] = m.temperature_c
        if m.frame is not None:
            found['frame'] = m.frame
        if m.correction is not None:
            found['correction'] = np.array(['', 'off', 'on'])[m.correction + 1]
        return found

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Sensor names, at the indices that ``measurements.sensor`` has."""
        return tuple(self.sensors)

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Marker names, at the indices that ``measurements.marker`` has."""
        return tuple(self.markers)

    @property
    def is_corrected(self) -> BoolArray:
        """Mask of the measurements with a correction on, (n,).

        Rows of which it is unknown count as on if the session states a correction, else as
        off.
        """
        given, unknown = self.measurements.correction, self.correction is not None
        if given is None:
            return np.full(len(self.measurements), unknown)
        return np.where(given < 0, unknown, given == 1)

    @property
    def correction_note(self) -> str:
        """Sentence on whether zero-offsets found here come on top of the correction.

        '' if it is on in no row. If it is in the controller, they come on top of it; if it is
        outside, they take its place; if its form is unknown, the sentence asks for it.
        """
        on = self.is_corrected
        if not on.any():
            return ''
        measured = f'Measured with a correction on ({self.correction or "its form is not stated"})'
        if self.correction is None or not (self.correction.is_inside or self.correction.is_beside):
            return (
                f'{measured}: whether the zero-offsets found here come on top of it or take its '
                'place cannot be told; give session.yaml the key correction with form '
                'robot_bridge, layer, urdf, pad, rising or ros2_control.'
            )
        if self.correction.is_inside:
            return (
                f'{measured}, in the controller: the zero-offsets found here are what remains, '
                'and come on top of it.'
            )
        return (
            f'{measured}, beside the controller, whose reported angles are as without it: the '
            'zero-offsets found here are the whole ones again, take its place and never come on '
            'top of it; whether it is in use, and what remains, tells remaster verify.'
        )

    def positions_alone(self) -> Session:
        """Return a copy of the session without the measured orientations."""
        without = replace(self.measurements, orientation=None)
        return replace(self, measurements=without, oriented=frozenset())

    def through_correction(self) -> Session:
        """Return the rows with the correction on, as of the nominal robot at the angles wanted.

        A new session whose ``q`` are the angles ``wanted``; previous angles are unknown, and it
        has no references and states no correction. What a fit finds in it is the error that
        the correction leaves; it must not be loaded as a correction.

        Raises
        ------
        ValueError
            No row has a correction on, or one of these rows has no ``wanted``.
        """
        on = self.is_corrected
        found = replace(self.select(on), correction=None, references=None)
        m = found.measurements
        if m.wanted is None or not len(m) or np.isnan(m.wanted).any():
            raise ValueError(
                'a row with the correction on does not tell what was wanted (wanted1_rad …)'
                if len(m)
                else 'no row has a correction on'
            )
        unknown = np.full_like(m.q, np.nan)
        plain = replace(m, q=m.wanted, from_q=unknown, wanted=None, correction=None)
        return replace(found, measurements=plain)

    def select(self, rows: BoolArray | IntArray) -> Session:
        """Return a copy of the session with only the given rows (mask or indices), in that order.

        References stay; ``observations_sha256`` is ''.
        """
        return replace(self, measurements=self.measurements.select(rows), observations_sha256='')
