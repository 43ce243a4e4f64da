# SPDX-License-Identifier: Apache-2.0
"""Sentences on single facts of a fit and its causes, equal on a terminal, a page and in a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.predictions import Coverage
from remaster_ros.compensation.export import APPLY_FOLDER, LAYER_FILE, REMASTER_FILE, URDF_FILE
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.words import called, part_words, percent, sentence_case
from remaster_ros.reports.schemas import FittedGeometry, Imitation, Loadable, MeasuredSession

if TYPE_CHECKING:
    from remaster_ros.types import Session

# Least ratio of errors that counts as a noticeable gain.
NOTICEABLE_GAIN = 1.1
# Least number of held-out poses that prove a gain.
FEWEST_HELD_OUT = 3
NOT_PROVEN = 'No poses were held out, so the gain is not proven: measure some, and run this again.'
NO_TIMES = 'without times, so nothing that changes with time can be seen'
# Titles of the metrics of fit.json.
METRICS = {
    'post_registration': 'position, sensor registered (eq. 18)',
    'post_registration_orientation': '… orientation',
    'relative': 'distances between solutions of a pose (eq. 17)',
    'relative_orientation': '… angles',
    'theoretical': 'what the posterior predicts (section V-C)',
    'paper_theoretical': '… in the robot base, offsets alone, as the paper has it',
    'theoretical_random': 'the same at 1,000 random configurations',
    'paper_theoretical_random': '… in the robot base, as the paper has it',
}
# A cause with more parameters, such as a curve, has one line in tables; discovery.json has all.
MOST_PARAMETERS = 8
_RESULTS = {
    'offsets': 'zero-offsets alone',
    'geometry': 'all lengths, tilts and zero-offsets together',
    'everything': 'everything that a command can correct',
}
_MORE = {
    'offsets': f', {REMASTER_FILE} or {LAYER_FILE}',
    'everything': ', by remaster compensate or remaster_ros.read_compensation',
}


def hardly_proven(held_out_poses: int) -> str:
    """Return a sentence that only one or two poses were held out; '' for none, or enough.

    Enough: `FEWEST_HELD_OUT`, 3.
    """
    if not 0 < held_out_poses < FEWEST_HELD_OUT:
        return ''
    return (
        f'Only {counted(held_out_poses, "pose")} {"was" if held_out_poses == 1 else "were"} held '
        'out, which proves little: hold out some ten.'
    )


def held_out_poses(session: Session) -> int:
    """Number of held-out poses of a session."""
    m = session.measurements
    return len(np.unique(m.pose[m.is_validation]))


def not_counted(gross: int) -> str:
    """Return a text such as '3 gross errors not counted'; ``gross``: their number."""
    return f'{counted(gross, "gross error")} not counted'


def times_smaller(before: float, after: float) -> str:
    """Return the ratio of an error before to that after as text, such as '9.0 times smaller'."""
    times = before / max(after, 1e-9)
    return f'{times:.{1 if times < 10 else 0}f} times smaller'


def counts_words(session: MeasuredSession) -> str:
    """Return the numbers of fitted and held-out observations as text.

    With those of their configurations and poses.
    """
    fitted, held_out = (
        f'({counts.configurations} configurations of {counts.poses} poses)'
        for counts in (session.optimization, session.validation)
    )
    return (
        f'{session.optimization.observations} observations fitted {fitted}, '
        f'{session.validation.observations} held out {held_out}'
    )


def at_marker(size_m: float) -> str:
    """Size of an error, m, as text: '0.123 mm RMS at the marker'."""
    return f'{1e3 * size_m:.3f} mm RMS at the marker'


def size_words(effect: FoundEffect) -> str:
    """Return the size of a cause, and the share of the gain that is lost without it, as text.

    Without the share if it is unknown; '' in files of other programs, which have no size.
    """
    if np.isnan(effect.size_m):
        return ''
    if effect.share is None:
        return at_marker(effect.size_m)
    lost = f'without it {percent(effect.share)} of the gain is lost'
    return f'{at_marker(effect.size_m)}, {lost}'


def look_alike_name(effect: FoundEffect, other: LookAlike) -> str:
    """Return the name of a cause's look-alike, beginning with a small letter.

    ``effect``: the cause; ``other``: its look-alike. 'joint 2 alone' if that is the same effect of
    fewer joints.
    """
    fewer = part_words(effect.name, effect.joints, other.name, other.joints)
    return fewer or sentence_case(other.title or called(other.name, other.joints))


def coverage_words(held_out: Coverage, gross: int) -> str:
    """Clause on the number of held-out rows that lie in their predicted 95 % regions.

    '' if there are none. ``gross``: number of held-out gross errors, which are not counted.
    """
    if held_out.share is None:
        return ''
    return (
        f'{held_out.inside} of {held_out.rows} held-out rows ({percent(held_out.share)}) lie in '
        'the regions predicted for them with 95 %' + (f'; {not_counted(gross)}' if gross else '')
    )


def std_remark(tolerance_m: float) -> str:
    """Return a sentence for files on what the standard deviations of offsets include.

    ``tolerance_m``: by how much links and axes may be off their drawing.
    """
    return (
        'The standard deviations contain what links and axes that are off their drawing by '
        f'{1e3 * tolerance_m:.2g} mm would do to the offsets.'
    )


def as_drawn(geometry: FittedGeometry, imitations: Sequence[Imitation]) -> str:
    """Return a clause on what links off their drawing add to the offsets' standard deviations.

    ``imitations``: lengths or tilts to name, each with the change of a joint's offset by it if it
    is off by the tolerance of ``geometry``.
    """
    moved = '; '.join(
        f'{"link" if imitation.cause == "link_length" else "the axis of joint"} {imitation.of} is '
        f'{imitation.shown} at {imitation.joint}'
        for imitation in imitations
    )
    return (
        'the standard deviations contain links and axes off their drawing: '
        f'{geometry.tolerance_mm:.2g} mm at {moved}'
    )


def loadable_of_fit(geometry: FittedGeometry) -> list[Loadable]:
    """Results of a fit that a robot can load: zero-offsets alone, then the robot model."""
    return [
        Loadable(
            'offsets', geometry.drawing_held_out_mean_mm, True, f'{APPLY_FOLDER}/{URDF_FILE}'
        ),
        Loadable('geometry', geometry.held_out_mean_mm, bool(geometry.file), geometry.file),
    ]


def load_words(row: Loadable) -> tuple[str, str]:
    """Return the name of a loadable result, and its file or why not to load it, as texts.

    Not to be loaded if it has no file, or held-out poses do not show that it is better than a
    plainer one.
    """
    file = f'{row.file}{_MORE.get(row.result, "")}'
    worse = row.result != 'offsets' and row.held_out_mean_mm is not None and not row.better
    if worse and row.result == 'everything' and row.file:
        # Better than the offsets alone, or the file would not hold it.
        what_to_do = f'only where no robot model can be loaded: {file}'
    elif worse:
        what_to_do = 'leave it: not clearly better than a plainer one'
    elif row.file:
        what_to_do = file
    elif row.held_out_mean_mm is None:
        what_to_do = 'leave it: no held-out poses show that it is better'
    else:
        what_to_do = 'leave it: no file holds it'
    return _RESULTS[row.result], what_to_do
