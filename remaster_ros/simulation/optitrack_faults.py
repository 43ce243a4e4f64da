"""What becomes of the frames of a faulty OptiTrack server; the list is in `faults`."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from remaster_ros.sensors.optitrack.protocol.natnet import Frame, LabeledMarker
from remaster_ros.simulation.faults import Numbers

JUMP_M = 0.5
_GARBAGE_BYTES = 300


class FrameFaults:
    """Spoil frames on their way out.

    Parameters
    ----------
    rng
        Source of garbage.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._frozen: tuple[LabeledMarker, ...] | None = None
        self._late: deque[Frame] = deque()
        self._held: Frame | None = None
        self._begins_at: Frame | None = None

    def spoil(self, frame: Frame, faults: Numbers) -> Iterator[Frame | bytes]:
        """Return what is sent instead of a frame: frames, or bytes as they are."""
        if 'frozen' not in faults:
            self._frozen = None
        elif self._frozen is None:
            self._frozen = frame.labeled_markers
        else:
            frame = replace(frame, labeled_markers=self._frozen)
        if 'renumbered' not in faults:
            self._begins_at = None
        else:
            first = self._begins_at = self._begins_at or frame
            frame = replace(
                frame,
                number=frame.number - first.number,
                timestamp=frame.timestamp - first.timestamp,
            )
        if 'jumping' in faults and frame.number % 4 == 0:
            markers = tuple(
                LabeledMarker(m.id, (x + JUMP_M, y, z), m.size, m.params, m.residual)
                for m in frame.labeled_markers
                for x, y, z in [m.position]
            )
            frame = replace(frame, labeled_markers=markers)
        if 'stopped' in faults or 'off' in faults or frame.number % faults.get('slow', 1):
            return
        if 'garbage' in faults:
            yield self._rng.bytes(_GARBAGE_BYTES)
        elif 'late' in faults:
            self._late.append(frame)
            while self._late and frame.timestamp - self._late[0].timestamp >= faults['late']:
                yield self._late.popleft()
        elif 'reordered' in faults:
            if self._held is None:
                self._held = frame
            else:
                yield frame
                yield self._held
                self._held = None
        else:
            yield frame
            if 'duplicate' in faults:
                yield frame
