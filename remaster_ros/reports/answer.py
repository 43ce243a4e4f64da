# SPDX-License-Identifier: Apache-2.0
"""Answer of a report after a fit and a search for causes: action, gain and remaining errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from remaster_ros.calibration.gauge_words import counted, listed
from remaster_ros.calibration.noise_check import MEAN_LENGTH
from remaster_ros.calibration.outliers import LARGEST_SHARE
from remaster_ros.compensation.export import LAYER_FILE, MODEL_FILE, REMASTER_FILE, URDF_FILE
from remaster_ros.compensation.mastering import MasteringStep, mastering
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.remaining_errors import Remaining, what_remains
from remaster_ros.reports.report_inputs import Inputs
from remaster_ros.reports.schemas import Discovered, JointOffset, Judgement, Mood
from remaster_ros.reports.sentences import NOTICEABLE_GAIN, not_counted, times_smaller
from remaster_ros.types import BoolArray, FloatArray, Session

ALL_FILES = (REMASTER_FILE, URDF_FILE, LAYER_FILE, MODEL_FILE)


class Stage(NamedTuple):
    """3-D errors of the rows by which a report judges, mm, with some errors corrected."""

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
    """Mean length of a reading's 3-D error due to a sensor's noise alone, mm."""

    sensor: str
    reading_mm: float  # Noise of one reading
    # With the noise that all readings of a pose share; None if unknown
    shared_mm: float | None


@dataclass(frozen=True, eq=False)
class Answer:
    """Answer of a report: what to do (action), how much it gains, and which errors remain."""

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
        """Whether the teach pendant needs no conversion: zero-offsets are set one joint at a time.

        If so, each joint is mastered at the pendant's 0, and the pendant counts angles as the URDF
        does. True also if there is nothing to set.
        """
        return all(len(group) == 1 and group[0].is_plain for group in self.on_the_pad)

    @property
    def slides(self) -> bool:
        """Whether the arm has a prismatic joint."""
        return any(row.unit == 'mm' for row in self.offsets)

    @property
    def left_alone(self) -> list[str]:
        """Names, on the teach pendant, of the joints not to be set as their offset is unknown.

        'A4 (joint_4)' if that name differs from the URDF's; [] if there are none.
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
        """Names of the files in the folder ``apply`` for the action; [] unless it is 'set'.

        The robot model is among them only if `loads_model`.
        """
        if self.action != 'set':
            return []
        return [name for name in ALL_FILES if self.loads_model or name != MODEL_FILE]


def answer_of(inputs: Inputs) -> Answer:
    """Return action, gain and remaining errors for a session and its results.

    The stages are the errors today, with offsets, and with what further can be used: causes,
    if all are errors of the measurement that are taken out, or a robot model, if it makes the
    mean error clearly smaller (`NOTICEABLE_GAIN`). The rows judged are those of `judged_rows`.
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
    """Return the mastering steps on the teach pendant for offsets, in groups of coupled joints.

    ``offsets``: of each joint of the session's arm, in order.
    """
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


def all_taken_out(found: Discovered | None) -> bool:
    """Whether all causes of a discovery are certain errors of the measurement, none of the arm.

    False without a discovery, without causes, or if its verdict is 'undetermined'.
    """
    return (
        found is not None
        and found.verdict != 'undetermined'
        and bool(found.effects)
        and all(effect.is_taken_out for effect in found.effects)
    )


def _stages(inputs: Inputs) -> list[tuple[str, FloatArray]]:
    """Title, and errors of all rows, mm, (n,), at each stage: today, zero-offsets, then more.

    If all causes are certain errors of the measurement, one more stage has these taken out. Else
    there is one with the robot model, if there is one, and one with all causes, if any.
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
    """Return the action of a report, and a sentence with its reason ('' for 'set').

    'wait' if the fit's judgement is bad, or if a cause of the arm happened at one moment;
    'nothing' if no offset is identifiable, or if the mean error before is below
    `NOTICEABLE_GAIN` (1.1) times that after; else 'set': set the offsets. ``effects``: causes
    found, [] if there are none; ``before, after``: mean errors without and with offsets, mm.
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
    """Return the noise of each sensor, those of unknown noise left out.

    As estimated with the causes if there is a discovery, else as the fit assumes it.
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
    """Return the mood of a report: 'good', 'caution' or 'bad'.

    'bad' if the fit is judged bad. 'good' only if the fit's data do not disagree, a discovery, if
    there is one, is judged good, and either the fit is judged good and there are no causes, or all
    causes are in a robot model to be loaded (``loads_model``). ``may_be_good``: whether poses were
    held out and the action is not to wait; if not, 'caution' at best.
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
    """Return a sentence on the action and how much smaller it makes the mean error.

    ``joints``: number of identifiable offsets; ``brings``: index of the stage that the action
    reaches; ``measured``: titles of the measurement's errors; ``gross``: number of held-out
    gross errors that are not counted.
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
