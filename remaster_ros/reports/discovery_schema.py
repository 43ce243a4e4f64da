"""What discovery.json holds beside what it shares with fit.json (`schemas`): each key once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from msgspec import UNSET, Struct, UnsetType

from remaster_ros.reports.schemas import (
    JointOffset,
    Judgement,
    Marker,
    MeasuredSession,
    Noise,
    Registration,
    Robot,
    Sampler,
)


class EffectParameter(Struct):
    """A parameter of an effect, in its unit."""

    name: str
    value: float
    std: float
    unit: str


class LookAlike(Struct):
    """What could be mistaken for an effect, and what would separate the two.

    ``same``: nothing can, the two displace every pose alike. ``general``: it is a free form, and
    the effect one of the shapes that it can have.
    """

    name: str
    joints: list[int]
    log_evidence_gain: float
    separate_by: str
    same: bool = False
    general: bool = False
    title: str = ''


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
    parameters: list[EffectParameter]
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
    predicted_regions95: PredictedRegions | UnsetType = UNSET
    loadable: list[Loadable] | UnsetType = UNSET
    rows_searched: SearchedRows | UnsetType = UNSET
    confirmation: Confirmed | UnsetType = UNSET
    decided: list[Decided] | UnsetType = UNSET
    judgement: Judgement | UnsetType = UNSET
