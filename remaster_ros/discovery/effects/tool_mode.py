"""Mode of the tool: the tool swings behind its acceleration."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from remaster_ros.calibration.dynamics import MODES
from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced, needs_motion
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import number
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield one candidate: δp = -R diag(m) R' a - R diag(n) R' b, 3 parameters m and 3 n, s².

    m = 1/(2πf)² of the tool's first mode of frequency f along each axis of the tool, R: rotation
    of the tool. a: acceleration of the tool frame's origin; b: acceleration of the centre of the
    markers relative to that origin, to which n belongs likewise.
    """
    yield EFFECT.candidate(_swung, MODES)


def _swung(context: Context) -> Design:
    """Return columns of the marker displaced by the tool's swing, m per s², one for each of 6."""
    swing = context.motion.swing(context.markers.mean(axis=0))
    return displaced(*(swing[:, :, column] for column in range(len(MODES))))


def _frequency(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the frequency, Hz, at which the tool swings along its softest axis.

    ``draws``: of the parameters of `candidates`, s², (draws, 6); the softest has the largest
    mean of the first three.
    """
    axis = int(np.argmax(draws[:, :3].mean(axis=0)))
    softest = np.maximum(draws[:, axis], 1e-7)
    hertz = 1.0 / (2.0 * np.pi * np.sqrt(softest))
    shown = number(float(hertz.mean()), float(hertz.std()), ' Hz')
    return f'along {"xyz"[axis]} of the tool it swings at {shown}'


EFFECT = Effect(
    name='tool_mode',
    place='marker',
    driver='acceleration',
    form='linear',
    equation="δp = −R_T diag(m) R_T' a, m = 1/(2πf)², far below the mode's frequency f; "
    'a of the tool frame, and a share of that from there to the markers',
    source='Inman 2014, Engineering Vibration: base excitation below resonance',
    unit='s²',
    plausible=(1e-6, 5e-4),
    sentence='The tool swings behind its acceleration (a soft tool or mount).',
    separate_by='the same path at two speeds, and markers on the flange beside those of the tool',
    remedy='Stiffen the tool or its mount, or accelerate less where it must be exact.',
    size=_frequency,
    candidates=candidates,
    needs=needs_motion,
)
