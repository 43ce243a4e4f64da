# SPDX-License-Identifier: Apache-2.0
"""Changes of the set-up since the references were first measured: cause, time and size.

The references are measured twice at the beginning: the difference of the two rounds is the
repeatability of arm and sensor, the noise for all later differences. Each later round is compared
with the first ones by F tests; the probabilities of a false alarm of all rounds of a session add
up to the stated one (alpha spending: round r spends 6 / (π r)² of it). A cause is searched only
for a round that differs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from remaster_ros.collection.pairing import PairedReading
from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.planning.reference_choice import Cause, Place, causes
from remaster_ros.planning.tour_order import nearest_solution
from remaster_ros.types import FloatArray, IntArray, Session

FALSE_ALARM = 0.01
"""Probability of any alarm in a session without a change."""
STOP_M = 0.5e-3
"""Default size of a change that stops a collection, m."""
LEAST_STD_M = 2e-6
"""Best repeatability of sensor and arm, m."""
FEWEST_FREEDOMS = 6
"""Fewest degrees of freedom for a sensor's noise."""
LOOKS_ALIKE = 6.0
"""Difference of information criteria (odds of 20) below which two causes look the same."""
UNEXPLAINED_P = 1e-4
UNEXPLAINED_SHARE = 0.05
"""Largest share of the displacements that a cause may leave, as the error of linearisation."""
Noise = tuple[float, int]
"""Standard deviation per axis, m, and its degrees of freedom."""
Displacements = Mapping[tuple[int, tuple[int, str]], FloatArray]
"""Round, reference and sensor -> measured minus nominal marker position in R, m, (3,)."""


def changes(
    session: Session, chain: SerialChain, T_R_N: Mapping[str, FloatArray]
) -> tuple[int, list[SetupChange]]:
    """Number of rounds of the references, and the changes that they show.

    Each change is returned once, as found by the last round that shows it; 0 and [] without
    references. ``T_R_N``: registrations, sensor -> (4, 4).
    """
    m = session.references
    if m is None:
        return 0, []
    readings = [
        ReferenceReading(
            session.sensor_names[m.sensor[i]],
            session.marker_names[m.marker[i]],
            float(m.stamp_s[i]),
            m.q[i],
            m.position[i],
            m.std[i] if np.all(np.isfinite(m.std[i])) else None,
            max(int(m.samples[i]), 1),
            configuration=int(m.configuration[i]),
        )
        for i in range(len(m))
    ]
    watch = ReferenceWatch(chain, session.markers)
    found = replay(watch, readings, session.measurements.configuration.tolist(), T_R_N)
    last = {(change.subject, change.after): change for change in found}
    return watch.rounds, list(last.values())


def replay(
    watch: ReferenceWatch,
    readings: Sequence[ReferenceReading],
    other_configurations: Sequence[int],
    T_R_N: Mapping[str, FloatArray],
) -> list[SetupChange]:
    """Changes found by the references of a recorded session, round by round.

    ``readings``: in the order measured; ``other_configurations``: numbers of the configurations
    that are not references, in any order.
    """
    other = np.sort(np.asarray(other_configurations, dtype=int))
    found: list[SetupChange] = []
    for i, reading in enumerate(readings):
        if i:
            between = (readings[i - 1].configuration, reading.configuration)
            if np.ptp(np.searchsorted(other, between)) > 0:
                watch.end_round()
        if watch.rounds and watch.begins_round(reading):
            change = watch.judge(T_R_N)
            found += [change] if change is not None else []
        watch.add(reading)
    change = watch.judge(T_R_N)
    return found + ([change] if change is not None else [])


@dataclass(frozen=True, kw_only=True)
class ReferenceReading(PairedReading):
    """Reading at a reference; `configuration` is the configuration's number in the session."""

    configuration: int


@dataclass(frozen=True)
class SetupChange:
    """Change of the set-up: which part moved, when, and how far."""

    # ``sensor``, ``base``, ``marker``, ``tool``, ``joint``, or ``unexplained`` (no one cause) or
    # ``unsteady`` (the references do not repeat from the first)
    kind: str
    subject: str  # Name of the changed part, for people
    drifts: bool  # True if the change grows with time, False if it came at once
    size_m: float  # Largest displacement of a marker at a reference
    turn_rad: float | None  # Rotation of sensor, base, tool or joint; None without one: a slide
    # Configurations before and after the change: the last unchanged one (None if changed from the
    # first) and the first changed one
    after: int | None
    before: int
    p_value: float  # p-value of the round that showed the change
    look_alikes: tuple[str, ...] = ()  # Other subjects that explain the same readings

    def describe(self) -> str:
        """Sentence on the change: what changed, between which configurations, size, look-alikes.

        Size: largest displacement at the references, mm, and the turn, if any. Look-alikes:
        the other causes that explain the same readings; left out if there are none.
        """
        turn = ''
        if self.turn_rad is not None:
            turn = f' and turned by {np.rad2deg(self.turn_rad) * 60:.1f} arc minutes'
            if self.kind == 'joint':
                turn = f' ({np.rad2deg(self.turn_rad):.4f} degrees)'
        how = ', growing with time,' if self.drifts else ''
        since = f'between configurations {self.after} and {self.before}'
        if self.after is None:
            since = f'up to configuration {self.before}'
        alike = f'; it looks the same as: {", ".join(self.look_alikes)}' * bool(self.look_alikes)
        size = f'the references are off by up to {1e3 * self.size_m:.2f} mm{turn}'
        return f'{self.subject}{how} {since}: {size}{alike}'


@dataclass
class ReferenceRound:
    """Readings of one visit to the references, by reference and sensor."""

    rows: dict[tuple[int, str], ReferenceReading] = field(default_factory=dict)
    judged: bool = False
    alarmed: bool = False

    @property
    def configurations(self) -> list[int]:
        """Numbers of the measured configurations in the session."""
        return [row.configuration for row in self.rows.values()]


class ReferenceWatch:
    """Detector of changes of the set-up, by the rounds of visits to reference configurations.

    ``chain``: the arm as drawn, for its own part of the displacement between two visits,
    within its repeatability; ``markers``: nominal positions in the tool frame, m, (3,);
    ``stop_m``: largest difference of the first two rounds that can show later changes, m.
    Attributes: ``change``: last change found since the beginning or `accept`; None without a
    change.
    """

    def __init__(
        self,
        chain: SerialChain,
        markers: Mapping[str, FloatArray],
        stop_m: float = STOP_M,
        false_alarm: float = FALSE_ALARM,
    ) -> None:
        self._chain, self._stop_m, self._false_alarm = chain, stop_m, false_alarm
        self._markers = {name: np.asarray(place, float) for name, place in markers.items()}
        self._references: list[FloatArray] = []
        # One marker of each sensor: markers of a frame have common errors, and each has the error
        # of its own nominal position.
        self._followed: dict[str, str] = {}
        self._rounds: list[ReferenceRound] = []
        self._open = False
        self._begin = 0
        self._begins: set[int] = set()
        self._tests = 0
        self.change: SetupChange | None = None

    @property
    def rounds(self) -> int:
        """Number of rounds of visits to the references that have begun."""
        return len(self._rounds)

    def add(self, reading: ReferenceReading) -> None:
        """Add a reading; a second one at a reference in this round begins the next round.

        Only the marker that a sensor has measured first counts.
        """
        if self._followed.setdefault(reading.sensor, reading.marker) != reading.marker:
            return
        if self.begins_round(reading):
            self._rounds.append(ReferenceRound())
            self._open = True
        key = self._key(reading)
        if key[0] == len(self._references):
            self._references.append(np.asarray(reading.q, float))
        self._rounds[-1].rows[key] = reading

    def begins_round(self, reading: ReferenceReading) -> bool:
        """Whether `add` would begin another round with a reading."""
        if self._followed.get(reading.sensor, reading.marker) != reading.marker:
            return False
        return not self._open or self._key(reading) in self._rounds[-1].rows

    def _key(self, reading: ReferenceReading) -> tuple[int, str]:
        """Number of a reading's reference (a new one if none is near), and its sensor.

        From 0 in the order of the first visits; near as in `nearest_solution`.
        """
        known = None
        if self._references:
            units = JointUnits.of(self._chain)
            known = nearest_solution(np.array(self._references), reading.q, units)
        return len(self._references) if known is None else known, reading.sensor

    def end_round(self) -> None:
        """End the round, as the arm goes elsewhere: the next reading begins another one."""
        self._open = False

    def accept(self) -> None:
        """Use the next round as the new normal state: a person has checked the change.

        `change` is None then; after ``unsteady`` all rounds before are forgotten.
        """
        if self.change is not None and self.change.kind == 'unsteady':
            # Repeatability is still to be found.
            self._rounds = []
        self._begin, self._open, self.change = len(self._rounds), False, None
        self._begins.add(self._begin)

    def judge(self, T_R_N: Mapping[str, FloatArray]) -> SetupChange | None:
        """Judge the last round, unless it was judged before; return `change`, None without one.

        Of the first two rounds only whether they repeat is judged. ``T_R_N``: sensor -> its
        frame in R, (4, 4); a first registration is good enough, since only differences count.
        A sensor without one is not judged.
        """
        number = len(self._rounds) - 1
        if number < 0 or self._rounds[number].judged:
            return self.change
        off = {
            (i, key): self._displacement(row, T_R_N[row.sensor])
            for i, reference_round in enumerate(self._rounds)
            for key, row in reference_round.rows.items()
            if row.sensor in T_R_N
        }
        found = {name: self._noise(name, off) for name in T_R_N}
        noise = {name: level for name, level in found.items() if level is not None}
        self._rounds[number].judged = True
        if number == 1:
            return self._unsteady(noise)
        if number < 2 or number <= self._begin:
            return self.change
        self._tests += 1
        alpha = self._false_alarm * 6.0 / (np.pi * self._tests) ** 2
        p_value = self._p_value(number, noise, off)
        self.change = None
        if p_value < alpha:
            self.change = self._explain(number, noise, off, p_value)
        self._rounds[number].alarmed = self.change is not None
        return self.change

    # Noise

    def _noise(self, sensor: str, off: Displacements) -> Noise | None:
        """Noise of a sensor: std per axis, m, and degrees of freedom; None if unknown yet.

        By the differences of successive rounds: of the first two, and of later ones in which
        no change was found and between which none was accepted. Unknown with fewer than
        `FEWEST_FREEDOMS` differences (each axis counts). A slow drift hardly changes them, so
        that it is not taken for noise. The std is at least the standard error of a mean over a
        dwell by its own scatter, and `LEAST_STD_M`. ``off``: measured minus nominal marker
        positions, m, by round, reference and sensor.
        """
        quiet = [r.judged and not r.alarmed for r in self._rounds]
        steps = [
            i
            for i in range(1, self.rounds)
            if i == 1 or (quiet[i - 1] and quiet[i] and i not in self._begins)
        ]
        pairs = [
            (i, key)
            for i in steps
            for key in self._rounds[i].rows
            if key[1] == sensor and (i - 1, key) in off
        ]
        differences = np.array([off[i, key] - off[i - 1, key] for i, key in pairs])
        if differences.size < FEWEST_FREEDOMS:
            return None
        read = [self._rounds[j].rows[key] for i, key in pairs for j in (i - 1, i)]
        mean_variances = [
            np.mean(row.std**2) / max(row.samples, 1) for row in read if row.std is not None
        ]
        least = float(np.mean(mean_variances)) if mean_variances else 0.0
        variance = max(float(np.mean(differences**2)) / 2.0, least, LEAST_STD_M**2)
        # Successive differences share readings: each further one counts two thirds.
        first = 3 * sum(i == 1 for i, _ in pairs)
        return float(np.sqrt(variance)), first + int((differences.size - first) * 2 / 3)

    def _unsteady(self, noise: Mapping[str, Noise]) -> SetupChange | None:
        """Change ``unsteady`` if the first two rounds differ too much to show later changes.

        They do if the largest noise of a sensor times sqrt(6) (three axes, two rounds) is `stop_m`
        or more. Sets `change`; None if not, or without a noise.
        """
        if not noise:
            return None
        sensor, (std, _) = max(noise.items(), key=lambda item: item[1][0])
        if np.sqrt(6.0) * std < self._stop_m:
            return None
        self.change = SetupChange(
            'unsteady',
            f'{sensor} and the arm do not repeat: something is loose, or was moved,',
            False,
            float(np.sqrt(6.0) * std),
            None,
            None,
            max(self._rounds[1].configurations),
            0.0,
        )
        return self.change

    def _displacement(self, row: ReferenceReading, T_R_N: FloatArray) -> FloatArray:
        """Measured minus nominal marker position of a reading, in the robot base R, m, (3,)."""
        nominal = self._chain.positions(row.q, self._markers[row.marker])
        return np.asarray(transforms.apply(T_R_N, row.position) - nominal)

    def _place(self, row: ReferenceReading) -> Place:
        """Marker and sensor of a reading as a `Place`."""
        return Place(row.q, row.sensor, row.marker, self._markers[row.marker])

    # Changes

    def _p_value(
        self,
        number: int,
        noise: Mapping[str, Noise],
        off: Displacements,
    ) -> float:
        """p-value of the hypothesis that a round equals the first ones; 1.0 without any of these.

        Of several tests, in two groups: one for each sensor, of all its differences; and one
        for each cause, of the part of all differences that it explains, which finds a change
        in one direction much sooner. The result is the smaller of 2 × (smallest p-value ×
        number of tests) of the groups (Bonferroni; it may exceed 1). ``number``: index of the
        round; ``noise``: by sensor; sensors that are missing in it are left out; ``off``:
        measured minus nominal marker positions, m.
        """
        first = [self._begin] if self._begin else [0, 1]
        places, stds, scaled = [], [], []
        for key, row in self._rounds[number].rows.items():
            before = [off[i, key] for i in first if (i, key) in off]
            if row.sensor in noise and before:
                stds.append(noise[row.sensor][0] * np.sqrt(1.0 + 1.0 / len(before)))
                scaled.append((off[number, key] - np.mean(before, axis=0)) / stds[-1])
                places.append(self._place(row))
        if not places:
            return 1.0
        std, z = np.array(stds), np.array(scaled)
        sensor_p_values, single = [], []
        for sensor, (_, freedoms) in noise.items():
            selection = z[[place.sensor == sensor for place in places]]
            if len(selection):
                sensor_p_values.append(
                    scipy.stats.f.sf(np.mean(selection**2), selection.size, freedoms)
                )
        freedoms = min(freedoms for _, freedoms in noise.values())
        for cause in causes(self._chain, places):
            signal = (cause.jacobian / std[:, None, None]).reshape(z.size, -1)
            basis, size, _ = np.linalg.svd(signal, full_matrices=False)
            basis = basis[:, size > 1e-9 * max(size[0], 1e-300)]
            if basis.shape[1]:
                explained = float(np.sum((basis.T @ z.ravel()) ** 2))
                single.append(
                    scipy.stats.f.sf(explained / basis.shape[1], basis.shape[1], freedoms)
                )
        return 2.0 * min(min(tests) * len(tests) for tests in (sensor_p_values, single) if tests)

    def _explain(
        self,
        number: int,
        noise: Mapping[str, Noise],
        displacements: Displacements,
        p_value: float,
    ) -> SetupChange:
        """Change with the cause and the time that explain the rounds best (by BIC).

        ``kind`` is 'unexplained' if the best leaves too much (`UNEXPLAINED_P`,
        `UNEXPLAINED_SHARE`). Causes within `LOOKS_ALIKE` of it are look-alikes; a drift must be
        better by that than a step. ``number``: index of the round; ``noise``: by sensor;
        ``p_value``: of `_p_value`, kept in the change.
        """
        rounds = range(self._begin, number + 1)
        keys = [
            key
            for key in sorted(self._rounds[number].rows)
            if key[1] in noise and any(key in self._rounds[i].rows for i in rounds if i != number)
        ]
        rows = [
            (i, g) for i in rounds for g, key in enumerate(keys) if key in self._rounds[i].rows
        ]
        group = np.array([g for _, g in rows])
        at = np.array([i for i, _ in rows])
        read = [self._rounds[i].rows[keys[g]] for i, g in rows]
        scale = np.array([1.0 / noise[row.sensor][0] for row in read])[:, None]
        off = np.array([displacements[i, keys[g]] for i, g in rows])
        y = _centered(off, group) * scale
        stamps = np.array([row.stamp_s for row in read])
        places = [self._place(self._rounds[number].rows[key]) for key in keys]
        steps = [i for i in rounds if i > self._begin and (i > 1 or self._begin)]
        patterns: list[tuple[int | None, FloatArray]] = [
            (i, (at >= i).astype(float)) for i in steps
        ]
        if len(steps) > 1:
            # With one later round a drift and a step look the same.
            span = max(float(np.ptp(stamps)), 1e-9)
            patterns.append((None, (stamps - stamps.min()) / span))
        fits: list[tuple[float, float, FloatArray, Cause, int | None]] = []
        data = max(y.size - 3 * len(keys), 2)
        known = min(freedoms for _, freedoms in noise.values())
        for cause in causes(self._chain, places):
            per_row = cause.jacobian[group]
            for step, course in patterns:
                x = _centered(course[:, None, None] * per_row, group) * scale[..., None]
                flat = x.reshape(-1, x.shape[-1])
                theta, _, rank, _ = np.linalg.lstsq(flat, y.ravel(), rcond=None)
                chi2 = float(np.sum((y.ravel() - flat @ theta) ** 2))
                # A Student t, because the noise is an estimate itself.
                score = (known + data) * np.log1p(chi2 / known) + rank * np.log(data)
                score += LOOKS_ALIKE if step is None else 0.0
                fits.append((score, chi2, theta, cause, step))
        score, chi2, theta, cause, step = min(fits, key=lambda fit: fit[0])
        freedoms = max(data - len(theta), 1)
        poor = scipy.stats.f.sf(chi2 / freedoms, freedoms, known)
        share = np.sqrt(chi2 / max(float(np.sum(y**2)), 1e-300))
        first_new = number if step is None else step
        earlier = [c for i in range(first_new) for c in self._rounds[i].configurations]
        after, before = max(earlier, default=None), min(self._rounds[first_new].configurations)
        if step is None:
            after = max(self._rounds[self._begin].configurations)
        if poor < UNEXPLAINED_P and share > UNEXPLAINED_SHARE:
            last = {g: off[j] for j, (i, g) in enumerate(rows) if i == number}
            first = {g: off[j] for j, (i, g) in reversed(list(enumerate(rows)))}
            size = max(float(np.linalg.norm(last[g] - first[g])) for g in last)
            subject = 'something changed that no single cause explains'
            return SetupChange('unexplained', subject, False, size, None, after, before, p_value)
        alike = {
            other.subject
            for value, _, _, other, _ in fits
            if value < score + LOOKS_ALIKE and other.subject != cause.subject
        }
        size = float(np.max(np.linalg.norm(cause.jacobian @ theta, axis=-1)))
        turned = theta[cause.shifts :]
        return SetupChange(
            cause.kind,
            cause.subject,
            step is None,
            size,
            float(np.linalg.norm(turned)) if len(turned) else None,
            after,
            before,
            p_value,
            tuple(sorted(alike)),
        )


def _centered(values: FloatArray, group: IntArray) -> FloatArray:
    """Values (n, ...) less the mean of their group, to remove each group's unknown constant.

    ``group``: number of each value's group, (n,), from 0.
    """
    count = np.bincount(group)
    total = np.zeros((len(count), *values.shape[1:]))
    np.add.at(total, group, values)
    mean = total / count.reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(values - mean[group])
