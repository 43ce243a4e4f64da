"""What to do after a fit and a search for causes, what it brings, and what remains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from remaster_ros.calibration.gauge_words import listed
from remaster_ros.calibration.noise_check import MEAN_LENGTH
from remaster_ros.calibration.outliers import LARGEST_SHARE
from remaster_ros.compensation.export import LAYER_FILE, MODEL_FILE, REMASTER_FILE, URDF_FILE
from remaster_ros.compensation.mastering import MasteringStep, mastering
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_quaternion_xyzw, transform
from remaster_ros.reports.answer_inputs import Inputs, all_taken_out
from remaster_ros.reports.discovery_schema import Effect
from remaster_ros.reports.judgement import NOTICEABLE_GAIN
from remaster_ros.reports.remaining import Remaining, what_remains
from remaster_ros.reports.schemas import JointOffset, Judgement
from remaster_ros.types import BoolArray, FloatArray, Session

ALL_FILES = (REMASTER_FILE, URDF_FILE, LAYER_FILE, MODEL_FILE)
Mood = Literal['good', 'caution', 'bad']


class Stage(NamedTuple):
    """The 3-D errors of the judged rows at one stage, mm.

    Attributes
    ----------
    title
        What is corrected.
    errors
        Of the judged rows, mm, (m,).
    """

    title: str
    errors: FloatArray

    @property
    def mean(self) -> float:
        """Mean, mm."""
        return float(self.errors.mean())

    @property
    def most(self) -> float:
        """What 95 % of the rows stay below, mm."""
        return float(np.quantile(self.errors, 0.95))

    @property
    def largest(self) -> float:
        """Largest, mm."""
        return float(self.errors.max())


class SensorNoise(NamedTuple):
    """The mean 3-D error that a sensor's noise makes, mm.

    Attributes
    ----------
    reading_mm
        Of one reading.
    shared_mm
        With what all readings of a pose have in common; None where that is not known.
    """

    sensor: str
    reading_mm: float
    shared_mm: float | None


@dataclass(frozen=True, eq=False)
class Answer:
    """The first screen.

    Attributes
    ----------
    mood, headline
        The judgement: 'good' where held-out poses bear out all of it.
    action
        'set' the offsets, 'wait' with them, or 'nothing' has to be set.
    uses_causes
        The offsets are those of the model with the causes: all lie in the measurement.
    loads_model
        The deed is to load the robot model with all lengths, tilts and zero-offsets.
    stages
        From today on, each with more corrected.
    brings
        Index of the stage that the deed reaches.
    final_mm
        The error of every row there, (n,).
    held_out
        The stages are judged by poses that were never fitted.
    not_counted
        Of their readings so many are gross errors, by which no stage is judged.
    noise
        Of every sensor for which it is known.
    remains
        What the deed leaves.
    offsets
        Of every joint.
    on_the_pad
        What to do on the robot's pad, in its own numbers, in groups of coupled joints.
    pad_names
        Joint of the URDF -> its name on the pad, where that is known.
    """

    mood: Mood
    headline: str
    action: Literal['set', 'wait', 'nothing']
    uses_causes: bool
    loads_model: bool
    stages: tuple[Stage, ...]
    brings: int
    final_mm: FloatArray
    held_out: bool
    not_counted: int
    noise: tuple[SensorNoise, ...]
    remains: tuple[Remaining, ...]
    offsets: tuple[JointOffset, ...]
    on_the_pad: tuple[tuple[MasteringStep, ...], ...]
    pad_names: Mapping[str, str]

    @property
    def plain_pad(self) -> bool:
        """Whether the pad has the URDF's joints and degrees, each set where it is to show 0."""
        return all(len(group) == 1 and group[0].is_plain for group in self.on_the_pad)

    @property
    def slides(self) -> bool:
        """Whether the arm has a joint that slides."""
        return any(row.unit == 'mm' for row in self.offsets)

    @property
    def left_alone(self) -> list[str]:
        """The joints to leave as they are, by their names on the pad: their zeros are unknown."""
        told = {step.joint for group in self.on_the_pad for step in group}
        return [
            called if called == row.joint else f'{called} ({row.joint})'
            for row in self.offsets
            if not row.identifiable and row.joint not in told
            for called in [self.pad_names.get(row.joint, row.joint)]
        ]

    @property
    def files(self) -> list[str]:
        """The files that belong to the deed, in the folder ``apply``."""
        if self.action != 'set':
            return []
        return [name for name in ALL_FILES if self.loads_model or name != MODEL_FILE]


def answer_of(inputs: Inputs) -> Answer:
    """Return what to do, what it brings, and what remains."""
    fit, found = inputs.fit, inputs.found
    effects = found.effects if found is not None else []
    judged, held_out = judged_rows(inputs)
    not_counted = int(inputs.session.measurements.is_validation.sum()) - int(judged.sum())
    rows = _stages(inputs)
    stages = tuple(Stage(text, errors[judged]) for text, errors in rows)
    uses_causes = inputs.causes_mm is not None and all_taken_out(found)
    loads_model = (
        inputs.model_mm is not None
        and not uses_causes
        and stages[1].mean > NOTICEABLE_GAIN * stages[2].mean
    )
    brings = 2 if uses_causes or loads_model else 1
    offsets = found.joint_offsets_after if uses_causes and found else fit.joint_offsets
    action, reason = _action(
        inputs.judgement, effects, stages[0].mean, stages[brings].mean, offsets
    )
    known = sum(row.identifiable for row in offsets)
    pad = inputs.session.controller
    measured = [e.title for e in effects if uses_causes]
    return Answer(
        mood=_mood(inputs, loads_model, held_out and action != 'wait'),
        headline=reason
        or _headline(
            known, stages, brings, held_out, measured, loads_model, not_counted if held_out else 0
        ),
        action=action,
        uses_causes=uses_causes,
        loads_model=loads_model,
        stages=stages,
        brings=brings,
        final_mm=rows[brings][1],
        held_out=held_out,
        not_counted=not_counted if held_out else 0,
        noise=_noise(inputs),
        remains=tuple(what_remains(inputs, loads_model, held_out)),
        offsets=tuple(offsets),
        on_the_pad=_on_the_pad(inputs.session, offsets),
        pad_names={} if pad is None else {name: joint.name for name, joint in pad.joints.items()},
    )


def _on_the_pad(
    session: Session, offsets: Sequence[JointOffset]
) -> tuple[tuple[MasteringStep, ...], ...]:
    return mastering(
        session.controller,
        SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link, sliding=True),
        np.array([row.mean_and_std[0] for row in offsets]),
        np.array([row.mean_and_std[1] for row in offsets]),
        np.array([row.identifiable for row in offsets]),
    )


def judged_rows(inputs: Inputs) -> tuple[BoolArray, bool]:
    """Return the rows that the stages are judged by, (n,), and whether they were held out."""
    m = inputs.session.measurements
    if m.is_validation.any():
        gross = m.is_validation & np.isin(m.observation, inputs.gross)
        # So many are no single errors: something changed there, or the model does not hold.
        if gross.sum() > max(1.0, LARGEST_SHARE * m.is_validation.sum()):
            return m.is_validation, True
        return m.is_validation & ~gross, True
    return ~np.isin(m.observation, list(inputs.fit_left_out)), False


def _stages(inputs: Inputs) -> list[tuple[str, FloatArray]]:
    """Return title and errors of all rows, mm, at each stage."""
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
    effects: list[Effect],
    before: float,
    after: float,
    offsets: list[JointOffset],
) -> tuple[Literal['set', 'wait', 'nothing'], str]:
    """Return what to do, and where it is not to set the offsets, why."""
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
    """Return the noise of the final model where there is one, else what the fit counts on."""
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
    """Return 'good' only where the fit, the discovery and the held-out poses all agree."""
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
    loads_model: bool,
    not_counted: int,
) -> str:
    """Return the deed and its gain; ``measured`` is what was found of the measurement."""
    before, after = stages[0], stages[brings]
    deed = f'Set the zero-offsets of {joints} joint{"s" if joints > 1 else ""}'
    if loads_model:
        deed = 'Load the robot model with all lengths, tilts and zero-offsets'
    where = 'poses that were never fitted' if held_out else 'the fitted poses'
    if not_counted:
        where += f' ({not_counted} gross error{"s" if not_counted > 1 else ""} not counted)'
    if measured:
        # That part of the errors was never the arm's.
        return (
            f'{deed}: with them the mean error on {where} is {after.mean:.3f} mm, once the '
            f'measuring error ({listed(measured)}) is taken out; the {before.mean:.3f} mm of '
            'today contain it.'
        )
    times = before.mean / max(after.mean, 1e-9)
    return (
        f'{deed}: the mean error on {where} falls from {before.mean:.3f} mm to {after.mean:.3f} '
        f'mm, {times:.{1 if times < 10 else 0}f} times smaller.'
    )


def registrations(inputs: Inputs) -> dict[str, FloatArray]:
    """Return T_R_N of every sensor as fitted, (4, 4)."""
    return {
        sensor: transform(
            matrix_from_quaternion_xyzw(np.array(frame.rotation_xyzw)),
            np.array(frame.translation_m),
        )
        for sensor, frame in inputs.fit.registration.items()
    }
