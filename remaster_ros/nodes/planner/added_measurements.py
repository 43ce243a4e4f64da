# SPDX-License-Identifier: Apache-2.0
"""Measurements after a complete collection, which separate causes from look-alikes.

/remaster/discover looks for causes; if it leaves look-alikes, the next /remaster/collect measures
the configurations that separate them, at most `MOST_ADDED` in a session.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.separating_design import MOST_ADDED
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.files import read_limited
from remaster_ros.session.records.plan_journal import PlanJournal
from remaster_ros.session.records.reader import OBSERVATIONS_LIMIT, ROWS, read_session
from remaster_ros.types import FloatArray

DISCOVER = '/remaster/discover'


class AddedMeasurements:
    """Decides which measurements are added to a complete collection to separate causes.

    ``discovery``: folder of the optimizer's discovery, with the causes; '' for no additions.
    """

    def __init__(
        self, discovery: str, session: Path, journal: PlanJournal, tours: TourPlanner
    ) -> None:
        self._discovery, self._session = discovery, session
        self._journal, self._tours = journal, tours

    def next_plan(self, state: str, *, under_way: bool) -> tuple[str | None, partial[Tour] | None]:
        """Return why no measurements are added now, and a function that plans those to be added.

        If measurements are added, '' and the function, which takes the registrations, sensor
        -> (4, 4), and returns the tour. If none are, the reason and None. If the collection is
        not complete, '' and None while earlier additions are being measured (``under_way``),
        else None and None. ``state``: of the planner's run.
        """
        if state != 'complete':
            return '' if under_way else None, None
        if self._journal.tour is not None and self._journal.tour.inspection:
            return 'it was no calibration; name a new session folder', None
        # Imported when needed, since the import is slow.
        from remaster_ros.reports.fit_json import DISCOVERY_FILE
        from remaster_ros.reports.found_causes import read_causes

        path = Path(self._discovery) / DISCOVERY_FILE
        if not self._discovery or not path.exists():
            return f'{DISCOVER} looks for causes, and collect measures what they leave open', None
        try:
            causes = read_causes(path, observations_sha256=self._digest())
        except InputError as error:
            return str(error), None
        most = MOST_ADDED - self._added_so_far()
        if most <= 0:
            return f'{MOST_ADDED} configurations were measured to separate causes already', None
        return '', partial(self._plan, causes, most)

    def _digest(self) -> str:
        """Return the SHA-256 of the session's table of observations, as hexadecimal text.

        Raises InputError if the table is missing or larger than `OBSERVATIONS_LIMIT`.
        """
        rows = read_limited(self._session / ROWS, OBSERVATIONS_LIMIT, 'it is part of a session')
        return hashlib.sha256(rows).hexdigest()

    def _added_so_far(self) -> int:
        """Return the number of configurations to fit in all tours of additions so far."""
        return sum(tour.to_fit for tour in self._journal.tours if tour.begin_at)

    def _plan(
        self, causes: tuple[FoundCause, ...], most: int, T_R_N: Mapping[str, FloatArray]
    ) -> Tour:
        """Return the tour that separates `causes`, of at most `most` configurations.

        ``T_R_N``: registrations, sensor -> (4, 4). Raises as `TourPlanner.separating_tour`.
        """
        previous = self._journal.tour
        assert previous is not None
        rows = read_session(self._session).measurements
        return self._tours.separating_tour(T_R_N, causes, rows, previous, most)

    def describe_tour(self, tour: Tour) -> str:
        """Return a tour's counts of poses and its expected precision in one line.

        For a tour of additions, in place of the precision, how far it separates the causes
        (`describe`). No precision without an optimal design.
        """
        design = self._tours.design_result
        expected = '' if design is None else design.describe()
        if tour.begin_at:
            expected = self.describe()
        return '; '.join(filter(None, (tour.describe(), expected)))

    def describe(self) -> str:
        """Return as text how far the additions separate causes from their look-alikes.

        Separations are in standard deviations, before and expected. '' if none were planned.
        """
        design = self._tours.separating_design
        if design is None:
            return ''
        sentences = [
            f'{pair.cause} and {pair.look_alike}: {pair.before:.1f} standard deviations apart, '
            f'{pair.after:.1f} expected'
            for pair in design.pairs
        ]
        sentences += [
            f'no poses of this cell separate {sentence}' for sentence in design.otherwise
        ]
        return ('' if design.order else 'nothing to measure: ') + '; '.join(sentences)
