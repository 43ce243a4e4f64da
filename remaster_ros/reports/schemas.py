# SPDX-License-Identifier: Apache-2.0
"""Schemas of fit.json and discovery.json: each key once, for writing and reading.

Effects, noise, sampler and the like are the records of `calibration` and `discovery` themselves.
A key without a default is part of the contract, and a file without it is refused. A key that is
`UNSET` by default is written if it has a value; other programs' files may lack it. Unknown keys
are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

from msgspec import UNSET, Struct, UnsetType

from remaster_ros.calibration.convergence import SamplerInfo
from remaster_ros.calibration.identifiability import GaugeDirection
from remaster_ros.calibration.motion_proof import MotionProof
from remaster_ros.calibration.noise_check import NoiseCheck
from remaster_ros.calibration.noise_estimate import NoiseEstimate
from remaster_ros.calibration.predictions import Coverage
from remaster_ros.calibration.records import Marker, Registration, Robot, Triple
from remaster_ros.calibration.residual_structure import StructureTest
from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.decision import Decision
from remaster_ros.discovery.explain import FoundEffect, SearchRecord
from remaster_ros.discovery.gain import Gain
from remaster_ros.discovery.guard import Unexplained
from remaster_ros.discovery.thinning import Thinning
from remaster_ros.kinematics.serial_chain import LEVER_M

FIT_FORMAT = 'remaster-fit/1'
DISCOVERY_FORMAT = 'remaster-discovery/1'
# Judgement of a result: green, amber or red.
Mood = Literal['good', 'caution', 'bad']


class Counts(Struct):
    """Numbers of observations, configurations and poses among the fitted or held-out rows."""

    observations: int
    configurations: int
    poses: int


class MeasuredSession(Struct):
    """Description of the session: counts, sensors with markers, date, exit status, hash, times."""

    optimization: Counts
    validation: Counts
    sensors: dict[str, str]
    created: str
    exit_status: str
    observations_sha256: str | UnsetType = UNSET
    times: Literal['none'] | UnsetType = UNSET


class JointOffset(Struct):
    """Zero-offset of a joint; if ``identifiable`` is false, ``why`` is the reason.

    ``std_deg`` and ``interval95_deg`` include the effect of lengths and tilts off their drawing
    (``geometry``); ``std_if_exactly_drawn_deg`` is without it, and ``model_std_deg``, present if
    errors remain that the model does not have (``intervals``), is also without those.

    For a prismatic joint ``unit`` is mm, the values end in ``_mm``, and those in ``_deg`` are
    null: there is no such angle.
    """

    joint: str
    mean_deg: float | None
    std_deg: float | None
    interval95_deg: tuple[float, float] | None
    identifiable: bool
    why: str
    unit: Literal['deg', 'mm'] = 'deg'
    mean_mm: float | UnsetType = UNSET
    std_mm: float | UnsetType = UNSET
    interval95_mm: tuple[float, float] | UnsetType = UNSET
    std_if_exactly_drawn_deg: float | UnsetType = UNSET
    std_if_exactly_drawn_mm: float | UnsetType = UNSET
    model_std_mm: float | UnsetType = UNSET
    model_std_deg: float | UnsetType = UNSET

    @property
    def mean_and_std(self) -> tuple[float, float]:
        """Mean and standard deviation, rad; m for a prismatic joint."""
        if self.mean_deg is None or self.std_deg is None:
            assert self.mean_mm is not UNSET
            assert self.std_mm is not UNSET
            return 1e-3 * self.mean_mm, 1e-3 * self.std_mm
        return math.radians(self.mean_deg), math.radians(self.std_deg)

    @property
    def std_if_exactly_drawn(self) -> float:
        """Standard deviation for an arm of exactly nominal geometry, rad or m.

        If the file has none, as older files: that of `mean_and_std`.
        """
        std = getattr(self, f'std_if_exactly_drawn_{self.unit}')
        if std is UNSET:
            return self.mean_and_std[1]
        return 1e-3 * float(std) if self.unit == 'mm' else math.radians(std)


class SampledParameter(Struct):
    """A parameter in the unit of its name (m, rad), and its convergence diagnostics."""

    name: str
    mean: float
    std: float
    r_hat: float | None
    ess_bulk: float | None
    ess_tail: float | None


class Accuracy(Struct):
    """Accuracy metrics of the fitted and of the held-out rows.

    ``validation`` is None if nothing was held out.
    """

    optimization: Mapping[str, Any] | None
    validation: Mapping[str, Any] | None


class LeftOut(Struct):
    """Number (``observation``) of a row that was not fitted, and the reason."""

    observation: int
    why: str


class TurnNoise(Struct):
    """Noise of a sensor's orientations per axis, degrees: of one row, and shared by a pose."""

    sigma_deg: float
    std_deg: float
    pose_sigma_deg: float | None


class Body(Struct):
    """Rotation of a measured body on the tool, R_T_B; the std is about the axes of T."""

    rotation_xyzw: list[float]
    std_deg: Triple


class Orientation(Struct):
    """Result of measured orientations.

    ``p_value`` is that of agreement of positions and orientations on the offsets;
    ``std_positions_deg`` is the std of each offset from the positions alone (None: unknown),
    ``std_positions_mm`` that of prismatic joints. If orientations are not fitted, ``why`` has the
    reason.
    """

    fitted: bool
    count: int
    why: str
    noise: dict[str, TurnNoise]
    bodies: dict[str, Body]
    p_value: float | None = None
    std_positions_deg: dict[str, float | None] = {}
    std_positions_mm: dict[str, float | None] | UnsetType = UNSET


class Judgement(Struct):
    """Judgement of a result for a reader who did not measure it: green, amber or red, and why.

    ``points`` are further remarks. Of these, ``findings`` are errors that noise does not explain,
    but causes may; ``doubts`` are limits of the data; ``disagreements`` are data that contradict
    each other.
    """

    mood: Mood
    headline: str
    points: list[str] = []
    findings: list[str] = []
    doubts: list[str] = []
    disagreements: list[str] = []


class Imitation(Struct):
    """Length or tilt that changes a joint's offset most, and the change if it is off its drawing.

    ``deg`` is the change of the offset of ``joint`` (a name) by a length or tilt that is off by
    the tolerance; for a prismatic joint it is ``mm``, and ``deg`` is null. ``link_length`` ``of``
    2 is that of the link after joint 2.
    """

    joint: str
    cause: Literal['link_length', 'joint_axis_tilt']
    of: int
    axis: str
    deg: float | None
    mm: float | UnsetType = UNSET

    @property
    def as_angle(self) -> float:
        """Change of the joint's offset as an angle, rad; a length is divided by 0.25 m."""
        if self.deg is not None:
            return math.radians(self.deg)
        assert self.mm is not UNSET
        return 1e-3 * self.mm / LEVER_M

    @property
    def shown(self) -> str:
        """Change of the joint's offset with its unit, to three decimals: '0.012 deg'."""
        return f'{self.mm:.3f} mm' if self.deg is None else f'{self.deg:.3f} deg'


class FittedGeometry(Struct):
    """All link lengths and axis tilts, fitted together with the offsets.

    There is one prior variance for lengths and one for tilts. Standard deviations are RMS
    displacements of the marker by each length and each tilt, at least ``tolerance_mm``. Errors are
    means over the validation rows, with nominal geometry and with the robot model that has these
    lengths and tilts; ``file`` is that model if it predicts them better, '' otherwise.
    """

    tolerance_mm: float
    length_std_mm: float | None
    tilt_std_mm: float | None
    drawing_held_out_mean_mm: float | None
    held_out_mean_mm: float | None
    file: str
    imitations: list[Imitation]


class Clock(Struct):
    """Delay of a sensor's stamps against those of the joint states, ms, and its std."""

    late_ms: float
    std_ms: float


class Fit(Struct):
    """Content of fit.json.

    ``intervals`` is 'model' if those of the offsets are the posterior's, 'robust' if they are
    wider because errors remain that the model does not have.
    """

    format: str
    joint_offsets: list[JointOffset]
    gauge: list[GaugeDirection]
    registration: dict[str, Registration]
    markers: dict[str, Marker]
    noise: dict[str, NoiseEstimate]
    sampler: SamplerInfo
    accuracy: Accuracy
    left_out: list[LeftOut]
    version: str | UnsetType = UNSET
    robot: Robot | UnsetType = UNSET
    session: MeasuredSession | UnsetType = UNSET
    parameters: list[SampledParameter] | UnsetType = UNSET
    explained_by_noise: dict[str, NoiseCheck] | UnsetType = UNSET
    residual_structure: list[StructureTest] | UnsetType = UNSET
    intervals: Literal['model', 'robust'] | UnsetType = UNSET
    geometry: FittedGeometry | UnsetType = UNSET
    orientation: Orientation | UnsetType = UNSET
    clocks: dict[str, Clock] | UnsetType = UNSET
    motion_proof: MotionProof | UnsetType = UNSET
    judgement: Judgement | UnsetType = UNSET


class Loadable(Struct):
    """A result that a robot can load, and the mean 3-D error on held-out poses with it.

    ``result``: 'offsets' alone, 'geometry' (all link lengths, axis tilts and zero-offsets) or
    'everything' that the model has. ``better``: whether its error is smaller than those of the
    simpler results worth loading; if not, there is no reason to load it. ``file`` is '' if no
    file contains it.
    """

    result: Literal['offsets', 'geometry', 'everything']
    held_out_mean_mm: float | None
    better: bool
    file: str


class NoiseOfDiscovery(Struct):
    """Noise and gross errors as estimated by the search for causes."""

    pose_common_fraction: float
    outliers: list[int]
    heteroscedastic: Mapping[str, Any]
    sensors: dict[str, NoiseEstimate] | UnsetType = UNSET


class OffsetBefore(Struct):
    """Zero-offset of a joint in the fit without causes, with its standard deviation.

    The standard deviation is None if the data do not determine the offset. Units of prismatic
    joints as in `JointOffset`.
    """

    joint: str
    mean_deg: float | None
    std_deg: float | None
    unit: Literal['deg', 'mm'] = 'deg'
    mean_mm: float | UnsetType = UNSET
    std_mm: float | UnsetType | None = UNSET


class PredictedRegions(Struct):
    """The 95 % regions of predictions.csv: ``widening`` is the factor on their size.

    It is chosen so that 95 % of the fitted rows lie inside if their pose is left out.
    """

    widening: float
    held_out: Coverage
    fitted: Coverage


class JointCovariance(Struct):
    """Covariance of the identifiable zero-offsets and of all parameters of the causes.

    ``matrix`` is in the units of its parameters, to six figures.
    """

    names: list[str]
    units: list[str]
    matrix: list[list[float]]


class Discovered(Struct):
    """Content of discovery.json.

    Zero-offsets are of two kinds. ``joint_offsets_after`` are fitted together with the causes, for
    a controller that corrects these, too. ``joint_offsets_alone`` are fitted without causes of the
    arm, for a controller that takes offsets alone: they contain the mean effect of the causes over
    the configurations measured.
    """

    format: str
    verdict: Literal['effects', 'none', 'undetermined', 'unexplained']
    effects: list[FoundEffect]
    gain: Gain
    noise: NoiseOfDiscovery
    joint_offsets_after: list[JointOffset]
    version: str | UnsetType = UNSET
    robot: Robot | UnsetType = UNSET
    session: MeasuredSession | UnsetType = UNSET
    metrics: Mapping[str, Any] | UnsetType = UNSET
    untestable: dict[str, str] | UnsetType = UNSET
    unexplained: list[Unexplained] | UnsetType = UNSET
    search: SearchRecord | UnsetType = UNSET
    joint_offsets_before: list[OffsetBefore] | UnsetType = UNSET
    joint_offsets_alone: list[JointOffset] | UnsetType = UNSET
    sampler: SamplerInfo | UnsetType = UNSET
    registration: dict[str, Registration] | UnsetType = UNSET
    markers: dict[str, Marker] | UnsetType = UNSET
    covariance: JointCovariance | UnsetType = UNSET
    predicted_regions95: PredictedRegions | UnsetType = UNSET
    loadable: list[Loadable] | UnsetType = UNSET
    rows_searched: Thinning | UnsetType = UNSET
    clocks: dict[str, Clock] | UnsetType = UNSET
    confirmation: Confirmation | UnsetType = UNSET
    decided: list[Decision] | UnsetType = UNSET
    judgement: Judgement | UnsetType = UNSET
