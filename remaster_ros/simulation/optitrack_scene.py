# SPDX-License-Identifier: Apache-2.0
"""Scene of the fake OptiTrack system: frames of the markers in world time, with faults."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from remaster_ros.sensors.optitrack.natnet_bytes import (
    Vec3,
    Version,
)
from remaster_ros.sensors.optitrack.natnet_frame import (
    HAS_MODEL,
    MEASURED,
    MODEL_FILLED,
    OCCLUDED,
    TRACKING_VALID,
    UNLABELED,
    Frame,
    LabeledMarker,
    RigidBody,
)
from remaster_ros.sensors.optitrack.natnet_model import (
    MarkerSetDescription,
    ModelDefinition,
    RigidBodyDescription,
)
from remaster_ros.simulation.faults import Numbers
from remaster_ros.simulation.world import World
from remaster_ros.types import FloatArray

JUMP_M = 0.5
_GARBAGE_BYTES = 300


class FrameFaults:
    """Applies injected faults to the frames of the fake OptiTrack server before they are sent."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._frozen: tuple[LabeledMarker, ...] | None = None
        self._late: deque[Frame] = deque()
        self._previous: Frame | None = None
        self._begins_at: Frame | None = None

    def spoil(self, frame: Frame, faults: Numbers) -> Iterator[Frame | bytes]:
        """Yield the frames or raw bytes to be sent in place of a frame, or nothing.

        ``faults``: fault -> number, as in `faults.OF_OPTITRACK`. 'late' and 'reordered' keep
        frames for later calls, 'frozen' and 'renumbered' the first frame with the fault.
        """
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
            if self._previous is None:
                self._previous = frame
            else:
                yield frame
                yield self._previous
                self._previous = None
        else:
            yield frame
            if 'duplicate' in faults:
                yield frame


CLOCK_HZ = 10_000_000
"""Ticks per second of the server's fine clock, as on usual Windows hosts."""
_MARKER_SIZE_M = 0.0127
_RESIDUAL_M = 2e-4
_FIRST_STRAY_ID = 50_001
_FLAGS_BEFORE_3 = OCCLUDED | MEASURED | MODEL_FILLED
_HIDDEN = (
    OCCLUDED | HAS_MODEL,
    OCCLUDED | MODEL_FILLED | HAS_MODEL,
    MODEL_FILLED | HAS_MODEL,
)
"""Flags of a marker that no camera sees: at the last position, or at the model's guess."""


@dataclass(frozen=True)
class OptiTrackBehaviour:
    """Settings of the fake camera bar; the defaults are an OptiTrack Trio."""

    # Rigid body of the tool. Its member 1 is the calibration marker.
    rigid_body: str = 'tool'
    body_id: int = 1
    # Further markers of the world's sensor, by name, with their numbers in the body
    further: Mapping[str, int] = field(default_factory=dict)
    # Members 2, 3, … if there are no further markers: offsets from the calibration marker along
    # the sensor's axes, m. These members move with the marker and do not turn with the tool: no
    # program here uses the body's rotation.
    companions: tuple[Vec3, ...] = ((0.06, 0.0, 0.0), (0.0, 0.05, 0.0), (0.04, 0.03, 0.02))
    # Reflections at fixed places in the sensor frame, m
    strays: tuple[Vec3, ...] = ((0.8, -0.5, 2.4), (-0.7, 0.4, 2.9))
    # Standard deviation of a position across the line of sight (sensor x, y) and along it (z)
    noise_across_m: float = 25e-6
    noise_along_m: float = 100e-6
    # Rate at which one of the followed markers is hidden, and mean duration (exponential
    # distributions), in world time
    occlusions_per_s: float = 0.0
    occlusion_s: float = 0.3
    # Standard deviation per axis of the model's guess at a hidden marker
    guess_error_m: float = 2e-3


class OptiTrackScene:
    """Frames of marker data of a fake camera bar, from the hidden world.

    ``sensor``: the bar's name in the world.
    """

    def __init__(
        self,
        world: World,
        sensor: str,
        rng: np.random.Generator,
        behaviour: OptiTrackBehaviour,
    ) -> None:
        self._world = world
        self._sensor = sensor
        self._rng = rng
        self._behaviour = behaviour
        self._start_s = world.now()
        self._further = behaviour.further
        first = world.marker_in_sensor(sensor, self._start_s)
        further = [
            world.marker_in_sensor(sensor, self._start_s, name) - first for name in self._further
        ]
        self._offsets = np.array([(0.0, 0.0, 0.0), *(further or behaviour.companions)])
        self._strays = np.reshape(np.array(behaviour.strays, dtype=float), (-1, 3))
        members = [1, *(self._further.values() or range(2, len(self._offsets) + 1))]
        stray_labels = range(_FIRST_STRAY_ID, _FIRST_STRAY_ID + len(self._strays))
        self._labels = (*(behaviour.body_id << 16 | m for m in members), *stray_labels)
        across, along = behaviour.noise_across_m, behaviour.noise_along_m
        self._noise = np.array([across, across, along])
        self._occlusion = (self._start_s, self._start_s)
        self._plan_occlusion(self._start_s)
        self._hidden_params: int | None = None
        # Index of the followed marker that is hidden, if not all are.
        self._hidden_place = 0
        self._guess_error = np.zeros(3)
        self._last_seen = np.zeros_like(self._offsets)

    @property
    def model(self) -> ModelDefinition:
        """Descriptions of the rigid body and of its marker sets.

        The body's marker positions are about their mean, m, as at the start.
        """
        behaviour = self._behaviour
        names = tuple(f'{behaviour.rigid_body}_{i + 1}' for i in range(len(self._offsets)))
        body = RigidBodyDescription(
            name=behaviour.rigid_body,
            id=behaviour.body_id,
            marker_positions=_tuples(self._offsets - self._offsets.mean(axis=0)),
            marker_labels=(0,) * len(self._offsets),
            marker_names=names,
        )
        return ModelDefinition(
            (
                MarkerSetDescription(behaviour.rigid_body, names),
                MarkerSetDescription('all', names),
                body,
            )
        )

    def frame(self, number: int, version: Version, t: float | None = None) -> Frame:
        """Frame of marker data that is sent at world time t, s, or now if t is None.

        With a camera's timing it shows the world some time before. Noise and occlusions are
        drawn in each call. ``number``: of the frame; ``version``: bitstream of the server:
        NatNet 2 has fewer flags and no residual.
        """
        behaviour, size = self._behaviour, len(self._offsets)
        sent_s = self._world.now() if t is None else t
        timing = self._world.camera(self._sensor)
        t = sent_s if timing is None else sent_s - timing.late_s
        tracked = self._world.line_of_sight(self._sensor, t)
        hidden_params = self._hidden(t, tracked)
        points = self._rng.standard_normal((len(self._labels), 3))
        points *= self._noise
        points[size:] += self._strays
        seen = points[:size]
        truth = self._offsets + self._world.marker_in_sensor(self._sensor, t)
        for place, name in enumerate(self._further, 1):
            truth[place] = self._world.marker_in_sensor(self._sensor, t, name)
        seen += truth
        params = [MEASURED | HAS_MODEL] * size + [MEASURED | UNLABELED] * len(self._strays)
        if hidden_params is not None:
            hidden = [self._hidden_place] if tracked else list(range(size))
            guessed = bool(hidden_params & MODEL_FILLED)
            seen[hidden] = (truth + self._guess_error if guessed else self._last_seen)[hidden]
            for place in hidden:
                params[place] = hidden_params
        faults = self._world.faults(self._sensor)
        if 'hidden' in faults:
            place = self._label_index(faults['hidden'])
            seen[place], params[place] = self._last_seen[place], OCCLUDED | HAS_MODEL
        if 'exchanged' in faults:
            pair = [0, self._label_index(faults['exchanged'])]
            seen[pair] = seen[pair[::-1]]
        self._last_seen = seen

        old = version < (3, 0)
        if old:
            params = [flags & _FLAGS_BEFORE_3 for flags in params]
        residual = None if old else _RESIDUAL_M
        positions = _tuples(points)
        tool, strays = positions[:size], positions[size:]
        labeled = tuple(
            LabeledMarker(label, position, _MARKER_SIZE_M, flags, residual)
            for label, position, flags in zip(self._labels, positions, params, strict=True)
        )
        body = RigidBody(
            behaviour.body_id,
            tuple((seen.sum(axis=0) / size).tolist()),  # type: ignore[arg-type]
            (0.0, 0.0, 0.0, 1.0),
            _RESIDUAL_M,
            TRACKING_VALID if tracked else 0,
            tuple((p, i, _MARKER_SIZE_M) for i, p in enumerate(tool, 1)) if old else (),
        )
        stamped_s = sent_s if timing is None else sent_s - timing.latency_s
        ticks = self.ticks(stamped_s)
        return Frame(
            number=number,
            timestamp=self._by_its_clock(stamped_s),
            labeled_markers=labeled,
            rigid_bodies=(body,),
            marker_sets=((behaviour.rigid_body, tool), ('all', tool)),
            other_markers=strays,
            data_received=ticks,
            transmitted=self.ticks(self._world.now()),
        )

    def ticks(self, t: float) -> int:
        """Server's fine clock at world time t, s, in ticks of `CLOCK_HZ`.

        It began 1000 s before the scene, as on a real host, and has the camera's drift.
        """
        return round((self._by_its_clock(t) + 1000.0) * CLOCK_HZ)

    def _by_its_clock(self, t: float) -> float:
        """Time since the start by the server's clock, which may drift, s, at world time t, s."""
        timing = self._world.camera(self._sensor)
        return (t - self._start_s) * (1.0 if timing is None else 1.0 + timing.drift)

    def _hidden(self, t: float, tracked: bool) -> int | None:
        """Flags of a marker that is hidden at world time t, s; None if none is hidden.

        ``tracked``: whether the line of sight is free. If it is not, all markers are hidden,
        else the one of index ``_hidden_place``. At the beginning of an occlusion its flags,
        this index, and the error of a guessed position are drawn; after its end the next one
        is planned.
        """
        start, end = self._occlusion
        if t >= end:
            self._plan_occlusion(end)
            start, end = self._occlusion
        faults = self._world.faults(self._sensor)
        if 'filled' in faults:
            self._hidden_params = MODEL_FILLED | HAS_MODEL
        elif 'occluded' in faults:
            self._hidden_params = OCCLUDED | HAS_MODEL
        elif tracked and not start <= t < end:
            self._hidden_params = None
        elif self._hidden_params is None:
            self._hidden_params = int(self._rng.choice(_HIDDEN))
            if self._further:
                self._hidden_place = int(self._rng.integers(len(self._offsets)))
            self._guess_error = self._rng.normal(0.0, self._behaviour.guess_error_m, 3)
        return self._hidden_params

    def _label_index(self, number: float) -> int:
        """Index in `_labels` of the rigid body's marker with this number.

        Raises ValueError if there is none.
        """
        return self._labels.index(self._behaviour.body_id << 16 | int(number))

    def _plan_occlusion(self, after_s: float) -> None:
        """Draw start and end of the next occlusion after a time, s; never if the rate is 0."""
        rate = self._behaviour.occlusions_per_s
        if rate <= 0:
            self._occlusion = (math.inf, math.inf)
            return
        start = after_s + self._rng.exponential(1.0 / rate)
        self._occlusion = (start, start + self._rng.exponential(self._behaviour.occlusion_s))


def _tuples(points: FloatArray) -> tuple[Vec3, ...]:
    """Points (n, 3) as plain tuples."""
    return tuple(map(tuple, points.tolist()))
