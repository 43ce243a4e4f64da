"""What the fake OptiTrack cameras see: the tool's markers, strays, noise and occlusion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from remaster_ros.sensors.optitrack.protocol.natnet import (
    HAS_MODEL,
    MEASURED,
    MODEL_FILLED,
    OCCLUDED,
    TRACKING_VALID,
    UNLABELED,
    BodyMarker,
    Frame,
    LabeledMarker,
    MarkerSet,
    MarkerSetDescription,
    ModelDefinition,
    RigidBody,
    RigidBodyDescription,
    Vec3,
    Version,
)
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.simulation.world import World

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
"""How a marker that no camera sees is streamed: the last position, or the model's guess."""


@dataclass(frozen=True)
class OptiTrackBehaviour:
    """How the fake camera bar behaves; the defaults are an OptiTrack Trio.

    Attributes
    ----------
    rigid_body, body_id
        The tool's rigid body. Its member 1 is the calibration marker.
    further
        Further markers of the world's sensor, by name, with their numbers in the body.
    companions
        Members 2, 3, … where there are no further markers: offsets from the calibration marker
        along the sensor's axes, m. They move with it and do not turn with the tool: no program
        here uses the body's rotation.
    strays
        Reflections at fixed places in the sensor frame, m.
    noise_across_m, noise_along_m
        Standard deviation of a position across the line of sight (sensor x, y) and along it (z).
    mid_exposure_clock
        Whether frames carry the time of exposure; USB cameras send 0.
    occlusions_per_s, occlusion_s
        How often one of the markers that are followed is hidden, and for how long on average
        (exponential distributions), in world time.
    guess_error_m
        Standard deviation per axis of the model's guess at a hidden marker.
    """

    rigid_body: str = 'tool'
    body_id: int = 1
    further: Mapping[str, int] = field(default_factory=dict)
    companions: tuple[Vec3, ...] = ((0.06, 0.0, 0.0), (0.0, 0.05, 0.0), (0.04, 0.03, 0.02))
    strays: tuple[Vec3, ...] = ((0.8, -0.5, 2.4), (-0.7, 0.4, 2.9))
    noise_across_m: float = 25e-6
    noise_along_m: float = 100e-6
    mid_exposure_clock: bool = False
    occlusions_per_s: float = 0.0
    occlusion_s: float = 0.3
    guess_error_m: float = 2e-3


class OptiTrackScene:
    """Makes the frames of data of a fake camera bar.

    Parameters
    ----------
    world
        The hidden world.
    sensor
        The bar's name in the world.
    rng
        Source of noise and occlusion.
    behaviour
        See `OptiTrackBehaviour`.
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
        # Which of the markers that are followed is hidden, where not all are.
        self._hidden_place = 0
        self._guess_error = np.zeros(3)
        self._last_seen = np.zeros_like(self._offsets)

    @property
    def model(self) -> ModelDefinition:
        """The rigid body and its marker sets."""
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

    def frame(self, number: int, version: Version) -> Frame:
        """Look at the world now.

        Parameters
        ----------
        number
            Frame number.
        version
            Bitstream of the server: NatNet 2 has fewer flags and no residual.
        """
        behaviour, size = self._behaviour, len(self._offsets)
        t = self._world.now()
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
            place = self._place_of(faults['hidden'])
            seen[place], params[place] = self._last_seen[place], OCCLUDED | HAS_MODEL
        if 'exchanged' in faults:
            pair = [0, self._place_of(faults['exchanged'])]
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
            tuple(BodyMarker(p, i, _MARKER_SIZE_M) for i, p in enumerate(tool, 1)) if old else (),
        )
        ticks = self.ticks(t)
        return Frame(
            number=number,
            timestamp=t - self._start_s,
            labeled_markers=labeled,
            rigid_bodies=(body,),
            marker_sets=(
                MarkerSet(behaviour.rigid_body, tool),
                MarkerSet('all', tool),
            ),
            other_markers=strays,
            mid_exposure=ticks if behaviour.mid_exposure_clock else 0,
            data_received=ticks,
            transmitted=self.ticks(self._world.now()),
        )

    def ticks(self, t: float) -> int:
        """Return the server's fine clock at world time t; as on a real host it began earlier."""
        return round((t - self._start_s + 1000.0) * CLOCK_HZ)

    def _hidden(self, t: float, tracked: bool) -> int | None:
        """Return the flags of the hidden marker; None while all are seen."""
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

    def _place_of(self, number: float) -> int:
        """Return where the marker of this number in the body is among the labels."""
        return self._labels.index(self._behaviour.body_id << 16 | int(number))

    def _plan_occlusion(self, after_s: float) -> None:
        rate = self._behaviour.occlusions_per_s
        if rate <= 0:
            self._occlusion = (math.inf, math.inf)
            return
        start = after_s + self._rng.exponential(1.0 / rate)
        self._occlusion = (start, start + self._rng.exponential(self._behaviour.occlusion_s))


def _tuples(points: FloatArray) -> tuple[Vec3, ...]:
    """Turn an array of points, (n, 3), into plain tuples."""
    return tuple(map(tuple, points.tolist()))
