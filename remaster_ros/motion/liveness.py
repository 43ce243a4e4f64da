# SPDX-License-Identifier: Apache-2.0
"""Which sensors are present: their nodes report, and report ready. Times are arguments."""

from __future__ import annotations

from collections.abc import Collection, Iterable

UNSEEN_S = 10.0
"""A node that has not reported at all may still be starting for so long, s."""
BACK_S = 1.0
"""Readings of a node that was started again may begin to arrive so much later than its reports."""


class Liveness:
    """Record of the sensors' reports and readings, which tells which sensors are absent.

    Parameters
    ----------
    sensors
        Their names.
    heartbeat_s
        A sensor whose node has reported, and then not for longer than this, is absent, s.
    streams
        Those that read all the time. One whose node was started (again) is absent until a reading
        has come: its readings may begin to arrive later than its reports.
    since_s
        When this process began to listen, s: for `UNSEEN_S` from then a required sensor counts as
        absent until its node has reported. By default, long ago.

    Attributes
    ----------
    readings
        Readings received, per sensor.
    reports
        Number of reports of each sensor's node; without those that never reported.
    """

    def __init__(
        self,
        sensors: Iterable[str],
        heartbeat_s: float,
        streams: Collection[str] = (),
        since_s: float = float('-inf'),
    ) -> None:
        self._heartbeat_s, self._streams, self._since_s = heartbeat_s, streams, since_s
        self._started: dict[str, str] = {}
        self._back: dict[str, float] = {}
        self._new: set[str] = set()
        self._seen: dict[str, float] = {}
        self._trouble: dict[str, str] = {}
        self._read: dict[str, float] = {}
        self.readings = dict.fromkeys(sensors, 0)
        self.reports: dict[str, int] = {}

    def node_reports(
        self,
        sensor: str,
        ready: bool,
        message: str,
        now_s: float,
        started: str = '',
        hidden: bool = False,
    ) -> None:
        """Process a report of a sensor's node.

        Parameters
        ----------
        sensor
            Its name; other sensors are ignored.
        ready, message
            Whether it can measure, and what is wrong if not.
        now_s
            Now, s.
        started
            Another text after each start of the node; '' if the node gives none.
        hidden
            The marker is out of its sight: no reading will come before the arm has moved on.
        """
        if sensor not in self.readings:
            return
        self._seen[sensor] = now_s
        self.reports[sensor] = self.reports.get(sensor, 0) + 1
        self._trouble[sensor] = '' if ready else message or 'not ready'
        before = self._started.get(sensor, '')
        if sensor in self._streams and started != before:
            self._new.add(sensor)
        elif started and before and started != before:
            self._back[sensor] = now_s
        self._started[sensor] = started
        if hidden:
            self._new.discard(sensor)

    def reads(self, sensor: str, now_s: float) -> None:
        """Count a reading of a sensor at `now_s`, s; it shows that a stream is there again.

        Raises KeyError for an unknown sensor.
        """
        self.readings[sensor] += 1
        self._read[sensor] = now_s
        self._new.discard(sensor)

    def read_age_s(self, sensor: str, now_s: float) -> float:
        """Time since the last reading, s; infinite if there was none.

        ``now_s``: now, by the clock of `reads`, s.
        """
        return now_s - self._read.get(sensor, float('-inf'))

    def absent(self, now_s: float, required: Collection[str] = ()) -> dict[str, str]:
        """Return why each absent sensor counts as absent, by name; {} if none is.

        Absent: its node was silent for more than `heartbeat_s` after a report, reports that it
        is not ready, or, of a stream, was started and has had no reading since. A sensor whose
        node has never reported is not absent, because a bag may hold readings alone. One that
        is ``required`` is also absent while its node may still be starting (`UNSEEN_S`,
        `BACK_S`). ``now_s``: now, s.
        """
        why = {}
        for name in self.readings:
            reason = self._why(name, now_s)
            if not reason and name in required:
                reason = self._why_unsure(name, now_s)
            if reason:
                why[name] = reason
        return why

    def _why(self, name: str, now_s: float) -> str:
        """Why a sensor is absent (silent, not ready, no reading since its start), or ''.

        '' also if its node has never reported.
        """
        if name not in self._seen:
            return ''
        if now_s - self._seen[name] > self._heartbeat_s:
            return f'its node has been silent for {self._heartbeat_s:g} s'
        if name in self._new:
            return self._trouble[name] or 'no reading since its node was started'
        return self._trouble[name]

    def _why_unsure(self, name: str, now_s: float) -> str:
        """Why it is too early to count on a sensor, or ''.

        Either there is no report and no reading of it yet, within `UNSEEN_S` of the begin of
        listening; or its node was restarted less than `BACK_S` ago. ``now_s``: now, s.
        """
        unseen = name not in self._seen and name not in self._read
        if unseen and now_s - self._since_s < UNSEEN_S:
            return 'its node has not reported yet'
        if now_s - self._back.get(name, float('-inf')) < BACK_S:
            return 'its node has just been started again'
        return ''
