"""What fit.json and discovery.json hold: each key once, for writing and for reading.

A key without a default is what other programs rely on, and a file without it is refused. One that
is `UNSET` by default is written where it has a value; the files of other programs may lack it.
Keys that are not here are kept as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType

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
    """What was measured: counts, sensor -> marker, when, how it ended; if it has no times."""

    optimization: Counts
    validation: Counts
    sensors: dict[str, str]
    created: str
    exit_status: str
    times: Literal['none'] | UnsetType = UNSET


class JointOffset(Struct):
    """One joint's zero-offset; where ``identifiable`` is false, ``why`` is the reason."""

    joint: str
    mean_deg: float
    std_deg: float
    interval95_deg: tuple[float, float]
    identifiable: bool
    why: str


class GaugeCombination(Struct):
    """A combination of parameters that the data do not determine, and what fixes it."""

    combination: dict[str, float]
    why: str
    fixed_by: str


class Registration(Struct):
    """T_R_N: the sensor's frame N in the robot base R."""

    translation_m: Triple
    rotation_xyzw: tuple[float, float, float, float]
    std_m: Triple
    std_rad: Triple


class Marker(Struct):
    """A marker's position in the tool frame T."""

    position_m: Triple
    std_m: Triple


class Noise(Struct):
    """A sensor's noise per axis: of one row, and common to a pose (None: not separable).

    Where it differs along and across the line of sight, both stand there as well.
    """

    sigma_m: float
    std_m: float
    pose_sigma_m: float | None
    pose_std_m: float | UnsetType | None = UNSET
    along_sigma_m: float | UnsetType = UNSET
    along_std_m: float | UnsetType = UNSET
    along_pose_sigma_m: float | UnsetType | None = UNSET
    along_pose_std_m: float | UnsetType | None = UNSET
    across_sigma_m: float | UnsetType = UNSET
    across_std_m: float | UnsetType = UNSET
    across_pose_sigma_m: float | UnsetType | None = UNSET
    across_pose_std_m: float | UnsetType | None = UNSET


class Sampler(Struct):
    """How the posterior was sampled; ``draws`` are kept draws of each chain.

    ``precision`` is the Monte Carlo error of the worst mean in standard deviations;
    ``log_density_error_max`` that of the second-order density on the draws that were checked.
    ``method`` is 'metropolis' for chains, 'importance' for weighted draws, 'laplace' for a
    Gaussian about the mode; for the latter two ``pareto_k`` is the check of their weights, passed
    below 0.7.
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
    log_density_error_max: float | UnsetType | None = UNSET
    log_density_checked_draws: int | UnsetType = UNSET
    method: Literal['metropolis', 'importance', 'laplace'] | UnsetType = UNSET
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


class NoiseCheck(Struct):
    """Does noise explain what is left of a sensor's errors?

    ``after_m`` is the mean error after (held out where there are such rows, without the worst
    twentieth), ``noise_m`` what the noise makes that the sensor states and that shows within poses
    (None where neither does).
    """

    explained: bool | None
    after_m: float
    noise_m: float | None
    stated_std_m: float | None
    within_pose_std_m: float | None


class Fit(Struct):
    """fit.json."""

    format: str
    joint_offsets: list[JointOffset]
    gauge: list[GaugeCombination]
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


class EffectParameter(Struct):
    """A parameter of an effect, in its unit."""

    name: str
    value: float
    std: float
    unit: str


class LookAlike(Struct):
    """What could be mistaken for an effect, and what would separate the two."""

    name: str
    joints: list[int]
    log_evidence_gain: float
    separate_by: str


class Effect(Struct):
    """A cause; ``size_m`` is the RMS at the marker after absorption, ``share`` of the gain.

    ``sizes`` are its parts in arc minutes and millimetres, ``remedy`` is what to do about it.
    """

    name: str
    joints: list[int]
    place: str
    driver: str
    form: str
    parameters: list[EffectParameter]
    p_value: float
    log_evidence_gain: float
    confusable_with: list[LookAlike]
    cause: str
    size_m: float | UnsetType = UNSET
    share: float | UnsetType | None = UNSET
    sizes: list[str] | UnsetType = UNSET
    remedy: str | UnsetType = UNSET


class Gain(Struct):
    """RMS of the 3-D error over every validation row, and what the noise alone makes."""

    held_out_rms_before_m: float | None
    held_out_rms_after_m: float | None
    noise_floor_m: float


class NoiseOfDiscovery(Struct):
    """What the search found of the noise."""

    pose_common_fraction: float
    outliers: list[int]
    heteroscedastic: Mapping[str, Any]
    sensors: dict[str, Noise] | UnsetType = UNSET


class OffsetBefore(Struct):
    """A joint's zero-offset without the effects; None where nothing bounds it."""

    joint: str
    mean_deg: float
    std_deg: float | None


class SearchedRows(Struct):
    """Of a session of which the search saw a part."""

    searched: int
    rows: int
    others_rms_before_m: float | None
    others_rms_after_m: float | None


class Compared(Struct):
    """A parameter in both sessions, and by how many standard deviations of both they differ."""

    name: str
    unit: str
    value: float
    std: float
    other_value: float
    other_std: float
    sigmas: float


class ConfirmedEffect(Struct):
    """How an effect does in the other session.

    ``rows_common`` of its rows have its driver where it was seen; ``carried_over`` is the share of
    what it could gain there; None where that is nothing.
    """

    name: str
    joints: list[int]
    carried_over: float | None
    rows_common: int | UnsetType = UNSET
    rms_without_m: float | UnsetType | None = UNSET
    rms_frozen_m: float | UnsetType | None = UNSET
    parameters: list[Compared] | UnsetType = UNSET


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


class Coverage(Struct):
    """How many rows lie in their 95 % regions; the interval takes the rows as independent."""

    rows: int
    inside: int
    share: float | None
    interval95: tuple[float, float] | None


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
    joint_offsets_before: list[OffsetBefore] | UnsetType = UNSET
    sampler: Sampler | UnsetType = UNSET
    registration: dict[str, Registration] | UnsetType = UNSET
    markers: dict[str, Marker] | UnsetType = UNSET
    covariance: JointCovariance | UnsetType = UNSET
    least_p_value: float | UnsetType = UNSET
    predicted_regions95: PredictedRegions | UnsetType = UNSET
    rows_searched: SearchedRows | UnsetType = UNSET
    confirmation: Confirmed | UnsetType = UNSET


def checked(content: Mapping[str, Any], schema: type[Content]) -> Content:
    """Return a file's content by its schema: arrays as lists, NaN as None, other keys left out.

    Raises
    ------
    msgspec.ValidationError
        A key that other programs rely on is missing or of another type.
    """
    return msgspec.json.decode(msgspec.json.encode(content, enc_hook=_plain), type=schema)


def _plain(values: Any) -> Any:
    if isinstance(values, np.ndarray | np.generic):
        return values.tolist()
    if isinstance(values, Mapping):
        return dict(values)
    raise NotImplementedError(f'no JSON for {type(values)}')


def encode(content: Struct) -> bytes:
    """Return a file's bytes, indented."""
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b'\n'
