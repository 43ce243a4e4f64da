"""What both OptiTrack clients have in common: the thread, the markers, counts and diagnosis."""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.optitrack.diagnosis import (
    Diagnosis,
    StreamStatus,
    diagnose,
)
from remaster_ros.sensors.optitrack.frame_gate import (
    Dropped,
    GateCounts,
    MarkerGate,
    MarkerSample,
)
from remaster_ros.sensors.optitrack.frame_source import Source, SourceLock, SourceVerdict, describe
from remaster_ros.sensors.optitrack.protocol.frames import Frame
from remaster_ros.sensors.optitrack.protocol.natnet import encode_echo_request
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.sensors.optitrack.sockets import interface_towards, port_is_closed, resolve

FOREIGN_REMEMBERED = 4

_log = logging.getLogger('remaster_ros')


class MarkerFollower(ABC):
    """Follows the markers of one rigid body of an OptiTrack server in a thread of its own.

    Each marker is judged by itself: one that is hidden, filled in by the model or jumps is NaN
    in a frame of which others are seen. Where none is, there is no reading at all.

    Parameters
    ----------
    settings
        How to reach the server, and which markers to follow.
    on_sample
        Called in the thread with every reading, those of a frame one after the other. What it
        raises is logged.
    clock
        Gives the time at which a datagram arrived, s.
    """

    def __init__(
        self,
        settings: NatNetSettings,
        on_sample: Callable[[MarkerSample], object],
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._settings = settings
        self._on_sample = on_sample
        self._clock = clock
        self._status = StreamStatus()
        self._gate = MarkerGate(settings.marker, self._status)
        self._further = {
            name: MarkerGate(choice, GateCounts())
            for name, choice in settings.choices().items()
            if name
        }
        self._lock = SourceLock(settings.silence_s)
        self._believed_before: Source | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._ready = threading.Event()

        self._frame_at: float | None = None
        self._sample_at: float | None = None

    def start(self, wait_s: float = 0.0) -> None:
        """Open the sockets and begin; the client keeps trying until `stop`.

        Parameters
        ----------
        wait_s
            How long to wait for the first frame and the marker's identity, s (wall clock); 0
            returns at once.

        Raises
        ------
        DeviceError
            If a socket cannot be opened, or nothing useful came within `wait_s`; the message
            is that of `diagnosis`. The client is stopped then.
        """
        settings = self._settings
        self._status.server_ip = resolve(settings.server)
        self._status.interface = settings.local_interface or interface_towards(
            self._status.server_ip, settings.command_port
        )
        self._stopping.clear()
        self._ready.clear()
        self._open()
        self._thread = threading.Thread(target=self._run, name='natnet', daemon=True)
        self._thread.start()
        if wait_s and not self._ready.wait(wait_s):
            message = self.diagnosis().message or 'frames come, but no reading of the marker'
            self.stop()
            raise DeviceError(f'OptiTrack: {message}')

    def stop(self) -> None:
        """End the thread and close the sockets; may be repeated."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close()

    def __enter__(self) -> MarkerFollower:
        """Start without waiting."""
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop."""
        self.stop()

    def status(self) -> StreamStatus:
        """Return a snapshot of counts and of what the server has answered."""
        now = time.monotonic()
        return replace(
            self._status,
            dropped=dict(self._status.dropped),
            silent_s=None if self._frame_at is None else now - self._frame_at,
            starved_s=None if self._sample_at is None else now - self._sample_at,
            source='' if self._lock.source is None else describe(self._lock.source),
            sources_taken=self._lock.taken,
            rivals=tuple(map(describe, self._lock.rivals(now)[:FOREIGN_REMEMBERED])),
            contestants=tuple(map(describe, self._lock.contestants(now)[:FOREIGN_REMEMBERED])),
        )

    def further_counts(self) -> dict[str, GateCounts]:
        """Return the counts of each further marker, by name."""
        return {name: gate.counts for name, gate in self._further.items()}

    def diagnosis(self) -> Diagnosis:
        """Return what is wrong when readings are missing, and the remedy."""
        return diagnose(self.status(), self._settings)

    @abstractmethod
    def _open(self) -> None:
        """Open what `_run` needs; raise `DeviceError`, and leave nothing open then."""

    @abstractmethod
    def _run(self) -> None:
        """Work until `_stopping` is set."""

    @abstractmethod
    def _close(self) -> None:
        """Close what is open."""

    def _is_foreign(self, address: str) -> bool:
        """Count and remember a sender that is not the server."""
        if address == self._status.server_ip:
            return False
        self._gate.drop(Dropped.FOREIGN)
        if address not in self._status.foreign and len(self._status.foreign) < FOREIGN_REMEMBERED:
            self._status.foreign = (*self._status.foreign, address)
        return True

    def _is_refused(self, source: Source) -> bool:
        """Count what comes from a port of the server that is not the believed one."""
        if not self._lock.is_refused(source, time.monotonic()):
            return False
        self._gate.drop(Dropped.FOREIGN)
        return True

    def _release_silent_source(self) -> bool:
        """Free the lock after a silence; the server must answer before it is given again."""
        holder = self._lock.source
        if holder is None or not self._lock.release_if_silent(time.monotonic()):
            return False
        _log.warning(
            'OptiTrack: no frame from %s for %g s; whose frames are believed is decided anew',
            describe(holder),
            self._settings.silence_s,
        )
        return True

    def _note_closed_port(self) -> None:
        """Find out whether the server's computer is there without its command port."""
        self._status.port_closed = port_is_closed(
            self._status.server_ip, self._settings.command_port, encode_echo_request(0)
        )

    def _note_malformed(self, what: object) -> None:
        self._gate.drop(Dropped.MALFORMED)
        self._status.last_malformed = str(what)

    def _name_assets(self, assets: Mapping[str, int]) -> None:
        """Find the markers' ids among the rigid bodies that the server streams, by name."""
        for gate in (self._gate, *self._further.values()):
            gate.name_assets(assets)

    def _take_whole_frame(
        self, frame: Frame, received_s: float, source: Source
    ) -> list[MarkerSample]:
        """Account for a frame that decoded to its end, and find its readings."""
        now = time.monotonic()
        before = self._lock.source
        verdict = self._lock.judge(source, now)
        if verdict is SourceVerdict.FOREIGN:
            self._gate.drop(Dropped.FOREIGN)
            return []
        if verdict is SourceVerdict.PROBATION:
            self._gate.pass_over(Dropped.PROBATION)
            return []
        if before is None:
            self._begin_source(source)
        self._status.last_malformed = ''
        self._frame_at = now
        connection = self._status.server.connection if self._status.server is not None else None
        ticks_per_s = connection.clock_frequency if connection is not None else 0
        found = {
            name: gate.admit(frame, received_s, ticks_per_s)
            for name, gate in {'': self._gate, **self._further}.items()
        }
        if self._gate.resolved:
            self._ready.set()
        seen = next(filter(None, found.values()), None)
        if seen is None:
            return []
        # A message for every marker: whoever listens to several topics then knows, by the stamps
        # alone, that nothing of a frame is still to come.
        hidden = replace(seen, position=np.full(3, np.nan), residual_m=np.nan)
        return [replace(sample or hidden, marker=name) for name, sample in found.items()]

    def _begin_source(self, source: Source) -> None:
        """Report whose frames are believed from now on."""
        before, self._believed_before = self._believed_before, source
        if before is not None and before != source:
            for gate in (self._gate, *self._further.values()):
                gate.begin_source()
            _log.warning(
                'OptiTrack: frames of %s are believed from now on, before it was %s',
                describe(source),
                describe(before),
            )
        else:
            _log.info('OptiTrack: frames of %s are believed', describe(source))

    def _hand_on(self, sample: MarkerSample) -> None:
        self._sample_at = time.monotonic()
        try:
            self._on_sample(sample)
        except Exception:
            _log.exception('a reading of the OptiTrack marker could not be handed on')
