# SPDX-License-Identifier: Apache-2.0
"""Time of each configuration in motion, settling, measuring and software."""

from __future__ import annotations

import numpy as np

from remaster_ros.collection.events import (
    ConfigurationEnded,
    Event,
    PoseAnnounced,
    ShotMeasured,
    SolutionCommanded,
    SolutionSettled,
    State,
)


class ConfigurationTimes:
    """Times of configurations, from the nodes' events.

    Motion, settling and measuring are world time. Measuring is the time of the slowest
    instrument: the dwell of a stream, or search and integration of a laser tracker. Software is
    wall time: from the bridge's report that the arm has settled to its next command, less the
    measuring. ``rate``: world time over wall time.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._instrument_s = 0.0
        self._open: dict[tuple[str, int], dict[str, float]] = {}
        self._last: dict[str, float] | None = None
        self._registration: set[str] = set()
        self.rows: list[dict[str, float]] = []

    def add(self, event: Event | State) -> None:
        """Add the times in an event; others than those of configurations are ignored.

        Configurations of a registration do not count.
        """
        match event:
            case PoseAnnounced(split='registration', stamp=stamp):
                self._registration.add(stamp)
            case SolutionCommanded(stamp=stamp, solution=solution, since_settled_wall_s=since_s):
                if self._last is not None:
                    self._last['until_command'] = since_s
                self._last = None
                if stamp not in self._registration:
                    # After a registration pose there is planning, which does not count.
                    self._last = self._open.setdefault((stamp, solution), {})
            case SolutionSettled(stamp=stamp, solution=solution):
                if (row := self._open.get((stamp, solution))) is not None:
                    row.update(motion=event.motion_s, settle=event.settle_s)
            case ShotMeasured(instrument_wall_s=wall_s):
                self._instrument_s = wall_s * self._rate
            case ConfigurationEnded(stamp=stamp, solution=solution, measuring_s=float(reading_s)):
                if (row := self._open.get((stamp, solution))) is not None:
                    row['measuring'] = max(reading_s, self._instrument_s)
                    self._instrument_s = 0.0
                    self.rows.append(row)

    def columns(self) -> dict[str, np.ndarray]:
        """Return the times of complete configurations by name, s, (n,); n = 0 if there are none.

        Names are motion, settle and measuring, in world time, and software, in wall time.
        """
        needed = ('motion', 'settle', 'measuring', 'until_command')
        rows = [row for row in self.rows if all(name in row for name in needed)]
        table = {name: np.array([row[name] for row in rows]) for name in needed}
        # A reading begins when the arm stands, slightly before the bridge's report of it.
        software = table.pop('until_command') - table['measuring'] / self._rate
        return {**table, 'software': np.maximum(software, 0.0)}
