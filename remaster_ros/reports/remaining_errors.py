# SPDX-License-Identifier: Apache-2.0
"""Errors that remain after the action of a report, with their sizes and remedies."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from remaster_ros.calibration.gauge_words import counted, listed
from remaster_ros.discovery.words import clock_time
from remaster_ros.reports.discovery_judgement import FEW_HELD_OUT, more_than_noise
from remaster_ros.reports.fit_judgement import FEW_POSES
from remaster_ros.reports.report_inputs import Inputs
from remaster_ros.reports.schemas import Discovered
from remaster_ros.reports.sentences import at_marker, hardly_proven

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
    """Error that is left after a report's action: name, size in words, and remedy."""

    what: str
    size: str
    remedy: str

    @property
    def sentence(self) -> str:
        """'Name: size. Remedy' as one text; without size or remedy these parts are left out."""
        size = self.size.rstrip('.')
        return f'{self.what}{": " if size else ""}{size}. {self.remedy}'.rstrip()


def what_remains(inputs: Inputs, loads_model: bool, held_out: bool) -> list[Remaining]:
    """Return the errors that are left after a report's action, causes first; at least one.

    ``loads_model``: whether the action is to load the robot model, which corrects the causes
    in it; ``held_out``: whether poses were held out.
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
    """Return the causes of a discovery that remain, and its errors without a cause.

    At most 4 causes (`MOST_NAMED`); the smaller ones share one entry. ``loads_model``: leave
    out causes that the robot model corrects.
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
    """Return an entry on the number, sensors and time of the gross errors; None if they are few.

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
