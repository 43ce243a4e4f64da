# SPDX-License-Identifier: Apache-2.0
"""What fit.json and discovery.json hold: each key once, to write and to read.

A key without a default is what other programs rely on, and a file without it is refused. One that
is `UNSET` by default is written where it has a value; the files of other programs may lack it.
Keys that are not here are kept as they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType

from remaster_ros.calibration.identifiability import GaugeDirection
from remaster_ros.calibration.predictions import Coverage
from remaster_ros.discovery.explain import CERTAIN, LookAlike, Parameter
from remaster_ros.discovery.thinning import Thinning
from remaster_ros.kinematics.serial_chain import LEVER_M

FIT_FORMAT = 'remaster-fit/1'
DISCOVERY_FORMAT = 'remaster-discovery/1'

Triple = tuple[float, float, float]
Content = TypeVar('Content', bound=Struct)


class Robot(Struct):
    """Whose offsets these are."""

    name: str
    urdf_sha256: str
    joint_names: list[str]
    base_link: str
    tip_link: str


class Counts(Struct):
    """What was measured of a split."""

    observations: int
    configurations: int
    poses: int


class MeasuredSession(Struct):
    """What was measured: counts, sensor -> marker, date, how it ended, hash; if it has times."""

    optimization: Counts
    validation: Counts
    sensors: dict[str, str]
    created: str
    exit_status: str
    observations_sha256: str | UnsetType = UNSET
    times: Literal['none'] | UnsetType = UNSET


class JointOffset(Struct):
    """One joint's zero-offset; where ``identifiable`` is false, ``why`` is the reason.

    ``std_deg`` and ``interval95_deg`` contain what lengths and tilts off their drawing would do to
    the offset (``geometry``); ``std_if_exactly_drawn_deg`` is without them, and ``model_std_deg``,
    where errors are left (``intervals``), also without those.

    Of a joint that slides ``unit`` is mm, the values end in ``_mm``, and those in ``_deg`` are
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
        """Mean and standard deviation, rad; m of a joint that slides."""
        if self.mean_deg is None or self.std_deg is None:
            assert self.mean_mm is not UNSET
            assert self.std_mm is not UNSET
            return 1e-3 * self.mean_mm, 1e-3 * self.std_mm
        return math.radians(self.mean_deg), math.radians(self.std_deg)

    @property
    def std_if_exactly_drawn(self) -> float:
        """Standard deviation on an arm that is its drawing, rad or m; ``std`` in older files."""
        std = getattr(self, f'std_if_exactly_drawn_{self.unit}')
        if std is UNSET:
            return self.mean_and_std[1]
        return 1e-3 * float(std) if self.unit == 'mm' else math.radians(std)


class Registration(Struct):
    """T_R_N: the sensor's frame N in the robot base R.

    ``std_is_lower_limit`` is true where errors are left that the model has not: they move
    registrations and markers by more than it states, by how much no data show.
    """

    translation_m: Triple
    rotation_xyzw: tuple[float, float, float, float]
    std_m: Triple
    std_rad: Triple
    std_is_lower_limit: bool | UnsetType = UNSET


class Marker(Struct):
    """A marker's position in the tool frame T; ``std_is_lower_limit`` as of a registration."""

    position_m: Triple
    std_m: Triple
    std_is_lower_limit: bool | UnsetType = UNSET


class Noise(Struct):
    """A sensor's noise per axis: of one row, and common to a pose (None: not separable).

    Where it has several markers in a frame, also what these share. Where it differs along and
    across the line of sight, both stand there as well.
    """

    sigma_m: float
    std_m: float
    pose_sigma_m: float | None
    pose_std_m: float | UnsetType | None = UNSET
    frame_sigma_m: float | UnsetType = UNSET
    frame_std_m: float | UnsetType = UNSET
    along_sigma_m: float | UnsetType = UNSET
    along_std_m: float | UnsetType = UNSET
    along_pose_sigma_m: float | UnsetType | None = UNSET
    along_pose_std_m: float | UnsetType | None = UNSET
    along_frame_sigma_m: float | UnsetType = UNSET
    along_frame_std_m: float | UnsetType = UNSET
    across_sigma_m: float | UnsetType = UNSET
    across_std_m: float | UnsetType = UNSET
    across_pose_sigma_m: float | UnsetType | None = UNSET
    across_pose_std_m: float | UnsetType | None = UNSET
    across_frame_sigma_m: float | UnsetType = UNSET
    across_frame_std_m: float | UnsetType = UNSET


class Sampler(Struct):
    """How the posterior was sampled; ``draws`` are kept draws of each chain.

    ``precision`` is the Monte Carlo error of the worst mean in standard deviations;
    ``method`` is 'metropolis' for chains, 'laplace' for a Gaussian about the mode; ``pareto_k``,
    where chains were given up, is the shape of the tail of their proposals' weights.
    """

    name: str
    chains: int
    draws: int
    r_hat_max: float | None
    ess_min: float | None
    seconds: float | None
    acceptance_rate: float | UnsetType | None = UNSET
    converged: bool | UnsetType = UNSET
    message: str | UnsetType = UNSET
    precision: float | UnsetType | None = UNSET
    precision_wanted: float | UnsetType | None = UNSET
    method: Literal['metropolis', 'laplace'] | UnsetType = UNSET
    pareto_k: float | UnsetType | None = UNSET


class SampledParameter(Struct):
    """A parameter in the unit of its name (m, rad), and how well it was sampled."""

    name: str
    mean: float
    std: float
    r_hat: float | None
    ess_bulk: float | None
    ess_tail: float | None


class Accuracy(Struct):
    """The three metrics by split; ``validation`` is None where nothing was held out."""

    optimization: Mapping[str, Any] | None
    validation: Mapping[str, Any] | None


class LeftOut(Struct):
    """A row that was not fitted, and why."""

    observation: int
    why: str


class TurnNoise(Struct):
    """Noise of a sensor's orientations per axis, degrees: of one row, and common to a pose."""

    sigma_deg: float
    std_deg: float
    pose_sigma_deg: float | None


class Body(Struct):
    """How a measured body stands on the tool, R_T_B; the std is about the axes of T."""

    rotation_xyzw: list[float]
    std_deg: Triple


class Orientation(Struct):
    """What came of measured orientations.

    ``p_value`` is that positions and orientations agree on the offsets; ``std_positions_deg`` is
    what the positions alone would know of each (None: nothing), ``std_positions_mm`` the same of
    joints that slide. Where they are not fitted ``why`` has the reason.
    """

    fitted: bool
    count: int
    why: str
    noise: dict[str, TurnNoise]
    bodies: dict[str, Body]
    p_value: float | None = None
    std_positions_deg: dict[str, float | None] = {}
    std_positions_mm: dict[str, float | None] | UnsetType = UNSET


class NoiseCheck(Struct):
    """Does noise explain what is left of a sensor's errors?

    ``after_m`` is the mean error after (held out where there are such rows, without the worst
    twentieth), ``noise_m`` what the noise makes that the sensor states for a reading, the mean of
    its samples, and that shows within poses (None where neither does, as ``explained``). ``gross``
    has the observations of the held-out rows that are gross errors.
    """

    explained: bool | None
    after_m: float
    noise_m: float | None
    stated_std_m: float | None
    within_pose_std_m: float | None
    gross: list[int] = []


class Judgement(Struct):
    """A result for a reader who did not measure it: green, amber or red, and why.

    ``points`` is what else matters before it is used. Of these, ``findings`` are what noise does
    not explain, but causes may; ``doubts`` are what these data cannot show; ``disagreements`` are
    data that contradict each other.
    """

    mood: Literal['good', 'caution', 'bad']
    headline: str
    points: list[str] = []
    findings: list[str] = []
    doubts: list[str] = []
    disagreements: list[str] = []


class StructureTest(Struct):
    """Do the residuals follow a driver: in the means of the poses, or in deviations from them?

    The driver 'held_out' asks whether those of a ``sensor`` are larger on held-out poses than on
    poses left out of the fit: ``ratio`` times, in units of what is uncertain of their prediction.
    """

    driver: str
    between_poses: bool
    p_value: float
    found: bool
    sensor: str | UnsetType = UNSET
    ratio: float | UnsetType = UNSET


class Imitation(Struct):
    """Which length or tilt moves a joint's offset most: by ``deg`` if it is the tolerance off.

    ``joint`` is the joint's name; ``link_length`` ``of`` 2 is that of the link after joint 2. Of a
    joint that slides it is ``mm``, and ``deg`` is null.
    """

    joint: str
    cause: Literal['link_length', 'joint_axis_tilt']
    of: int
    axis: str
    deg: float | None
    mm: float | UnsetType = UNSET

    @property
    def as_angle(self) -> float:
        """How much it is, what slides by the angle that it counts as, rad."""
        if self.deg is not None:
            return math.radians(self.deg)
        assert self.mm is not UNSET
        return 1e-3 * self.mm / LEVER_M

    @property
    def shown(self) -> str:
        """How much it is, as people read it."""
        return f'{self.mm:.3f} mm' if self.deg is None else f'{self.deg:.3f} deg'


class FittedGeometry(Struct):
    """All link lengths and axis tilts fitted beside the offsets, one variance for either kind.

    Standard deviations are RMS displacements of the marker by each length and each tilt, at least
    ``tolerance_mm``. Errors are means over the validation rows, with the offsets on the drawing
    and with the robot model that has these lengths and tilts; ``file`` is that model where it
    predicts them better, '' where it does not.
    """

    tolerance_mm: float
    length_std_mm: float | None
    tilt_std_mm: float | None
    drawing_held_out_mean_mm: float | None
    held_out_mean_mm: float | None
    file: str
    imitations: list[Imitation]


class Clock(Struct):
    """How late a sensor's stamps are beside those of the joint states."""

    late_ms: float
    std_ms: float


class Fit(Struct):
    """fit.json.

    ``intervals`` is 'model' where those of the offsets are the posterior's, 'robust' where they
    are wider because errors are left that the model has not.
    """

    format: str
    joint_offsets: list[JointOffset]
    gauge: list[GaugeDirection]
    registration: dict[str, Registration]
    markers: dict[str, Marker]
    noise: dict[str, Noise]
    sampler: Sampler
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
    judgement: Judgement | UnsetType = UNSET


def checked(content: Mapping[str, Any], schema: type[Content]) -> Content:
    """Return a file's content by its schema: arrays as lists, NaN as None, other keys left out."""
    return msgspec.json.decode(msgspec.json.encode(content, enc_hook=_plain), type=schema)


def _plain(values: Any) -> Any:
    if isinstance(values, np.ndarray | np.generic):
        return values.tolist()
    if isinstance(values, Mapping):
        return dict(values)
    raise TypeError(f'no JSON for {type(values)}')


def encode(content: Struct) -> bytes:
    """Return a file's bytes, indented."""
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b'\n'


# Beside what it shares with fit.json: what discovery.json holds.


class NamedCause(Struct):
    """A cause by name and joints."""

    name: str
    joints: list[int]


class Decided(Struct):
    """What was decided between a cause and its look-alike; see `decision.Decision`."""

    cause: NamedCause
    look_alike: NamedCause
    answer: Literal['cause', 'look_alike', 'open', 'neither']
    log_evidence: float | None
    sigma: float
    sentence: str


class Effect(Struct):
    """A cause; ``size_m`` is the RMS at the marker after absorption, ``share`` of the gain.

    ``sizes`` are its parts in arc minutes and millimetres, ``remedy`` is what to do about it.
    ``title`` is a heading; '' in files of earlier versions, which lack what follows it, too:
    whether a corrected robot model holds it, whether it lies in how the arm was measured, and when
    it happened if it came at one moment and stayed.
    """

    name: str
    joints: list[int]
    place: str
    driver: str
    form: str
    parameters: list[Parameter]
    p_value: float
    log_evidence_gain: float
    confusable_with: list[LookAlike]
    cause: str
    size_m: float | UnsetType = UNSET
    share: float | UnsetType | None = UNSET
    sizes: list[str] | UnsetType = UNSET
    remedy: str | UnsetType = UNSET
    title: str = ''
    in_robot_model: bool = False
    of_measurement: bool = False
    moment_s: float | None = None
    probability: float | None = None

    @property
    def is_taken_out(self) -> bool:
        """As of `FoundEffect`."""
        known = self.probability is None or self.probability >= CERTAIN
        return self.of_measurement and known


class Gain(Struct):
    """RMS of the 3-D error over every validation row, and what the noise alone makes.

    ``held_out_kept_…`` is the same without the ``held_out_gross`` rows that are gross errors.
    """

    held_out_rms_before_m: float | None
    held_out_rms_after_m: float | None
    noise_floor_m: float
    held_out_gross: int = 0
    held_out_kept_before_m: float | UnsetType | None = UNSET
    held_out_kept_after_m: float | UnsetType | None = UNSET


class Loadable(Struct):
    """What of the result a robot can load, and the mean 3-D error on held-out poses with it.

    'offsets' by themselves, 'geometry': all link lengths, axis tilts and zero-offsets together, or
    'everything' that the model holds. ``better`` than all before it, or there is no reason to load
    it. ``file`` is '' where no file holds it.
    """

    result: Literal['offsets', 'geometry', 'everything']
    held_out_mean_mm: float | None
    better: bool
    file: str


class NoiseOfDiscovery(Struct):
    """What the search found of the noise."""

    pose_common_fraction: float
    outliers: list[int]
    heteroscedastic: Mapping[str, Any]
    sensors: dict[str, Noise] | UnsetType = UNSET


class OffsetBefore(Struct):
    """A joint's zero-offset without the effects; None where nothing bounds it.

    Of a joint that slides as `JointOffset` has it.
    """

    joint: str
    mean_deg: float | None
    std_deg: float | None
    unit: Literal['deg', 'mm'] = 'deg'
    mean_mm: float | UnsetType = UNSET
    std_mm: float | UnsetType | None = UNSET


class Compared(Struct):
    """A parameter in both sessions, and by how many standard deviations of both they differ."""

    name: str
    unit: str
    value: float
    std: float
    other_value: float
    other_std: float
    sigmas: float | None


class ConfirmedEffect(Struct):
    """How an effect does in the other session.

    ``rows_common`` of its rows have its driver where it was seen; ``carried_over`` is the share of
    what it could gain there; None where that is nothing. ``answer`` is what the evidence says, and
    ``log_evidence`` that of the cause shared by both sessions, of a size of its own there, and
    absent there, less the best.
    """

    name: str
    joints: list[int]
    carried_over: float | None
    rows_common: int | UnsetType = UNSET
    rms_without_m: float | UnsetType | None = UNSET
    rms_frozen_m: float | UnsetType | None = UNSET
    parameters: list[Compared] | UnsetType = UNSET
    answer: Literal['confirmed', 'changed', 'absent', 'open'] | UnsetType = UNSET
    log_evidence: dict[str, float] | UnsetType | None = UNSET


class Confirmed(Struct):
    """How the effects do in another session of the arm; see `confirmation.Confirmation`."""

    rms_before_m: float | None
    rms_after_m: float | None
    rms_own_m: float | None
    same_offsets: bool
    carried_over: float | None
    confirmed: bool
    effects: list[ConfirmedEffect]
    rows: int | UnsetType = UNSET
    rows_common: int | UnsetType = UNSET
    rms_frozen_offsets_m: float | UnsetType | None = UNSET
    joint_offsets: list[Compared] | UnsetType = UNSET
    offsets_rms_sigmas: float | UnsetType | None = UNSET
    parameters_rms_sigmas: float | UnsetType | None = UNSET
    why: str | UnsetType = UNSET
    other_joints: list[int] | UnsetType = UNSET
    open_joints: list[int] | UnsetType = UNSET
    differ_by: float | UnsetType = UNSET


class PredictedRegions(Struct):
    """The 95 % regions of predictions.csv: ``widening`` is the factor on their size.

    It is what the fitted rows take when their pose is left out, so that 95 % of them lie inside.
    """

    widening: float
    held_out: Coverage
    fitted: Coverage


class JointCovariance(Struct):
    """Covariance of the zero-offsets that are identifiable and of all of the causes' parameters.

    ``matrix`` is in the units of its parameters, to six figures.
    """

    names: list[str]
    units: list[str]
    matrix: list[list[float]]


class Unexplained(Struct):
    """Structure that no cause explains: where it shows, its size, and what to do next."""

    where: str
    driver: str
    size_m: float
    p_value: float | None
    next: str


class LessLikely(Struct):
    """A cause that is rather not there than there."""

    name: str
    joints: list[int]
    title: str
    probability: float


class Search(Struct):
    """How far the chains of the walk over models agree.

    ``log_posterior``: of the best model of each chain; ``models``: models of a share worth
    mentioning, ``best_share``: share of the best.
    """

    log_posterior: list[float]
    models: int
    best_share: float
    less_likely: list[LessLikely]


class Discovered(Struct):
    """discovery.json."""

    format: str
    verdict: Literal['effects', 'none', 'undetermined', 'unexplained']
    effects: list[Effect]
    gain: Gain
    noise: NoiseOfDiscovery
    joint_offsets_after: list[JointOffset]
    version: str | UnsetType = UNSET
    robot: Robot | UnsetType = UNSET
    session: MeasuredSession | UnsetType = UNSET
    metrics: Mapping[str, Any] | UnsetType = UNSET
    untestable: dict[str, str] | UnsetType = UNSET
    unexplained: list[Unexplained] | UnsetType = UNSET
    search: Search | UnsetType = UNSET
    joint_offsets_before: list[OffsetBefore] | UnsetType = UNSET
    sampler: Sampler | UnsetType = UNSET
    registration: dict[str, Registration] | UnsetType = UNSET
    markers: dict[str, Marker] | UnsetType = UNSET
    covariance: JointCovariance | UnsetType = UNSET
    predicted_regions95: PredictedRegions | UnsetType = UNSET
    loadable: list[Loadable] | UnsetType = UNSET
    rows_searched: Thinning | UnsetType = UNSET
    clocks: dict[str, Clock] | UnsetType = UNSET
    confirmation: Confirmed | UnsetType = UNSET
    decided: list[Decided] | UnsetType = UNSET
    judgement: Judgement | UnsetType = UNSET
