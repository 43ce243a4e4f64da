"""What the deed of a report leaves: causes, gross errors, data that disagree, and the remedy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from remaster_ros.calibration.gauge_words import listed
from remaster_ros.discovery.words import clock_time
from remaster_ros.reports.answer_inputs import Inputs
from remaster_ros.reports.discovery_judgement import more_than_noise
from remaster_ros.reports.discovery_schema import Discovered

# Fewer gross errors are in the table of left-out rows alone.
FEWEST_GROSS, LEAST_SHARE = 3, 0.01
# In place of a remedy that is a file: it is beside the page only where it belongs to the deed.
NO_FILE = (
    'No robot model beside this page holds it: correcting it brings no noticeable gain beside the '
    'zero-offsets, or the page says to set nothing.'
)
# The first screen names so many causes, with so many sizes each; all of them stand below.
MOST_NAMED, MOST_SIZES = 4, 2


class Remaining(NamedTuple):
    """Something that the deed leaves: its name, its size in words, and what to do."""

    what: str
    size: str
    remedy: str

    @property
    def sentence(self) -> str:
        """All of it."""
        size = self.size.rstrip('.')
        return f'{self.what}{": " if size else ""}{size}. {self.remedy}'.rstrip()


def what_remains(inputs: Inputs, loads_model: bool, held_out: bool) -> list[Remaining]:
    """Return what the deed leaves, the causes first."""
    found, judgement = inputs.found, inputs.judgement
    rows = [] if found is None else _of_discovery(found, loads_model)
    if found is None and (lines := judgement.findings or judgement.doubts):
        rows.append(
            Remaining(
                'More than noise' if judgement.findings else 'Not shown to be noise',
                lines[0],
                'Search for its cause: remaster discover SESSION --out DIR, then give DIR to '
                'remaster report.'
                if judgement.findings
                else '',
            )
        )
    elif found is not None and not rows:
        # Causes have answered the findings of the fit without them.
        left = more_than_noise(found)
        if not left and not found.effects:
            left = next(iter(judgement.findings), '')
        if left:
            rows.append(
                Remaining(
                    'More than noise',
                    f'{left.rstrip(".")}. No cause that was tried explains it',
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
    if not rows:
        words = (
            'every cause was tried, and none explains more of what is left than chance does'
            if found is not None
            else 'what is left is what noise explains'
        )
        rows.append(Remaining('Noise', '. '.join([words, *judgement.doubts[:1]]), ''))
    return rows


def _of_discovery(found: Discovered, loads_model: bool) -> list[Remaining]:
    """Return the causes that stay, and what has none."""
    rows: list[Remaining] = []
    stay = [e for e in found.effects if not (loads_model and e.in_robot_model)]
    for effect in stay[:MOST_NAMED]:
        sizes = effect.sizes if isinstance(effect.sizes, list) else []
        size = '; '.join(sizes)
        if len(sizes) > MOST_SIZES and isinstance(effect.size_m, float):
            size = f'{1e3 * effect.size_m:.3f} mm RMS at the marker'
        remedy = effect.remedy if isinstance(effect.remedy, str) else ''
        remedy = NO_FILE if effect.in_robot_model else remedy
        rows.append(Remaining(effect.title, size, remedy))
    if more := stay[MOST_NAMED:]:
        largest = max(e.size_m for e in more if isinstance(e.size_m, float))
        size = f'up to {1e3 * largest:.3f} mm RMS at the marker'
        name = f'{len(more)} smaller cause{"s" if len(more) > 1 else ""}'
        rows.append(Remaining(name, size, 'See below.'))
    if found.verdict == 'undetermined':
        remedy = 'Measure what the look-alikes below call for.'
        rows.append(Remaining('Undecided', 'another explanation fits as well', remedy))
    if isinstance(found.unexplained, list):
        rows += [
            Remaining('Unexplained', f'{1e3 * left.size_m:.3f} mm RMS', left.next)
            for left in found.unexplained
        ]
    return rows


def _gross(inputs: Inputs) -> Remaining | None:
    """Return how many readings are gross errors, of which sensors and when; None of few."""
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
