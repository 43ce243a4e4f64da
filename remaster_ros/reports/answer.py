# SPDX-License-Identifier: Apache-2.0
"""The answer of a report after a fit and a search for causes: action, gain.

Last result: remaining errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import msgspec
import numpy as np

from remaster_ros.calibration.gauge_words import counted, listed
from remaster_ros.calibration.noise_check import MEAN_LENGTH
from remaster_ros.calibration.outliers import LARGEST_SHARE
from remaster_ros.compensation.export import (
    APPLY_FOLDER,
    LAYER_FILE,
    MODEL_FILE,
    REMASTER_FILE,
    URDF_FILE,
)
from remaster_ros.compensation.loaded_errors import errors_with_urdf
from remaster_ros.compensation.mastering import MasteringStep, mastering
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.words import clock_time
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.fit_json import DISCOVERY_FILE, FIT_FILE, FIT_LIMIT, read_fit
from remaster_ros.reports.rows_csv import (
    AFTER,
    BEFORE,
    PREDICTED,
    PREDICTIONS_FILE,
    RESIDUALS_FILE,
    lengths_mm,
    read_columns,
)
from remaster_ros.reports.schemas import (
    Discovered,
    Fit,
    FittedGeometry,
    JointOffset,
    Judgement,
    Loadable,
)
from remaster_ros.reports.sentences import (
    FEW_HELD_OUT,
    FEW_POSES,
    NOTICEABLE_GAIN,
    at_marker,
    hardly_proven,
    more_than_noise,
    not_counted,
    times_smaller,
)
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.types import BoolArray, FloatArray, Session

if TYPE_CHECKING:
    from remaster_ros.session.records.plan_journal import RecordedPlan

# Inputs: a session, its fit, and its discovery if any.


@dataclass(frozen=True, eq=False)
class Inputs:
    """Session and results that a report is made of; n rows."""

    session: Session
    # Contents of fit.json and discovery.json (None without the latter)
    fit: Fit
    found: Discovered | None
    # 3-D error of each row with all offsets at zero, and with those of the fit, (n,)
    before_mm: FloatArray
    after_mm: FloatArray
    causes_mm: FloatArray | None  # Error with the causes as well, (n,); None without causes
    # Error with the robot model of all lengths, tilts and zero-offsets, (n,); None if no such
    # model predicts held-out poses better
    model_mm: FloatArray | None = None
    model: Path | None = None  # File of that model
    plan: RecordedPlan | None = None  # Plan of the collection; None if the session has none

    @property
    def judgement(self) -> Judgement:
        """Judgement of the fit; the fit has to have one (AssertionError)."""
        assert isinstance(self.fit.judgement, Judgement)
        return self.fit.judgement

    @property
    def gross(self) -> list[int]:
        """``observation`` of the gross errors, by the discovery or, without one, by the fit.

        By the fit: rows that were not fitted, then held-out rows of `NoiseCheck.gross`.
        """
        if self.found is not None:
            return self.found.noise.outliers
        checks = self.fit.explained_by_noise
        held_out = checks.values() if isinstance(checks, dict) else ()
        return [*self.fit_left_out, *(row for check in held_out for row in check.gross)]

    @cached_property
    def fit_left_out(self) -> dict[int, str]:
        """Reason by ``observation`` for each row that was not fitted."""
        return {row.observation: row.why for row in self.fit.left_out}

    @property
    def T_R_N(self) -> dict[str, FloatArray]:
        """Fitted registration of each sensor, (4, 4)."""
        return {
            sensor: registration.T_R_N for sensor, registration in self.fit.registration.items()
        }


def located(path: Path) -> Path:
    """File fit.json or discovery.json at a path, or in a folder.

    Raises InputError if a folder has both or neither.
    """
    if not path.is_dir():
        return path
    there = [path / name for name in (FIT_FILE, DISCOVERY_FILE) if (path / name).exists()]
    if len(there) != 1:
        raise InputError(
            f'{path}: holds {"both" if there else "neither"} {FIT_FILE} '
            f'{"and" if there else "nor"} {DISCOVERY_FILE}; give one of the files'
        )
    return there[0]


def read_inputs(
    session: Session, fit_path: Path, found_path: Path | None, plan: RecordedPlan | None = None
) -> Inputs:
    """Read the results of a session.

    Parameters
    ----------
    session
        Session as read from its folder.
    fit_path, found_path
        fit.json and discovery.json, with residuals.csv and predictions.csv in their folders.
    plan
        Plan of the session.

    Raises
    ------
    InputError
        Results of another session, or a damaged file; one line naming file and remedy.
    """
    fit = read_fit(fit_path)
    _require_same(session, fit, fit_path, 'fit')
    residuals = read_columns(fit_path.parent / RESIDUALS_FILE, session, BEFORE + AFTER, 'fit')
    before_mm, after_mm = lengths_mm(residuals[:, :3]), lengths_mm(residuals[:, 3:])
    if found_path is None:
        model, model_mm = _model(session, fit_path, _file_of(fit.geometry), 'fit')
        return Inputs(session, fit, None, before_mm, after_mm, None, model_mm, model, plan)
    from remaster_ros.reports.discovery_json import read_discovery

    found = read_discovery(found_path)
    _require_same(session, found, found_path, 'discover')
    causes_mm = None
    if found.effects:
        path = found_path.parent / PREDICTIONS_FILE
        predicted = read_columns(path, session, PREDICTED, 'discover')
        causes_mm = lengths_mm(session.measurements.position - predicted)
    rows = found.loadable if isinstance(found.loadable, list) else []
    model, model_mm = _model(
        session,
        found_path,
        ''.join(_file_of(r) for r in rows if r.result == 'geometry'),
        'discover',
    )
    return Inputs(session, fit, found, before_mm, after_mm, causes_mm, model_mm, model, plan)


def _file_of(source: Loadable | FittedGeometry | msgspec.UnsetType) -> str:
    """File of a loadable result; '' if there is none."""
    return '' if isinstance(source, msgspec.UnsetType) else source.file


def _model(
    session: Session, result: Path, file: str, verb: str
) -> tuple[Path | None, FloatArray | None]:
    """Path of a result's robot model, and the errors of all rows with it, mm, (n,).

    Both None if ``file`` (as the result names it) is ''. ``result``: path of the result; ``verb``:
    command that writes it. Raises InputError if the model is missing.
    """
    if not file:
        return None, None
    path = result.parent / APPLY_FOLDER / MODEL_FILE
    data = read_limited(path, FIT_LIMIT, f'{verb} again, which writes it')
    return path, errors_with_model_mm(session, decode_text(data, path))


def all_taken_out(found: Discovered | None) -> bool:
    """Whether there are causes, not 'undetermined', all certain errors of the measurement."""
    return (
        found is not None
        and found.verdict != 'undetermined'
        and bool(found.effects)
        and all(effect.is_taken_out for effect in found.effects)
    )


def errors_with_model_mm(session: Session, urdf: str) -> FloatArray:
    """3-D error of each row with the robot model of a URDF (text), mm, (n,).

    As of `errors_with_urdf`: registrations and markers are fitted, offsets are 0.
    """
    return lengths_mm(errors_with_urdf(session, urdf))


def _require_same(session: Session, result: Fit | Discovered, path: Path, verb: str) -> None:
    """Raise InputError for the result of other data, or of a version that lacks needed keys.

    ``verb``: command of the remedy.
    """
    if (
        not isinstance(result.session, msgspec.Struct)
        or not isinstance(result.judgement, msgspec.Struct)
        or (isinstance(result, Discovered) and not all(e.title for e in result.effects))
    ):
        raise InputError(f'{path}: of an earlier version; {verb} this session again')
    if result.session.observations_sha256 != session.observations_sha256:
        raise InputError(
            f'{path}: of other data than this session (observations.csv has another SHA-256); '
            f'{verb} this session'
        )


def parts(paths: Sequence[Path]) -> tuple[Path | None, Path | None]:
    """Paths of fit.json and of discovery.json among at most two paths; None if absent.

    Raises
    ------
    InputError
        Two files of one kind, or a file of another name.
    """
    found: dict[str, Path] = {}
    for path in map(located, paths):
        if path.name not in (FIT_FILE, DISCOVERY_FILE):
            missing = '' if path.exists() else 'there is no such file or folder; '
            raise InputError(
                f'{path}: {missing}give {FIT_FILE} or {DISCOVERY_FILE}, or the folder of '
                'one of them'
            )
        if path.name in found:
            raise InputError(f'{path}: two files {path.name}; give one of each')
        found[path.name] = path
    return found.get(FIT_FILE), found.get(DISCOVERY_FILE)


# Action, and its gain.

ALL_FILES = (REMASTER_FILE, URDF_FILE, LAYER_FILE, MODEL_FILE)
Mood = Literal['good', 'caution', 'bad']


class Stage(NamedTuple):
    """3-D errors of the judged rows at one stage of correction, mm."""

    title: str  # Parts that are corrected
    errors: FloatArray  # Errors of the judged rows, mm, (m,)

    @property
    def mean(self) -> float:
        """Mean error, mm."""
        return float(self.errors.mean())

    @property
    def most(self) -> float:
        """95 % quantile of the errors, mm."""
        return float(np.quantile(self.errors, 0.95))

    @property
    def largest(self) -> float:
        """Largest error, mm."""
        return float(self.errors.max())


class SensorNoise(NamedTuple):
    """Mean 3-D error due to a sensor's noise, mm."""

    sensor: str
    reading_mm: float  # Noise of one reading
    # With the noise that all readings of a pose share; None if unknown
    shared_mm: float | None


@dataclass(frozen=True, eq=False)
class Answer:
    """Content of the first screen."""

    # Judgement: 'good' if held-out poses confirm all of it
    mood: Mood
    headline: str
    # Set the offsets ('set'), set nothing yet ('wait'), or no need to set anything ('nothing')
    action: Literal['set', 'wait', 'nothing']
    # Whether the offsets are those of the model with causes, as all lie in the measurement
    uses_causes: bool
    # Whether the action is to load the robot model with all lengths, tilts and zero-offsets
    loads_model: bool
    stages: tuple[Stage, ...]  # From today's state, each with more corrected
    brings: int  # Index of the stage that the action reaches
    final_mm: FloatArray  # Error of each row at that stage, (n,)
    held_out: bool  # Whether the stages are judged by poses that were never fitted
    not_counted: int  # Number of gross errors among them, by which no stage is judged
    noise: tuple[SensorNoise, ...]  # Noise of each sensor for which it is known
    remains: tuple[Remaining, ...]  # Errors that the action leaves
    offsets: tuple[JointOffset, ...]  # One for each joint
    # Steps on the robot's pad, in its numbers, in groups of coupled joints
    on_the_pad: tuple[tuple[MasteringStep, ...], ...]
    pad_names: Mapping[str, str]  # Joint of the URDF -> its name on the pad, if known

    @property
    def plain_pad(self) -> bool:
        """Whether the pad counts the joints as the URDF, and each is set where it shows 0.

        True also if there is nothing to set.
        """
        return all(len(group) == 1 and group[0].is_plain for group in self.on_the_pad)

    @property
    def slides(self) -> bool:
        """Whether the arm has a prismatic joint."""
        return any(row.unit == 'mm' for row in self.offsets)

    @property
    def left_alone(self) -> list[str]:
        """Names on the pad of the joints to leave as they are, whose offsets are unknown.

        'A4 (joint_4)' if the pad's name differs from the URDF's.
        """
        set_joints = {step.joint for group in self.on_the_pad for step in group}
        return [
            called if called == row.joint else f'{called} ({row.joint})'
            for row in self.offsets
            if not row.identifiable and row.joint not in set_joints
            for called in [self.pad_names.get(row.joint, row.joint)]
        ]

    @property
    def files(self) -> list[str]:
        """Names of the files in the folder ``apply`` for the action; [] unless it is 'set'."""
        if self.action != 'set':
            return []
        return [name for name in ALL_FILES if self.loads_model or name != MODEL_FILE]


def answer_of(inputs: Inputs) -> Answer:
    """Action, gain and remaining errors for a session and its results.

    The stages are the errors today, with offsets, and with what further can be used: causes, if
    all are errors of the measurement that are taken out, or a robot model, if it makes the mean
    error clearly smaller (`NOTICEABLE_GAIN`). The rows judged are those of `judged_rows`.
    """
    fit, found = inputs.fit, inputs.found
    effects = found.effects if found is not None else []
    judged, held_out = judged_rows(inputs)
    gross = int(inputs.session.measurements.is_validation.sum()) - int(judged.sum())
    rows = _stages(inputs)
    stages = tuple(Stage(text, errors[judged]) for text, errors in rows)
    uses_causes = inputs.causes_mm is not None and all_taken_out(found)
    loads_model = (
        inputs.model_mm is not None
        and not uses_causes
        # Where other causes are there and no length or tilt is, they imitate those.
        and (not effects or any(effect.in_robot_model for effect in effects))
        and stages[1].mean > NOTICEABLE_GAIN * stages[2].mean
    )
    brings = 2 if uses_causes or loads_model else 1
    offsets = found.joint_offsets_after if uses_causes and found else fit.joint_offsets
    action, reason = _action(
        inputs.judgement, effects, stages[0].mean, stages[brings].mean, offsets
    )
    known = sum(row.identifiable for row in offsets)
    pad = inputs.session.controller
    measured = [e.title for e in effects if e.of_measurement]
    return Answer(
        mood=_mood(inputs, loads_model, held_out and action != 'wait'),
        headline=reason
        or _headline(
            known,
            stages,
            brings,
            held_out,
            measured,
            uses_causes,
            loads_model,
            gross if held_out else 0,
        ),
        action=action,
        uses_causes=uses_causes,
        loads_model=loads_model,
        stages=stages,
        brings=brings,
        final_mm=rows[brings][1],
        held_out=held_out,
        not_counted=gross if held_out else 0,
        noise=_noise(inputs),
        remains=tuple(what_remains(inputs, loads_model, held_out)),
        offsets=tuple(offsets),
        on_the_pad=_on_the_pad(inputs.session, offsets),
        pad_names={} if pad is None else {name: joint.name for name, joint in pad.joints.items()},
    )


def _on_the_pad(
    session: Session, offsets: Sequence[JointOffset]
) -> tuple[tuple[MasteringStep, ...], ...]:
    """Steps on the pad for the offsets of a session, in groups of coupled joints."""
    return mastering(
        session.controller,
        SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link),
        np.array([row.mean_and_std[0] for row in offsets]),
        np.array([row.mean_and_std[1] for row in offsets]),
        np.array([row.identifiable for row in offsets]),
    )


def judged_rows(inputs: Inputs) -> tuple[BoolArray, bool]:
    """Mask of the rows by which the stages are judged, (n,), and whether they were held out.

    Held-out rows if there are any, else fitted ones; without gross errors, unless more than a
    tenth of the held-out rows are (`LARGEST_SHARE`).
    """
    m = inputs.session.measurements
    if m.is_validation.any():
        gross = m.is_validation & np.isin(m.observation, inputs.gross)
        # So many are no single errors: something changed there, or the model does not hold.
        if gross.sum() > max(1.0, LARGEST_SHARE * m.is_validation.sum()):
            return m.is_validation, True
        return m.is_validation & ~gross, True
    return ~np.isin(m.observation, list(inputs.fit_left_out)), False


def _stages(inputs: Inputs) -> list[tuple[str, FloatArray]]:
    """Title, and errors of all rows, mm, (n,), at each stage: today, zero-offsets, then the rest.

    The rest is the robot model and all causes, as far as there are any; the causes alone if all
    are errors of the measurement.
    """
    rows = [('today', inputs.before_mm), ('with the zero-offsets', inputs.after_mm)]
    if inputs.causes_mm is not None and all_taken_out(inputs.found):
        return [*rows, ('with zero-offsets, measuring errors taken out', inputs.causes_mm)]
    if inputs.model_mm is not None:
        rows.append(('with all lengths and tilts in the robot model', inputs.model_mm))
    if inputs.causes_mm is not None:
        rows.append(('with every cause corrected', inputs.causes_mm))
    return rows


def _action(
    judgement: Judgement,
    effects: list[FoundEffect],
    before: float,
    after: float,
    offsets: list[JointOffset],
) -> tuple[Literal['set', 'wait', 'nothing'], str]:
    """Action, and a sentence with the reason if it is not to set the offsets, else ''.

    'wait' for a bad judgement or a cause of the arm that came at a moment; 'nothing' without an
    identifiable offset or a gain of 10 % (`NOTICEABLE_GAIN`). ``before, after``: mean errors, mm.
    """
    if judgement.mood == 'bad':
        return 'wait', f'Set nothing yet. {judgement.headline}'
    slipped = [e for e in effects if e.moment_s is not None and not e.of_measurement]
    if slipped:
        names = listed([effect.title for effect in slipped])
        return 'wait', (
            f'Set nothing yet. {names} while it was measured, so no one zero-offset holds for all '
            'of the session.'
        )
    if not any(row.identifiable for row in offsets):
        return 'nothing', 'Nothing can be set: these data determine no zero-offset.'
    if before < NOTICEABLE_GAIN * after:
        return 'nothing', (
            'Nothing has to be set, the zero-offsets hardly matter here: the mean error is '
            f'{before:.3f} mm without and {after:.3f} mm with them.'
        )
    return 'set', ''


def _noise(inputs: Inputs) -> tuple[SensorNoise, ...]:
    """Noise by sensor: of the model with causes if there is one, else that assumed by the fit.

    Sensors whose noise is unknown are left out.
    """
    rows: list[SensorNoise] = []
    if inputs.found is not None and isinstance(inputs.found.noise.sensors, dict):
        for sensor, noise in inputs.found.noise.sensors.items():
            # What the markers of a frame share is in each of its readings.
            frame = noise.frame_sigma_m if isinstance(noise.frame_sigma_m, float) else 0.0
            reading, pose = float(np.hypot(noise.sigma_m, frame)), noise.pose_sigma_m
            both = None if pose is None else 1e3 * MEAN_LENGTH * float(np.hypot(reading, pose))
            rows.append(SensorNoise(sensor, 1e3 * MEAN_LENGTH * reading, both))
    elif isinstance(inputs.fit.explained_by_noise, dict):
        for sensor, check in inputs.fit.explained_by_noise.items():
            if check.noise_m is not None:
                # One of held-out rows alone is not fitted.
                fitted = inputs.fit.noise.get(sensor)
                both = None
                if fitted is not None and fitted.pose_sigma_m is not None:
                    both = 1e3 * float(np.hypot(check.noise_m, MEAN_LENGTH * fitted.pose_sigma_m))
                rows.append(SensorNoise(sensor, 1e3 * check.noise_m, both))
    return tuple(rows)


def _mood(inputs: Inputs, loads_model: bool, may_be_good: bool) -> Mood:
    """Judgement: 'good' only if the fit, the discovery and the held-out poses all agree.

    ``may_be_good``: whether poses were held out and the action is not to wait.
    """
    fit, found = inputs.judgement, inputs.found
    if fit.mood == 'bad':
        return 'bad'
    if fit.disagreements or not may_be_good:
        return 'caution'
    moods: list[Mood] = []
    if found is None or not found.effects:
        moods.append(fit.mood)
    elif not loads_model or not all(effect.in_robot_model for effect in found.effects):
        # Something is left, in the arm or in how it was measured.
        moods.append('caution')
    if found is not None and isinstance(found.judgement, Judgement):
        moods.append(found.judgement.mood)
    return 'good' if all(mood == 'good' for mood in moods) else 'caution'


def _headline(
    joints: int,
    stages: Sequence[Stage],
    brings: int,
    held_out: bool,
    measured: Sequence[str],
    uses_causes: bool,
    loads_model: bool,
    gross: int,
) -> str:
    """Sentence with the action and its gain.

    ``joints``: number of identifiable ones; ``brings``: index of the stage that the action
    reaches; ``measured``: titles of the measurement's errors; ``gross``: number of held-out gross
    errors that are not counted.
    """
    before, after = stages[0], stages[brings]
    action = f'Set the zero-offset{"s" if joints > 1 else ""} of {counted(joints, "joint")}'
    if loads_model:
        action = 'Load the robot model with all lengths, tilts and zero-offsets'
    poses_text = 'poses that were never fitted' if held_out else 'the fitted poses'
    if gross:
        poses_text += f' ({not_counted(gross)})'
    if uses_causes:
        # That part of the errors was never the arm's.
        return (
            f'{action}: with them the mean error on {poses_text} is {after.mean:.3f} mm, once the '
            f'measuring error ({listed(measured)}) is taken out; the {before.mean:.3f} mm of '
            'today contain it.'
        )
    note = f' Both contain what the measurement errs by ({listed(measured)}).' if measured else ''
    return (
        f'{action}: the mean error on {poses_text} falls from {before.mean:.3f} mm to '
        f'{after.mean:.3f} '
        f'mm, {times_smaller(before.mean, after.mean)}.{note}'
    )


# Errors that the action leaves: causes, gross errors, data that disagree, and the remedy.

# Fewer gross errors than these, in number and share, are in the table of left-out rows only.
FEWEST_GROSS, LEAST_SHARE = 3, 0.01
# Stands in place of a remedy that is a file if the file does not belong to the action.
NO_FILE = (
    'No robot model beside this page holds it: correcting it brings no noticeable gain beside the '
    'zero-offsets, or the page says to set nothing.'
)
# Numbers of causes, and of sizes of each, on the first screen; all of them are listed below.
MOST_NAMED, MOST_SIZES = 4, 2


# Name of an error if nothing shows how large the noise is, or too little was held out.
NOISE_UNKNOWN = 'May be sensor noise alone'


class Remaining(NamedTuple):
    """An error that the action leaves: name, size in words, and remedy."""

    what: str
    size: str
    remedy: str

    @property
    def sentence(self) -> str:
        """'Name: size. Remedy' as one text; without size or remedy these parts are left out."""
        size = self.size.rstrip('.')
        return f'{self.what}{": " if size else ""}{size}. {self.remedy}'.rstrip()


def what_remains(inputs: Inputs, loads_model: bool, held_out: bool) -> list[Remaining]:
    """Errors that the action leaves, the causes first; at least one entry.

    ``loads_model``: whether the action is to load the robot model, which takes its causes out;
    ``held_out``: whether poses were held out.
    """
    found, judgement = inputs.found, inputs.judgement
    rows = [] if found is None else _of_discovery(found, loads_model)
    if found is None and (lines := judgement.findings or judgement.doubts):
        few = any(line.startswith(FEW_POSES) for line in judgement.doubts)
        search = (
            'Search for its cause: remaster discover SESSION --out DIR, then give DIR to '
            'remaster report.'
        )
        rows.append(
            Remaining(
                'More than noise' if judgement.findings else NOISE_UNKNOWN,
                lines[0],
                ('Measure more poses first, and fit again.' if few else search)
                if judgement.findings
                else '',
            )
        )
    elif found is not None and not rows:
        # Causes have answered the findings of the fit without them.
        finding = more_than_noise(found)
        if not finding and not found.effects:
            finding = next(iter(judgement.findings), '')
        if finding:
            rows.append(
                Remaining(
                    NOISE_UNKNOWN if FEW_HELD_OUT in finding else 'More than noise',
                    f'{finding.rstrip(".")}. No cause that was tried explains it',
                    'Look at the largest errors below; measure again, with references in between.',
                )
            )
    if (gross := _gross(inputs)) is not None:
        rows.append(gross)
    rows += [Remaining('The data disagree', line, '') for line in judgement.disagreements]
    if not held_out:
        rows.append(
            Remaining('Not proven', 'no poses were held out', 'Measure some more, and fit again.')
        )
    elif isinstance(inputs.fit.session, msgspec.Struct) and (
        words := hardly_proven(inputs.fit.session.validation.poses)
    ):
        rows.append(Remaining('Hardly proven', words, ''))
    if not rows:
        words = (
            'no cause that this session can show explains more of what is left than chance does'
            if found is not None
            else 'what is left is what noise explains'
        )
        rows.append(Remaining('Noise', '. '.join([words, *judgement.doubts[:1]]), ''))
    return rows


def _of_discovery(found: Discovered, loads_model: bool) -> list[Remaining]:
    """Causes that remain, and errors without a cause.

    At most 4 causes (`MOST_NAMED`); the smaller ones share one entry.
    """
    rows: list[Remaining] = []
    stay = [e for e in found.effects if not (loads_model and e.in_robot_model)]
    for effect in stay[:MOST_NAMED]:
        size = '; '.join(effect.sizes)
        if not 0 < len(effect.sizes) <= MOST_SIZES and not np.isnan(effect.size_m):
            size = at_marker(effect.size_m)
        remedy = NO_FILE if effect.in_robot_model else effect.remedy
        rows.append(Remaining(effect.title, size, remedy))
    if more := stay[MOST_NAMED:]:
        largest = np.nanmax([effect.size_m for effect in more])
        size = f'up to {at_marker(largest)}'
        rows.append(Remaining(counted(len(more), 'smaller cause'), size, 'See below.'))
    if found.verdict == 'undetermined':
        remedy = 'Measure what the look-alikes below call for.'
        rows.append(Remaining('Undecided', 'another explanation fits as well', remedy))
    if isinstance(found.unexplained, list):
        rows += [
            Remaining('Unexplained', f'{1e3 * error.size_m:.3f} mm RMS', error.next)
            for error in found.unexplained
        ]
    return rows


def _gross(inputs: Inputs) -> Remaining | None:
    """Number, sensors and time of the gross errors; None if there are few.

    Few: below 3 (`FEWEST_GROSS`) or below 1 % of all readings (`LEAST_SHARE`).
    """
    session, m = inputs.session, inputs.session.measurements
    rows = np.isin(m.observation, inputs.gross)
    if rows.sum() < max(FEWEST_GROSS, LEAST_SHARE * len(m)):
        return None
    sensors = listed([session.sensor_names[i] for i in np.unique(m.sensor[rows])])
    first, last = m.stamp_s[rows].min(), m.stamp_s[rows].max()
    when = f'configurations {m.configuration[rows].min()} to {m.configuration[rows].max()}'
    if session.timed:
        start = m.stamp_s.min()
        when += f', {(first - start) / 60.0:.1f} to {(last - start) / 60.0:.1f} min'
        if clock := clock_time(float(first)):
            when += f' after the first reading, from {clock} on'
        else:
            when += ' after the first reading'
    return Remaining(
        'Gross errors',
        f'{rows.sum()} of {len(m)} readings, of {sensors}: {when}',
        'Find out what was moved or hidden then.',
    )
