"""Which sensors are there: heard from lately, and ready by their own word; times are arguments."""

from __future__ import annotations

from collections.abc import Collection, Iterable

UNSEEN_S = 10.0
"""A node that has not been heard at all may still be starting for so long, s."""
BACK_S = 1.0
"""What a node that was started again publishes may find its way so much later than its word, s."""


class Liveness:
    """Follow the signs of life of sensors.

    Parameters
    ----------
    sensors
        Their names.
    heartbeat_s
        A sensor that was heard and then is silent for longer is absent, s.
    streams
        Those that read all the time. One whose node was started (again) is absent until a reading
        has come: what it publishes may find its way later than what it says.
    since_s
        When listening began, s: for `UNSEEN_S` from then a required sensor may be there though
        it has not been heard. As a rule, long ago.

    Attributes
    ----------
    readings
        Readings received, per sensor.
    words
        How often each sensor's node has been heard; none where it never was.
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
        self.words: dict[str, int] = {}

    def node_reports(
        self,
        sensor: str,
        ready: bool,
        message: str,
        now_s: float,
        started: str = '',
        hidden: bool = False,
    ) -> None:
        """Take the word of a sensor's node.

        Parameters
        ----------
        sensor
            Its name; a stranger's word is not heard.
        ready, message
            Whether it can measure, and what is wrong if not.
        now_s
            Now, s.
        started
            Tells one start of the node from the next; '' where it does not say.
        hidden
            It does not see its marker: no reading will come before the arm has moved on.
        """
        if sensor not in self.readings:
            return
        self._seen[sensor] = now_s
        self.words[sensor] = self.words.get(sensor, 0) + 1
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
        """Take note of a reading."""
        self.readings[sensor] += 1
        self._read[sensor] = now_s
        self._new.discard(sensor)

    def read_age_s(self, sensor: str, now_s: float) -> float:
        """Time since the last reading, s; infinite if there was none."""
        return now_s - self._read.get(sensor, float('-inf'))

    def absent(self, now_s: float, required: Collection[str] = ()) -> dict[str, str]:
        """Return why, for each sensor that is not there.

        A sensor that never said anything is none of them: a bag may hold readings alone. But as
        long as that means nothing yet, one that is ``required`` is.
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
        if name not in self._seen:
            return ''
        if now_s - self._seen[name] > self._heartbeat_s:
            return f'its node has been silent for {self._heartbeat_s:g} s'
        if name in self._new:
            return self._trouble[name] or 'no reading since its node was started'
        return self._trouble[name]

    def _why_unsure(self, name: str, now_s: float) -> str:
        unseen = name not in self._seen and name not in self._read
        if unseen and now_s - self._since_s < UNSEEN_S:
            return 'its node has not been heard yet'
        if now_s - self._back.get(name, float('-inf')) < BACK_S:
            return 'its node has just been started again'
        return ''
